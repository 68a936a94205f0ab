"""What the wrappers refuse: settings, states of something else, wrong environments, bad numbers."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Discrete, MultiBinary, Text, Tuple
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TransformAction, TransformObservation, TransformReward
from shared import BANDIT, learned, play, refused, vector_of
from stable_baselines3.common.env_util import make_vec_env

from mace_rl.config.section import ConfigError
from mace_rl.numerics.finite import NonFiniteError
from mace_rl.runs.checkpoint import archive
from mace_rl.wrapping.wrappers import CuriosityReward, VectorCuriosityReward

NEXT = AutoresetMode.NEXT_STEP
LEARNS = {"kind": "custom", "rule": "test_extras:Noted", "arguments": {"learns": True}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.update(discount=0.9), "made with discount 0.9, but here it is 0.99"),
        (lambda s: s.update(beta=0.5), "made with beta 0.5, but here it is {.* 0.4}"),
        (lambda s: s.update(environments=2), "made with environments 2, but here it is 1"),
        (lambda s: s.pop("beta"), "made with beta unknown, but here it is {'kind'"),  # before it
        (lambda s: s.update(curves=3), "made with curves 3, but here it is unknown"),  # later
    ],
)
def test_a_state_made_with_other_settings_is_refused(change, message):
    env = CuriosityReward(gymnasium.make("CartPole-v1"))
    state = env.state_dict()
    change(state["settings"])
    before = archive(env.state_dict())
    with pytest.raises(ConfigError, match=message):
        env.load_state_dict(state)
    assert archive(env.state_dict()) == before


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"beta": {"kind": "meta", "initial": 0.4}}, "its objective should be one that asks for"),
        ({"beta": learned("credit")}, "of kind return, score, progress or words: policy gradients"),
        ({"beta": "learnt"}, "beta is 'learnt', but it should be a number, 'learned', or a rule"),
        ({"meta": {"chunks": 8}}, "meta is for a β that is 'learned'"),
        ({"beta": LEARNS}, "beta.rule has 'test_extras:Noted', which learns from policy"),
        ({"beta": {"kind": "none"}}, "'none'.*'constant', 'exponential', 'custom'"),
        ({"beta": 10.5}, "beta.value is 10.5, but .* less than or equal to 10"),
        ({"memory": {"capcity": 5}}, "unknown key 'memory.capcity' .* 'capacity'"),
        ({"relevance": False, "memory": {}}, "relevance False does not use memory"),
        ({"novelty": {"kind": "counts"}}, "novelty.kind is 'counts', but the observations are Box"),
        ({"novelty": {"neighbours": [9000]}}, "neighbours has 9000, which must be less than"),
        ({"seed": -1}, "seed is -1, but .* greater than or equal to 0"),
    ],
)
def test_mistakes_get_one_line(settings, message):
    with refused(ConfigError, message):
        CuriosityReward(gymnasium.make("CartPole-v1"), **settings)


def observing(observations, space=None) -> gymnasium.Env:
    told = iter(observations)
    return TransformObservation(gymnasium.make("CartPole-v1"), lambda _: next(told), space)


def paying(reward) -> gymnasium.Env:
    paid = iter([1.0, 1.0, reward])
    return TransformReward(gymnasium.make("CartPole-v1"), lambda _: next(paid))


TWO_ACTIONS = TransformAction(gymnasium.make("CartPole-v1"), None, Tuple([Discrete(2)]))
PAIR, NO_MODE = vector_of("CartPole-v1", 2, NEXT), vector_of("CartPole-v1", 1, NEXT)
NO_MODE.metadata = {}


@pytest.mark.parametrize(
    ("form", "given", "error", "message"),
    [
        (CuriosityReward, [observing([], Text(3))], ConfigError, "the observation is of Text"),
        (CuriosityReward, [TWO_ACTIONS], ConfigError, "has actions Tuple.*ActionWrapper"),
        # stable-baselines3's are none of Gymnasium's.
        (CuriosityReward, [make_vec_env("CartPole-v1", 2)], TypeError, "Expected env to be"),
        (VectorCuriosityReward, [PAIR, BANDIT], ConfigError, "Bandit.*2 go on at once"),
        (VectorCuriosityReward, [NO_MODE], ConfigError, "should be one of gymnasium"),
    ],
)
def test_what_cannot_be_wrapped(form, given, error, message):
    with pytest.raises(error, match=message):
        form(*given)


GOOD, THREE = np.zeros(4, np.float32), Discrete(3, start=5)
BAD = [GOOD + np.inf] * 99


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (CuriosityReward(observing([], MultiBinary(4))).state_dict(), r"space 'MultiBinary\(4\)'"),
        (CuriosityReward(observing([], THREE)).state_dict(), "made with observation_s"),
        *((other, "not one of `state_dict`") for other in ({}, None, 5)),
    ],
)
def test_a_state_of_something_else_is_refused(state, message):
    with pytest.raises(ConfigError, match=message):
        CuriosityReward(gymnasium.make("CartPole-v1")).load_state_dict(state)


@pytest.mark.parametrize(
    ("env", "error", "message"),
    [
        (observing([GOOD, []]), ConfigError, r"\[\] of shape \(0,\) after step 1, but its obs"),
        # As numpy stretches.
        (observing([GOOD, [0]]), ConfigError, r"of shape \(1,\) after step 1"),
        (observing([5, 6, 7, 8], THREE), ConfigError, "observation 8 of shape .* after step 3"),
        (observing([4], THREE), ConfigError, "observation 4 of shape .* after the reset"),
        (paying(np.nan), NonFiniteError, "the reward is nan after step 3"),
        (paying(-1.7e308), NonFiniteError, r"reward is -1.7e\+308 after step 3, but float32"),
        (paying(None), ConfigError, "None as reward after step 3, but it should be one number"),
        (observing([GOOD, *BAD]), NonFiniteError, "observation is inf after step 1"),
        (observing([[1e200] * 4]), NonFiniteError, r"observation is 1e\+200 after the reset, but"),
    ],
)
def test_what_goes_wrong_stops_it(env, error, message):
    novelty = {"neighbours": [1], "write_every": 1, "refresh_every": 1}
    with pytest.raises(error, match=message):
        play(CuriosityReward(env, novelty=novelty), 100)
