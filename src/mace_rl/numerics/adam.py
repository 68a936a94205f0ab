"""Adam (Kingma & Ba 2015), compiled.

PyTorch's takes every run a second and 70 MB to load. A call of it takes longer than the rest of a
small network's update.
"""

import math
from typing import NamedTuple

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.matmul import dot

DECAY_MEAN, DECAY_SQUARE, EPSILON = 0.9, 0.999, 1e-5  # β₁, β₂ and ε


class AdamState(NamedTuple):
    """What one step takes beside the gradient; it changes the arrays in place."""

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
        self, parameters: np.ndarray, learning_rate: float, max_gradient_norm: float = math.inf
    ) -> None:
        self.parameters = parameters
        self.rates = learning_rate, max_gradient_norm
        self.mean, self.square = np.zeros_like(parameters), np.zeros_like(parameters)
        self.decayed = np.ones(2)

    def step(self, gradient: np.ndarray) -> float:
        """One step against `gradient`, [n]; returns the gradient's norm before clipping."""
        return step(gradient, self.state)

    @property
    def state(self) -> AdamState:
        """For the compiled `step`."""
        return AdamState(self.parameters, self.mean, self.square, self.decayed, *self.rates)

    def preconditioned(self, direction: np.ndarray) -> np.ndarray:
        """`direction`, [n], in the units in which this optimiser steps: over √v̂ + ε, float32 [n].

        v̂ is the second moment. Before the first step it is not known: the direction is returned.
        """
        return direction if self.decayed[1] == 1 else preconditioned(direction, self.state)


@kernel
def step(gradient, state):
    """One step of Adam (algorithm 1), in place; see `Adam.step`."""
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
def preconditioned(direction, state):
    """That of an `Adam` in this state."""
    result, share = np.empty_like(direction), np.float32(1 - state.decayed[1])
    for i in range(len(direction)):
        result[i] = direction[i] / (math.sqrt(state.square[i] / share) + np.float32(EPSILON))
    return result
