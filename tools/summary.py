"""Print a metrics.csv as a table: for each environment and variant the mean and its 95 % interval.

.venv/bin/python tools/summary.py METRICS.csv [COLUMN ...]

Columns are those of the file, by default final_return, area_under_curve and, where there is one,
solved. Intervals are those of the tables (`results.statistics.mean_interval`).
"""

import sys

import numpy as np
import pandas as pd

from mace_rl.results.statistics import mean_interval

DEFAULT = ("final_return", "area_under_curve", "solved")


def summary(table: pd.DataFrame, columns: list[str]) -> list[str]:
    """Lines of a Markdown table."""
    lines = ["| environment | variant | seeds | " + " | ".join(columns) + " |"]
    lines.append("|" + "---|" * (3 + len(columns)))
    for (environment, variant), runs in table.groupby(["env", "variant"], sort=False):
        cells = []
        for column in columns:
            values = runs[column].to_numpy(np.float64)
            low, high = mean_interval(values, 0.95, 10_000, np.random.default_rng(0))
            cells.append(f"{values.mean():.4g} ({low:.4g} to {high:.4g})")
        solved = f", {int((runs['solved'] >= 0.9).sum())} ≥ 0.9" if "solved" in columns else ""
        lines.append(f"| {environment} | {variant} | {len(runs)} | {' | '.join(cells)}{solved} |")
    return lines


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    frame = pd.read_csv(sys.argv[1])
    wanted = sys.argv[2:] or [name for name in DEFAULT if name in frame.columns]
    print("\n".join(summary(frame, wanted)))
