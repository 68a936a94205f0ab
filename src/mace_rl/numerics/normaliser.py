"""Running mean and standard deviation of observations."""

import math
from typing import Any, NamedTuple

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.numerics.compiling import kernel


class RunningNormaliser(Stateful):
    """Mean and standard deviation of all observations so far (Chan et al. 1979), float64.

    Before the first `update` the mean is 0 and the standard deviation 1.
    """

    STATE = ("count", "mean", "sum_of_squares")

    def __init__(self, size: int) -> None:
        self.count = 0
        self.mean = np.zeros(size)
        self.sum_of_squares = np.zeros(size)  # of deviations from the mean
        self.std = np.ones(size)  # 1 where nothing has varied yet
        self.varied = np.zeros(size, np.bool_)  # which dimensions have varied beyond rounding

    def update(self, observations: np.ndarray) -> None:
        """Take in `observations`, [N, size]."""
        update(observations, self.count, self.mean, self.sum_of_squares, self.std, self.varied)
        self.count += len(observations)

    def __call__(self, observations: np.ndarray, bound: float = math.inf) -> np.ndarray:
        """(observations - mean) / std, clipped to ±bound; float32 [N, size]."""
        return standardised(observations, self.mean, self.std, bound)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        spread(self.count, self.sum_of_squares, self.std, self.varied)


class Normalisation(NamedTuple):
    """How observations are normalised at one time."""

    mean: np.ndarray  # float32 [observation], like the next
    inverse_std: np.ndarray
    clip: np.float32  # bound of normalised observations

    @classmethod
    def of(cls, mean: np.ndarray, std: np.ndarray, clip: float) -> "Normalisation":
        """From a running mean and standard deviation, [observation]."""
        return cls(*centre_and_inverse(mean, std), np.float32(clip))


@kernel
def centre_and_inverse(mean, std):
    """Mean and 1 / std as float32, [size] each."""
    return mean.astype(np.float32), (1 / std).astype(np.float32)


@kernel
def update(batch, count, mean, sum_of_squares, std, varied):
    """Add a `batch`, [N, size], to the statistics of `count` observations; see the class."""
    share = len(batch) / (count + len(batch))
    for i in range(len(mean)):
        batch_mean = 0.0
        for n in range(len(batch)):
            batch_mean += batch[n, i]
        batch_mean /= len(batch)
        for n in range(len(batch)):
            sum_of_squares[i] += (batch[n, i] - batch_mean) ** 2
        difference = batch_mean - mean[i]
        mean[i] += difference * share
        sum_of_squares[i] += difference**2 * count * share
    spread(count + len(batch), sum_of_squares, std, varied)


@kernel
def spread(count, sum_of_squares, std, varied):
    """Fill in the standard deviation, and which dimensions have varied."""
    for i in range(len(std)):
        deviation = math.sqrt(sum_of_squares[i] / max(count, 1))
        varied[i] = deviation > 1e-8
        std[i] = deviation if varied[i] else 1.0


@kernel
def standardised(observations, mean, std, bound):
    """`normalise` of each row, to the bit, float32 [N, size]."""
    result = np.empty(observations.shape, np.float32)
    centre, inverse = centre_and_inverse(mean, std)
    clip = np.float32(bound)
    for n in range(len(observations)):  # a call for each row takes ten times as long
        for i in range(len(centre)):
            value = (observations[n, i] - centre[i]) * inverse[i]
            result[n, i] = min(max(value, -clip), clip)
    return result


@kernel
def normalise(observation, normalisation, result):
    """Fill in and return (observation - mean) / std, clipped to ±clip; float32 [size]."""
    mean, inverse_std, clip = normalisation
    for i in range(len(observation)):
        result[i] = min(max((observation[i] - mean[i]) * inverse_std[i], -clip), clip)
    return result
