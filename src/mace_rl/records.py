"""`episodes.csv`: one row per training episode, and the only thing the results are computed from.

A file that is not exactly what training writes is refused with one line that names the file and
the line, because a damaged record would otherwise become a plausible number in Table 1.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mace_rl.files import write_atomically

if TYPE_CHECKING:  # pandas is imported where a frame is built: training only writes
    import pandas as pd


@dataclass(frozen=True)
class Record:
    """One episode of training, a row of `episodes.csv`."""

    episode: int  # 1, 2, …
    env_steps: int  # environment steps since the start of training, this episode included
    length: int  # environment steps of this episode
    extrinsic_return: float  # undiscounted sum of the environment's rewards
    intrinsic_return: float  # undiscounted sum of the curiosity bonus, not weighted by β
    beta: float  # β of this episode
    terminated: int  # 1: the environment ended the episode, 0: its time limit did


EPISODE_COLUMNS: Mapping[str, type] = {field.name: field.type for field in fields(Record)}

Run = tuple[str, str, int]  # environment, variant, seed

_NUMBER = {
    int: re.compile(r"-?[0-9]{1,15}"),  # fits int64 and is exact as a double
    float: re.compile(r"-?[0-9]+(\.[0-9]+)?(e[+-]?[0-9]+)?"),
}


class RecordError(ValueError):
    """A result file that cannot be trusted; the message names the file and the line."""


def write_episodes(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write one array of shape [episodes] per column of `EPISODE_COLUMNS`, atomically.

    Doubles are written in the shortest form that reads back as the same double. Raises
    `RecordError` for what `read_episodes` would refuse.
    """
    if list(columns) != list(EPISODE_COLUMNS):
        raise RecordError(f"{path}: {_wrong_header(list(columns), list(EPISODE_COLUMNS))}")
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    shapes = {name: values.shape for name, values in arrays.items()}
    if len(set(shapes.values())) != 1 or len(shapes["episode"]) != 1:
        raise RecordError(f"{path}: columns need one shape [episodes], these have {shapes}")
    for name, kind in EPISODE_COLUMNS.items():
        if arrays[name].dtype.kind not in ("bui" if kind is int else "buif"):
            raise RecordError(
                f"{path}: column {name} is of type {arrays[name].dtype}, not {kind.__name__}"
            )
        arrays[name] = arrays[name].astype(np.int64 if kind is int else np.float64)
    _check_episodes(path, arrays)
    rows = zip(*(values.tolist() for values in arrays.values()), strict=True)
    lines = [",".join(EPISODE_COLUMNS), *(",".join(map(repr, row)) for row in rows)]
    write_atomically(path, "\n".join(lines) + "\n")


def read_episodes(path: str | Path, episodes: int) -> "pd.DataFrame":
    """Read the records of a finished run of `episodes` training episodes.

    Returns a frame with the columns of `EPISODE_COLUMNS` (int64 and float64) and one row per
    episode. Raises `RecordError` for a file that `write_episodes` did not write in full.
    """
    import pandas as pd

    rows = read_rows(path, EPISODE_COLUMNS)
    arrays = {
        name: np.array([row[i] for row in rows], np.int64 if kind is int else np.float64)
        for i, (name, kind) in enumerate(EPISODE_COLUMNS.items())
    }
    _check_episodes(path, arrays)
    if len(rows) != episodes:
        raise RecordError(
            f"{path}: line {len(rows) + 1} is the last, after {len(rows)} episodes;"
            f" the run is configured to have {episodes}"
        )
    return pd.DataFrame(arrays)


def read_rows(path: str | Path, columns: Mapping[str, type]) -> list[tuple]:
    """Every row of a CSV file whose header is exactly `columns`, each cell an int, float or str.

    Floats are finite and keep every bit. Raises `RecordError` for a file that is missing, empty,
    cut off, or has another header, a row of another width or a cell that is no such number.
    """
    try:
        text = Path(path).read_bytes().decode("utf-8")
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise RecordError(f"{path}: line {line}: not UTF-8 text") from None
    if not text:
        raise RecordError(f"{path}: line 1: the file is empty")
    lines = text.split("\n")
    if lines.pop() != "":
        raise RecordError(f"{path}: line {len(lines) + 1}: the file ends within this line")
    header = lines[0].split(",")
    if header != list(columns):
        raise RecordError(f"{path}: line 1: {_wrong_header(header, list(columns))}")
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        cells = line.split(",")
        if len(cells) != len(columns):
            raise RecordError(
                f"{path}: line {number}: {len(cells)} cells instead of {len(columns)}"
            )
        try:
            rows.append(tuple(map(_parse, cells, columns.values(), columns)))
        except ValueError as error:
            raise RecordError(f"{path}: line {number}: {error}") from None
    return rows


def _parse(cell: str, kind: type, name: str) -> int | float | str:
    """One cell as `kind`, or a ValueError that names column and cell."""
    if kind is str:
        return cell
    if not _NUMBER[kind].fullmatch(cell) or not abs(kind(cell)) < np.inf:
        wanted = "an integer" if kind is int else "a finite number"
        raise ValueError(f"{name} is {cell!r}, not {wanted}")
    return kind(cell)


def _check_episodes(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Refuse rows that no training could have produced; `columns` hold arrays [episodes]."""
    rules = (  # column, whether each row is right [episodes], what would be right
        (
            "episode",
            columns["episode"] == np.arange(len(columns["episode"])) + 1,
            "the next number",
        ),
        ("length", columns["length"] >= 1, "at least 1"),
        (
            "env_steps",
            columns["env_steps"] == np.cumsum(columns["length"]),
            "the sum of the lengths so far",
        ),
        ("extrinsic_return", np.isfinite(columns["extrinsic_return"]), "finite"),
        ("intrinsic_return", _within(columns["intrinsic_return"], 0, np.inf), "finite and >= 0"),
        ("beta", _within(columns["beta"], 0, 1), "in [0, 1]"),
        ("terminated", _within(columns["terminated"], 0, 1), "0 or 1"),
    )
    wrong = [(int(np.argmin(right)), name, wish) for name, right, wish in rules if not right.all()]
    if wrong:
        row, name, wish = min(wrong, key=lambda found: found[0])
        value = columns[name][row].item()
        raise RecordError(f"{path}: line {row + 2}: {name} is {value!r}, not {wish}")


def _within(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Whether each value [n] is finite and in [low, high]."""
    return np.isfinite(values) & (values >= low) & (values <= high)


def _wrong_header(found: Sequence[str], wanted: Sequence[str]) -> str:
    """What is wrong with a header."""
    missing = [name for name in wanted if name not in found]
    unknown = [name for name in found if name not in wanted]
    if missing:
        return f"the column {missing[0]!r} is missing"
    if unknown:
        return f"unknown column {unknown[0]!r}"
    return f"the columns are {','.join(found)} instead of {','.join(wanted)}"
