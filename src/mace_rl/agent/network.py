"""Networks: one small interface, the vector-Jacobian product, and two implementations.

A `torch.nn.Module` defines each network. `TorchNetwork` runs any such module; `CompiledMLP` runs
the default one, a tanh network, in compiled code. Whoever holds a network sees a flat vector of
parameters, outputs, and gradients, and cannot tell which it is.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch

from mace_rl.agent import kernels
from mace_rl.agent.products import padded
from mace_rl.config.agent import PPOConfig, TorchModule
from mace_rl.config.plugins import make
from mace_rl.config.section import ConfigError


class Trace(NamedTuple):
    """What a forward pass leaves for the backward pass."""

    outputs: np.ndarray  # float32 [N, out]
    saved: Any  # of the network's own


class Network(Protocol):
    """A function of inputs and parameters with its vector-Jacobian product."""

    parameters: np.ndarray  # float32 [n]; whoever learns changes it in place

    def forward(self, inputs: np.ndarray) -> Trace:
        """Outputs for inputs, [N, in] → `Trace` with [N, out]."""

    def backward(self, trace: Trace, grad_outputs: np.ndarray) -> np.ndarray:
        """Gradient of a loss with respect to `parameters`, float32 [n].

        trace: what `forward` returned; grad_outputs: the loss's gradient at the outputs, [N, out].
        """

    def gradients(self, trace: Trace, grad_outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same, and the gradient with respect to the inputs, [N, in]."""

    def move_to(self, memory: np.ndarray) -> None:
        """Keep the parameters in `memory`, float32 [n], from now on."""

    def module(self) -> torch.nn.Module:
        """The same network as a torch module; it may share memory with this one."""

    def load_module_state(self, state: dict[str, torch.Tensor]) -> None:
        """Take over the parameters in the `state_dict` of such a module."""


