"""Statistics over seeds: estimates, intervals and comparisons.

Pure functions of float64 arrays of shape [seeds]; whatever draws random numbers takes the generator
that it draws them from. An interval is a pair (low, high), both NaN where one seed allows none.
After Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice".
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # loads scipy.stats when it is first used: importing this module stays fast

BOOTSTRAP_SEEDS = 10  # with fewer seeds a bootstrap interval is too narrow: t is used instead
CHUNK = 2**22  # resampled values held in memory at a time


class PairedComparison(NamedTuple):
    """x - y over the seeds that both have."""

    difference: float  # mean of x - y
    low: float  # of the interval of the mean difference
    high: float
    p_value: float  # two-sided, of the sign-flip test; with n seeds ≥ 2 / 2ⁿ; NaN with one


def interval_kind(seeds: int) -> str:
    """Which interval `mean_interval` gives for this many seeds."""
    return "t" if seeds < BOOTSTRAP_SEEDS else "bootstrap"


def mean_interval(
    values: np.ndarray, confidence: float, repetitions: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Interval of the mean over the first axis: Student's t below 10 seeds, else the bootstrap.

    `values` are [seeds] or [seeds, points]; low and high are [] or [points], pointwise.
    """
    seeds, mean = len(values), np.mean(values, axis=0)
    if seeds == 1:
        return np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    if interval_kind(seeds) == "t":
        error = np.std(values, axis=0, ddof=1) / np.sqrt(seeds)
        half = scipy.stats.t.ppf((1 + confidence) / 2, seeds - 1) * error
        return mean - half, mean + half
    chosen = generator.integers(seeds, size=(repetitions, seeds))
    flat = values.reshape(seeds, -1)  # [seeds, points]
    points = max(1, CHUNK // chosen.size)
    bounds = [  # the same resampled seeds serve every point
        _percentiles(np.mean(flat[chosen, start : start + points], axis=1), confidence)
        for start in range(0, flat.shape[1], points)
    ]
    low, high = np.concatenate(bounds, axis=1)
    return low.reshape(mean.shape), high.reshape(mean.shape)


def paired_comparison(
    x: np.ndarray,
    y: np.ndarray,
    confidence: float,
    repetitions: int,
    generator: np.random.Generator,
) -> PairedComparison:
    """Compare x with y, [seeds] each, where x[i] and y[i] share seed i.

    The sign-flip test asks whether each sign of x - y was as likely as the other. It is exact while
    2ⁿ ≤ `repetitions`, else of that many random sign patterns.
    """
    difference = x - y
    low, high = mean_interval(difference, confidence, repetitions, generator)
    p_value = np.nan
    if len(difference) > 1:
        p_value = scipy.stats.permutation_test(
            (difference,),
            np.mean,
            permutation_type="samples",
            n_resamples=repetitions,
            rng=generator,
            vectorized=True,
        ).pvalue
    return PairedComparison(float(np.mean(difference)), float(low), float(high), float(p_value))


def probability_of_improvement(
    x: np.ndarray,
    y: np.ndarray,
    confidence: float,
    repetitions: int,
    generator: np.random.Generator,
) -> tuple[float, float, float]:
    """P(X > Y) + P(X = Y) / 2 for one run of each, and the bounds of its bootstrap interval.

    x [n] and y [m] are unpaired and resampled independently. *Greater* is the improvement: pass the
    negative of a metric of which lower is better.
    """
    wins = np.heaviside(x[:, None] - y[None, :], 0.5)  # [n, m]
    if min(wins.shape) == 1:
        return float(wins.mean()), np.nan, np.nan
    share_x, share_y = (  # [repetitions, n or m]: how often each run was drawn
        generator.multinomial(count, np.full(count, 1 / count), size=repetitions) / count
        for count in wins.shape
    )
    low, high = _percentiles(np.sum((share_x @ wins) * share_y, axis=1), confidence)
    return float(wins.mean()), float(low), float(high)


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Holm's (1979) adjusted p values, in the given order: reject where one is ≤ the level.

    The k-th smallest of m is multiplied by m - k + 1 and is never less than those before it.
    Raises ValueError for a value outside [0, 1] or NaN.
    """
    p = np.asarray(p_values, dtype=np.float64)
    if not ((p >= 0) & (p <= 1)).all():
        raise ValueError(f"p values must be in [0, 1], these are {p.tolist()}")
    order = np.argsort(p)
    adjusted = np.empty_like(p)
    adjusted[order] = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.minimum(adjusted, 1)


def _percentiles(resampled: np.ndarray, confidence: float) -> np.ndarray:
    """The bounds [2, …] that leave out equal tails of `resampled` [repetitions, …]."""
    return np.percentile(resampled, [50 * (1 - confidence), 50 * (1 + confidence)], axis=0)
