"""Environments that do not fit, or are not as Gymnasium has them: told in one line, by name."""

import sys
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text, Tuple
from shared import Bonanza, environment_of, finish

from mace_rl.config.section import ConfigError
from mace_rl.environments.environment import Environment
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.training.rollout import roll_out


def play(environment: Environment) -> Episode:
    """One episode of action 0."""
    policy = SimpleNamespace(act=lambda _observation, _noise: (0, np.float32(0)))
    return roll_out(environment, policy, np.zeros(environment.max_steps))


@pytest.mark.parametrize(
    ("spaces", "limit", "message"),
    [
        ({}, 10**9, "has a time limit of 1000000000 .*set one of 1 to 1000000"),
        ({"observation_space": Text(3)}, 10, "the observation is of Text.*, by --wrapper"),
        ({"observation_space": Box(0, 9, (84, 84, 4), np.uint8)}, 10, "has 28224 numbers"),
        ({"action_space": Tuple([Discrete(2)])}, 10, "MultiBinary and Box work"),
        ({"action_space": Box(-1, 1, (0,))}, 10, "has 0 numbers"),
        ({"action_space": Box(0, 9, (1,), np.int64)}, 10, "of integers"),
        ({"action_space": Discrete(10**9)}, 10, "has 1000000000 numbers"),
        ({"action_space": Box(-1, 1, (200,))}, 10**6, "time limit is 1000000, not up to 500000"),
        ({"action_space": MultiBinary(200)}, 10**6, "200 numbers in an action.*up to 500000"),
        ({"observation_space": Tuple([Dict(a=Dict({}))])}, 10, r"\[0\]\['a'\] is of Dict"),
        (None, 10, ""),
    ],
)
def test_environments_that_do_not_fit_are_refused_by_name(register, spaces, limit, message):
    plain = {"observation_space": Box(-1, 1, (2,)), "action_space": Discrete(2)}
    if spaces is not None:  # else there is no such environment
        register("Unfit-v0", type("Unfit", (gymnasium.Env,), plain | spaces), limit)
    with pytest.raises(ConfigError, match=rf"^[^\n]*Unfit-v0[^\n]*{message}[^\n]*$"):
        environment_of("Unfit-v0")


class Odd(Bonanza):
    def __init__(self, method, does):
        super().__init__()
        self.odd = method, does
        setattr(self, method, does)

    def reset(self, **given):
        found = super().reset(**given)
        setattr(self, *self.odd)
        return found


@pytest.mark.parametrize(
    ("method", "does", "message"),
    [
        ("reset", lambda **_: np.zeros(2), r"TypeError: reset gave array\(\[0., 0.\]\), not"),
        ("reset", lambda: None, "'Odd-v0': TypeError: .*unexpected keyword argument 'seed'"),
        ("reset", lambda **_: 1 / 0, r"'Odd-v0': ZeroDivisionError: .*test_environment.py:\d+"),
        ("np_random", np.random.RandomState(0), "np_random is a RandomState, not a Generator"),
        ("step", lambda _: (np.zeros(2), 0, True, {}), "step 1: not .*expected 5, got 4"),
        ("step", lambda _: (None, 0, True, False, {}), "the observation None .* after step 1"),
        ("step", lambda _: (np.zeros(2), [1, [2]], True, False, {}), "as reward after step 1"),
        ("step", lambda _: ((np.zeros(2), {}), 0, True, False, {}), "the observation .* step 1"),
        ("reset", lambda **_: sys.exit(0), "'Odd-v0': SystemExit: 0"),
        ("step", lambda _: (np.zeros(2), 0, None, False, {}), "None as terminated after step 1"),
        ("step", lambda _: (np.zeros((2, 1)), np.ones(1), np.True_, [0], None), ""),
    ],
)
def test_what_is_not_gymnasium_s_form_is_told_in_one_line(register, method, does, message):
    """And arrays of one are taken for the number in them."""
    register("Odd-v0", Odd, 5, method=method, does=does)
    if not message:
        assert play(environment_of("Odd-v0")).rewards.tolist() == [1.0]
        return
    with pytest.raises(ConfigError, match=rf"^environment [^\n]*{message}[^\n]*$"):
        play(environment_of("Odd-v0"))


class Endless(gymnasium.Wrapper):
    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, False, info


def test_a_wrapper_that_hides_the_time_limit_is_told(run_config):
    around = {"environment_wrappers": ["test_environment:Endless"], "max_episode_steps": 20}
    with pytest.raises(ConfigError, match="goes on after 20 steps, its time limit: a wrapper"):
        finish(run_config("MountainCar-v0", "ppo", 0, episodes=2, **around))


PARTS = Dict(a=Discrete(3), b=Tuple([Box(0, 1, (2,)), Box(0, 1, (1,))]), c=MultiDiscrete([2, 3]))
GOOD = {"a": 1, "b": (np.zeros(2), np.zeros(1)), "c": np.array([1, 2])}
PIXELS, WHOLE = Box(0, 255, (2, 2, 3), np.uint8), Dict(a=Box(0, 9, (2,), np.int8))


@pytest.mark.parametrize(
    ("space", "good", "encoded", "others"),
    [
        (
            PARTS,
            GOOD,
            [0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 1],
            [
                {"a": 1},
                *(GOOD | {"a": state} for state in (-1, 3, 1.5, None, [0, 1])),
                *(GOOD | {"c": np.array(state)} for state in ([2, 0], [0, -1], [0])),
                *(GOOD | {"b": boxes} for boxes in ((np.zeros(1), np.zeros(2)), (np.zeros(2),), 0)),
            ],
        ),
        # A fraction would be new at each visit, and 257 be 1.
        (PIXELS, np.full(PIXELS.shape, 7), [7] * 12, [np.full(PIXELS.shape, 0.5)]),
        (MultiBinary(3), [1.0, 0, 1], [1, 0, 1], [[0.5, 0, 1]]),
        (WHOLE, {"a": [1.0, 2]}, [1, 2], [{"a": [1, 2.5]}, {"a": np.array([1, 257])}]),
    ],
)
def test_what_is_not_of_its_space_is_refused(space, good, encoded, others):
    spaces, kind = Spaces("Parts-v0", space, Discrete(2)), type(space).__name__
    assert (spaces.encode(good) == encoded).all()
    for given in others:
        with pytest.raises(ConfigError, match=rf"Parts-v0.* after step 4, but its .* is {kind}"):
            spaces.encode(given, 4)


def test_settings_reach_the_environment():
    """max_episode_steps goes before its own; without slipping an action leads where it points."""
    for name, own in (("CliffWalking-v1", None), ("CartPole-v1", 500)):
        environment = environment_of(name, 0, 7)
        assert environment.max_steps == 7 != own
        episode = play(environment)
        assert (len(episode), episode.terminated) == (7, False)
    transitions = environment_of("FrozenLake-v1", 0, None, {"is_slippery": False}).env.unwrapped.P
    assert {len(outcomes) for state in transitions.values() for outcomes in state.values()} == {1}
    for arguments in ({"slippery": False}, {"map_name": "9x9"}):
        with pytest.raises(ConfigError, match=r"^[^\n]*FrozenLake-v1[^\n]*(slippery|9x9)[^\n]*$"):
            environment_of("FrozenLake-v1", 0, None, arguments)
