"""Running mean and standard deviation of observations."""

from typing import Any

import numpy as np
import torch


class RunningStandardiser:
    """Mean and standard deviation over everything seen so far (Chan et al. 1979), float64.

    Before the first `update` the mean is 0 and the standard deviation 1.
    """

    def __init__(self, size: int) -> None:
        self.count = 0
        self.mean = np.zeros(size)
        self.sum_of_squares = np.zeros(size)  # of deviations from the mean

    def update(self, observations: np.ndarray) -> None:
        """Take in `observations`, [N, size]."""
        batch = np.asarray(observations, np.float64)
        batch_mean = batch.mean(axis=0)
        difference = batch_mean - self.mean
        total = self.count + len(batch)
        self.mean = self.mean + difference * (len(batch) / total)
        self.sum_of_squares = (
            self.sum_of_squares
            + np.square(batch - batch_mean).sum(axis=0)
            + np.square(difference) * (self.count * len(batch) / total)
        )
        self.count = total

    @property
    def std(self) -> np.ndarray:
        """Standard deviation, [size]; 1 where nothing has varied yet."""
        if self.count == 0:
            return np.ones_like(self.mean)
        std = np.sqrt(self.sum_of_squares / self.count)
        return np.where(std > 1e-8, std, 1.0)

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
