"""The meta-adaptation network: an LSTM over one episode and a readout (paper, supplement).

`MetaNetwork` defines it in torch; `CompiledMetaNetwork` computes the same in compiled code, where
PyTorch's 32 short steps are nearly all call overhead.
"""

import math

import numpy as np
import torch
from torch import Tensor

from mace_rl.agent.elementary import log, tanh
from mace_rl.agent.kernels import kernel
from mace_rl.agent.network import TorchNetwork, Trace
from mace_rl.agent.products import LANES, add_product, dot, padded, product


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
        self.readout_bias = _parameter(np.array([logit(initial)]))

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


class TorchMetaNetwork(TorchNetwork):
    """`MetaNetwork` for several sequences, [T, in] each, one after the other."""

    def forward(self, inputs: list[np.ndarray]) -> Trace:  # type: ignore[override]
        """See `Network`; the outputs are one logit for each sequence, [B]."""
        outputs = torch.cat([self._module(torch.from_numpy(sequence)) for sequence in inputs])
        return Trace(outputs.detach().numpy(), (outputs, inputs))


class CompiledMetaNetwork:
    """`MetaNetwork` in compiled code, for several sequences side by side.

    `parameters` are the module's, one kind after the other, with units added to a multiple of 16
    (see `mace_rl.agent.kernels`): their weights are 0 and stay so.
    """

    parameters: np.ndarray  # float32 [n]

    def __init__(self, module: MetaNetwork) -> None:
        self.inputs, self.units = len(module.weight_ih), len(module.weight_hh)
        width = padded(self.units)
        self.shapes = (
            (self.inputs, 4 * width),
            (self.units, 4 * width),
            (4 * width,),
            (width,),
            (1,),
        )
        self.parameters = np.zeros(sum(math.prod(shape) for shape in self.shapes), np.float32)
        self.views = self.split(self.parameters)
        self.load_module_state(module.state_dict())

    def split(self, flat: np.ndarray) -> list[np.ndarray]:
        """Views of a vector like `parameters`: each kind of weights, units added."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])[:-1]
        return [
            part.reshape(shape)
            for part, shape in zip(np.split(flat, ends), self.shapes, strict=True)
        ]

    def move_to(self, memory: np.ndarray) -> None:
        """See `Network`."""
        memory[:] = self.parameters
        self.parameters, self.views = memory, self.split(memory)

    def forward(self, inputs: list[np.ndarray]) -> Trace:
        """See `TorchMetaNetwork`."""
        lengths = np.array([len(sequence) for sequence in inputs])
        order = np.argsort(-lengths, kind="stable")
        lengths = lengths[order]
        # All end together: [T, B, in], the longest first, so that who takes part comes first.
        side_by_side = np.zeros((lengths[0], len(inputs), self.inputs), np.float32)
        for row, place in enumerate(order):
            side_by_side[lengths[0] - lengths[row] :, row] = inputs[place]
        logits, *states = lstm_outputs(side_by_side, lengths, *self.views)
        outputs = np.empty_like(logits)
        outputs[order] = logits
        return Trace(outputs, (order, lengths, side_by_side, *states))

    def backward(self, trace: Trace, grad_outputs: np.ndarray) -> np.ndarray:
        """See `Network`."""
        order, *states = trace.saved
        gradient = np.zeros_like(self.parameters)
        _, weight_hh, _, readout, _ = self.views
        grad_logits = grad_outputs[order]
        lstm_gradients(*states, weight_hh, readout, grad_logits, *self.split(gradient))
        return gradient

    def module(self) -> MetaNetwork:
        """See `Network`."""
        module = MetaNetwork(self.inputs, self.units, 0.5, np.random.default_rng(0))
        with torch.no_grad():
            for part, own in zip(module.parameters(), self.own(), strict=True):
                part.copy_(torch.from_numpy(own.reshape(part.shape)))
        return module

    def load_module_state(self, state: dict[str, Tensor]) -> None:
        """See `Network`."""
        for own, part in zip(self.own(), state.values(), strict=True):
            own[:] = part.numpy().reshape(own.shape)

    def own(self) -> list[np.ndarray]:
        """Views of the parameters without the units added, in the module's order."""
        weight_ih, weight_hh, bias, readout, readout_bias = self.views
        gates = (part.reshape(*part.shape[:-1], 4, -1) for part in (weight_ih, weight_hh, bias))
        return [*(part[..., : self.units] for part in gates), readout[: self.units], readout_bias]


MetaNetworks = TorchMetaNetwork | CompiledMetaNetwork


def meta_network(
    inputs: int, hidden_units: int, initial: float, engine: str, generator: np.random.Generator
) -> MetaNetworks:
    """A newly initialised meta-adaptation network."""
    module = MetaNetwork(inputs, hidden_units, initial, generator)
    return CompiledMetaNetwork(module) if engine == "compiled" else TorchMetaNetwork(module)


@kernel
def logit(beta: float) -> float:
    """log(β / (1 - β)), of a float64 in (0, 1), to float32's rounding."""
    return log(np.float32(beta / (1 - beta)))


@kernel
def sigmoid(x: np.float32) -> np.float32:
    """The logistic function."""
    return np.float32(0.5) + np.float32(0.5) * tanh(np.float32(0.5) * x)


