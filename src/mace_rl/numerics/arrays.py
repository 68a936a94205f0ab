"""Sums, moments, quantiles and permutations of arrays: loops in a fixed order."""

import math

import numpy as np

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.matmul import dot


@kernel
def total(values: np.ndarray) -> float:
    """Σ x of [N], in order, float64."""
    result = 0.0
    for value in values:
        result += value
    return result


@kernel
def mean(values: np.ndarray) -> float:
    """Σ x / N."""
    return total(values) / len(values)


@kernel
def variance(values: np.ndarray) -> float:
    """Mean squared deviation from the mean of float64 [N]."""
    centre, squares = mean(values), 0.0
    for value in values:
        squares += (value - centre) ** 2
    return squares / len(values)


@kernel
def root_mean_square(values: np.ndarray) -> float:
    """√(Σ x² / N)."""
    return math.sqrt(dot(values, values) / len(values))


@kernel
def quantile(values: np.ndarray, share: float) -> float:
    """The `share` quantile of float64 [N], linearly interpolated."""
    ordered = np.sort(values)
    place = share * (len(ordered) - 1)
    before = int(place)
    after = min(before + 1, len(ordered) - 1)
    return ordered[before] + (place - before) * (ordered[after] - ordered[before])


@kernel
def shuffled(draws: np.ndarray) -> np.ndarray:
    """K permutations by Fisher and Yates from uniform draws, [K, N]; int64."""
    order = np.empty(draws.shape, np.int64)
    for k in range(len(draws)):
        order[k] = np.arange(draws.shape[1])
        for n in range(draws.shape[1] - 1, 0, -1):
            other = min(int(draws[k, n] * (n + 1)), n)
            order[k, n], order[k, other] = order[k, other], order[k, n]
    return order
