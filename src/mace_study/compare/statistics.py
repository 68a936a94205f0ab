"""Statistics over seeds, of float64 arrays [seeds], after Agarwal et al. 2021 (docs/metrics.md).

An interval is a pair (low, high), both NaN where there are too few seeds for one.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads what is used of it when it is: scipy.stats alone takes a second

from mace_study.config.metrics import MetricsConfig

BOOTSTRAP_SEEDS = 10  # with fewer a bootstrap interval is too narrow: of a mean t's is taken
CHUNK = 2**20  # resampled values held in memory at a time
BATCH = 1000  # resamples of a test at a time: faster than all 10000, which caches cannot hold
REMEMBERED = 64  # draws: some MB each


class PairedComparison(NamedTuple):
    """x - y over the seeds that both have."""

    difference: np.ndarray  # mean of x - y, [] or [metrics] as the others
    low: np.ndarray  # of the interval of the mean difference
    high: np.ndarray
    p_value: np.ndarray  # two-sided, of the sign-flip test; with n seeds ≥ 2 / 2ⁿ; NaN with one


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
        half = scipy.special.stdtrit(seeds - 1, (1 + confidence) / 2) * error
        return mean - half, mean + half
    drawn = draws(seeds, repetitions, generator)  # the same resampled seeds serve every point
    flat, place = np.unique(values.reshape(seeds, -1), axis=1, return_inverse=True)
    points = max(1, CHUNK // repetitions)
    bounds = [
        percentiles(drawn @ flat[:, start : start + points] / seeds, confidence, seeds)
        for start in range(0, flat.shape[1], points)
    ]
    low, high = np.concatenate(bounds, axis=1)[:, place.ravel()]
    return low.reshape(mean.shape), high.reshape(mean.shape)


def interval(values: np.ndarray, settings: MetricsConfig) -> tuple[np.ndarray, np.ndarray]:
    """`mean_interval` as configured, from a generator of its own: none depends on another."""
    generator = np.random.default_rng(settings.bootstrap_seed)
    return mean_interval(values, settings.confidence, settings.bootstrap_repetitions, generator)


def paired_comparison(
    differences: np.ndarray,
    confidence: float,
    repetitions: int,
    generator: np.random.Generator,
    tested: Sequence[bool] | None = None,
) -> PairedComparison:
    """Compare x with y, of which `differences` are x - y by seed, [seeds] or [seeds, metrics].

    The sign-flip test asks whether each sign of x - y was as likely as the other. It is exact while
    2ⁿ ≤ `repetitions`, else of that many random sign patterns, the same for all metrics. `tested`:
    of each metric whether it is to have a p value; None for all.
    """
    mean = np.mean(differences, axis=0)
    low, high = mean_interval(differences, confidence, repetitions, generator)
    single = len(differences) == 1
    p = np.full_like(mean, np.nan)
    if not single:
        chosen = ... if tested is None else (..., tested)
        p[chosen] = _sign_flips(differences[chosen], repetitions, generator)
    return PairedComparison(mean, low, high, p)


def equivalence(
    differences: Sequence[np.ndarray],
    margin: float,
    repetitions: int,
    generator: np.random.Generator,
) -> float:
    """p value that the mean over strata of the mean difference is not within ± `margin`.

    The larger p value of two one-sided sign-flip tests (Schuirmann 1987), that it is above -margin
    and that it is below margin; NaN with one seed in a stratum.
    """
    if min(map(len, differences)) == 1:
        return np.nan
    p_values = []
    for end, alternative in ((-margin, "greater"), (margin, "less")):
        shifted = _weighted([values - end for values in differences])
        p_values.append(float(_sign_flips(shifted, repetitions, generator, alternative)))
    return max(p_values)


def _sign_flips(
    values: np.ndarray,
    repetitions: int,
    generator: np.random.Generator,
    alternative: str = "two-sided",
) -> np.ndarray:
    """p value of the sign-flip test of each mean over the first axis, exact where it can be."""
    # Of the sum of the absolute values, by which ties are told: rounding is of their size.
    shares = values / np.maximum(np.abs(values).sum(axis=0), np.finfo(np.float64).tiny)
    seeds, how = len(values), {"alternative": alternative, "vectorized": True}
    if 2**seeds <= repetitions:
        how |= {"permutation_type": "samples", "n_resamples": repetitions}
        tested = scipy.stats.permutation_test(
            (shares,), lambda x, axis: np.round(np.sum(x, axis=axis), 12), **how
        )
        return tested.pvalue
    drawn, p_values = signs(repetitions, seeds, generator), np.empty(values.shape[1:])
    how |= {"n_resamples": repetitions, "batch": BATCH}
    for metric in np.ndindex(p_values.shape):  # `permutation_test` would take 25 times as long
        column = shares[:, *metric]
        batches = iter(np.split(drawn, range(BATCH, repetitions, BATCH)))
        tested = scipy.stats.monte_carlo_test(
            np.ones(seeds),
            lambda size, batches=batches: next(batches),
            lambda flips, axis, column=column: np.round(flips @ column, 12),
            **how,
        )
        p_values[metric] = tested.pvalue
    return p_values


def _weighted(differences: Sequence[np.ndarray]) -> np.ndarray:
    """The differences of all strata, weighted: their mean is the mean of the strata's means."""
    total, count = sum(map(len, differences)), len(differences)
    return np.concatenate([values * total / (count * len(values)) for values in differences])