@kernel
def quarters(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Four views of a vector, [4 H]."""
    size = len(vector) // 4
    return vector[:size], vector[size : 2 * size], vector[2 * size : 3 * size], vector[3 * size :]


@kernel
def lstm_outputs(
    sequences: np.ndarray,
    lengths: np.ndarray,
    weight_ih: np.ndarray,
    weight_hh: np.ndarray,
    bias: np.ndarray,
    readout: np.ndarray,
    readout_bias: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The readout of the last hidden state of each sequence, [B], and `lstm_states`."""
    gates, cells, hidden = lstm_states(sequences, lengths, weight_ih, weight_hh, bias)
    logits = np.empty(len(lengths), np.float32)
    for b in range(len(lengths)):
        logits[b] = dot(readout, hidden[-1, b]) + readout_bias[0]
    return logits, gates, cells, hidden


@kernel
def lstm_states(
    sequences: np.ndarray,
    lengths: np.ndarray,
    weight_ih: np.ndarray,
    weight_hh: np.ndarray,
    bias: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Long short-term memory over B sequences that end together, [T, B, in], from a zero state.

    lengths: of each, the longest first. weight_ih: [in, 4 H], weight_hh: [≤ H, 4 H], bias: [4 H],
    for H units, whose columns are the input, forget and output gates and the candidate. Returns
    these four in one array, [T, B, 4 H], and the cell states and hidden states, [T + 1, B, H] each,
    the zero state included.
    """
    steps, count, inputs = sequences.shape
    size = weight_hh.shape[1] // 4
    gates = np.empty((steps, count, 4 * size), np.float32)
    rows = steps * count
    product(sequences.reshape(rows, inputs), weight_ih, bias, gates.reshape(rows, 4 * size))
    cells = np.zeros((steps + 1, count, size), np.float32)
    hidden = np.zeros_like(cells)
    for t in range(steps):
        there = 0
        while there < count and lengths[there] >= steps - t:
            there += 1
        add_product(hidden[t, :there], weight_hh, gates[t, :there])
        for b in range(there):
            gate, before, cell, shown = gates[t, b], cells[t, b], cells[t + 1, b], hidden[t + 1, b]
            sigmoids = gate[: 3 * size]
            for j in range(3 * size):
                sigmoids[j] = sigmoid(sigmoids[j])
            input_gate, forget_gate, output_gate, candidate = quarters(gate)
            for j in range(size):
                candidate[j] = tanh(candidate[j])
                cell[j] = forget_gate[j] * before[j] + input_gate[j] * candidate[j]
                shown[j] = output_gate[j] * tanh(cell[j])
    return gates, cells, hidden


@kernel
def lstm_gradients(
    lengths: np.ndarray,
    sequences: np.ndarray,
    gates: np.ndarray,
    cells: np.ndarray,
    hidden: np.ndarray,
    weight_hh: np.ndarray,
    readout: np.ndarray,
    grad_logits: np.ndarray,
    grad_weight_ih: np.ndarray,
    grad_weight_hh: np.ndarray,
    grad_bias: np.ndarray,
    grad_readout: np.ndarray,
    grad_readout_bias: np.ndarray,
) -> None:
    """Add the gradients with respect to weights and biases, by backpropagation in time.

    grad_logits: the loss's gradient at each logit, float32 [B]; readout: [H]; the states as
    `lstm_states` returned them.
    """
    steps, count, inputs = sequences.shape
    size, one = len(readout), np.float32(1)
    back = np.zeros((4 * size, size), np.float32)  # weight_hh transposed
    for first in range(0, 4 * size, LANES):  # a strip at a time: 16 rows stay in the cache
        for j in range(len(weight_hh)):
            for k in range(first, first + LANES):
                back[k, j] = weight_hh[j, k]
    grad_gates = np.zeros_like(gates)
    grad_hidden, grad_cell = (
        np.empty((count, size), np.float32),
        np.zeros((count, size), np.float32),
    )
    for b in range(count):
        for j in range(size):
            grad_hidden[b, j] = grad_logits[b] * readout[j]
            grad_readout[j] += grad_logits[b] * hidden[steps, b, j]
        grad_readout_bias[0] += grad_logits[b]
    for t in range(steps - 1, -1, -1):
        there = 0
        while there < count and lengths[there] >= steps - t:
            there += 1
        for b in range(there):
            input_gate, forget_gate, output_gate, candidate = quarters(gates[t, b])
            grad_input, grad_forget, grad_output, grad_candidate = quarters(grad_gates[t, b])
            cell, before, grad_shown, grad = (
                cells[t + 1, b],
                cells[t, b],
                grad_hidden[b],
                grad_cell[b],
            )
            for j in range(size):
                shown = tanh(cell[j])
                grad_output[j] = grad_shown[j] * shown * output_gate[j] * (one - output_gate[j])
                grad[j] += grad_shown[j] * output_gate[j] * (one - shown * shown)
                grad_input[j] = grad[j] * candidate[j] * input_gate[j] * (one - input_gate[j])
                grad_forget[j] = grad[j] * before[j] * forget_gate[j] * (one - forget_gate[j])
                grad_candidate[j] = grad[j] * input_gate[j] * (one - candidate[j] * candidate[j])
                grad[j] *= forget_gate[j]
        product(grad_gates[t, :there], back, np.zeros(size, np.float32), grad_hidden[:there])
    rows = steps * count
    changes = grad_gates.reshape(rows, 4 * size)
    add_product(sequences.reshape(rows, inputs).T, changes, grad_weight_ih)
    add_product(hidden[:-1].reshape(rows, size).T, changes, grad_weight_hh)
    add_product(np.ones((1, rows), np.float32), changes, grad_bias.reshape(1, 4 * size))
