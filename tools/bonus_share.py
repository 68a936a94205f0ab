"""Measure the bonus's share of the total advantage in the first and last tenth of the updates.

    .venv/bin/python -m tools.bonus_share FILE RUNS VARIANT ...

RUNS is a folder of runs, such as results/controls/runs, with their diagnostics.csv, which
reference/study does not keep. A row for each environment and variant, means over seeds, replaces
what FILE (CSV) had of both; that is reference/measured/bonus_share.csv for `tools.show shares`.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from mace_rl.files import write_atomically


def first_and_last(diagnostics: Path) -> tuple[float, float]:
    """The mean share in the first and in the last tenth of a run's updates."""
    share = pd.read_csv(diagnostics)["bonus_share"].to_numpy()
    tenth = -(-len(share) // 10)
    return float(share[:tenth].mean()), float(share[-tenth:].mean())


def main(file: Path, runs: Path, variants: list[str]) -> None:
    """Put the rows into `file`; exits with one line if there are none."""
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
    if file.exists():
        table = pd.concat([pd.read_csv(file), table])
        table = table.drop_duplicates(["env", "variant"], keep="last")
    table = table.sort_values(["env", "variant"])
    write_atomically(file, table.to_csv(index=False, float_format="%.4f"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.bonus_share shares.csv results/controls/runs beta_0.4",
    )
    parser.add_argument("file", type=Path, help="where the rows go")
    parser.add_argument("runs", type=Path, help="a folder of runs, such as results/runs")
    parser.add_argument("variants", nargs="+", help="such as beta_0.4")
    arguments = parser.parse_args()
    main(arguments.file, arguments.runs, arguments.variants)
