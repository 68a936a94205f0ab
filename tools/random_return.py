"""Measure the mean return of uniformly random actions, for `metrics.random_return` in config.yaml.

.venv/bin/python -m tools.random_return ENVIRONMENT EPISODES
"""

import argparse

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
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.random_return CartPole-v1 2000",
    )
    parser.add_argument("environment", help="its Gymnasium id")
    parser.add_argument("episodes", type=int)
    arguments = parser.parse_args()
    measured = random_returns(arguments.environment, arguments.episodes)
    error = measured.std(ddof=1) / np.sqrt(len(measured))
    print(f"{arguments.environment}: {measured.mean():.4g} (standard error {error:.2g})")
