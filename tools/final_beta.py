"""Print the β that runs end with: its mean over the last 10 % of the episodes, sorted by size.

    .venv/bin/python -m tools.final_beta RUNS [VARIANT]

RUNS is a folder of runs, such as results/planted/runs; VARIANT is mace_full unless given.
"""

import argparse
from pathlib import Path

import pandas as pd

from mace_rl.results.metrics import final_return


def main(runs: Path, variant: str) -> None:
    """Print a line for each environment."""
    for environment in sorted(path.name for path in runs.iterdir()):
        found = [
            final_return(pd.read_csv(path)["beta"].to_numpy(), 0.1)
            for path in (runs / environment / variant).glob("seed*/episodes.csv")
        ]
        if found:
            print(f"{environment}: {', '.join(f'{value:.2f}' for value in sorted(found))}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.final_beta results/tables/planted/runs",
    )
    parser.add_argument("runs", type=Path, help="a folder of runs, such as results/runs")
    parser.add_argument("variant", nargs="?", default="mace_full", help="(default: mace_full)")
    arguments = parser.parse_args()
    main(arguments.runs, arguments.variant)
