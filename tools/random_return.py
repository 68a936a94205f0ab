"""Measure the mean return of uniformly random actions, for `metrics.random_return` in config.yaml.

.venv/bin/python -m tools.random_return ENVIRONMENT EPISODES [CONFIG ...]

The environment is the one that a study trains in: with the time limit and the arguments that
config.yaml, and the files CONFIG read over it, set for it.
"""

import argparse
import sys
from pathlib import Path

import gymnasium
import numpy as np

from mace_rl.config.reading import merge, read_yaml
from mace_rl.config.run import RunConfig
from mace_rl.config.section import ConfigError
from mace_rl.config.study import Study, load_study

ROOT = Path(__file__).resolve().parent.parent


def study_of(environment: str, overlays: list[str]) -> Study:
    """The study of config.yaml and the files over it, in this environment alone.

    `ConfigError` for what cannot be one; a random return is not asked for.
    """
    config = read_yaml(ROOT / "config.yaml")
    for overlay in overlays:
        config = merge(config, read_yaml(Path(overlay)))
    config["environments"] = [environment]
    config["metrics"]["random_return"].setdefault(environment, 0.0)
    return load_study(config, " + ".join(["config.yaml", *overlays]))


def random_returns(config: RunConfig, episodes: int) -> np.ndarray:
    """Undiscounted return of each episode, [episodes], with seed 0."""
    env = gymnasium.make(
        config.environment,
        max_episode_steps=config.max_episode_steps,
        **config.environment_arguments,
    )
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
    parser.add_argument("configs", nargs="*", help="files over config.yaml")
    arguments = parser.parse_args()
    name, episodes = arguments.environment, arguments.episodes
    if episodes < 2:
        sys.exit(f"random_return: EPISODES is {episodes}, but should be at least 2")
    try:
        config = study_of(name, arguments.configs).run_config(name, "ppo", 0)
    except ConfigError as error:
        sys.exit(f"random_return: {error}")
    measured = random_returns(config, episodes)
    standard_error = measured.std(ddof=1) / np.sqrt(episodes)
    print(f"{name}: {measured.mean():.4g} (standard error {standard_error:.2g})")


if __name__ == "__main__":
    main()
