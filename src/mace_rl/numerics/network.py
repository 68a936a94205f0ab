"""Networks: one small interface, and two implementations.

A `torch.nn.Module` defines each network. `TorchNetwork` runs any such module; `CompiledMLP` runs
the default one, a tanh network, in compiled code.
"""

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch

from mace_rl.numerics import network_kernels as kernels
from mace_rl.numerics.matmul import padded


class Network(Protocol):
    """A function of inputs and parameters."""

    parameters: np.ndarray  # float32 [n]; whoever learns changes it in place

    def outputs(self, inputs: np.ndarray) -> np.ndarray:
        """Float32 [N, out] for inputs, [N, in]."""

    def move_to(self, memory: np.ndarray) -> None:
        """Keep the parameters in `memory`, float32 [n], from now on."""

    def module(self) -> torch.nn.Module:
        """The same network as a torch module; it may share memory with this one."""

    def load_module_state(self, state: dict[str, torch.Tensor]) -> None:
        """Take over the parameters in the `state_dict` of such a module."""


class TorchNetwork:
    """A `Network` of any torch module, whose parameters become views of the flat vector."""

    def __init__(self, module: torch.nn.Module) -> None:
        self._module = module
        vector = torch.nn.utils.parameters_to_vector(module.parameters())
        self.move_to(vector.detach().numpy().copy())

    @torch.no_grad()
    def outputs(self, inputs: np.ndarray) -> np.ndarray:
        return self._module(torch.from_numpy(np.array(inputs, np.float32))).numpy()

    def move_to(self, memory: np.ndarray) -> None:
        vector = torch.from_numpy(memory)
        vector.copy_(torch.nn.utils.parameters_to_vector(self._module.parameters()).detach())
        torch.nn.utils.vector_to_parameters(vector, self._module.parameters())  # as views
        self.parameters = memory

    def module(self) -> torch.nn.Module:
        return self._module

    def load_module_state(self, state: dict[str, torch.Tensor]) -> None:
        self._module.load_state_dict(state)


class Trace(NamedTuple):
    """What a forward pass leaves for the backward pass."""

    outputs: np.ndarray  # float32 [N, out]
    saved: Any  # of the network's own


class CompiledMLP:
    """A `Network` of `mlp` in compiled code; `network_kernels` has the layout of `parameters`."""

    def __init__(self, module: torch.nn.Sequential) -> None:
        shapes = [layer.weight.shape for layer in module if isinstance(layer, torch.nn.Linear)]
        self.sizes = np.array([shapes[0][1], *(shape[0] for shape in shapes)])
        count = sum((inputs + 1) * padded(outputs) for outputs, inputs in shapes)
        self.parameters = np.zeros(count, np.float32)
        # For one input and what the layers make of it, while somebody acts.
        self.scratch = (
            np.empty((1, shapes[0][1]), np.float32),
            kernels.activation_buffer(1, self.sizes),
        )
        self.load_module_state(module.state_dict())

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
        given = *trace.saved, self.parameters, grad_outputs, self.sizes
        return kernels.network_gradient(*given)[0]

    def gradients(self, trace: Trace, grad_outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same, and the gradient with respect to the inputs, [N, in]."""
        given = *trace.saved, self.parameters, grad_outputs, self.sizes
        gradient, first = kernels.network_gradient(*given)
        return gradient, kernels.input_gradient(first, self.parameters, self.sizes)

    def move_to(self, memory: np.ndarray) -> None:
        """See `Network`; raises `ValueError` for what compiled code would read as other numbers."""
        if memory.dtype != np.float32 or not memory.flags.c_contiguous:
            raise ValueError(f"parameters have to be contiguous float32, not {memory.dtype}")
        memory[:] = self.parameters
        self.parameters = memory

    def layers(self, flat: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Views of a vector like `parameters`: each layer's weights, [in, out], and biases."""
        views, start = [], 0
        for inputs, outputs in pairwise(self.sizes.tolist()):
            width = padded(outputs)
            end = start + (inputs + 1) * width
            layer = flat[start:end].reshape(inputs + 1, width)[:, :outputs]
            views.append((layer[:-1], layer[-1]))
            start = end
        return views

    def module(self) -> torch.nn.Sequential:
        return tanh_layers(self.layers(self.parameters))

    def load_module_state(self, state: dict[str, torch.Tensor]) -> None:
        for place, (weights, biases) in enumerate(self.layers(self.parameters)):
            weights[:] = state[f"{2 * place}.weight"].numpy().T
            biases[:] = state[f"{2 * place}.bias"].numpy()


def mlp(
    sizes: list[int], output_gain: float, generator: np.random.Generator
) -> torch.nn.Sequential:
    """Linear layers with tanh between them: what `CompiledMLP` computes, in torch.

    Initial weights are orthogonal with gain √2, `output_gain` in the last layer; biases are 0.
    """
    pairs = list(pairwise(sizes))
    gains = [math.sqrt(2)] * (len(pairs) - 1) + [output_gain]
    zeros = (np.zeros(outputs) for _, outputs in pairs)
    weights = (gain * orthogonal(pair, generator) for pair, gain in zip(pairs, gains, strict=True))
    return tanh_layers(zip(weights, zeros, strict=True))


def tanh_layers(parameters: Iterable[tuple[np.ndarray, np.ndarray]]) -> torch.nn.Sequential:
    """The torch module of `mlp` from each layer's weights, [in, out], and biases."""
    layers: list[torch.nn.Module] = []
    for weights, biases in parameters:
        generator = torch.get_rng_state()  # a new layer draws weights, which are replaced
        inputs, outputs = weights.shape
        layer = torch.nn.Linear(inputs, outputs, device="cpu", dtype=torch.float32)
        torch.set_rng_state(generator)
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(weights.T))
            layer.bias.copy_(torch.from_numpy(biases))
        layers += [layer, torch.nn.Tanh()]
    return torch.nn.Sequential(*layers[:-1])


def orthogonal(shape: tuple[int, int], generator: np.random.Generator) -> np.ndarray:
    """A random matrix with orthonormal rows or columns (Saxe et al. 2014)."""
    rows, columns = max(shape), min(shape)
    basis = kernels.orthonormal(generator.standard_normal((rows, columns)))
    return basis if shape == (rows, columns) else basis.T
