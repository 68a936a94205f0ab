"""Networks: one small interface, and the default one, a tanh network, in compiled code.

`torch_network` has the other implementation, which runs any torch module.
"""

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from mace_rl.numerics import network_kernels as kernels
from mace_rl.numerics.matmul import padded

if TYPE_CHECKING:  # it takes seconds to import, and most trainings need nothing of it
    import torch

Layers = list[tuple[np.ndarray, np.ndarray]]  # each one's weights, [in, out], and biases


class Network(Protocol):
    """A function of inputs and parameters."""

    parameters: np.ndarray  # float32 [n]; whoever learns changes it in place

    def outputs(self, inputs: np.ndarray) -> np.ndarray:
        """Float32 [N, out] for inputs, [N, in]."""

    def move_to(self, memory: np.ndarray) -> None:
        """Keep the parameters in `memory`, float32 [n], from now on."""

    def module(self) -> "torch.nn.Module":
        """The same network as a torch module; it may share memory with this one."""

    def load_module_state(self, state: "dict[str, torch.Tensor]") -> None:
        """Take over the parameters in the `state_dict` of such a module."""


class Trace(NamedTuple):
    """What a forward pass leaves for the backward pass."""

    outputs: np.ndarray  # float32 [N, out]
    saved: Any  # of the network's own


class CompiledMLP:
    """A `Network` of `mlp` in compiled code; `network_kernels` has the layout of `parameters`."""

    def __init__(self, layers: Layers) -> None:
        shapes = [weights.shape for weights, _ in layers]
        self.sizes = np.array([shapes[0][0], *(shape[1] for shape in shapes)])
        count = sum((inputs + 1) * padded(outputs) for inputs, outputs in shapes)
        self.parameters = np.zeros(count, np.float32)
        # For one input and what the layers make of it, while somebody acts.
        self.scratch = (
            np.empty((1, shapes[0][0]), np.float32),
            kernels.activation_buffer(1, self.sizes),
        )
        for (weights, biases), initial in zip(self.layers(self.parameters), layers, strict=True):
            weights[:], biases[:] = initial

    def outputs(self, inputs: np.ndarray) -> np.ndarray:
        inputs = np.ascontiguousarray(inputs, np.float32)
        return kernels.network_outputs(inputs, self.parameters, self.sizes)[0]

    def forward(self, inputs: np.ndarray) -> Trace:
        """`outputs`, and what `backward` needs of the way to them."""
        inputs = np.ascontiguousarray(inputs, np.float32)
        outputs, activations = kernels.network_outputs(inputs, self.parameters, self.sizes)
        return Trace(outputs, (inputs, activations))

    def backward(self, trace: Trace, grad_outputs: np.ndarray) -> np.ndarray:
        """Gradient of a loss with respect to `parameters`, float32 [n].

        trace: what `forward` returned; grad_outputs: the loss's gradient at the outputs, [N, out].
        """
        return kernels.network_gradient(*trace.saved, self.parameters, grad_outputs, self.sizes)[0]

    def gradients(self, trace: Trace, grad_outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same, and the gradient with respect to the inputs, [N, in]."""
        same = self.parameters, grad_outputs, self.sizes
        gradient, at_first_layer = kernels.network_gradient(*trace.saved, *same)
        return gradient, kernels.input_gradient(at_first_layer, self.parameters, self.sizes)

    def move_to(self, memory: np.ndarray) -> None:
        """See `Network`; raises `ValueError` for what compiled code would read as other numbers."""
        if memory.dtype != np.float32 or not memory.flags.c_contiguous:
            raise ValueError(f"parameters have to be contiguous float32, not {memory.dtype}")
        memory[:] = self.parameters
        self.parameters = memory

    def layers(self, flat: np.ndarray) -> Layers:
        """Views of a vector like `parameters`."""
        views, start = [], 0
        for inputs, outputs in pairwise(self.sizes.tolist()):
            width = padded(outputs)
            end = start + (inputs + 1) * width
            layer = flat[start:end].reshape(inputs + 1, width)[:, :outputs]
            views.append((layer[:-1], layer[-1]))
            start = end
        return views

    def module(self) -> "torch.nn.Sequential":
        from mace_rl.numerics.torch_network import tanh_layers

        return tanh_layers(self.layers(self.parameters))

    def load_module_state(self, state: "dict[str, torch.Tensor]") -> None:
        for place, (weights, biases) in enumerate(self.layers(self.parameters)):
            weights[:] = state[f"{2 * place}.weight"].numpy().T
            biases[:] = state[f"{2 * place}.bias"].numpy()


def mlp(sizes: list[int], output_gain: float, generator: np.random.Generator) -> Layers:
    """The layers of a new `CompiledMLP`, between which tanh stands.

    Weights are orthogonal with gain √2, `output_gain` in the last layer; biases are 0.
    """
    pairs = list(pairwise(sizes))
    gains = [math.sqrt(2)] * (len(pairs) - 1) + [output_gain]
    return [
        (gain * orthogonal(pair, generator), np.zeros(pair[1]))
        for pair, gain in zip(pairs, gains, strict=True)
    ]


def orthogonal(shape: tuple[int, int], generator: np.random.Generator) -> np.ndarray:
    """A random matrix with orthonormal rows or columns (Saxe et al. 2014)."""
    rows, columns = max(shape), min(shape)
    basis = kernels.orthonormal(generator.standard_normal((rows, columns)))
    return basis if shape == (rows, columns) else basis.T
