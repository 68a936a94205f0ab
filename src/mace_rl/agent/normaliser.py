"""Running mean and standard deviation of observations."""

from typing import Any

import numpy as np
import torch
from numba import njit


class RunningNormaliser:
    """Mean and standard deviation over everything seen so far (Chan et al. 1979), float64.

    Before the first `update` the mean is 0 and the standard deviation 1.
    """

    def __init__(self, size: int) -> None:
        self.count = 0
        self.mean = np.zeros(size)
        self.sum_of_squares = np.zeros(size)  # of deviations from the mean

    def update(self, observations: np.ndarray) -> None:
        """Take in `observations`, [N, size]."""
        self.mean, self.sum_of_squares = updated(
            observations, self.count, self.mean, self.sum_of_squares
        )
        self.count += len(observations)

    @property
    def std(self) -> np.ndarray:
        """Standard deviation, [size]; 1 where nothing has varied yet."""
        std = np.sqrt(self.sum_of_squares / max(self.count, 1))
        return np.where(self.varied, std, 1.0)

    @property
    def varied(self) -> np.ndarray:
        """Whether each dimension has varied, beyond rounding, bool [size]."""
        return np.sqrt(self.sum_of_squares / max(self.count, 1)) > 1e-8

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """(observations - mean) / std as float32, [..., size]."""
        return ((observations - self.mean) / self.std).astype(np.float32)

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""
        return {
            "count": self.count,
            "mean": torch.from_numpy(self.mean.copy()),
            "sum_of_squares": torch.from_numpy(self.sum_of_squares.copy()),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.count = state["count"]
        self.mean = state["mean"].numpy().copy()
        self.sum_of_squares = state["sum_of_squares"].numpy().copy()


@njit(cache=True, error_model="numpy")
def updated(
    batch: np.ndarray, count: int, mean: np.ndarray, sum_of_squares: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sum of squared deviations, float64 [size], of `count` observations and a `batch`.

    batch: [N, size]. A compiled loop since an episode of 30 steps is less work than NumPy's calls.
    """
    mean, sum_of_squares = mean.copy(), sum_of_squares.copy()
    share = len(batch) / (count + len(batch))
    for i in range(len(mean)):
        batch_mean = 0.0
        for value in batch[:, i]:
            batch_mean += value
        batch_mean /= len(batch)
        for value in batch[:, i]:
            sum_of_squares[i] += (value - batch_mean) ** 2
        difference = batch_mean - mean[i]
        mean[i] += difference * share
        sum_of_squares[i] += difference**2 * count * share
    return mean, sum_of_squares
