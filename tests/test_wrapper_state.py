"""Curiosity for other agents: saved midway and resumed, and what a seed decides."""

import copy
import io
import re

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import FlattenObservation
from wrapped import BANDIT, ENVIRONMENTS, MODES, RANDOM, SMALL, play, play_vector, step, vector_of

import mace_rl.environments  # noqa: F401  (registers ours)
from mace_rl import wrappers
from mace_rl.config.section import ConfigError
from mace_rl.runs.checkpoint import archive
from mace_rl.wrappers import CuriosityReward, VectorCuriosityReward


def saved(state: dict) -> dict:
    """Through a file's bytes."""
    return torch.load(io.BytesIO(archive(state)), weights_only=True)


@pytest.mark.parametrize("steps", [0, 7, 333, 600])
@pytest.mark.parametrize(
    ("name", "beta"), list(zip(ENVIRONMENTS, [0.4, RANDOM, BANDIT, 1], strict=True))
)
def test_saved_midway_it_continues_to_the_bit(name, beta, steps):
    original = CuriosityReward(gymnasium.make(name), beta, seed=1, **SMALL)
    play(original, steps)
    state = saved(original.state_dict())
    restored = CuriosityReward(copy.deepcopy(original.env), beta, seed=99, **SMALL)
    restored.load_state_dict(state)
    for number in range(500):
        one, other = step(original, 1000 + number), step(restored, 1000 + number)
        np.testing.assert_equal(one, other)
        if one[2] or one[3]:
            original.reset()
            restored.reset()
    assert archive(original.state_dict()) == archive(restored.state_dict())


@pytest.mark.parametrize("mode", MODES)
def test_vector_form_saved_midway_continues_to_the_bit(mode):
    env, action = vector_of("CartPole-v1", 3, mode), np.random.default_rng(0)
    original = VectorCuriosityReward(env, RANDOM, **SMALL)
    play_vector(original, 200)
    restored = VectorCuriosityReward(copy.deepcopy(env), RANDOM, seed=9, **SMALL)
    restored.load_state_dict(saved(original.state_dict()))
    for _ in range(200):
        actions = action.integers(2, size=3)
        one, other = original.step(actions), restored.step(actions)
        np.testing.assert_equal(one[:4], other[:4])
        for part in wrappers.PARTS:
            np.testing.assert_array_equal(one[4][part], other[4][part])


def test_a_state_stays_as_it_was_while_the_training_goes_on():
    env = CuriosityReward(gymnasium.make("CartPole-v1"), BANDIT, **SMALL)
    play(env, 300)
    state = env.state_dict()
    before = archive(copy.deepcopy(state))
    play(env, 300)
    assert archive(state) == before
    env.load_state_dict(state)
    play(env, 300)
    assert archive(state) == before


def test_a_state_made_with_other_settings_is_refused():
    state = CuriosityReward(gymnasium.make("CartPole-v1")).state_dict()
    message = re.escape("made with beta {'kind': 'constant', 'value': 0.4}, but here it is")
    with pytest.raises(ConfigError, match=message):
        CuriosityReward(gymnasium.make("CartPole-v1"), 0.5).load_state_dict(state)
    with pytest.raises(ConfigError, match="made with observation_size 4, but here it is 6"):
        CuriosityReward(gymnasium.make("Acrobot-v1")).load_state_dict(state)
    two = VectorCuriosityReward(vector_of("CartPole-v1", 2, AutoresetMode.NEXT_STEP))
    with pytest.raises(ConfigError, match="made with environments 1, but here it is 2"):
        two.load_state_dict(state)
    discrete = CuriosityReward(gymnasium.make("FrozenLake-v1")).state_dict()
    box = FlattenObservation(gymnasium.make("FrozenLake-v1"))
    with pytest.raises(ConfigError, match="made with observation_space 'Discrete', but here it is"):
        CuriosityReward(box).load_state_dict(discrete)
    del discrete["settings"]["beta"]
    with pytest.raises(
        ConfigError, match="the state to load has no setting beta: another version saved it"
    ):
        CuriosityReward(gymnasium.make("FrozenLake-v1"), 0.9).load_state_dict(discrete)
    state["settings"]["curves"] = 3  # as a later version could have it
    with pytest.raises(ConfigError, match="made with curves 3, which is no setting here"):
        CuriosityReward(gymnasium.make("CartPole-v1")).load_state_dict(state)


def test_equal_seeds_give_equal_rewards_and_others_do_not():
    first, second, third = (
        [item[1] for item in play(CuriosityReward(gymnasium.make("Acrobot-v1"), seed=seed), 1500)]
        for seed in (1, 1, 2)
    )
    assert first == second != third
