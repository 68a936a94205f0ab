"""Measure the mean return of uniformly random actions, for `metrics.random_return` in config.yaml.

.venv/bin/python -m tools.random_return ENVIRONMENT EPISODES
"""

import argparse
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


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.random_return CartPole-v1 2000",
    )
    parser.add_argument("environment", help="its Gymnasium id")
    parser.add_argument("episodes", type=int)
    arguments = parser.parse_args()
    name, episodes = arguments.environment, arguments.episodes
    if episodes < 2:
        sys.exit(f"random_return: EPISODES is {episodes}, but should be at least 2")
    try:
        measured = random_returns(name, episodes)
    except (gymnasium.error.Error, ImportError) as error:
        reason = " ".join(str(error).split())
        sys.exit(f"random_return: ENVIRONMENT is {name!r}, which cannot be made: {reason}")
    standard_error = measured.std(ddof=1) / np.sqrt(episodes)
    print(f"{name}: {measured.mean():.4g} (standard error {standard_error:.2g})")


if __name__ == "__main__":
    main()