def stratified_comparison(
    differences: Sequence[np.ndarray],
    confidence: float,
    repetitions: int,
    generator: np.random.Generator,
) -> PairedComparison:
    """The mean over strata (environments) of the mean paired difference, [seeds] in each.

    The bootstrap resamples within the strata. With fewer than 10 seeds in one of them the interval
    is Student's t with the degrees of freedom of the smallest.
    """
    if len(differences) == 1:
        return paired_comparison(differences[0], confidence, repetitions, generator)
    tested = paired_comparison(_weighted(differences), confidence, repetitions, generator)
    smallest = min(map(len, differences))
    if smallest == 1:
        return tested._replace(low=np.array(np.nan), high=np.array(np.nan))
    if interval_kind(smallest) == "t":
        errors = [np.var(values, ddof=1) / len(values) for values in differences]
        error = np.sqrt(np.sum(errors)) / len(differences)
        half = scipy.special.stdtrit(smallest - 1, (1 + confidence) / 2) * error
        return tested._replace(low=tested.difference - half, high=tested.difference + half)
    means = [draws(len(own), repetitions, generator) @ own / len(own) for own in differences]
    low, high = percentiles(np.mean(means, axis=0), confidence, smallest)
    return tested._replace(low=low, high=high)


def logrank(
    x: np.ndarray, y: np.ndarray, repetitions: int, generator: np.random.Generator
) -> float:
    """Two-sided p value of the log-rank test that x [n] and y [m] come from the same distribution.

    Episodes at which something was reached, np.inf where it never was (censored at the end of
    training). By permutations of observed minus expected events: all of them while there are
    ≤ `repetitions`, else so many random ones. (The normal approximation gives 0.025 for three runs
    all later than three others; it is 0.1.) NaN with one run of either.
    """
    times, reached = np.concatenate([x, y]), np.isfinite(np.concatenate([x, y]))
    if min(len(x), len(y)) == 1:
        return np.nan
    at_risk = np.sum(times[:, None] <= times, axis=1)  # [n + m]: those that are not earlier
    expected = (times[:, None] >= times) @ (reached / at_risk)
    scores = reached - expected

    def statistic(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
        return np.round(np.mean(x, axis=axis) - np.mean(y, axis=axis), 12)  # ties

    how = {"n_resamples": repetitions, "batch": BATCH, "vectorized": True}
    if scipy.special.comb(len(times), len(x)) <= repetitions:
        both = scores[: len(x)], scores[len(x) :]
        return float(scipy.stats.permutation_test(both, statistic, **how).pvalue)
    tested = scipy.stats.monte_carlo_test(  # `permutation_test` would draw orders one by one
        scores,
        lambda size: scores[orders(size[0], size[1], generator)],
        lambda scores, axis: statistic(scores[..., : len(x)], scores[..., len(x) :], axis),
        **how,
    )
    return float(tested.pvalue)


def probability_of_improvement(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    confidence: float,
    repetitions: int,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P(X > Y) + P(X = Y) / 2 for one run of each, and the bounds of its bootstrap interval.

    Each is [metrics], the mean over `pairs` (x [n, metrics], y [m, metrics]), one for each
    environment. x and y are resampled independently, the same draws for all metrics. Greater is
    better. The bounds are NaN with fewer than `BOOTSTRAP_SEEDS` in an environment.
    """
    metrics = pairs[0][0].shape[1]
    means, resampled = np.zeros(metrics), np.zeros((repetitions, metrics))
    fewest = min(len(runs) for both in pairs for runs in both)
    for x, y in pairs:
        wins = np.heaviside(x[:, None] - y[None, :], 0.5)  # [n, m, metrics]
        means += wins.mean(axis=(0, 1)) / len(pairs)
        if fewest < BOOTSTRAP_SEEDS:
            continue
        drawn_x, drawn_y = (single_draws(len(runs), repetitions, generator) for runs in (x, y))
        halves = wins.astype(np.float32)  # of which sums of n · m are exact, and faster
        for metric in range(metrics):
            won = np.einsum("ry,ry->r", drawn_x @ halves[:, :, metric], drawn_y)
            resampled[:, metric] += won.astype(np.float64) / (len(x) * len(y) * len(pairs))
    low, high = percentiles(resampled, confidence, fewest)
    return means, low, high


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Holm's (1979) adjusted p values, in the given order: reject where one is ≤ the level.

    The k-th smallest of m is multiplied by m - k + 1 and is never less than those before it.
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p)
    adjusted = np.empty_like(p)
    adjusted[order] = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.minimum(adjusted, 1)


def _remembered(
    draw: Callable[[int, int, np.random.Generator], np.ndarray],
) -> Callable[[int, int, np.random.Generator], np.ndarray]:
    """`draw` with a memory: most rows of a table draw the same, from equal generators.

    The generator moves on as if it had been drawn from.
    """
    drawn: dict[tuple[int, int, str], tuple[np.ndarray, Mapping[str, Any]]] = {}

    def again(first: int, second: int, generator: np.random.Generator) -> np.ndarray:
        key = first, second, repr(generator.bit_generator.state)
        if key not in drawn:
            if len(drawn) == REMEMBERED:
                drawn.clear()
            values = draw(first, second, generator)
            values.flags.writeable = False
            drawn[key] = values, generator.bit_generator.state
        values, generator.bit_generator.state = drawn[key]
        return values

    return again


@_remembered
def draws(count: int, repetitions: int, generator: np.random.Generator) -> np.ndarray:
    """How often each of `count` values is in each bootstrap sample of that size.

    As float64 [repetitions, count]: `draws @ values / count` are the means of the samples.
    """
    drawn = generator.integers(count, size=(repetitions, count))
    drawn += count * np.arange(repetitions)[:, None]  # each sample has a range of its own
    times = np.bincount(drawn.ravel(), minlength=repetitions * count)
    return times.reshape(repetitions, count).astype(np.float64)


@_remembered
def single_draws(count: int, repetitions: int, generator: np.random.Generator) -> np.ndarray:
    """`draws` as float32."""
    return draws(count, repetitions, generator).astype(np.float32)


@_remembered
def signs(repetitions: int, count: int, generator: np.random.Generator) -> np.ndarray:
    """Random signs of `count` values, -1 and 1 as int8 [repetitions, count]."""
    both = np.tile(np.array([1, -1], np.int8), (BATCH, count, 1))
    drawn = [generator.permuted(both, axis=-1)[..., 0] for _ in range(0, repetitions, BATCH)]
    return np.concatenate(drawn)[:repetitions]


@_remembered
def orders(repetitions: int, count: int, generator: np.random.Generator) -> np.ndarray:
    """Random orders of `count` values, int64 [repetitions, count]."""
    return generator.permuted(np.tile(np.arange(count), (repetitions, 1)), axis=-1)


def percentiles(estimates: np.ndarray, confidence: float, seeds: int) -> np.ndarray:
    """The bounds [2, …] of a bootstrap interval from `estimates` [repetitions, …], used up by it.

    The expanded percentile interval (Hesterberg 2015): percentiles moved outward as much as
    Student's t is wider than the normal distribution with so few `seeds`, over which a bootstrap is
    too narrow otherwise (docs/metrics.md). NaN below `BOOTSTRAP_SEEDS`, and where one of
    `estimates` is NaN.
    """
    if seeds < BOOTSTRAP_SEEDS:
        return np.full((2, *estimates.shape[1:]), np.nan)
    wider = np.sqrt(seeds / (seeds - 1)) * scipy.special.stdtrit(seeds - 1, (1 + confidence) / 2)
    tail = 100 * scipy.special.ndtr(-wider)
    together = np.ascontiguousarray(np.moveaxis(estimates, 0, -1))  # sorted faster
    return np.percentile(together, [tail, 100 - tail], axis=-1, overwrite_input=True)