class TorchNetwork:
    """Any torch module; its parameters become views of the flat vector."""

    def __init__(self, module: torch.nn.Module) -> None:
        self._module = module
        vector = torch.nn.utils.parameters_to_vector(module.parameters())
        self.move_to(vector.detach().numpy().copy())

    def forward(self, inputs: np.ndarray) -> Trace:
        """See `Network`."""
        seen = torch.from_numpy(np.array(inputs, np.float32)).requires_grad_()
        outputs = self._module(seen)
        return Trace(outputs.detach().numpy(), (outputs, seen))

    def backward(self, trace: Trace, grad_outputs: np.ndarray) -> np.ndarray:
        """See `Network`."""
        outputs, _ = trace.saved
        gradients = torch.autograd.grad(
            outputs,
            list(self._module.parameters()),
            torch.from_numpy(grad_outputs),
            retain_graph=True,
            materialize_grads=True,
        )
        return torch.cat([gradient.ravel() for gradient in gradients]).numpy()

    def gradients(self, trace: Trace, grad_outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Network`."""
        outputs, seen = trace.saved
        weights = torch.from_numpy(grad_outputs)
        inward = torch.autograd.grad([outputs], [seen], [weights], retain_graph=True)
        return self.backward(trace, grad_outputs), inward[0].numpy()

    def move_to(self, memory: np.ndarray) -> None:
        """See `Network`."""
        vector = torch.from_numpy(memory)
        vector.copy_(torch.nn.utils.parameters_to_vector(self._module.parameters()).detach())
        torch.nn.utils.vector_to_parameters(vector, self._module.parameters())  # as views
        self.parameters = memory

    def module(self) -> torch.nn.Module:
        """See `Network`."""
        return self._module

    def load_module_state(self, state: dict[str, torch.Tensor]) -> None:
        """See `Network`."""
        self._module.load_state_dict(state)


class CompiledMLP:
    """The tanh network of `mlp` in compiled code.

    `parameters` are laid out as in `kernels`, with zeros between them.
    """

    def __init__(self, module: torch.nn.Sequential) -> None:
        shapes = [layer.weight.shape for layer in module if isinstance(layer, torch.nn.Linear)]
        self.sizes = np.array([shapes[0][1], *(shape[0] for shape in shapes)])
        count = sum((inputs + 1) * padded(outputs) for outputs, inputs in shapes)
        self.parameters = np.zeros(count, np.float32)
        self.load_module_state(module.state_dict())

    def forward(self, inputs: np.ndarray) -> Trace:
        """See `Network`."""
        inputs = np.ascontiguousarray(inputs, np.float32)
        outputs, activations = kernels.network_outputs(inputs, self.parameters, self.sizes)
        return Trace(outputs, (inputs, activations))

    def backward(self, trace: Trace, grad_outputs: np.ndarray) -> np.ndarray:
        """See `Network`."""
        nobody_s = np.empty((0, 0), np.float32)
        given = *trace.saved, self.parameters, grad_outputs, self.sizes
        return kernels.network_gradient(*given, nobody_s)

    def gradients(self, trace: Trace, grad_outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Network`."""
        inputs = self.sizes[0]
        inward = np.empty((len(grad_outputs), padded(inputs)), np.float32)
        given = *trace.saved, self.parameters, grad_outputs, self.sizes
        return kernels.network_gradient(*given, inward), inward[:, :inputs]

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
        """See `Network`."""
        module = tanh_layers(self.sizes.tolist())
        linear = [layer for layer in module if isinstance(layer, torch.nn.Linear)]
        with torch.no_grad():
            for layer, (weights, biases) in zip(linear, self.layers(self.parameters), strict=True):
                layer.weight.copy_(torch.from_numpy(weights.T))
                layer.bias.copy_(torch.from_numpy(biases))
        return module

    def load_module_state(self, state: dict[str, torch.Tensor]) -> None:
        """See `Network`."""
        for place, (weights, biases) in enumerate(self.layers(self.parameters)):
            weights[:] = state[f"{2 * place}.weight"].numpy().T
            biases[:] = state[f"{2 * place}.bias"].numpy()


def network(
    config: PPOConfig,
    engine: str,
    inputs: int,
    outputs: int,
    output_gain: float,
    generator: np.random.Generator,
) -> Network:
    """A network as the settings ask for it, newly initialised; `output_gain`: see `mlp`."""
    if isinstance(config.network, TorchModule):
        module = custom_module(config.network, config.hidden_units, inputs, outputs, generator)
        return TorchNetwork(module)
    layers = mlp([inputs, *config.hidden_units, outputs], output_gain, generator)
    return CompiledMLP(layers) if engine == "compiled" else TorchNetwork(layers)


def custom_module(
    settings: TorchModule,
    hidden_units: list[int],
    inputs: int,
    outputs: int,
    generator: np.random.Generator,
) -> torch.nn.Module:
    """The user's own module; what it draws from torch's global generator comes from `generator`.

    Raises `ConfigError` for a module that keeps more state than its parameters, or whose outputs
    are not [N, outputs] or not the same twice: such a run would not resume to the bit.
    """
    with torch.random.fork_rng(devices=[]), as_torch_begins():
        torch.manual_seed(int(generator.integers(2**63)))
        module = make(
            settings.module,
            "ppo.network.module",
            torch.nn.Module,
            True,
            *(inputs, outputs, hidden_units),
            **settings.arguments,
        )
        trial = torch.randn(2, inputs)  # not 0, which a dropout before any bias would keep
        shapes = [tuple(module(trial).shape), (2, outputs)]
        same = torch.equal(module(trial), module(trial))
    for problem, found in {
        f"gives {shapes[0]} for inputs (2, {inputs}), not {shapes[1]}": shapes[0] != shapes[1],
        "keeps state besides its parameters (buffers)": any(True for _ in module.buffers()),
        "gives other outputs the second time (dropout?)": not same,
    }.items():
        if found:
            raise ConfigError(f"ppo.network.module: the module of {settings.module!r} {problem}")
    return module.float()


@contextmanager
def as_torch_begins() -> Iterator[None]:
    """New tensors are float32 on the CPU, whatever the program or the user's module has set."""
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        with torch.device("cpu"):
            yield
    finally:
        torch.set_default_dtype(dtype)


def mlp(
    sizes: list[int], output_gain: float, generator: np.random.Generator
) -> torch.nn.Sequential:
    """Linear layers with tanh between them: what `CompiledMLP` computes, in torch.

    Initial weights are orthogonal with gain √2, `output_gain` in the last layer; biases are 0.
    """
    module = tanh_layers(sizes)
    linear = [layer for layer in module if isinstance(layer, torch.nn.Linear)]
    with torch.no_grad():
        for layer in linear:
            gain = output_gain if layer is linear[-1] else np.sqrt(2)
            weights = gain * orthogonal((layer.in_features, layer.out_features), generator)
            layer.weight.copy_(torch.from_numpy(weights.T))
            layer.bias.zero_()
    return module


def tanh_layers(sizes: list[int]) -> torch.nn.Sequential:
    """The layers of `mlp`, with weights that mean nothing."""
    generator = torch.get_rng_state()  # a new layer draws weights, which are replaced
    linear = [torch.nn.Linear(*pair, device="cpu", dtype=torch.float32) for pair in pairwise(sizes)]
    torch.set_rng_state(generator)
    layers = [part for one in linear for part in (one, torch.nn.Tanh())]
    return torch.nn.Sequential(*layers[:-1])


def orthogonal(shape: tuple[int, int], generator: np.random.Generator) -> np.ndarray:
    """A random matrix with orthonormal rows or columns (Saxe et al. 2014)."""
    rows, columns = max(shape), min(shape)
    basis = kernels.orthonormal(generator.standard_normal((rows, columns)))
    return basis if shape == (rows, columns) else basis.T
