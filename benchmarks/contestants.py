"""What is timed. Each function here prepares one training, or one environment without an agent.

It returns an iterator that works while it is iterated over and yields the environment steps done so
far, whenever that is known. What happens before the first `next` is not timed.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
import pybullet_envs_gymnasium  # noqa: F401  (registers HopperBulletEnv-v0)

from benchmarks.settings import OURS, ROOT

if TYPE_CHECKING:  # imported where it is used: the others' memory should not hold it
    from mace_rl.hyperparameters import RunConfig

ENDLESS = 10**9  # episodes


def start(contestant: str, environment: str, seed: int, steps: int) -> Iterator[int]:
    """Prepare `contestant` for at least `steps` steps in `environment`."""
    match contestant:
        case "environment":
            return alone(gymnasium.make(environment, disable_env_checker=True), seed, steps)
        case "environment_fast":
            from mace_rl.environments import Environment

            return alone(Environment(environment, seed).env, seed, steps)
        case "sb3_default":
            return stable_baselines3(environment, seed, steps)
        case "sb3_2048x4":
            full_batch = {"n_steps": 2048, "batch_size": 2048, "n_epochs": 4}
            return stable_baselines3(environment, seed, steps, **full_batch)
        case _:
            from mace_rl.train import Trainer

            trainer = Trainer(our_config(contestant, environment, seed))
            return (records[-1].env_steps for records in trainer.run())


def our_config(contestant: str, environment: str, seed: int) -> "RunConfig":
    """The study's settings of one of `OURS`, but without an end."""
    from mace_rl.study import read_study

    study = read_study([ROOT / "config.yaml"])
    config = study.run_config(environment, OURS[contestant], seed)
    rollout_steps = 2048 if contestant == "ppo_2048" else config.ppo.rollout_steps
    ppo = config.ppo.model_copy(update={"rollout_steps": rollout_steps})
    return config.model_copy(update={"ppo": ppo, "episodes": ENDLESS})


def alone(env: gymnasium.Env, seed: int, steps: int) -> Iterator[int]:
    """Random actions, drawn beforehand; resets are part of the work."""
    rng = np.random.default_rng(seed)
    if isinstance(env.action_space, gymnasium.spaces.Discrete):
        actions = rng.integers(env.action_space.n, size=steps).tolist()
    else:
        size = (steps, *env.action_space.shape)
        actions = list(rng.uniform(-1, 1, size).astype(np.float32))
    env.reset(seed=seed)

    def play() -> Iterator[int]:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        yield steps

    return play()


def stable_baselines3(environment: str, seed: int, steps: int, **settings: int) -> Iterator[int]:
    """stable-baselines3's PPO; `settings` are its own, all others its defaults."""
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", environment, seed=seed, device="cpu", **settings)

    def learn() -> Iterator[int]:
        model.learn(steps)
        yield model.num_timesteps

    return learn()
