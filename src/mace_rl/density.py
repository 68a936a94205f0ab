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
        mean, log_std = self._moments(self.forward(x))
        deviations = (x - mean) * np.exp(-log_std)
        constant = np.float32(0.5 * math.log(2 * math.pi))
        return (-0.5 * deviations * deviations - log_std - constant).sum(axis=1)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """∇ of the mean log-density of the rows of x, [N, size], with respect to `parameters`."""
        activations = self.forward(x)
        mean, log_std = self._moments(activations)
        slope = gaussian_slope(activations[0], mean, log_std, np.exp(-log_std))
        return self.backward(activations, slope) * self.mask

    def _moments(self, activations: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
        """μ and log σ, [N, size] each, from what `forward` returned."""
        mean, log_std = np.split(activations[-1], 2, axis=1)
        return mean, np.maximum(log_std, np.float32(SMALLEST_LOG_STD))


@njit(cache=True, error_model="numpy")
def gaussian_slope(x, mean, log_std, inverse_std):
    """Gradient of the mean of log N(x; μ, σ) with respect to μ and log σ, [N, 2 size].

    All arguments are [N, size]; log σ at its lower bound has no gradient.
    """
    count, size = x.shape
    slope = np.empty((count, 2 * size), x.dtype)
    for n in range(count):
        mean_slope, log_std_slope = slope[n, :size], slope[n, size:]
        for i in range(size):
            deviation = (x[n, i] - mean[n, i]) * inverse_std[n, i]
            mean_slope[i] = deviation * inverse_std[n, i] / count
            free = log_std[n, i] > SMALLEST_LOG_STD
            log_std_slope[i] = (deviation * deviation - 1) / count if free else 0.0
    return slope
