"""stable-baselines3's PPO on an exploration task, without and with the curiosity reward.

Prints the mean extrinsic return of all episodes and of the last tenth of them, for each seed, then
their means over the seeds and the differences, with 95 % intervals; and β over training.
"""

import argparse
import sys
from typing import Any

import mace_rl.base.cpu_features  # noqa: F401  # isort: skip  (before NumPy: equal bits on every processor)

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import FlattenObservation
from minigrid.wrappers import ImgObsWrapper  # registers MiniGrid, too
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

from mace_rl.base.errors import Refusal
from mace_rl.wrapping.wrappers import CuriosityReward
from mace_study.compare.statistics import mean_interval, paired_comparison

MEASURES = ("all episodes", "last tenth")


class Betas(BaseCallback):
    """β of each step, from `info`."""

    def __init__(self) -> None:
        super().__init__()
        self.values: list[float] = []

    def _on_step(self) -> bool:
        self.values += [info.get("beta", 0.0) for info in self.locals["infos"]]
        return True


def train(
    environment: str, beta: float | str | None, seed: int, steps: int, centred: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """A training's extrinsic returns, [episodes], and β in each tenth of it, [10].

    beta: None for PPO alone.
    """
    monitor = Monitor(gymnasium.make(environment))  # inside, so that it sees extrinsic rewards
    env: gymnasium.Env[Any, Any] = monitor
    if beta is not None:
        env = CuriosityReward(monitor, beta, centred=centred, seed=seed)
    if environment.startswith("MiniGrid-"):  # whose policy reads the image, flattened
        env = FlattenObservation(ImgObsWrapper(env))
    agent = PPO("MlpPolicy", env, n_steps=256, batch_size=256, seed=seed, device="cpu")
    betas = Betas()
    agent.learn(steps, callback=betas)
    tenths = [part.mean() for part in np.array_split(betas.values, 10)]
    return np.array(monitor.get_episode_rewards()), np.array(tenths)


def main() -> None:
    """Train with every seed, and print what came out as a table in Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="example: python examples/sb3_ppo.py --seeds 2 --first-seed 1000",
    )
    parser.add_argument("--environment", default="DeepSea10-v0", help="default: %(default)s")
    parser.add_argument("--steps", type=int, default=12_000, help="default: %(default)s")
    parser.add_argument("--seeds", type=int, default=10, help="how many, default: %(default)s")
    parser.add_argument("--first-seed", type=int, default=0, help="default: %(default)s")
    kind = "β: a number, or learned (default: %(default)s)"
    parser.add_argument("--beta", default="0.4", help=kind)
    pays = "pay all of R_curiosity, not what is beyond its present mean"
    parser.add_argument("--uncentred", action="store_true", help=pays)
    arguments = parser.parse_args()
    for option, least in {"steps": 1, "seeds": 1, "first_seed": 0}.items():
        value = getattr(arguments, option)
        if value < least:
            name = option.replace("_", "-")
            parser.error(f"--{name} is {value}, but should be at least {least}")
    try:
        gymnasium.make(arguments.environment).close()
    except (gymnasium.error.Error, ImportError) as error:
        reason = " ".join(str(error).split())
        sys.exit(f"sb3_ppo: --environment {arguments.environment!r} cannot be made: {reason}")
    try:
        beta = arguments.beta if arguments.beta == "learned" else float(arguments.beta)
        CuriosityReward(gymnasium.make(arguments.environment), beta).close()
    except Refusal as error:
        sys.exit(f"sb3_ppo: {error}")
    except ValueError:
        parser.error(f"--beta is {arguments.beta!r}, but should be a number or learned")
    torch.set_num_threads(1)
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    found = np.empty((len(MEASURES), 2, len(seeds)))  # without and with curiosity
    betas = np.empty((len(seeds), 10))
    heads = [f"{agent}: {name}" for name in MEASURES for agent in ("PPO", "with curiosity")]
    print("| seed |", " | ".join(heads), "|")
    print("| --- |", " | ".join(["--:"] * len(heads)), "|", flush=True)
    for i, seed in enumerate(seeds):
        for curious in (False, True):
            own = arguments.environment, beta if curious else None, seed, arguments.steps
            returns, betas[i] = train(*own, centred=not arguments.uncentred)
            if not len(returns):
                sys.exit(f"sb3_ppo: no episode ended in --steps {arguments.steps}: give more")
            last = returns[-max(len(returns) // 10, 1) :]
            found[:, int(curious), i] = returns.mean(), last.mean()
        row = [f"{value:z.2f}" for value in found[:, :, i].ravel()]
        print("|", " | ".join([str(seed), *row]), "|", flush=True)
    rng = np.random.default_rng(0)
    cells = []
    for values in found.reshape(-1, len(seeds)):
        low, high = mean_interval(values, 0.95, 10_000, rng)
        cells.append(f"{values.mean():z.2f} ({low:z.2f} to {high:z.2f})")
    print("| mean |", " | ".join(cells), "|\n")
    for name, (without, with_curiosity) in zip(MEASURES, found, strict=True):
        gain = paired_comparison(with_curiosity - without, 0.95, 10_000, rng)
        interval = f"{gain.difference:z.2f} ({gain.low:z.2f} to {gain.high:z.2f})"
        print(f"with curiosity minus without, {name}: {interval}, p = {gain.p_value:.4f}")
    for what, each in (("β", betas.mean(0)), ("its deviation over seeds", betas.std(0))):
        print(f"{what}, in tenths of training:", " ".join(f"{value:.2f}" for value in each))


if __name__ == "__main__":
    main()
