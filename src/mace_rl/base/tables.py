"""CSV files, read strictly: a damaged one is refused, lest it become a plausible number."""

from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mace_rl.base import files
from mace_rl.base.errors import Refusal

if TYPE_CHECKING:  # training only writes, without pandas
    import pandas as pd

TEXTS = ("env", "variant", "baseline", "metric", "kind", "reading", "source", "test")  # columns
_BOUND = {int: 2**53, float: np.inf}  # below which an int is exact as a double


class RecordError(Refusal, ValueError):
    """A result file that cannot be trusted; the message names the file and the line."""


def read_made(path: str | Path) -> "pd.DataFrame":
    """What a study made, to the bit (pandas 3.1.0 and later): names as they were given, NA and 0.1.

    An empty cell is NaN. Of a table that people may edit or break, `read_table` judges each cell.
    """
    import pandas as pd

    how: Any = {"dtype": dict.fromkeys(TEXTS, str), "keep_default_na": False, "na_values": [""]}
    return pd.read_csv(path, **how)


def read_table(path: str | Path, columns: Mapping[str, type]) -> "pd.DataFrame":
    """What `read_columns` reads and judges, as a frame."""
    import pandas as pd

    table = read_columns(path, columns)
    return pd.DataFrame({name: pd.Series(table[name], dtype=columns[name]) for name in columns})


def read_columns(
    path: str | Path, columns: Mapping[str, type], content: bytes | None = None
) -> dict[str, list[Any]]:
    """The values in a CSV file with exactly the `columns`, each int, float or str.

    content: of the file, if it is known to be as it was written; else it is read and judged. Raises
    `RecordError` at the first line that would be written otherwise, to the byte.
    """
    known = content is not None
    try:
        *lines, rest = (files.content(path) if content is None else content).split(b"\n")
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror}") from None
    if rest or not lines:
        raise RecordError(f"{path}: line {len(lines) + 1}: the file ends within this line")
    header = lines[0].decode(errors="replace").split(",")
    for found, wanted in zip_longest(header, columns, fillvalue=""):
        if found != wanted:
            raise RecordError(
                f"{path}: line 1: the column {found!r} stands where {wanted!r} should"
            )
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            cells = line.decode().split(",")
            if len(cells) != len(columns):
                raise ValueError(f"{len(cells)} cells instead of {len(columns)}")
            kinds = zip(cells, columns.items(), strict=True)
            rows.append([_parse(cell, kind, name, known) for cell, (name, kind) in kinds])
        except ValueError as error:
            raise RecordError(f"{path}: line {number}: {error}") from None
    return {name: [row[place] for row in rows] for place, name in enumerate(columns)}


def _parse(cell: str, kind: type, name: str, known: bool) -> int | float | str:
    """One cell as `kind`; `ValueError` with column and cell if it is none.

    Also if it would be written otherwise, unless it is `known` to be as it was written.
    """
    try:
        value = kind(cell)
    except ValueError:
        value = np.nan
    if not (known or str(value) == cell) or not (kind is str or abs(value) < _BOUND[kind]):
        wanted = "an integer" if kind is int else "a finite number"
        raise ValueError(f"{name} is {cell!r}, not {wanted}")
    return value
