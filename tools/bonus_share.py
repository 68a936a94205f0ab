"""Measure the bonus's share of the total advantage in the first and last tenth of the updates.

    .venv/bin/python -m tools.bonus_share RUNS VARIANT ... > reference/measured/bonus_share.csv

RUNS is a folder of runs, such as results/controls/runs, with their diagnostics.csv, which
reference/study does not keep. A row for each environment and variant, means over seeds;
`tools.show shares reference/measured` prints them as a table.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd


def first_and_last(diagnostics: Path) -> tuple[float, float]:
    """The mean share in the first and in the last tenth of a run's updates."""
    share = pd.read_csv(diagnostics)["bonus_share"].to_numpy()
    tenth = -(-len(share) // 10)
    return float(share[:tenth].mean()), float(share[-tenth:].mean())


def main(runs: Path, variants: list[str]) -> None:
    """Print the rows as CSV; exits with one line if there are none."""
    rows = []
    for environment in sorted(runs.glob("*")):
        for variant in variants:
            found = sorted((environment / variant).glob("seed*/diagnostics.csv"))
            if found:
                first, last = np.mean([first_and_last(path) for path in found], axis=0)
                rows.append((environment.name, variant, len(found), first, last))
    if not rows:
        sys.exit(f"bonus_share: {runs} has no diagnostics.csv of {', '.join(variants)}")
    table = pd.DataFrame(rows, columns=["env", "variant", "seeds", "first", "last"])
    print(table.to_csv(index=False, float_format="%.4f"), end="")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.bonus_share results/controls/runs beta_0.4 beta_1",
    )
    parser.add_argument("runs", type=Path, help="a folder of runs, such as results/runs")
    parser.add_argument("variants", nargs="+", help="such as beta_0.4")
    arguments = parser.parse_args()
    main(arguments.runs, arguments.variants)
