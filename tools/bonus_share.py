"""Print the bonus's share of the total advantage: of the first tenth of the updates / of the last.

    .venv/bin/python -m tools.bonus_share RUNS VARIANT ...

RUNS is a folder of runs, such as results/controls/runs; a line for each environment, a cell for
each variant: means over seeds.
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
    """Print the table as Markdown; exits with one line if there is nothing to print."""
    if not any(any(runs.glob(f"*/{variant}/seed*/diagnostics.csv")) for variant in variants):
        sys.exit(f"bonus_share: {runs} has no diagnostics.csv of {', '.join(variants)}")
    print(f"| | {' | '.join(variants)} |")
    print("|---" * (1 + len(variants)) + "|")
    for environment in sorted(path for path in runs.iterdir()):
        cells = []
        for variant in variants:
            found = sorted((environment / variant).glob("seed*/diagnostics.csv"))
            means = np.mean([first_and_last(path) for path in found], axis=0) if found else []
            cells.append(" / ".join(f"{value:.2f}" for value in means))
        if any(cells):
            print(f"| {environment.name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.bonus_share results/controls/runs beta_0.4 beta_1",
    )
    parser.add_argument("runs", type=Path, help="a folder of runs, such as results/runs")
    parser.add_argument("variants", nargs="+", help="such as beta_0.4")
    arguments = parser.parse_args()
    main(arguments.runs, arguments.variants)
