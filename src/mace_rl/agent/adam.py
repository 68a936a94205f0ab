"""Adam, the optimiser of every network here.

Written out because loading PyTorch's costs every run a second and 70 MB, and a call of it more
than the rest of a small network's update.
"""

import math
from typing import Any

import numpy as np
import torch
from numba import njit

DECAY_MEAN, DECAY_SQUARE, EPSILON = 0.9, 0.999, 1e-5  # β₁, β₂ and ε


class Adam:
    """Adam on one vector of parameters, changed in place, with the gradient clipped by its norm."""

    def __init__(
        self,
        parameters: np.ndarray,
        learning_rate: float,
        max_gradient_norm: float = math.inf,
    ) -> None:
        self.parameters = parameters
        self.learning_rate = learning_rate
        self.max_gradient_norm = max_gradient_norm
        self.mean, self.square = np.zeros_like(self.parameters), np.zeros_like(self.parameters)
        self.time = 0

    def step(self, gradient: np.ndarray) -> float:
        """One step against `gradient`, [n]; returns the gradient's norm before clipping."""
        norm = float(np.sqrt(gradient @ gradient))
        if norm > self.max_gradient_norm:
            gradient = gradient * np.float32(self.max_gradient_norm / norm)
        self.time += 1
        adam(self.parameters, gradient, self.mean, self.square, self.time, self.learning_rate)
        return norm

    def preconditioned(self, direction: np.ndarray) -> np.ndarray:
        """`direction`, [n], in the units in which this optimiser steps: over √v̂ + ε, float32 [n].

        v̂ is the second moment after the steps so far; before the first one nothing is known of it
        and the direction is returned.
        """
        if self.time == 0:
            return direction
        unbiased = self.square / np.float32(1 - DECAY_SQUARE**self.time)
        return direction / (np.sqrt(unbiased) + np.float32(EPSILON))

    def state_dict(self) -> dict[str, Any]:
        """Parameters and the optimiser's moments."""
        arrays = {"parameters": self.parameters, "mean": self.mean, "square": self.square}
        return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()} | {
            "time": self.time
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned, in place: the network holds the same arrays."""
        self.parameters[:] = state["parameters"].numpy()
        self.mean[:] = state["mean"].numpy()
        self.square[:] = state["square"].numpy()
        self.time = state["time"]


@njit(cache=True, error_model="numpy")
def adam(
    parameters: np.ndarray,
    gradient: np.ndarray,
    mean: np.ndarray,
    square: np.ndarray,
    time: int,
    learning_rate: float,
) -> None:
    """One step of Adam (Kingma & Ba 2015, algorithm 1), in place; all arrays float32 [n].

    mean and square are the moments' running estimates, time counts steps from 1.
    """
    rate = np.float32(learning_rate / (1 - DECAY_MEAN**time))
    scale = np.float32(1 / math.sqrt(1 - DECAY_SQUARE**time))
    keep_mean, keep_square = np.float32(DECAY_MEAN), np.float32(DECAY_SQUARE)
    add_mean, add_square = np.float32(1 - DECAY_MEAN), np.float32(1 - DECAY_SQUARE)
    for i in range(len(parameters)):
        mean[i] = keep_mean * mean[i] + add_mean * gradient[i]
        square[i] = keep_square * square[i] + add_square * gradient[i] * gradient[i]
        parameters[i] -= rate * mean[i] / (math.sqrt(square[i]) * scale + np.float32(EPSILON))
