"""Numbers that go bad stop the run."""

import math

import numpy as np

from mace_rl.numerics.compiling import njit
from mace_rl.refusal import Refusal


class NonFiniteError(Refusal, ArithmeticError):
    """NaN, Inf or a number out of its range; the message says in what, and where in the run."""


def require_finite(name: str, values: float | np.ndarray, where: str = "") -> None:
    """Raise `NonFiniteError` if `values` has a NaN or Inf; `where` ends the message."""
    good = math.isfinite(values) if isinstance(values, float) else all_finite(values)
    if not good:
        found = np.asarray(values)
        bad = found[~np.isfinite(found)].ravel()[0]
        raise NonFiniteError(f"{name} is {bad}{where}")


def require_within(
    name: str, values: float | np.ndarray, rounding: float = 0.0, largest: float = 1.0
) -> None:
    """Raise `NonFiniteError` unless all `values` are finite and in [0, `largest`].

    They may be outside by so much `rounding`.
    """
    require_finite(name, values)
    found = np.asarray(values)
    outside = found[(found < -rounding) | (found > largest + rounding)].ravel()
    if len(outside):
        raise NonFiniteError(f"{name} is {outside[0]}, which is not in [0, {largest:g}]")


@njit(cache=True)
def all_finite(values: np.ndarray) -> bool:
    """Whether an array of any shape has neither NaN nor Inf."""
    good = True
    for value in values.flat:
        good &= np.isfinite(value)
    return good
