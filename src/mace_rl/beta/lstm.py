"""The meta-adaptation network: an LSTM over one episode and a readout (paper, supplement).

`MetaNetwork` defines it in torch; `CompiledMetaNetwork` computes the same in compiled code, where
PyTorch's 32 short steps are nearly all call overhead.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mace_rl.agent.kernels import kernel, tanh
from mace_rl.agent.network import Network, TorchNetwork, Trace


class MetaNetwork(torch.nn.Module):
    """Long short-term memory (Hochreiter & Schmidhuber 1997), then a linear readout.

    From a sequence, [T, in], to the logit of β, [1].
    """

    def __init__(
        self, inputs: int, hidden_units: int, initial: float, generator: np.random.Generator
    ) -> None:
        """`initial` is about what β is to every sequence before training."""
        super().__init__()

        gates = 4 * hidden_units  # columns: input, forget and output gate, candidate
        shapes = (inputs, gates), (hidden_units, gates), (gates,)
        self.weight_ih, self.weight_hh, self.bias = (
            _parameter(generator.uniform(-1, 1, shape) / math.sqrt(hidden_units))
            for shape in shapes
        )
        self.readout = _parameter(generator.uniform(-0.01, 0.01, hidden_units))
        self.readout_bias = _parameter(np.array([math.log(initial / (1 - initial))]))

    def forward(self, sequence: Tensor) -> Tensor:
        """The logit of β."""
        hidden = cell = self.bias.new_zeros(len(self.weight_hh))
        for x in sequence:
            gates = x @ self.weight_ih + hidden @ self.weight_hh + self.bias
            input_gate, forget_gate, output_gate, candidate = gates.chunk(4)
            cell = forget_gate.sigmoid() * cell + input_gate.sigmoid() * candidate.tanh()
            hidden = output_gate.sigmoid() * cell.tanh()
        return self.readout @ hidden + self.readout_bias


def _parameter(values: np.ndarray) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.from_numpy(values.astype(np.float32)))


class States(NamedTuple):
    """What the compiled forward pass leaves for the backward pass."""

    sequence: np.ndarray  # [T, in]
    gates: np.ndarray  # [T, 4 H]
    cells: np.ndarray  # [T + 1, H], the zero state included
    hidden: np.ndarray  # [T + 1, H], the same


class CompiledMetaNetwork:
    """`MetaNetwork` in compiled code; `parameters` are the module's, one after the other."""

    parameters: np.ndarray  # float32 [n]

    def __init__(self, module: MetaNetwork) -> None:
        self.shapes = {name: tuple(part.shape) for name, part in module.named_parameters()}
        vector = torch.nn.utils.parameters_to_vector(module.parameters())
        self.move_to(vector.detach().numpy().copy(), keep=False)

    def split(self, flat: np.ndarray) -> list[np.ndarray]:
        """Views of a vector like `parameters`: each kind of weights."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes.values()])[:-1]
        parts = zip(np.split(flat, ends), self.shapes.values(), strict=True)
        return [part.reshape(shape) for part, shape in parts]

    def move_to(self, memory: np.ndarray, keep: bool = True) -> None:
        """See `Network`; without `keep` the values in `memory` stay."""
        if keep:
            memory[:] = self.parameters
        self.parameters = memory
        views = self.split(memory)
        self.weight_ih, self.weight_hh, self.bias, self.readout, self.readout_bias = views

    def forward(self, inputs: np.ndarray) -> Trace:
        """See `Network`; the inputs are one sequence, the output is one logit, [1]."""
        states = lstm_states(inputs, self.weight_ih, self.weight_hh, self.bias)
        hidden = states[-1]
        logit = self.readout @ hidden[-1] + self.readout_bias[0]
        return Trace(np.array([logit]), States(inputs, *states))

    def backward(self, trace: Trace, grad_outputs: np.ndarray) -> np.ndarray:
        """See `Network`."""
        states: States = trace.saved
        gradient = np.empty_like(self.parameters)
        *lstm, readout, readout_bias = self.split(gradient)
        grad = grad_outputs[0]
        lstm_gradients(*states, self.weight_hh, grad * self.readout, *lstm)
        readout[:] = grad * states.hidden[-1]
        readout_bias[:] = grad
        return gradient

    def module(self) -> MetaNetwork:
        """See `Network`."""
        inputs, units = len(self.weight_ih), len(self.weight_hh)
        module = MetaNetwork(inputs, units, 0.5, np.random.default_rng(0))
        vector = torch.from_numpy(self.parameters.copy())
        torch.nn.utils.vector_to_parameters(vector, module.parameters())
        return module

    def load_module_state(self, state: dict[str, Tensor]) -> None:
        """See `Network`."""
        self.parameters[:] = np.concatenate([state[name].numpy().ravel() for name in self.shapes])


def meta_network(
    inputs: int, hidden_units: int, initial: float, engine: str, generator: np.random.Generator
) -> Network:
    """A newly initialised meta-adaptation network."""
    module = MetaNetwork(inputs, hidden_units, initial, generator)
    return CompiledMetaNetwork(module) if engine == "compiled" else TorchNetwork(module)


@kernel
def sigmoid(x: np.float32) -> np.float32:
    """The logistic function of a float32 or float64."""
    return np.float32(0.5) + np.float32(0.5) * tanh(np.float32(0.5) * x)


@kernel
def quarters(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Four views of a vector, [4 H]."""
    size = len(vector) // 4
    return vector[:size], vector[size : 2 * size], vector[2 * size : 3 * size], vector[3 * size :]


