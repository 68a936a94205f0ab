"""Does another checkout of this project learn the same? PPO by both, over many seeds.

    git worktree add /tmp/old COMMIT
    .venv/bin/python -m benchmarks.same_learning /tmp/old 60

Prints, for each environment and both checkouts, the mean over seeds of the final return and of the
episode at which the 50-episode average first covers three quarters of the way from the random
return to -100 (Acrobot) or 475 (CartPole), and the p value of a Mann-Whitney test.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import scipy

EPISODES = {"CartPole-v1": 500, "Acrobot-v1": 200}
BARS = {"CartPole-v1": 22.1 + 0.75 * (475 - 22.1), "Acrobot-v1": -499.1 + 0.75 * (-100 + 499.1)}
# Run inside each checkout, by its own code and configuration.
TRAIN = """
import json, sys, torch, yaml
sys.path.insert(0, "src")
from mace_rl.hyperparameters import RunConfig, check
from mace_rl.train import Trainer
torch.set_num_threads(1)
environment, episodes, seeds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
settings = yaml.safe_load(open("config.yaml"))
training = settings["training"] | settings["variant_settings"]["ppo"] | {"episodes": episodes}
for seed in range(seeds):
    run = {"environment": environment, "variant": "ppo", "seed": seed} | training
    trainer = Trainer(check(RunConfig, run, "config.yaml"))
    for _ in trainer.run():
        pass
    print(json.dumps([record.extrinsic_return for record in trainer.records]))
"""


def returns(checkout: Path, environment: str, seeds: int) -> np.ndarray:
    """Extrinsic returns, [seeds, episodes], of PPO as `checkout` has it."""
    command = [sys.executable, "-c", TRAIN, environment, str(EPISODES[environment]), str(seeds)]
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
    for environment in EPISODES:
        curves = [
            returns(checkout, environment, seeds)
            for checkout in (other, Path(__file__).resolve().parents[1])
        ]
        last = EPISODES[environment] // 10
        for name, measured in (
            ("final return", [curve[:, -last:].mean(axis=1) for curve in curves]),
            ("episodes to the bar", [reached(curve, BARS[environment]) for curve in curves]),
        ):
            then, now = measured
            p = scipy.stats.mannwhitneyu(then, now).pvalue
            print(f"{environment} {name}: {then.mean():.1f} and {now.mean():.1f}, p = {p:.2f}")


if __name__ == "__main__":
    main()
