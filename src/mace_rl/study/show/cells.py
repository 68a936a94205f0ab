"""What the cells of tables are made of: words (`str`), and `Cell`s of numbers with intervals."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

COLUMNS_PER_BLOCK = 3  # of LaTeX and the terminal, side by side; more continue below
DASH = "\u2013"  # in the place of a number that there is not


class Value(NamedTuple):
    """One number, or words, as printed."""

    text: str
    low: str = ""  # of its interval; empty where none is asked for
    high: str = ""
    mark: str = ""  # †, and of how many seeds
    best: bool = False


class Cell(NamedTuple):
    """Several values in one cell, and what is to be said beside them. (One word is a `str`.)"""

    values: Sequence[Value]
    joint: str = " / "
    note: str = ""


def number(value: float | None, digits: int = 0) -> str:
    """A number with a true minus, and without one before a zero; a dash where there is none."""
    if value is None or np.isnan(value):
        return DASH
    return f"{value:z.{digits}f}".replace("-", "−")


def estimate(
    value: float | None,
    low: float | None,
    high: float | None,
    digits: int = 0,
    mark: str = "",
    best: bool = False,
) -> Value:
    """A number with its interval, of dashes where there is none."""
    text, start, end = (number(one, digits) for one in (value, low, high))
    return Value(text, start, end, mark, best)
