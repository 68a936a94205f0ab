"""Environments of others: whatever they do a run repeats itself; their mistakes are named."""

import os
import random
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from shared import Bonanza, call, environment_of, play

from mace_rl import CuriosityReward, VectorCuriosityReward, load_agent
from mace_rl.runs import evaluate, run
from mace_rl.training.resuming import global_state
from mace_rl.training.rollout import roll_out

DRAWS = {
    "Python's": random.random,
    "NumPy's": lambda: np.random.random(),  # noqa: NPY002
    "PyTorch's": lambda: float(torch.rand(1)),
}


class Drawing(Bonanza):
    """Pays what a global generator draws, also in its constructor."""

    def __init__(self, draw):
        super().__init__()
        self.draw, self.first = draw, draw()

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, self.first + self.draw(), *rest


@pytest.mark.parametrize("generator", DRAWS)
def test_global_generators_repeat_themselves_and_are_given_back(
    generator, register, run_config, tmp_path
):
    name = register("Drawing-v0", Drawing, 5, draw=DRAWS[generator])
    found = []
    for place in ("one", "other"):
        DRAWS[generator]()  # elsewhere in the program
        before = global_state()
        run.run(run_config(name, "ppo", 1, episodes=3), tmp_path / place)
        after = global_state()
        assert [before[key] for key in ("random", "numpy")] == [after["random"], after["numpy"]]
        assert (before["torch"] == after["torch"]).all()
        found.append((tmp_path / place / "episodes.csv").read_bytes())
        found.append(evaluate.evaluate(tmp_path / place, 2, seed=4, trust=True).tolist())
    assert found[:2] == found[2:]
    other = run_config(name, "ppo", 2, episodes=3)
    run.run(other, tmp_path / "another seed")
    assert (tmp_path / "another seed" / "episodes.csv").read_bytes() != found[0]


class Careless(gymnasium.Env):
    """Writes into the action that it gets, and uses one buffer for all observations."""

    observation_space, action_space = Box(-9, 9, (1,)), Box(-1, 1, (1,))

    def __init__(self):
        self.buffer = np.zeros(1, np.float32)

    def reset(self, **given):
        super().reset(**given)
        self.buffer[:] = 0
        return self.buffer, {}

    def step(self, action):
        self.buffer += action
        action[:] = 7
        return self.buffer, 0.0, False, False, {}


def test_what_an_environment_changes_in_place_is_kept_as_it_was(register, run_config):
    actions = np.array([[0.5], [-0.25], [0.125]], np.float32)
    name = register("Careless-v0", Careless, 3)
    single = CuriosityReward(gymnasium.make(name))
    vector = VectorCuriosityReward(
        SyncVectorEnv([Careless], autoreset_mode=AutoresetMode.DISABLED), 0.4
    )
    for env, given in ((single, actions.copy()), (vector, actions[:, None].copy())):
        env.reset(seed=0)
        for action in given[:2]:
            env.step(action)
        kept = env.tracker.recordings[0]
        assert np.array_equal(kept.actions, actions[:2])
        assert np.array_equal(np.ravel(kept.observations), [0, 0.5, 0.25])
    environment = environment_of(name)
    environment.clips_actions = False
    policy = SimpleNamespace(act=lambda _, noise: (noise, np.float32(0)))
    episode = roll_out(environment, policy, actions.copy())
    assert np.array_equal(episode.actions, actions)
    assert np.array_equal(np.ravel(episode.observations), [0, 0.5, 0.25, 0.375])


class Wandering(Bonanza):
    def reset(self, **given):
        os.chdir("/")
        return super().reset(**given)


def test_an_environment_may_change_the_folder(register, monkeypatch, tmp_path, capsys):
    name = register("Wandering-v0", Wandering, 5)
    words = ("train", "--env", name, "--variant", "ppo", "--episodes", "3", "--out", "here")
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, *words) == (0, "")
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "evaluate", "here", "--episodes", "2") == (0, "")
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "verify", ".") == (0, "")
    assert (tmp_path / "here" / "run.json").exists()


class Failing(Bonanza):
    def __init__(self, error, where):
        super().__init__()
        self.error, self.where = error, where

    def reset(self, **given):
        found = super().reset(**given)
        if self.where == "reset" and self.resets == 4:
            raise self.error
        return found

    def step(self, action):
        if self.where == "step" and (self.resets, self.steps) == (4, 1):
            raise self.error
        return super().step(action)


MISSING = FileNotFoundError(2, "No such file or directory", "asset.urdf")


@pytest.mark.parametrize("where", ["step", "reset"])
@pytest.mark.parametrize("error", [MISSING, TimeoutError(), BrokenPipeError("gone"), KeyError("k")])
def test_an_error_in_an_environment_says_where(register, monkeypatch, tmp_path, error, where):
    name = register("Failing-v0", Failing, 5, error=error, where=where)
    words = ("train", "--env", name, "--variant", "ppo", "--episodes", "9", "--out", str(tmp_path))
    code, said = call(monkeypatch, *words)
    assert code == 1 and "\n" not in said
    assert f"mace-rl: in {name} ppo seed 0, episode 3, in " in said
    what = "step 2 of an episode" if where == "step" else "a reset"
    assert f", in {what} of {name}: " in said
    assert type(error).__name__ in said
    file = said.rpartition("(traceback: ")[2].rstrip(")")
    with open(file, encoding="utf-8") as kept:
        assert "test_others.py" in kept.read()
    os.unlink(file)


class Showing(gymnasium.Env):
    """Any observation at random; the actions that it got."""

    def __init__(self, observations=None, actions=None):
        self.observation_space = observations or Box(-1, 1, (2,))
        self.action_space = actions or Discrete(2)

    def reset(self, **given):
        super().reset(**given)
        self.observation_space.seed(int(self.np_random.integers(1000)))
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), 0.0, False, False, {}


@pytest.mark.parametrize(
    ("spaces", "size"),
    [
        ({"observations": Box(0, 255, (4, 4), np.uint16)}, 16),
        ({"observations": Box(0, 255, (8, 8, 3), np.uint8)}, 192),
        ({"observations": MultiDiscrete([2, 3])}, 5),
        ({"observations": MultiBinary(3)}, 3),
        ({"observations": Dict(a=MultiDiscrete([[2, 3], [1, 4]]), b=Box(0, 1, (2, 2)))}, 14),
        ({"actions": Box(-0.3, 0.7, (3,), np.float16)}, 2),
    ],
)
def test_spaces_are_trained_and_played_in_and_wrapped(register, run_config, tmp_path, spaces, size):
    name = register("Showing-v0", Showing, 4, **spaces)
    for clips in (True, False) if "observations" in spaces else (True,):
        config = run_config(name, "mace_full", 0, episodes=2, ppo={"clip_actions": clips})
        run.run(config, tmp_path / str(clips))
    env = gymnasium.make(name)
    policy = load_agent(tmp_path / "True", trust=True).policy
    assert len(policy.mean) == size
    policy(env.reset(seed=0)[0]).sample()
    play(CuriosityReward(env), 9)


def test_a_time_limit_that_only_the_environment_keeps(register, run_config):
    class Stopping(Bonanza):
        max_steps = 3  # as MiniGrid's call it

    name = register("Stopping-v0", Stopping, None)
    assert run_config(name, "ppo", 0).max_episode_steps == 3
