"""`episodes.csv`: one row per training episode, of which all results are computed.

A damaged file is refused with its name and line, lest it become a plausible number in Table 1.
"""

import csv
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, get_type_hints

import numpy as np

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.base.files import write_atomically
from mace_rl.config.beta import LARGEST_BETA

if TYPE_CHECKING:  # training only writes, without pandas
    import pandas as pd


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
    beta_credit: float  # mean credit of the βs judged in this update


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


_BOUND = {int: 2**53, float: np.inf}  # below which an int is exact as a double
ALTERED = "missing, cut off or altered (SHA-256 not as in run.json)"


class RecordError(Refusal, ValueError):
    """A result file that cannot be trusted; the message names the file and the line."""


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


def read_episodes(path: str | Path, episodes: int, digest: str | None = None) -> "pd.DataFrame":
    """The records of a finished run: a frame with the columns of `EpisodeRecord`, int64 or float64.

    episodes: how many there have to be; digest: the file's SHA-256 in `run.json`. Raises
    `RecordError` for a file that `write_episodes` did not write in full, or with another digest.
    """
    columns = get_type_hints(EpisodeRecord)
    frame = read_table(path, columns, digest)
    check_episodes(path, {name: frame[name].to_numpy() for name in columns})
    if len(frame) != episodes:
        raise RecordError(
            f"{path}: line {len(frame) + 1} is the last, after {len(frame)} episodes;"
            f" the run is configured to have {episodes}"
        )
    return frame


def read_table(
    path: str | Path, columns: Mapping[str, type], digest: str | None = None
) -> "pd.DataFrame":
    """A CSV file with exactly the `columns`, each int, float or str, as a frame.

    Raises `RecordError` unless its rows would be written like this to the byte, or if its SHA-256
    is not `digest`.
    """
    import pandas as pd

    try:
        content = files.content(path)
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror}") from None
    known = hashlib.sha256(content).hexdigest() == digest
    *lines, rest = content.split(b"\n")
    if rest or not lines:
        raise RecordError(f"{path}: line {len(lines) + 1}: the file ends within this line")
    header = lines[0].decode(errors="replace").split(",")
    for found, wanted in zip_longest(header, columns, fillvalue=""):
        if found != wanted:
            raise RecordError(
                f"{path}: line 1: the column {found!r} stands where {wanted!r} should"
            )
    try:
        frame = pd.read_csv(
            io.BytesIO(content), dtype=dict(columns), keep_default_na=False, quoting=csv.QUOTE_NONE
        )
        numbers = [name for name, kind in columns.items() if kind is not str]
        whole = known or (
            all((frame[name].abs() < _BOUND[columns[name]]).all() for name in numbers)
            and _text(frame) == content
        )
    except (ValueError, OverflowError, csv.Error):
        whole = False  # the first wrong line is named below
    if whole and digest and not known:
        raise RecordError(f"{path}: {ALTERED}")
    if whole:
        return frame
    for number, line in enumerate(lines[1:], start=2):
        try:
            row = line.decode().split(",")
            if len(row) != len(columns):
                raise ValueError(f"{len(row)} cells instead of {len(columns)}")
            for cell, kind, name in zip(row, columns.values(), columns, strict=True):
                _parse(cell, kind, name)
        except ValueError as error:
            raise RecordError(f"{path}: line {number}: {error}") from None
    raise AssertionError("a file cannot be read whose cells all can")


def _text(frame: "pd.DataFrame") -> bytes:
    """`frame.to_csv` without quotes and index, in half the time."""
    cells = (map(str, column.tolist()) for _, column in frame.items())
    rows = map(",".join, zip(*cells, strict=True))
    return "\n".join([",".join(map(str, frame)), *rows, ""]).encode()


def _parse(cell: str, kind: type, name: str) -> int | float | str:
    """One cell as `kind`; `ValueError` with column and cell if it would be written otherwise."""
    try:
        value = kind(cell)
    except ValueError:
        value = np.nan
    if str(value) != cell or not (kind is str or abs(value) < _BOUND[kind]):
        wanted = "an integer" if kind is int else "a finite number"
        raise ValueError(f"{name} is {cell!r}, not {wanted}")
    return value


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
