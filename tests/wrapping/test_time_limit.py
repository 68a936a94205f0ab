"""A bonus is paid wherever the time limit is: inside the wrapper, outside, or around a vector."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import TimeLimit

from mace_rl import CuriosityReward, VectorCuriosityReward


def limited_outside(env, steps):
    return TimeLimit(CuriosityReward(env, 0.4), steps)


def limited_inside(env, steps):
    return CuriosityReward(TimeLimit(env, steps), 0.4)


def limited_as_a_vector(env, steps):
    vector = VectorCuriosityReward(SyncVectorEnv([lambda: env]), 0.4)

    class Limited(gymnasium.Wrapper):
        def __init__(self):
            self.env, self.count = vector, 0

        def reset(self, **given):
            self.count = 0
            return vector.reset(**given)

        def step(self, action):
            self.count += 1
            observation, reward, ended, _, info = vector.step(np.array([action]))
            return observation, float(reward[0]), bool(ended[0]), self.count == steps, info

    limited = Limited()
    limited.action_space = env.action_space
    return limited


@pytest.mark.parametrize("form", [limited_outside, limited_inside, limited_as_a_vector])
def test_a_bonus_is_paid_wherever_the_time_limit_is(form):
    env = form(gymnasium.make("MountainCar-v0").unwrapped, 50)
    extrinsic = -1.0  # each step's
    env.reset(seed=0)
    paid = 0.0
    for number in range(400):
        env.action_space.seed(number)
        _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        paid += abs(reward - extrinsic)
        if terminated or truncated:
            env.reset()
    assert paid > 1
