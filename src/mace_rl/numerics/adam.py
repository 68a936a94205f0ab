"""Adam, the optimiser of every network here.

Written out because loading PyTorch's costs every run a second and 70 MB, and a call of it more
than the rest of a small network's update.
"""

import math
from typing import NamedTuple

import numpy as np

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.products import dot
from mace_rl.state import Stateful

DECAY_MEAN, DECAY_SQUARE, EPSILON = 0.9, 0.999, 1e-5  # β₁, β₂ and ε


class AdamState(NamedTuple):
    """What one step reads and, but for the rate and the norm, changes in place."""

    parameters: np.ndarray  # float32 [n], like the next two
    mean: np.ndarray  # running estimates of the gradient's moments
    square: np.ndarray
    decayed: np.ndarray  # float64 [2]: β₁ᵗ and β₂ᵗ after t steps
    learning_rate: float
    max_gradient_norm: float


class Adam(Stateful):
    """Adam on one vector of parameters, changed in place, with the gradient clipped by its norm."""

    STATE = ("parameters", "mean", "square", "decayed")

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
        self.decayed = np.ones(2)  # β₁ᵗ and β₂ᵗ after t steps

    def step(self, gradient: np.ndarray) -> float:
        """One step against `gradient`, [n]; returns the gradient's norm before clipping."""
        return step(gradient, self.state)

    @property
    def state(self) -> AdamState:
        """What the compiled `step` takes beside the gradient."""
        moments = self.mean, self.square, self.decayed
        return AdamState(self.parameters, *moments, self.learning_rate, self.max_gradient_norm)

    def preconditioned(self, direction: np.ndarray) -> np.ndarray:
        """`direction`, [n], in the units in which this optimiser steps: over √v̂ + ε, float32 [n].

        v̂ is the second moment after the steps so far; before the first one nothing is known of it
        and the direction is returned.
        """
        if self.decayed[1] == 1:
            return direction
        return preconditioned(direction, self.square, np.float32(1 - self.decayed[1]))


@kernel
def step(gradient, state):
    """One step of Adam (Kingma & Ba 2015, algorithm 1), in place; see `Adam.step`."""
    parameters, mean, square, decayed, learning_rate, max_gradient_norm = state
    norm = math.sqrt(dot(gradient, gradient))
    clipped = np.float32(max_gradient_norm / norm if norm > max_gradient_norm else 1)
    decayed[0] *= DECAY_MEAN
    decayed[1] *= DECAY_SQUARE
    rate = np.float32(learning_rate / (1 - decayed[0]))
    scale = np.float32(1 / math.sqrt(1 - decayed[1]))
    keep_mean, keep_square = np.float32(DECAY_MEAN), np.float32(DECAY_SQUARE)
    add_mean, add_square = np.float32(1 - DECAY_MEAN), np.float32(1 - DECAY_SQUARE)
    for i in range(len(parameters)):
        slope = clipped * gradient[i]
        mean[i] = keep_mean * mean[i] + add_mean * slope
        square[i] = keep_square * square[i] + add_square * slope * slope
        parameters[i] -= rate * mean[i] / (math.sqrt(square[i]) * scale + np.float32(EPSILON))
    return norm


@kernel
def preconditioned(direction, square, unbiased):
    """`Adam.preconditioned` with the running estimate of squares, which is so much too small."""
    result = np.empty_like(direction)
    for i in range(len(result)):
        result[i] = direction[i] / (math.sqrt(square[i] / unbiased) + np.float32(EPSILON))
    return result
