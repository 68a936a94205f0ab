"""CSV files, read strictly: a damaged one is refused, lest it become a plausible number."""

import csv
import hashlib
import io
from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mace_rl.base import files
from mace_rl.base.errors import Refusal

if TYPE_CHECKING:  # training only writes, without pandas
    import pandas as pd

_BOUND = {int: 2**53, float: np.inf}  # below which an int is exact as a double
ALTERED = "missing, cut off or altered (SHA-256 not as in run.json)"


class RecordError(Refusal, ValueError):
    """A result file that cannot be trusted; the message names the file and the line."""


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
