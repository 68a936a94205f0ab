"""Curiosity for other agents: what is refused, and in what words."""

import inspect
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_util import make_vec_env
from wrapped import BANDIT, play, vector_of

import mace_rl.environments  # noqa: F401  (registers ours)
from mace_rl.config.section import ConfigError
from mace_rl.config.wrappers import MEMORY, NOVELTY, CuriosityConfig
from mace_rl.finite import NonFiniteError
from mace_rl.wrappers import CuriosityReward, VectorCuriosityReward

ROOT = Path(__file__).parents[1]


def test_defaults_are_the_study_s():
    training = yaml.safe_load((ROOT / "config.yaml").read_text(encoding="utf-8"))["training"]
    assert training["memory"] == MEMORY and training["novelty"] == NOVELTY
    assert training["ppo"]["discount"] == 0.99


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"beta": {"kind": "meta", "initial": 0.4}}, "meta network learns from policy gradients"),
        (
            {"beta": {"kind": "custom", "rule": "test_wrappers:Learner"}},
            "beta.rule has 'test_wrappers:Learner', which learns from policy gradients",
        ),
        ({"beta": {"kind": "none"}}, "'none'.*'constant', 'random', 'bandit'"),
        ({"beta": 1.5}, "beta.value is 1.5, but .* less than or equal to 1"),
        ({"beta": "big"}, "beta.value is 'big', but .* number"),
        ({"memory": {"capcity": 5}}, "unknown key 'memory.capcity' .* 'capacity'"),
        ({"memory": 5}, "memory is 5, but"),
        ({"relevance": False, "memory": {"capacity": 70}}, "relevance False does not use memory"),
        ({"relevance": False, "memory": {}}, "relevance False does not use memory"),
        ({"novelty": {"kind": "counts"}}, "novelty.kind is 'counts', but the observations are Box"),
        ({"novelty": {"neighbours": [9000]}}, "neighbours has 9000, which must be less than"),
        ({"discount": 1.1}, "discount is 1.1, but .* less than or equal to 1"),
        ({"seed": -1}, "seed is -1, but .* greater than or equal to 0"),
        ({"seed": None}, "seed is None, but should be an? .*integer"),
        ({"discount": None}, "discount is None, but should be a .*number"),
        ({"rollout_steps": 0}, "rollout_steps is 0, but .* greater than 0"),
    ],
)
@pytest.mark.parametrize("vector", [False, True])
def test_mistakes_get_one_line(settings, message, vector):
    with pytest.raises(ConfigError, match=message) as caught:
        if vector:
            VectorCuriosityReward(vector_of("CartPole-v1", 1, AutoresetMode.NEXT_STEP), **settings)
        else:
            CuriosityReward(gymnasium.make("CartPole-v1"), **settings)
    assert "\n" not in str(caught.value)


def test_a_bandit_is_for_one_environment():
    """It has to see how an episode ended before it chooses for the next."""
    with pytest.raises(ConfigError, match=r"bandit.*2 go on at once"):
        VectorCuriosityReward(vector_of("CartPole-v1", 2, AutoresetMode.NEXT_STEP), BANDIT)


def test_arguments_that_there_are_not():
    """Python's own message; help() and editors show those that there are, the same for both."""
    with pytest.raises(TypeError, match="unexpected keyword argument 'gamma'"):
        CuriosityReward(gymnasium.make("CartPole-v1"), gamma=0.9)
    single, vector = (
        list(inspect.signature(wrapper).parameters.values())[1:]
        for wrapper in (CuriosityReward, VectorCuriosityReward)
    )
    assert single == vector
    assert {one.name for one in single} == set(CuriosityConfig.model_fields)
    for one in single:
        field = CuriosityConfig.model_fields[one.name]
        assert field.is_required() or field.default == one.default


@pytest.mark.parametrize("wrapper", [CuriosityReward, VectorCuriosityReward])
def test_what_is_no_environment_of_gymnasium_s_is_refused(wrapper):
    """stable-baselines3's several environments are none; `wrapper_class` is the way there."""
    with pytest.raises(TypeError, match="Expected env to be a `gymnasium"):
        wrapper(make_vec_env("CartPole-v1", 2))


class Odd(gymnasium.Env):
    """Goes wrong in its third step, or has spaces that do not work."""

    def __init__(self, observations=None, actions=None, reward=0.0, state=0.0, size=2) -> None:
        self.size = size
        self.observation_space = observations or Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = actions or Discrete(2)
        self.reward, self.state = reward, state

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        bad = self.steps == 3
        state = np.full(self.size if bad else 2, self.state if bad else 0.0, np.float32)
        return state, self.reward if bad else 0.0, self.steps == 5, False, {}


@pytest.mark.parametrize(
    ("spaces", "message"),
    [
        ({"observations": gymnasium.spaces.MultiBinary(3)}, "has multibinary observations"),
        ({"observations": Box(0, 255, (8, 8, 3), np.uint8)}, "has image observations"),
        ({"actions": gymnasium.spaces.MultiDiscrete([2, 2])}, "has actions MultiDiscrete"),
    ],
)
def test_spaces_that_do_not_work_get_one_line(spaces, message):
    with pytest.raises(ConfigError, match=message):
        CuriosityReward(Odd(**spaces))


@pytest.mark.parametrize("size", [0, 1, 3])
def test_an_observation_of_another_shape_is_refused(size):
    """One of size 1 too, which numpy would stretch."""
    message = rf"gave an observation of shape \({size},\), but its observation_space is Box"
    with pytest.raises(ConfigError, match=message):
        play(CuriosityReward(Odd(size=size)), 5)


class Numbers(gymnasium.Env):
    """Observations 5, 6, 7, …, of which the space has three."""

    observation_space, action_space = Discrete(3, start=5), Discrete(2)

    def __init__(self, first) -> None:
        self.number = first

    def reset(self, *, seed=None, options=None):
        return self.number, {}

    def step(self, action):
        self.number += 1
        return self.number, 0.0, False, False, {}


@pytest.mark.parametrize(("first", "good", "bad"), [(5, 2, 8), (4, 0, 4)])
def test_a_number_outside_its_space_is_refused(first, good, bad):
    env = CuriosityReward(Numbers(first))
    with pytest.raises(ConfigError, match=f"gave an observation of number {bad}, but its obs"):
        play(env, good + 1)
    assert env.env.number == bad


def test_a_vector_environment_has_to_say_how_it_resets():
    env = vector_of("CartPole-v1", 1, AutoresetMode.NEXT_STEP)
    env.metadata = {}
    with pytest.raises(ConfigError, match="should be one of gymnasium"):
        VectorCuriosityReward(env)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(
    ("where", "message"), [("reward", "the reward is .* after step 3"), ("state", "an observation")]
)
def test_numbers_that_go_bad_stop_it(where, message, value):
    env = CuriosityReward(Odd(**{where: value}))
    with pytest.raises(NonFiniteError, match=message):
        play(env, 5)


def test_a_state_that_is_not_finite_is_noticed_at_once_when_novelty_is_estimated():
    env = CuriosityReward(Odd(state=np.nan), novelty={"neighbours": [1], "write_every": 1})
    env.env.state = 0.0
    play(env, 20)
    env.env.state = np.nan
    with pytest.raises(NonFiniteError, match="the curiosity bonus is nan"):
        play(env, 3)
