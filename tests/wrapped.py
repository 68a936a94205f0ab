"""What the tests of the wrappers share: small settings, and environments that are played."""

import copy

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv

# Limits small enough that the buffer and the memory get full within a test, and replace what they
# hold.
SMALL = {
    "memory": {"capacity": 60, "write_every": 3},
    "novelty": {"buffer_size": 120, "write_every": 2, "neighbours": [3, 8, 5]},
}
RANDOM = {"kind": "random", "low": 0.2, "high": 0.7}
BANDIT = {"kind": "bandit", "arms": [0.1, 0.5], "window": 5, "exploration": 1.0, "epsilon": 0.3}
ENVIRONMENTS = ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1", "DeepSea10-v0"]
MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP]


def step(env, number: int):
    """A step with an action that depends on its number alone."""
    space = env.action_space
    rng = np.random.default_rng(number)
    if isinstance(space, Discrete):
        return env.step(int(rng.integers(space.n)))
    return env.step(rng.uniform(space.low, space.high).astype(np.float32))


def play(env, steps: int, seed: int = 0) -> list[tuple]:
    """What so many steps returned, episode after episode."""
    env.reset(seed=seed)
    found = []
    for number in range(steps):
        found.append(copy.deepcopy(step(env, number)))
        if found[-1][2] or found[-1][3]:
            env.reset()
    return found


def vector_of(name: str, count: int, mode: AutoresetMode) -> SyncVectorEnv:
    makers = [lambda: gymnasium.make(name) for _ in range(count)]
    return SyncVectorEnv(makers, autoreset_mode=mode)


def play_vector(env, steps: int, seed: int = 0) -> list[tuple]:
    """The same of several environments, with the same actions in each as `play` would take."""
    env.reset(seed=seed)
    found = []
    for number in range(steps):
        action = np.random.default_rng(number).integers(env.single_action_space.n)
        found.append(copy.deepcopy(env.step(np.full(env.num_envs, action))))
    return found
