"""Numbers that go bad stop the run."""

import numpy as np


class NonFiniteError(ArithmeticError):
    """NaN or Inf where a number is needed; the message says in what, and where in the run."""


def require_finite(name: str, values: float | np.ndarray, where: str = "") -> None:
    """Raise `NonFiniteError` if `values` has a NaN or Inf; `where` ends the message."""
    if not np.isfinite(values).all():
        found = np.asarray(values)
        bad = found[~np.isfinite(found)].ravel()[0]
        raise NonFiniteError(f"{name} is {bad}{where}")
