"""Does another checkout of this project learn the same? Both over many seeds.

    git worktree add /tmp/old COMMIT
    python -m benchmarks.same_learning /tmp/old 25

Prints, for each environment and variant and both checkouts, the mean over seeds of the final return
and of the episode at which the 50-episode average first covers three quarters of the way from the
random return to the bar's, and the p value of a Mann-Whitney test.
"""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import numpy as np
import scipy

VARIANTS = ("ppo", "mace_full")
# Episodes, return of random actions, and a return that is good so early in training.
ENVIRONMENTS = {
    "CartPole-v1": (500, 22.1, 475),
    "Acrobot-v1": (200, -499.1, -100),
    "HopperBulletEnv-v0": (500, 20.0, 200),
}
# Run inside each checkout, by its own code and configuration.
TRAIN = """
import json, sys, torch
from pathlib import Path
sys.path.insert(0, "src")
from threadpoolctl import threadpool_limits
from mace_rl.train import Trainer
try:
    from mace_rl.config.study import read_study
except ModuleNotFoundError:  # before the package had subpackages
    from mace_rl.study import read_study
torch.set_num_threads(1)
environment, variant, episodes, seeds = *sys.argv[1:3], int(sys.argv[3]), int(sys.argv[4])
study = read_study([Path("config.yaml")])
with threadpool_limits(1):
    for seed in range(seeds):
        config = study.run_config(environment, variant, seed)
        trainer = Trainer(config.model_copy(update={"episodes": episodes}))
        for _ in trainer.run():
            pass
        print(json.dumps([record.extrinsic_return for record in trainer.records]))
"""


def returns(checkout: Path, environment: str, variant: str, seeds: int) -> np.ndarray:
    """Extrinsic returns, [seeds, episodes], of a variant as `checkout` has it."""
    command = [sys.executable, "-c", TRAIN, environment, variant]
    command += [str(ENVIRONMENTS[environment][0]), str(seeds)]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=True)
    return np.array([json.loads(line) for line in done.stdout.splitlines() if line[:1] == "["])


def reached(curves: np.ndarray, bar: float) -> np.ndarray:
    """First episode, [seeds], whose 50-episode average is at `bar`; the last one if none is."""
    averages = np.array([np.convolve(curve, np.full(50, 1 / 50), "valid") for curve in curves])
    there = averages >= bar
    return np.where(there.any(axis=1), there.argmax(axis=1) + 50, curves.shape[1])


def main() -> None:
    """Compare this checkout with the one named."""
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    other, seeds = Path(sys.argv[1]), int(sys.argv[2])
    checkouts = (other, Path(__file__).resolve().parents[1])
    for environment, variant in product(ENVIRONMENTS, VARIANTS):
        with ThreadPoolExecutor(len(checkouts)) as pool:
            curves = list(
                pool.map(lambda place: returns(place, environment, variant, seeds), checkouts)  # noqa: B023
            )
        episodes, random, good = ENVIRONMENTS[environment]
        for name, (then, now) in (
            ("final return", [curve[:, -(episodes // 10) :].mean(axis=1) for curve in curves]),
            (
                "episodes to the bar",
                [reached(curve, random + 0.75 * (good - random)) for curve in curves],
            ),
        ):
            p = scipy.stats.mannwhitneyu(then, now).pvalue
            means = f"{then.mean():.1f} and {now.mean():.1f}"
            print(f"{environment} {variant} {name}: {means}, p = {p:.2f}", flush=True)


if __name__ == "__main__":
    main()
