"""A finished run's agent: torch modules that act as the trainer does, played and filmed."""

import gc
import io
import json
import shutil

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from gymnasium.spaces.utils import flatdim, flatten
from gymnasium.vector.utils import concatenate, create_empty_array
from PIL import Image
from shared import LAYER_NORM, call, finish, refused, returns_of

from mace_rl import settings, train
from mace_rl.base import files
from mace_rl.config.reading import merge
from mace_rl.config.section import ConfigError
from mace_rl.runs import watch
from mace_rl.runs.agent import Agent, load_agent
from mace_rl.runs.evaluate import evaluate
from mace_rl.runs.finished import FinishedRun, finished
from mace_rl.runs.observations import ObservationError, encoded
from mace_rl.training.trainer import Trainer


@pytest.mark.parametrize(
    ("environment", "changes"),
    [
        ("CartPole-v1", {}),
        ("Pendulum-v1", {}),
        ("FrozenLake-v1", {"engine": "torch"}),
        ("Pendulum-v1", {"engine": "torch", "ppo": {"network": LAYER_NORM}}),
    ],
)
def test_agent_is_torch_modules_that_act_as_trained(run_config, trained, environment, changes):
    """From observations as they are; Pendulum's are normalised, and what the critics get."""
    box = environment == "Pendulum-v1"
    changes = merge(changes, {"episodes": 3, "ppo": {"normalise_observations": box}})
    config = run_config(environment, "mace_full", 0, **changes)
    agent = load_agent(trained(environment, "mace_full", **changes), trust=True)
    trainer, rng = finish(config), np.random.default_rng(0)
    space = trainer.environment.observation_space
    space.seed(0)
    rows = np.stack([trainer.environment.encode(space.sample()) for _ in range(50)])
    noise = rng.standard_normal((50, 1)) if box else rng.random(50)
    acting, policy = trainer.ppo.acting_policy(), agent.policy(rows)
    drawn = [acting.act(*pair) for pair in zip(rows, noise, strict=True)]
    actions, log_probs = (np.array(parts) for parts in zip(*drawn, strict=True))
    found = policy.log_prob(torch.from_numpy(actions)).detach()
    np.testing.assert_allclose(found, log_probs, rtol=1e-4, atol=1e-4)
    if box:
        expected = policy.mean + policy.stddev * torch.from_numpy(noise)
        np.testing.assert_allclose(actions, expected.detach(), rtol=1e-4, atol=1e-5)
    else:
        expected = (torch.from_numpy(noise)[:, None] >= policy.probs.cumsum(1)).sum(1)
        assert (actions == expected.numpy()).all()
    one = agent.policy(rows[0]).log_prob(torch.from_numpy(actions)[0])
    torch.testing.assert_close(one, policy.log_prob(torch.from_numpy(actions))[0])
    assert (agent.policy.mean != 0).any() == box
    for kind, critic in trainer.ppo.critics.items():
        values = agent.critics[kind](torch.from_numpy(rows)).detach()
        np.testing.assert_allclose(values[:, 0], critic.outputs(rows)[:, 0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("deterministic", [False, True])
def test_an_agent_plays_as_it_was_trained(trained, monkeypatch, tmp_path, capsys, deterministic):
    """Its return is that of its torch modules in the library's own environment."""
    shutil.copytree(trained("HopperBulletEnv-v0", episodes=6), tmp_path, dirs_exist_ok=True)
    policy, noise = load_agent(tmp_path).policy, np.random.default_rng(5)
    noise = iter(noise.standard_normal((1000, 3)) * (not deterministic))

    def act(observation: np.ndarray) -> np.ndarray:
        distribution = policy(observation)
        action = distribution.mean + distribution.stddev * torch.from_numpy(next(noise))
        return action.clip(-1, 1).float().detach().numpy()

    [total] = returns_of("HopperBulletEnv-v0", act, 1, 5)
    assert evaluate(tmp_path, 1, 5, deterministic)[0] == pytest.approx(total, rel=1e-3)
    assert evaluate(tmp_path, 1, 5, not deterministic)[0] != pytest.approx(total, rel=1e-3)
    capsys.readouterr()
    assert call(monkeypatch, "evaluate", str(tmp_path), "--episodes", "3") == (0, "")
    assert capsys.readouterr().out.startswith("3 episodes: mean return ")


def test_an_agent_plays_whatever_version_of_the_method_trained_it(trained, tmp_path):
    """What playing does not need may have other settings; what it needs may not."""
    folder = trained("CartPole-v1", episodes=3)
    expected = evaluate(folder, 2, 5)
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    record["config"] |= {"meta": {"hidden_units": 128, "prior": 0.1}, "beta": {"kind": "older"}}
    (tmp_path / "run.json").write_text(json.dumps(record))
    assert (evaluate(tmp_path, 2, 5) == expected).all()
    with pytest.raises(ConfigError, match=r"run\.json: beta is [^\n]*'older'[^\n]*$"):
        _ = FinishedRun(tmp_path).config
    (tmp_path / "run.json").write_text(json.dumps(record | {"sources": "0" * 64}))
    with pytest.raises(ConfigError, match=r"'older'[^\n]*; [^\n]* of other code"):
        _ = FinishedRun(tmp_path).config
    with pytest.raises(ConfigError, match=r"'older'[^\n]*; [^\n]* --restart"):
        finished(FinishedRun(folder).config, tmp_path)
    record["config"]["ppo"]["clpi"] = 0.2
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(ConfigError, match=r"unknown key .ppo\.clpi"):
        evaluate(tmp_path, 2, 5)


def likeliest(policy: torch.nn.Module, episodes: int, seed: int) -> list[float]:
    """CartPole's returns under the most probable actions."""
    return returns_of("CartPole-v1", lambda seen: int(policy(seen).probs.argmax()), episodes, seed)


def test_without_chance_discrete_actions_are_the_most_probable(trained):
    folder = trained("CartPole-v1", episodes=3, engine="torch")
    expected = likeliest(load_agent(folder).policy, 3, 5)
    assert evaluate(folder, 3, 5, deterministic=True).tolist() == expected


# --- Observations ---------------------------------------------------------------------------------

FOUR, BOX = Discrete(4, start=-1), Box(-1, 1, (4,))
CARDS = Tuple([Discrete(32), Discrete(11), Discrete(2)])
MIXED = Dict({"a": Box(-1, 1, (2, 3)), "b": FOUR, "c": MultiBinary(2), "d": CARDS})
MIXED["e"] = MultiDiscrete([2, 3], start=[-1, 1])


@pytest.mark.parametrize("space", [FOUR, BOX, Box(-1, 1, (1, 4)), CARDS, MIXED], ids=str)
def test_one_or_a_batch_is_encoded_as_in_training(space):
    """As Gymnasium's flatten has it; a batch as its vector environments give it, too."""
    space.seed(0)
    ones, size = [space.sample() for _ in range(3)], flatdim(space)
    rows = np.stack([flatten(space, one) for one in ones]).astype(np.float32)
    for one, row in zip(ones, rows, strict=True):
        assert (encoded(one, space, size).numpy() == row).all()
    batch = concatenate(space, ones, create_empty_array(space, 3))
    for given in (batch, ones, rows, torch.from_numpy(rows), rows.tolist(), rows[None]):
        assert (encoded(given, space, size).numpy() == rows).all()


PAIR, HOT = Tuple([FOUR, FOUR]), [0.0, 1.0, 0.0, 0.0]
FORMS = [(FOUR, given, HOT) for given in (0, np.uint16(0), np.array(0), torch.tensor(0), HOT)]
FORMS += [(FOUR, given, [HOT] * 2) for given in ([0, 0], (0, 0), torch.zeros(2).int())]
FORMS += [(PAIR, given, HOT * 2) for given in ([0, 0], np.zeros(2, int), HOT * 2)]
FORMS += [(Dict(a=MultiDiscrete([2, 2])), {"a": np.array([0, 1])}, [1.0, 0.0, 0.0, 1.0])]
FORMS += [(Dict(a=FOUR), {"a": 0, "more": 5}, HOT)]  # as training does


@pytest.mark.parametrize(("space", "given", "expected"), FORMS)
def test_whatever_the_space_contains(space, given, expected):
    assert encoded(given, space, flatdim(space)).tolist() == expected


WRONG = [
    (FOUR, [3, -2, 0.0, None, "x", (0, {}), [3, 0], [0.5, 0.5, 0, 0], [[0, 1]], np.eye(3), 1j]),
    (BOX, [0, 0.5, np.zeros(3), np.zeros((4, 3)), [np.nan] * 4, [1e300] * 4, (HOT, {})]),
    (CARDS, [(1, 2), (1, 2, 2), (1.0, 2, 1), {1: 0, 2: 0, 0: 0}, ((1, 2, 1), {}), 3, [], ()]),
    (MIXED, [{}, {"a": 1}, (MIXED.sample(), {})]),
    (MIXED, [{**MIXED.sample(), "e": [1, 1]}]),
    (BOX, [np.zeros((0, 4))]),
]


@pytest.mark.parametrize("space, given", [(space, one) for space, all_ in WRONG for one in all_])
def test_anything_else_is_one_line(space, given):
    with refused(ObservationError, "no finite observation of ") as caught:
        encoded(given, space, flatdim(space))
    pair = isinstance(given, tuple) and given[-1:] == ({},)
    assert ("only the first is one" in str(caught.value)) == pair


@pytest.mark.parametrize(("name", "one"), [("FrozenLake-v1", 5), ("Blackjack-v1", (14, 9, 0))])
def test_a_loaded_policy_knows_its_space(name, one):
    policy = train(settings(name, "ppo", episodes=2, max_episode_steps=20)).agent.policy
    assert (policy(one).logits == policy(np.float32(flatten(policy.space, one))).logits).all()
    with pytest.raises(ObservationError, match="only the first"):
        policy((one, {}))


# --- Films ----------------------------------------------------------------------------------------


class Chance(gymnasium.Wrapper):
    """Rewards by a generator of its own."""

    def __init__(self, **arguments):
        super().__init__(CartPoleEnv(**arguments))

    def reset(self, *, seed=None, options=None):
        self.draws = self.draws if seed is None else np.random.default_rng(seed)
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        state, _, *rest = self.env.step(action)
        return state, self.draws.random(), *rest


class NoDisplay(CartPoleEnv):
    def render(self):
        raise OSError("no display")


@pytest.mark.slow
@pytest.mark.parametrize("environment", ["CartPole-v1", "HopperBulletEnv-v0", "Chance-v0"])
def test_what_is_filmed_is_what_evaluate_plays(trained, register, environment):
    register("Chance-v0", Chance)
    folder = trained(environment, episodes=2)
    threshold = gc.get_threshold()
    gc.set_threshold(10)  # what is no longer used goes while the film is made
    try:
        for deterministic in (False, True):
            film = watch.film(folder, 2, 5, deterministic=deterministic)
            assert film.returns == evaluate(folder, 2, 5, deterministic).tolist()
    finally:
        gc.set_threshold(*threshold)
    assert len({picture.tobytes() for picture in film.pictures}) > len(film.pictures) / 2


@pytest.mark.slow
def test_the_untrained_agent_has_the_weights_that_training_began_with(trained, run_config):
    trainer = Trainer(run_config(episodes=2))
    policy = Agent(trainer.ppo, trainer.environment.given_space).policy
    film = watch.film(trained("CartPole-v1", episodes=2), 1, 5, deterministic=True, untrained=True)
    assert film.returns == likeliest(policy, 1, 5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "rate", "stride", "durations"),
    [("CartPole-v1", 50, 3, {60}), ("Acrobot-v1", 15, 1, {60, 70})],  # a GIF has whole hundredths
)
def test_pictures_and_speed_are_the_environments(trained, environment, rate, stride, durations):
    """Thinned to at most 20 pictures a second, cut where it should be, and written whole."""
    env = gymnasium.make(environment, render_mode="rgb_array")
    env.reset(seed=0)
    env.reset()
    height, width, _ = env.render().shape
    folder = trained(environment, episodes=2)
    film = watch.film(folder, seconds=0.2, width=width)
    assert np.array_equal(np.asarray(film.pictures[0].crop((0, 0, width, height))), env.render())
    assert len(film.pictures) == 1 + rate // 5 // stride
    assert set(film.milliseconds[:-1]) == durations
    starts = np.cumsum([0, *film.milliseconds[:-1]])
    np.testing.assert_allclose(starts, np.arange(len(starts)) * 1000 * stride / rate, atol=5)
    assert film.returns == evaluate(folder, 1, 0).tolist()
    with Image.open(io.BytesIO(watch.gif(film))) as image:
        assert (image.format, image.info["loop"]) == ("GIF", 0)
        assert image.n_frames == len(film.pictures)
        for place, picture in enumerate(film.pictures):
            image.seek(place)
            assert image.info["duration"] == film.milliseconds[place]
            difference = np.subtract(image.convert("RGB"), picture, dtype=np.int16)
            assert abs(difference).mean() < 3


@pytest.mark.slow
def test_what_cannot_be_filmed_is_said(trained, tmp_path, register):
    register("NoDisplay-v0", NoDisplay)
    register("Nothing-v0", type("Nothing", (NoDisplay,), {"render": lambda _: None}))
    register("NoMode-v0", lambda: CartPoleEnv())  # takes no mode, though it promises one
    for name, reason in (
        ("PlantedHelp-v0", "cannot be drawn: 'rgb_array' is not"),
        ("NoDisplay-v0", "cannot be drawn: OSError: no display"),
        ("Nothing-v0", r"cannot be drawn: TypeError: render\(\) gives no picture"),
        ("NoMode-v0", "with .* cannot be drawn"),
    ):
        with pytest.raises(watch.RenderError, match=f"'{name}' {reason}"):
            watch.film(trained(name, episodes=2))
    shutil.copy(trained("CartPole-v1", episodes=2) / files.RECORD, tmp_path)
    assert watch.film(tmp_path, untrained=True).pictures  # needs no weights but the first
    wrappers = {"environment_wrappers": ["gymnasium.wrappers:NormalizeObservation"]}
    normalised = trained("CartPole-v1", episodes=2, **wrappers)
    assert watch.film(normalised, untrained=True, trust=True).pictures  # nor numbers of a wrapper
