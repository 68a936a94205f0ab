"""A multilayer perceptron with its gradient written out.

Two hidden layers of 64 units are too small for a tensor library: most of a PyTorch update of this
size is call overhead. Compiled it is several times faster, and the flat parameters need no copying
between learning and acting.
"""

from itertools import pairwise

import numpy as np

from mace_rl import compiled


class MLP:
    """Linear layers with tanh between them.

    `parameters` is one float32 vector, [n]: for each layer the weights, [in, out] row by row, then
    the biases, [out]; then `extra` numbers of the owner's. `weights` and `biases` are views of it.

    Initial weights are orthogonal with gain √2, `output_gain` in the last layer; all else is 0.
    """

    def __init__(
        self, sizes: list[int], output_gain: float, generator: np.random.Generator, extra: int = 0
    ) -> None:
        self.sizes = np.array(sizes)
        shapes = list(pairwise(sizes))
        count = sum(inputs * outputs + outputs for inputs, outputs in shapes)
        self.parameters = np.zeros(count + extra, np.float32)
        self.weights, self.biases = self.split(self.parameters)
        for layer, shape in enumerate(shapes):
            gain = output_gain if layer == len(shapes) - 1 else np.sqrt(2)
            self.weights[layer][:] = gain * orthogonal(shape, generator)

    def split(self, flat: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Views of a vector like `parameters`: each layer's weights, [in, out], and biases."""
        weights, biases, start = [], [], 0
        for inputs, outputs in pairwise(self.sizes.tolist()):
            end = start + inputs * outputs
            weights.append(flat[start:end].reshape(inputs, outputs))
            biases.append(flat[end : end + outputs])
            start = end + outputs
        return weights, biases

    def forward(self, inputs: np.ndarray) -> tuple[np.ndarray, ...]:
        """The activations of every layer for [N, in]: the inputs first, the outputs last."""
        inputs = np.ascontiguousarray(inputs, self.parameters.dtype)
        shapes = [(len(inputs), size) for size in self.sizes.tolist()[1:]]
        activations = (inputs, *(np.empty(shape, inputs.dtype) for shape in shapes))
        compiled.network_outputs(activations, self.parameters, self.sizes)
        return activations

    def backward(self, activations: tuple[np.ndarray, ...], slope: np.ndarray) -> np.ndarray:
        """Gradient with respect to `parameters`, [n], of a loss.

        activations: what `forward` returned; slope: the loss's gradient with respect to the
        outputs, [N, out]. The part of `extra` is 0.
        """
        return compiled.network_gradient(activations, slope, self.parameters, self.sizes)


def orthogonal(shape: tuple[int, int], generator: np.random.Generator) -> np.ndarray:
    """A random matrix with orthonormal rows or columns (Saxe et al. 2014)."""
    rows, columns = max(shape), min(shape)
    basis, triangle = np.linalg.qr(generator.standard_normal((rows, columns)))
    basis *= np.sign(np.diag(triangle))  # else not uniform over the orthogonal matrices
    return basis if shape == (rows, columns) else basis.T
