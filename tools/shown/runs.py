"""What tools.show prints of kept runs, and of what was measured while runs trained."""

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from mace_rl import files
from mace_rl.results.claims import stagnation_correlation
from mace_rl.results.metrics import final_return
from mace_rl.results.paper import FULL
from tools import kept_runs
from tools.shown.cells import SETTINGS, mean, number


def betas(folder: Path, *environments: str) -> list[str]:
    """The mean β of the last part of the episodes, of each seed, in order of size."""
    part = SETTINGS.final_fraction
    return _of_each_seed(
        folder, environments, "β at the end", lambda beta: final_return(beta, part)
    )


def lowest(folder: Path, *environments: str) -> list[str]:
    """The lowest β of all episodes, of each seed, in order of size."""
    return _of_each_seed(folder, environments, "lowest β", np.min)


def _of_each_seed(
    folder: Path, environments: Sequence[str], title: str, value: Callable[[np.ndarray], float]
) -> list[str]:
    """A table of `value` of the learned βs [episodes] of each seed."""
    lines = [f"| | seeds | {title} |", "|---|---|---|"]
    for environment in environments:
        runs = _learned(folder, environment)
        found = sorted(value(episodes["beta"].to_numpy()) for episodes in runs)
        numbers = ", ".join(f"{beta:.2f}" for beta in found)
        lines.append(f"| {environment} | {len(found)} | {numbers} |")
    return lines


def stagnation(folder: Path, *environments: str) -> list[str]:
    """The correlation of stagnation with the learned β that follows (C9): mean over seeds."""
    lines = ["| | seeds | correlation |", "|---|---|---|"]
    for environment in environments:
        found = pd.Series(
            [
                stagnation_correlation(
                    episodes["extrinsic_return"].to_numpy(np.float64),
                    episodes["beta"].to_numpy(),
                    SETTINGS.moving_average,
                )
                for episodes in _learned(folder, environment)
            ]
        )
        lines.append(f"| {environment} | {len(found)} | {mean(found, '.3f')} |")
    return lines


def _learned(folder: Path, environment: str) -> list[pd.DataFrame]:
    """The episodes of the kept runs in which β was learned, in the order of seeds."""
    kept = kept_runs.read(folder / environment / f"{FULL}.tar.xz")
    names = (name for name in kept if name.endswith(files.EPISODES))
    return [pd.read_csv(io.BytesIO(kept[name])) for name in names]


def shares(folder: Path) -> list[str]:
    """The share in the first tenth of the updates / in the last, by variant."""
    table = pd.read_csv(folder / "bonus_share.csv")
    variants = list(table["variant"].unique())
    lines = [f"| | seeds | {' | '.join(variants)} |", "|---" * (2 + len(variants)) + "|"]
    for environment, rows in table.groupby("env", sort=False):
        found = {row.variant: f"{row.first:.2f} / {row.last:.2f}" for row in rows.itertuples()}
        cells = " | ".join(found.get(variant, "") for variant in variants)
        lines.append(f"| {environment} | {rows['seeds'].min()} | {cells} |")
    return lines


def signals(folder: Path) -> list[str]:
    """Each measure of `tools.meta_signal` in the first / second / last third of training."""
    table = pd.read_csv(folder / "meta_signal.csv")
    measures = list(table["measure"].unique())
    lines = [f"| | seeds | {' | '.join(measures)} |", "|---" * (2 + len(measures)) + "|"]
    for (environment, episodes, seeds), rows in table.groupby(
        ["env", "episodes", "seeds"], sort=False
    ):
        found = {name: rows.loc[rows["measure"] == name, "value"] for name in measures}
        cells = [" / ".join(number(value, 2) for value in found[name]) for name in measures]
        lines.append(f"| {environment}, {episodes} | {seeds} | {' | '.join(cells)} |")
    return lines
