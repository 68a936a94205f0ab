"""Numbers that go bad stop the run."""

import math
from typing import Any

import numpy as np

from mace_rl.base.errors import Refusal
from mace_rl.numerics.compiling import njit

# For rewards and numbers in observations: float32 loses ordinary rewards beside larger ones, and
# sums of larger squares overflow.
TOO_LARGE = 1e12


class NonFiniteError(Refusal, ArithmeticError):
    """NaN, Inf or a number out of its range; the message says of what, and where in the run."""


def require_finite(
    name: str, values: float | np.ndarray, where: str = "", too_large: float = math.inf
) -> None:
    """`NonFiniteError`, with `where` after the number, unless all |values| < `too_large`."""
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
    """Raise `NonFiniteError` unless all `values` are finite and in [0, `largest`] ± `rounding`."""
    require_finite(name, values)
    found = np.asarray(values)
    if found.min() < -rounding or found.max() > largest + rounding:
        outside = found[(found < -rounding) | (found > largest + rounding)].ravel()[0]
        raise NonFiniteError(f"{name} is {outside}, which is not in [0, {largest:g}]")


@njit(cache=True)
def all_below(values: np.ndarray, bound: float) -> bool:
    """Whether all numbers of an array of any shape are within ±`bound`; NaN is not."""
    good = True
    for value in values.flat:
        good &= abs(value) < bound
    return good
