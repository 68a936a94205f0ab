"""Neural density estimator: a masked autoencoder, MADE (Germain et al. 2015), Gaussian outputs."""

import math

import numpy as np
from numba import njit

from mace_rl.network import MLP

SMALLEST_LOG_STD = -5.0  # a coordinate that never varies would otherwise have infinite density


class MADE(MLP):
    """log p(x) = Σ_i log N(x_i; μ_i(x_<i), σ_i(x_<i)) with one masked hidden layer.

    Being autoregressive it is normalised: p integrates to 1 whatever the weights are. Masked
    weights start at 0 and their gradient is 0, so they stay there.
    """

    def __init__(self, size: int, hidden_units: int, generator: np.random.Generator) -> None:
        super().__init__([size, hidden_units, 2 * size], output_gain=0.1, generator=generator)
        # Unit h sees inputs up to its degree; outputs of coordinate i see units of lower degree.
        degrees = np.arange(hidden_units) % max(size - 1, 1) + 1
        coordinates = np.arange(1, size + 1)
        self.mask = np.ones_like(self.parameters)
        (inward, outward), _ = self.split(self.mask)
        inward[:] = coordinates[:, None] <= degrees
        outward[:] = np.tile(degrees[:, None] < coordinates, 2)
        self.parameters *= self.mask

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Log-density of each row of x, [N, size] → [N]."""
        *_, outputs = self.forward(x)
        return gaussian_log_probs(x, outputs, self._inverse_std(outputs))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """∇ of the mean log-density of the rows of x, [N, size], with respect to `parameters`."""
        activations = self.forward(x)
        outputs = activations[-1]
        slope = gaussian_slope(x, outputs, self._inverse_std(outputs))
        return self.backward(activations, slope) * self.mask

    def _inverse_std(self, outputs: np.ndarray) -> np.ndarray:
        """1 / σ, [N, size], from the network's outputs, [N, 2 size]: μ, then log σ unbounded."""
        log_std = outputs[:, outputs.shape[1] // 2 :]
        return np.exp(-np.maximum(log_std, np.float32(SMALLEST_LOG_STD)))


@njit(cache=True, error_model="numpy")
def gaussian_log_probs(x, outputs, inverse_std):
    """Σ_i log N(x_i; μ_i, σ_i) of each row, [N]; arguments as in `gaussian_slope`."""
    count, size = x.shape
    result = np.full(count, -0.5 * math.log(2 * math.pi) * size, x.dtype)
    for n in range(count):
        for i in range(size):
            deviation = (x[n, i] - outputs[n, i]) * inverse_std[n, i]
            log_std = max(outputs[n, size + i], SMALLEST_LOG_STD)
            result[n] -= 0.5 * deviation * deviation + log_std
    return result


@njit(cache=True, error_model="numpy")
def gaussian_slope(x, outputs, inverse_std):
    """Gradient of the mean over the rows of Σ_i log N(x_i; μ_i, σ_i) at the outputs, [N, 2 size].

    x: [N, size]; outputs: [N, 2 size], μ and log σ, which has no gradient below its lower bound;
    inverse_std: [N, size], 1 / σ.
    """
    count, size = x.shape
    slope = np.empty_like(outputs)
    for n in range(count):
        for i in range(size):
            deviation = (x[n, i] - outputs[n, i]) * inverse_std[n, i]
            slope[n, i] = deviation * inverse_std[n, i] / count
            free = outputs[n, size + i] > SMALLEST_LOG_STD
            slope[n, size + i] = (deviation * deviation - 1) / count if free else 0.0
    return slope
