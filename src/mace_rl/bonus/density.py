"""Neural density estimator: a masked autoencoder, MADE (Germain et al. 2015), Gaussian outputs."""

import numpy as np

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import HALF_LOG_TAU, exp
from mace_rl.numerics.network import CompiledMLP, mlp

SMALLEST_LOG_STD = -5.0  # a coordinate that never varies would otherwise have infinite density


class DensityEstimator(CompiledMLP):
    """log p(x) = Σ_i log N(x_i; μ_i(x_<i), σ_i(x_<i)): p integrates to 1 whatever the weights.

    The network, [N, size] → [N, 2 size], has one hidden layer and tanh; its outputs are μ, then
    log σ. Masked weights start at 0, and their gradient is 0.
    """

    def __init__(self, size: int, hidden_units: int, generator: np.random.Generator) -> None:
        # Unit h sees inputs up to its degree; outputs of coordinate i see units of lower degree.
        degrees = np.arange(hidden_units) % max(size - 1, 1) + 1
        coordinates = np.arange(1, size + 1)
        inward = (coordinates[:, None] <= degrees).astype(np.float32)
        outward = np.tile(degrees[:, None] < coordinates, 2).astype(np.float32)
        hidden, output = mlp([size, hidden_units, 2 * size], 0.1, generator)
        super().__init__([(hidden[0] * inward, hidden[1]), (output[0] * outward, output[1])])
        self.mask = np.ones_like(self.parameters)
        for (weights, _), mask in zip(self.layers(self.mask), (inward, outward), strict=True):
            weights[:] = mask

    def log_prob(self, x: np.ndarray) -> np.ndarray:
        """Log-density of each row of x, float32 [N, size] → [N]."""
        return gaussian_log_probs(x, self.forward(x).outputs)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """∇ of the mean log-density of the rows of x, [N, size], with respect to the parameters."""
        trace = self.forward(x)
        return self.backward(trace, gaussian_grad(x, trace.outputs)) * self.mask


@kernel
def gaussian_log_probs(x: np.ndarray, outputs: np.ndarray) -> np.ndarray:
    """Σ_i log N(x_i; μ_i, σ_i) of each row, float32 [N]; arguments as in `gaussian_grad`."""
    count, size = x.shape
    result = np.empty(count, np.float32)
    for n in range(count):
        total = np.float32(-HALF_LOG_TAU * size)
        for i in range(size):
            log_std = max(outputs[n, size + i], np.float32(SMALLEST_LOG_STD))
            deviation = (x[n, i] - outputs[n, i]) * exp(-log_std)
            total -= np.float32(0.5) * deviation * deviation + log_std
        result[n] = total
    return result


@kernel
def gaussian_grad(x: np.ndarray, outputs: np.ndarray) -> np.ndarray:
    """Gradient of the mean over the rows of Σ_i log N(x_i; μ_i, σ_i) at the outputs, [N, 2 size].

    x: float32 [N, size]; outputs: float32 [N, 2 size], μ and log σ, which has no gradient below its
    lower bound.
    """
    count, size = x.shape
    grad = np.empty_like(outputs)
    share = np.float32(1 / count)
    for n in range(count):
        for i in range(size):
            free = outputs[n, size + i] > SMALLEST_LOG_STD
            log_std = max(outputs[n, size + i], np.float32(SMALLEST_LOG_STD))
            inverse_std = exp(-log_std)
            deviation = (x[n, i] - outputs[n, i]) * inverse_std
            grad[n, i] = deviation * inverse_std * share
            grad[n, size + i] = (deviation * deviation - np.float32(1)) * share if free else 0.0
    return grad
