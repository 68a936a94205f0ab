"""β and its logit, with equal bits on every processor."""

import numpy as np

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import exp, log

LARGEST_LOGIT = 6.0  # of β


def beta_of(logit: float) -> float:
    """The β with this logit, which is bounded so that β can come back; NaN stays NaN."""
    return logistic(np.float32(min(max(logit, -LARGEST_LOGIT), LARGEST_LOGIT)))


@kernel
def logistic(x: np.float32) -> float:
    """1 / (1 + e⁻ˣ), float64."""
    return 1 / (1 + np.float64(exp(-x)))


@kernel
def logit(beta: float) -> float:
    """log(β / (1 - β)), of a float64 in (0, 1), to float32's rounding."""
    return natural_log(beta / (1 - beta))


@kernel
def natural_log(x: float) -> float:
    """log x, to float32's rounding; the C library's differs between processors."""
    return log(np.float32(x))
