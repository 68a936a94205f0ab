"""Curiosity for other agents: several environments side by side."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from wrapped import MODES, RANDOM, play_vector, vector_of

import mace_rl.environments  # noqa: F401  (registers ours)
from mace_rl import wrappers
from mace_rl.wrappers import CuriosityReward, VectorCuriosityReward


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
@pytest.mark.parametrize("mode", MODES)
def test_vector_form_of_one_equals_the_single_form(name, mode):
    inside = SyncVectorEnv(
        [lambda: CuriosityReward(gymnasium.make(name), RANDOM, seed=2)], autoreset_mode=mode
    )
    outside = VectorCuriosityReward(vector_of(name, 1, mode), RANDOM, seed=2)
    ends = 0
    for one, other in zip(play_vector(inside, 400), play_vector(outside, 400), strict=True):
        for part in range(4):
            np.testing.assert_array_equal(one[part], other[part])
        told = one[4]
        if mode is AutoresetMode.SAME_STEP and (one[2] | one[3]).any():
            told, ends = one[4]["final_info"], ends + 1
        for name_ in wrappers.PARTS:
            mask = other[4][f"_{name_}"]
            assert mask.tolist() == told.get(f"_{name_}", np.zeros(1, bool)).tolist()
            if mask.any():
                np.testing.assert_array_equal(told[name_], other[4][name_])
    assert mode is AutoresetMode.NEXT_STEP or ends > 3


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
def test_modes_of_autoreset_pay_alike(name):
    """Three environments, whose resets take a step of their own or none: the same episodes."""

    def episodes(mode):
        env = VectorCuriosityReward(vector_of(name, 1, mode))
        env.reset(seed=7)
        numbers, found = iter(range(10**6)), []
        waiting = False
        while len(found) < 300:
            action = 0 if waiting else np.random.default_rng(next(numbers)).integers(2)
            _, reward, terminated, truncated, info = env.step(np.array([action]))
            if not waiting:
                found.append((reward[0], info["curiosity"][0]))
            ended = bool(terminated[0] or truncated[0])
            waiting = ended and mode is AutoresetMode.NEXT_STEP
            if ended and mode is AutoresetMode.DISABLED:
                env.reset(options={"reset_mask": np.array([True])})
        return found

    next_step, same_step, disabled = (episodes(mode) for mode in AutoresetMode)
    assert next_step == same_step == disabled


def test_what_one_environment_has_seen_is_known_to_the_others():
    """Three chains side by side, whose episodes of 10 steps end together, one after the other."""
    env = VectorCuriosityReward(vector_of("DeepSea10-v0", 3, AutoresetMode.SAME_STEP))
    found = play_vector(env, 10)
    assert all(info["novelty"].tolist() == [1, 1, 1] for *_, info in found)
    again = env.step(np.full(3, np.random.default_rng(0).integers(2)))
    count = sum(0.9995**k for k in (1, 2, 3))  # of the state that the first steps led to
    assert again[4]["novelty"] == pytest.approx(np.full(3, 1 / (count + 1)))
    # One step in 10 of these 30, and the last of each episode.
    assert len(env.appraisal.curiosity.curiosity.memory) == 3 + 3


def test_environments_that_end_at_other_times_keep_their_own_episodes():
    env = VectorCuriosityReward(vector_of("CartPole-v1", 3, AutoresetMode.NEXT_STEP))
    remembered = []
    remember = env.appraisal.curiosity.remember
    env.appraisal.curiosity.remember = lambda *given: (remembered.append(given), remember(*given))
    found = play_vector(env, 300)
    for i in range(3):
        lengths, length = [], 0
        for _, _, terminated, truncated, info in found:
            length += int(info["_curiosity"][i])
            if terminated[i] or truncated[i]:
                lengths.append(length)
                length = 0
        assert len(lengths) > 5
    starts = {episode.observations[0].tobytes() for episode, _ in remembered}
    assert len(starts) == len(remembered) > 15
    for episode, returns in remembered:  # 1 a step: (1 - γ^n) / (1 - γ) with n steps to go
        to_go = np.arange(len(episode), 0, -1)
        np.testing.assert_allclose(returns, (1 - 0.99**to_go) / (1 - 0.99))
        moved = np.diff(episode.observations[:, 0])  # 0.02 s at the velocity before the step
        np.testing.assert_allclose(moved, 0.02 * episode.observations[:-1, 1], atol=1e-6)
