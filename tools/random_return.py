"""Measure the mean return of uniformly random actions, for `metrics.random_return` in config.yaml.

    .venv/bin/python -m tools.random_return ENVIRONMENT EPISODES [CONFIG ...]

The environment is the one that a study trains in: with the time limit, the arguments and the
wrappers that config.yaml, and the files CONFIG read over it, set for it.
"""

import argparse
import sys
from typing import Any

import gymnasium
import numpy as np

from mace_rl.base.rng import Streams
from mace_rl.config.run import RunConfig
from mace_rl.config.section import ConfigError
from mace_rl.library import settings
from mace_rl.training.factories import environment
from mace_rl.training.rollout import endless


def random_returns(config: RunConfig, episodes: int) -> np.ndarray:
    """Undiscounted return of each episode, [episodes], with seed 0.

    `ConfigError` if the environment cannot be made with these arguments.
    """
    made = environment(config, Streams(0))
    env: gymnasium.Env[Any, Any] = made.env
    env.action_space.seed(0)
    env.reset(seed=0)
    returns = np.zeros(episodes)
    for episode in range(episodes):
        env.reset()
        for _ in range(made.max_steps):
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            returns[episode] += reward
            if terminated or truncated:
                break
        else:
            raise ConfigError(f"environment {made.name!r} {endless(made)}")
    return returns


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.random_return CartPole-v1 2000",
    )
    parser.add_argument("environment", help="its Gymnasium id")
    parser.add_argument("episodes", type=int)
    parser.add_argument("configs", nargs="*", default=[], help="files over config.yaml")
    arguments = parser.parse_args()
    name, episodes = arguments.environment, arguments.episodes
    if episodes < 2:
        sys.exit(f"random_return: EPISODES is {episodes}, but should be at least 2")
    try:
        measured = random_returns(settings(name, "ppo", config=arguments.configs), episodes)
    except ConfigError as error:
        sys.exit(f"random_return: {error}")
    standard_error = measured.std(ddof=1) / np.sqrt(episodes)
    print(f"{name}: {measured.mean():.4g} (standard error {standard_error:.2g})")


if __name__ == "__main__":
    main()
