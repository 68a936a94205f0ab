"""Print the β that runs end with: its mean over the last 10 % of the episodes, sorted by size.

.venv/bin/python tools/final_beta.py RUNS [VARIANT]

RUNS is a folder of runs, such as results/planted/runs; VARIANT is mace_full unless given.
"""

import sys
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
        print(f"{environment}: {', '.join(f'{value:.2f}' for value in sorted(found))}")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) == 3 else "mace_full")
