"""Does β rise when progress stalls, as the paper says? The correlation of the two, over seeds.

.venv/bin/python tools/stagnation.py RUNS [VARIANT]

RUNS is a folder of runs, such as results/runs; VARIANT is mace_full unless given. For each run:
Spearman's correlation, over all episodes from the 100th on, of stagnation, minus the slope of the
50-episode moving average as `results.metrics.slope` has it, with β of the next episode. Printed for
each environment: the mean over seeds and its 95 % interval. The claim wants it positive. A β that
never changes has no correlation; such runs are counted beside it.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import scipy

from mace_rl.results.metrics import slope
from mace_rl.results.statistics import mean_interval

WINDOW = 50  # episodes


def correlation(run: Path) -> float:
    """Of stagnation and the β that follows it; NaN where either is constant."""
    frame = pd.read_csv(run / "episodes.csv")
    stagnation = -slope(frame["extrinsic_return"].to_numpy(), WINDOW)[:-1]
    following = frame["beta"].to_numpy()[2 * WINDOW :]
    if np.ptp(stagnation) == 0 or np.ptp(following) == 0:
        return float("nan")
    return float(scipy.stats.spearmanr(stagnation, following).statistic)


def main(runs: Path, variant: str) -> None:
    """Print a line for each environment."""
    for environment in sorted(path.name for path in runs.iterdir()):
        found = [correlation(run) for run in sorted((runs / environment / variant).glob("seed*"))]
        values = np.array([value for value in found if np.isfinite(value)])
        if len(values) < 2:
            print(f"{environment}: {len(values)} of {len(found)} runs have a correlation")
            continue
        low, high = mean_interval(values, 0.95, 10_000, np.random.default_rng(0))
        print(
            f"{environment}: {values.mean():+.2f} ({low:+.2f} to {high:+.2f}),"
            f" {len(values)} of {len(found)} seeds"
        )


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) == 3 else "mace_full")
