"""Measure the mean return of uniformly random actions, for `metrics.random_return` in config.yaml.

.venv/bin/python tools/random_return.py ENVIRONMENT EPISODES
"""

import sys

import gymnasium
import numpy as np
import pybullet_envs_gymnasium  # noqa: F401  (registers HopperBulletEnv-v0)

import mace_rl.environments  # noqa: F401  (registers our own)


def random_returns(name: str, episodes: int) -> np.ndarray:
    """Undiscounted return of each episode, [episodes], with seed 0."""
    env = gymnasium.make(name)
    env.action_space.seed(0)
    env.reset(seed=0)
    returns = np.zeros(episodes)
    for episode in range(episodes):
        env.reset()
        over = False
        while not over:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            returns[episode] += reward
            over = terminated or truncated
    return returns


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    measured = random_returns(sys.argv[1], int(sys.argv[2]))
    error = measured.std(ddof=1) / np.sqrt(len(measured))
    print(f"{sys.argv[1]}: {measured.mean():.4g} (standard error {error:.2g})")
