"""Adam, the optimiser of every network here.

Written out because loading PyTorch's costs every run a second and 70 MB, and a call of it more
than the rest of a small network's update.
"""

import math
from typing import Any

import numpy as np
import torch

from mace_rl.agent.kernels import kernel
from mace_rl.agent.products import dot

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
        self.decayed = np.ones(2)  # β₁ᵗ and β₂ᵗ after t steps

    def step(self, gradient: np.ndarray) -> float:
        """One step against `gradient`, [n]; returns the gradient's norm before clipping."""
        return step(gradient, *self.state)

    @property
    def state(self) -> tuple[Any, ...]:
        """What the compiled `step` takes beside the gradient."""
        rates = self.learning_rate, self.max_gradient_norm
        return self.parameters, self.mean, self.square, self.decayed, *rates

    def preconditioned(self, direction: np.ndarray) -> np.ndarray:
        """`direction`, [n], in the units in which this optimiser steps: over √v̂ + ε, float32 [n].

        v̂ is the second moment after the steps so far; before the first one nothing is known of it
        and the direction is returned.
        """
        if self.decayed[1] == 1:
            return direction
        return preconditioned(direction, self.square, np.float32(1 - self.decayed[1]))

    def state_dict(self) -> dict[str, Any]:
        """Parameters and the optimiser's moments."""
        names = ("parameters", "mean", "square", "decayed")
        return {name: torch.from_numpy(getattr(self, name).copy()) for name in names}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned, in place: the network holds the same arrays."""
        for name, value in state.items():
            getattr(self, name)[:] = value.numpy()


@kernel
def step(gradient, parameters, mean, square, decayed, learning_rate, max_gradient_norm):
    """One step of Adam (Kingma & Ba 2015, algorithm 1), in place; see `Adam.step`.

    gradient, parameters and the moments' running estimates, mean and square: float32 [n].
    """
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