@kernel
def lstm_states(
    sequence: np.ndarray, weight_ih: np.ndarray, weight_hh: np.ndarray, bias: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Long short-term memory over a sequence, [T, in], from a zero state.

    weight_ih: [in, 4 H], weight_hh: [H, 4 H], bias: [4 H], for H units, whose columns are the
    input, forget and output gates and the candidate. Returns these four in one array, [T, 4 H], and
    the cell states and hidden states, [T + 1, H] each, the zero state included.
    """
    size = len(weight_hh)
    gates = np.dot(sequence, weight_ih)
    cells = np.zeros((len(sequence) + 1, size), gates.dtype)
    hidden = np.zeros_like(cells)
    for t in range(len(sequence)):
        gate, cell, shown = gates[t], cells[t + 1], hidden[t + 1]
        recurring, before = np.dot(hidden[t], weight_hh), cells[t]
        for j in range(3 * size):
            gate[j] = sigmoid(gate[j] + recurring[j] + bias[j])
        for j in range(3 * size, 4 * size):
            gate[j] = tanh(gate[j] + recurring[j] + bias[j])
        input_gate, forget_gate, output_gate, candidate = quarters(gate)
        for j in range(size):
            cell[j] = forget_gate[j] * before[j] + input_gate[j] * candidate[j]
            shown[j] = output_gate[j] * tanh(cell[j])
    return gates, cells, hidden


@kernel
def lstm_gradients(
    sequence: np.ndarray,
    gates: np.ndarray,
    cells: np.ndarray,
    hidden: np.ndarray,
    weight_hh: np.ndarray,
    grad_hidden: np.ndarray,
    grad_weight_ih: np.ndarray,
    grad_weight_hh: np.ndarray,
    grad_bias: np.ndarray,
) -> None:
    """Fill in the gradients with respect to weights and bias, by backpropagation in time.

    grad_hidden: the loss's gradient at the last hidden state, [H]; gates, cells and hidden as
    `lstm_states` returned them.
    """
    size, one = len(weight_hh), np.float32(1)
    grad_gates = np.empty_like(gates)
    grad_cell = np.zeros_like(grad_hidden)
    backward = weight_hh.T
    for t in range(len(sequence) - 1, -1, -1):
        input_gate, forget_gate, output_gate, candidate = quarters(gates[t])
        grad_input, grad_forget, grad_output, grad_candidate = quarters(grad_gates[t])
        cell, before = cells[t + 1], cells[t]
        for j in range(size):
            shown = tanh(cell[j])
            grad_output[j] = grad_hidden[j] * shown * output_gate[j] * (one - output_gate[j])
            grad_cell[j] += grad_hidden[j] * output_gate[j] * (one - shown * shown)
            grad_input[j] = grad_cell[j] * candidate[j] * input_gate[j] * (one - input_gate[j])
            grad_forget[j] = grad_cell[j] * before[j] * forget_gate[j] * (one - forget_gate[j])
            grad_candidate[j] = grad_cell[j] * input_gate[j] * (one - candidate[j] * candidate[j])
            grad_cell[j] *= forget_gate[j]
        grad_hidden = np.dot(grad_gates[t], backward)
    np.dot(sequence.T, grad_gates, grad_weight_ih)
    np.dot(hidden[:-1].T, grad_gates, grad_weight_hh)
    grad_bias[:] = 0
    for row in grad_gates:
        for j in range(len(row)):
            grad_bias[j] += row[j]
