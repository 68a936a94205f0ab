"""Wrappers around environments, counts of states of whole numbers, and MiniGrid with both."""

import io
import runpy
from importlib import metadata
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text, Tuple
from shared import ROOT, Bonanza, play, refused

from mace_rl import CuriosityReward, load_agent, settings
from mace_rl.bonus.counts import HashedCountNovelty
from mace_rl.cli import main
from mace_rl.config.section import ConfigError
from mace_rl.environments.spaces import Spaces, is_discrete
from mace_rl.runs.finished import FinishedRun
from mace_rl.runs.provenance import identity
from mace_rl.runs.verify import repeat
from mace_rl.training.trainer import Trainer

DOOR = "MiniGrid-DoorKey-5x5-v0"
IMAGE = "minigrid.wrappers:ImgObsWrapper"
PIXELS = Box(0, 255, (2, 2, 3), np.uint8)


@pytest.mark.parametrize(
    ("space", "counted"),
    [
        *((space, True) for space in (Discrete(3), MultiBinary(4), MultiDiscrete([2, 3]), PIXELS)),
        (Dict({"a": PIXELS, "b": Discrete(4)}), True),
        (Tuple((Discrete(2), MultiBinary(1))), True),
        (Box(0, 1, (3,), np.float32), False),
        (Dict({"a": PIXELS, "b": Box(0, 1, (1,), np.float32)}), False),
    ],
)
def test_what_is_counted(space, counted, run_config, register):
    class Any(gymnasium.ObservationWrapper):
        observation_space = space

        def observation(self, observation):
            return space.sample()

    assert is_discrete(space) == counted
    name = register("Any-v0", lambda: Any(Bonanza()), 6)
    trainer = Trainer(run_config(name, "mace_fixed", 0, episodes=3))
    list(trainer.run())
    kind = type(trainer.curiosity.novelty).__name__
    counts = "CountNovelty" if isinstance(space, Discrete) else "HashedCountNovelty"
    assert kind == (counts if counted else "DensityNovelty")


def test_counts_against_a_dictionary():
    """Every visit counts 0.9 to the power of its age; asking is not visiting."""
    rng, seen = np.random.default_rng(0), []
    novelty = HashedCountNovelty(SimpleNamespace(count_decay=0.9))
    for episode in range(30):
        states = rng.integers(0, 3, (20, 2)).astype(np.float32)
        expected, own = [], {}
        for state in map(tuple, states.tolist()):
            own[state] = own.get(state, 0) + 1
            before = sum(0.9 ** (episode - age) for age, one in seen if one == state)
            expected.append(1 / (before + own[state]))
        np.testing.assert_allclose(novelty(states), expected)
        np.testing.assert_allclose(novelty(states), expected)
        earlier = {states[0].tobytes(): 2}
        assert novelty.continued(states[:1], earlier) == pytest.approx(1 / (1 / expected[0] + 2))
        novelty.observe(states)
        seen += [(episode, state) for state in map(tuple, states.tolist())]
        if episode == 15:
            again = HashedCountNovelty(SimpleNamespace(count_decay=0.9))
            again.load_state_dict(novelty.state_dict())
            novelty = again
    assert len(novelty.known) == 9


def test_whole_numbers_that_float32_does_not_tell_apart_get_a_warning(caplog):
    novelty = HashedCountNovelty(SimpleNamespace(count_decay=0.9))
    for size in (2**24 - 1, 2**24, 2**24):
        novelty.observe(np.array([[size, 0]], np.float32))
    assert [len(caplog.messages), "2^24" in caplog.text] == [1, True]


def test_the_environment_s_package_is_a_part_of_what_a_run_is(run_config):
    around = [{"wrapper": "gymnasium.wrappers:FilterObservation"}]
    around[0]["arguments"] = {"filter_keys": ["image", "direction"]}
    config = run_config(DOOR, "ppo", 0, environment_wrappers=around)
    own = {"minigrid": metadata.version("minigrid")}
    assert identity(config)["versions"] == identity(run_config())["versions"] | own


class Halved(gymnasium.RewardWrapper):
    """Half the reward, or another share."""

    def __init__(self, env, share=0.5):
        super().__init__(env)
        self.share = share

    def reward(self, reward):
        return self.share * float(reward)


def test_wrappers_go_around_the_environment_in_order(run_config):
    """Also around one that is otherwise played in compiled code."""
    plain = Trainer(run_config("CartPole-v1", "ppo", 0, episodes=2))
    around = [
        "test_minigrid:Halved",
        {"wrapper": "test_minigrid:Halved", "arguments": {"share": 3}},
    ]
    config = run_config("CartPole-v1", "ppo", 0, episodes=2, environment_wrappers=around)
    wrapped = Trainer(config)
    first, second = next(plain.run())[0], next(wrapped.run())[0]
    assert second.length == first.length and second.extrinsic_return == 1.5 * first.length
    assert wrapped.environment.env.share == 3 and wrapped.environment.env.env.share == 0.5
    assert config.references()["environment_wrappers.1"] == "test_minigrid:Halved"


