"""`episodes.csv`: one row per training episode, of which all results are computed.

A damaged file is refused with its name and line, lest it become a plausible number in Table 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, get_type_hints

import numpy as np

from mace_rl.base.files import write_atomically
from mace_rl.base.tables import RecordError, read_columns
from mace_rl.config.beta import LARGEST_BETA


@dataclass(frozen=True)
class EpisodeRecord:
    """One episode of training, a row of `episodes.csv`."""

    episode: int  # 1, 2, …
    env_steps: int  # environment steps since the start of training, this episode included
    length: int  # environment steps of this episode
    extrinsic_return: float  # undiscounted sum of the environment's rewards
    intrinsic_return: float  # undiscounted sum of the curiosity bonus, not weighted by β; `rounded`
    beta: float  # β of this episode; `rounded`
    terminated: int  # 1: the environment ended the episode, 0: its time limit did


@dataclass(frozen=True)
class UpdateRecord:
    """One update, a row of `diagnostics.csv`; NaN where a variant has no such number."""

    update: int  # 1, 2, …
    episode: int  # the last one of the update's rollout
    env_steps: int  # environment steps since the start of training
    approximate_kl: float  # mean of r - 1 - log r over the update's last epoch
    clip_fraction: float  # share of the ratios r outside the clipping bounds, last epoch
    entropy: float  # of the policy, mean over the last epoch, nats
    explained_variance_extrinsic: float  # 1 - Var(return - V) / Var(return), before the update
    explained_variance_intrinsic: float
    gradient_norm_actor: float  # of the last minibatch, before clipping
    gradient_norm_extrinsic: float  # of that reward's critic
    gradient_norm_intrinsic: float
    beta: float  # mean over the rollout's episodes
    bonus_share: float  # Σ(β A_I)² / (Σ A_E² + Σ(β A_I)²), in units of their scales
    novelty: float  # mean over the rollout's steps, like the next two
    relevance: float
    similarity: float  # of a state to what the memory holds
    beta_credit: float  # of the rollout whose βs this update finished judging


RunKey = tuple[str, str, int]  # environment, variant, seed

Row = TypeVar("Row", EpisodeRecord, UpdateRecord)


def rounded(value: float) -> float:
    """To six significant digits: enough for every result, and half the size of a kept study."""
    return float(f"{value:.6g}")


def as_columns(kind: type[Row], rows: Sequence[Row]) -> dict[str, np.ndarray]:
    """The values of the rows by column, int64 or float64 [rows]."""
    types = {int: np.int64, float: np.float64}
    return {
        name: np.array([getattr(row, name) for row in rows], types[type_])
        for name, type_ in get_type_hints(kind).items()
    }


def as_rows(kind: type[Row], columns: Mapping[str, np.ndarray]) -> list[Row]:
    """The rows of which `as_columns` made the columns."""
    values = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [kind(**dict(zip(columns, row, strict=True))) for row in values]


def write_episodes(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write `as_columns` of `EpisodeRecord`s, atomically; `RecordError` if they are impossible."""
    check_episodes(path, columns)
    _write(path, columns)


def write_diagnostics(path: str | Path, rows: Sequence[UpdateRecord]) -> None:
    """Write `diagnostics.csv`, atomically; NaN is an empty cell."""
    _write(path, as_columns(UpdateRecord, rows))


def _write(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    # `repr` is the shortest form that reads back as the same double.
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = (",".join("" if value != value else repr(value) for value in row) for row in rows)
    write_atomically(path, "\n".join([",".join(columns), *lines]) + "\n")


def read_episodes(
    path: str | Path, episodes: int, content: bytes | None = None
) -> dict[str, np.ndarray]:
    """What `write_episodes` wrote; `RecordError` for a file that it did not write in full.

    episodes: how many there have to be; content: of the file, if its digest is that in `run.json`.
    """
    types = get_type_hints(EpisodeRecord)
    found = read_columns(path, types, content)
    columns = {name: np.array(found[name], kind) for name, kind in types.items()}
    check_episodes(path, columns)
    if (count := len(columns["episode"])) != episodes:
        raise RecordError(
            f"{path}: line {count + 1} is the last, after {count} episodes;"
            f" the run is configured to have {episodes}"
        )
    return columns


def check_episodes(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Refuse rows that no training could have produced; `columns` hold arrays [episodes]."""
    (number, steps, length, returns, bonus, beta, ended) = columns.values()
    rules = {  # whether each row is right, [episodes], and what would be right
        "episode": (number == np.arange(len(number)) + 1, "the next number"),
        "length": (length >= 1, "at least 1"),
        "env_steps": (steps == np.cumsum(length), "the sum of the lengths so far"),
        "extrinsic_return": (np.isfinite(returns), "finite"),
        "intrinsic_return": (np.isfinite(bonus) & (bonus >= 0), "finite and >= 0"),
        "beta": ((beta >= 0) & (beta <= LARGEST_BETA), f"in [0, {LARGEST_BETA:g}]"),
        "terminated": ((ended >= 0) & (ended <= 1), "0 or 1"),
    }
    wrong = [(int(np.argmin(fits)), name) for name, (fits, _) in rules.items() if not fits.all()]
    if wrong:
        row, name = min(wrong, key=lambda found: found[0])
        value = columns[name][row].item()
        raise RecordError(f"{path}: line {row + 2}: {name} is {value!r}, not {rules[name][1]}")
