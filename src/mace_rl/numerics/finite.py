"""Numbers that go bad stop the run."""

import math
from typing import Any

import numpy as np

from mace_rl.numerics.compiling import njit
from mace_rl.refusal import Refusal

# Of a reward, or of a number in an observation. Networks learn in float32: its 7 digits lose an
# ordinary reward beside a larger one, and sums of larger squares are infinite.
TOO_LARGE = 1e12


class NonFiniteError(Refusal, ArithmeticError):
    """NaN, Inf or a number out of its range; the message says in what, and where in the run."""


def require_finite(
    name: str, values: float | np.ndarray, where: str = "", too_large: float = math.inf
) -> None:
    """Raise `NonFiniteError` if `values` has a NaN or what is not within ±`too_large`.

    `where` follows the number in the message.
    """
    good = abs(values) < too_large if isinstance(values, float) else all_below(values, too_large)
    if not good:
        found = np.asarray(values)
        bad = found[~(abs(found) < too_large)].ravel()[0]
        why = f", but float32 learns from less than {too_large:g}: use a larger unit"
        raise NonFiniteError(f"{name} is {bad:.6g}{where}{why if math.isfinite(bad) else ''}")


def numbers(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """`values` as float64; `NonFiniteError` unless they are numbers in an array of this `shape`."""
    found = np.asarray(values)
    if found.shape != shape or found.dtype.kind not in "biuf":
        wrong = f"{found.dtype} of shape {found.shape}"
        raise NonFiniteError(f"{name} is {wrong}, but should be numbers of shape {shape}")
    return found.astype(np.float64, copy=False)


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
def all_below(values: np.ndarray, bound: float) -> bool:
    """Whether an array of any shape has neither a NaN nor what is not within ±`bound`."""
    good = True
    for value in values.flat:
        good &= abs(value) < bound
    return good