@pytest.mark.parametrize(
    ("wrapper", "words"),
    [
        ("test_minigrid:Halve", ["has no 'Halve'"]),
        # An environment and no wrapper: it would be played in place of the one that is named.
        ("gymnasium.envs.classic_control:AcrobotEnv", ["a subclass of gymnasium.core.Wrapper"]),
        ({"wrapper": "test_minigrid:Halved", "arguments": {"part": 1}}, ["unexpected", "part"]),
    ],
)
def test_a_wrapper_that_cannot_be_made_gets_one_line(wrapper, words):
    with refused(ConfigError, r"environment_wrappers\.0 has ") as caught:
        Trainer(settings("CartPole-v1", "ppo", environment_wrappers=[wrapper]))
    assert all(word in str(caught.value) for word in words)


class Forgetful(gymnasium.Wrapper):
    """It does not say what it wraps."""

    def __init__(self, env):
        self.wrapped = env


def test_a_wrapper_s_mistake_is_said_to_be_that():
    config = settings("CartPole-v1", "ppo", environment_wrappers=["test_minigrid:Forgetful"])
    with pytest.raises(ConfigError, match=r"^environment 'CartPole-v1': AttributeError: "):
        list(Trainer(config).run())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("None.x", r"AttributeError: .*no attribute 'x' \(.*{module}.py:1\)"),
        ("raise SystemExit(3)", r"SystemExit: 3 \(.*{module}.py:1\)"),
    ],
)
def test_a_module_that_cannot_be_imported_gets_one_line(text, said, tmp_path, monkeypatch, request):
    module = f"broken_{request.node.callspec.indices['text']}"
    (tmp_path / f"{module}.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    with refused(ConfigError, said.replace("{module}", module)):
        settings(f"{module}:X-v0", "ppo")


def test_a_text_is_refused_with_the_way_out_and_left_out_of_the_wrapper_s_bonus():
    spaces = Dict({"a": PIXELS, "mission": Text(5)}), Discrete(2)
    with pytest.raises(ConfigError, match=r"observation\['mission'\] is of Text.*--wrapper"):
        Spaces("x", *spaces)
    assert Spaces("x", *spaces, in_part=True).observation_size == 12
    env = CuriosityReward(gymnasium.make(DOOR))
    played = play(env, 400)
    curious = [info["curiosity"] for *_, info in played]
    assert isinstance(played[-1][0]["mission"], str)
    assert max(curious) == 1 and min(curious) < 0.2
    assert isinstance(env.tracker.curiosity.novelty, HashedCountNovelty)
    other = CuriosityReward(gymnasium.make(DOOR))
    torch.save(env.state_dict(), buffer := io.BytesIO())
    buffer.seek(0)
    other.load_state_dict(torch.load(buffer))
    assert other.tracker.curiosity.novelty.known == env.tracker.curiosity.novelty.known


@pytest.mark.slow
def test_minigrid_trains_resumes_repeats_and_is_drawn(
    tmp_path, run_config, kill, checkpoint_every, completes, monkeypatch
):
    changes = {"episodes": 6, "max_episode_steps": 40, "environment_wrappers": [IMAGE]}
    config, folder = run_config(DOOR, "mace_full", 0, **changes), tmp_path / "run"
    checkpoint_every(1)
    kill(4, config, folder)
    (interruption,) = completes(config, folder)["interruptions"]
    assert interruption["after_episode"] == 3 and interruption["environment_replayed"]
    assert repeat(FinishedRun(folder, trust=True))[0]
    with pytest.raises(ConfigError, match=r"environment_wrappers.*give --trust"):
        load_agent(folder)
    assert load_agent(folder, trust=True).policy(np.zeros((7, 7, 3), np.uint8)).sample().shape == ()
    monkeypatch.setattr("sys.argv", ["mace-rl", "watch", str(folder), "--trust", "--seconds", "1"])
    main()
    assert (folder / "watch.gif").read_bytes()[:4] == b"GIF8"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["minigrid_sb3", "minigrid_cleanrl"])
def test_the_examples_train(name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [name, "--steps", "600"])
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
    assert "mean extrinsic return" in capsys.readouterr().out
    for option, value in (("--steps", "0"), ("--environment", "Nope-v0")):
        monkeypatch.setattr("sys.argv", [name, option, value])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
        assert option in f"{capsys.readouterr().err}{ended.value}"
