"""Neural density estimator: a masked autoencoder, MADE (Germain et al. 2015), Gaussian outputs."""

import math

import numpy as np

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
        deviations, log_std = self._standardised(x, self.forward(x)[-1])
        constant = np.float32(0.5 * math.log(2 * math.pi))
        return (-0.5 * deviations * deviations - log_std - constant).sum(axis=1)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """∇ of the mean log-density of the rows of x, [N, size], with respect to `parameters`."""
        activations = self.forward(x)
        outputs = activations[-1]
        deviations, log_std = self._standardised(x, outputs)
        slope = np.empty_like(outputs)
        mean_slope, log_std_slope = np.split(slope, 2, axis=1)
        mean_slope[:] = deviations * np.exp(-log_std)
        log_std_slope[:] = deviations * deviations - 1
        log_std_slope *= outputs[:, x.shape[1] :] > SMALLEST_LOG_STD
        slope /= len(x)
        return self.backward(activations, slope) * self.mask

    def _standardised(self, x: np.ndarray, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(x - μ) / σ and log σ, [N, size] each, from the network's outputs, [N, 2 size]."""
        mean, log_std = np.split(outputs, 2, axis=1)
        log_std = np.maximum(log_std, np.float32(SMALLEST_LOG_STD))
        return (x - mean) * np.exp(-log_std), log_std
