"""The meta-adaptation network: an LSTM over one episode and a readout (paper, supplement).

`MetaNetwork` defines it in torch; `CompiledMetaNetwork` computes the same in compiled code, where
PyTorch's 32 short steps are nearly all call overhead.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import log, sigmoid, tanh
from mace_rl.numerics.network import Trace
from mace_rl.numerics.products import LANES, add_product, dot, padded, product


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


class Weights(NamedTuple):
    """Those of a `MetaNetwork` with H units, or like them; float32."""

    weight_ih: np.ndarray  # [in, 4 H]; columns: input, forget and output gate, candidate
    weight_hh: np.ndarray  # [≤ H, 4 H]
    bias: np.ndarray  # [4 H]
    readout: np.ndarray  # [H]
    readout_bias: np.ndarray  # [1]


class States(NamedTuple):
    """What the network computed for B sequences; float32."""

    gates: np.ndarray  # [T, B, 4 H], as in `Weights`
    cells: np.ndarray  # [T + 1, B, H], the zero state included, like the next
    hidden: np.ndarray


class CompiledMetaNetwork:
    """`MetaNetwork` in compiled code, for several sequences side by side.

    `parameters` are the module's, one kind after the other, with units added to a multiple of 16
    (see `network_kernels`): their weights are 0 and stay so.
    """

    def __init__(self, module: MetaNetwork) -> None:
        self.inputs, self.units = len(module.weight_ih), len(module.weight_hh)
        width = padded(self.units)
        gates = 4 * width
        self.shapes = (self.inputs, gates), (self.units, gates), (gates,), (width,), (1,)
        self.parameters = np.zeros(sum(math.prod(shape) for shape in self.shapes), np.float32)
        self.weights = self.split(self.parameters)
        self.load_module_state(module.state_dict())

    def split(self, flat: np.ndarray) -> Weights:
        """Views of a vector like `parameters`: each kind of weights, units added."""
        parts = np.split(flat, np.cumsum([math.prod(shape) for shape in self.shapes])[:-1])
        return Weights(*(part.reshape(n) for part, n in zip(parts, self.shapes, strict=True)))

    def forward(self, inputs: list[np.ndarray]) -> Trace:
        """The logit for each of several sequences, [T, in] each: outputs [B]."""
        lengths = np.array([len(sequence) for sequence in inputs])
        order = np.argsort(-lengths, kind="stable")
        lengths = lengths[order]
        # All end together: [T, B, in], the longest first, so that who takes part comes first.
        side_by_side = np.zeros((lengths[0], len(inputs), self.inputs), np.float32)
        for row, place in enumerate(order):
            side_by_side[lengths[0] - lengths[row] :, row] = inputs[place]
        logits, states = lstm_outputs(side_by_side, lengths, self.weights)
        outputs = np.empty_like(logits)
        outputs[order] = logits
        return Trace(outputs, (order, side_by_side, lengths, states))

    def backward(self, trace: Trace, grad_outputs: np.ndarray) -> np.ndarray:
        """See `CompiledMLP`."""
        order, *computed = trace.saved
        gradient = np.zeros_like(self.parameters)
        lstm_gradients(*computed, self.weights, grad_outputs[order], self.split(gradient))
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
        *gates, readout, readout_bias = self.weights
        parts = (part.reshape(*part.shape[:-1], 4, -1)[..., : self.units] for part in gates)
        return [*parts, readout[: self.units], readout_bias]


@kernel
def logit(beta: float) -> float:
    """log(β / (1 - β)), of a float64 in (0, 1), to float32's rounding."""
    return log(np.float32(beta / (1 - beta)))


@kernel
def quarters(vector):
    """Four views of a vector, [4 H]."""
    size = len(vector) // 4
    return vector[:size], vector[size : 2 * size], vector[2 * size : 3 * size], vector[3 * size :]


@kernel
def active_at(lengths, left):
    """How many of the sequences, the longest first, have at least so many steps left."""
    active = 0
    while active < len(lengths) and lengths[active] >= left:
        active += 1
    return active


@kernel
def lstm_outputs(sequences, lengths, weights):
    """The readout of the last hidden state of each sequence, [B], and the `States`."""
    states = lstm_states(sequences, lengths, weights)
    logits = np.empty(len(lengths), np.float32)
    for b in range(len(lengths)):
        logits[b] = dot(weights.readout, states.hidden[-1, b]) + weights.readout_bias[0]
    return logits, states


@kernel
def lstm_states(sequences, lengths, weights):
    """Long short-term memory over B sequences that end together, [T, B, in], from a zero state.

    lengths: of each, the longest first; weights: `Weights`. Returns `States`.
    """
    steps, count, inputs = sequences.shape
    size, rows = weights.weight_hh.shape[1] // 4, steps * count
    gates = np.empty((steps, count, 4 * size), np.float32)
    flat = gates.reshape(rows, 4 * size)
    product(sequences.reshape(rows, inputs), weights.weight_ih, weights.bias, flat)
    cells = np.zeros((steps + 1, count, size), np.float32)
    hidden = np.zeros_like(cells)
    for t in range(steps):
        active = active_at(lengths, steps - t)
        add_product(hidden[t, :active], weights.weight_hh, gates[t, :active])
        for b in range(active):
            gate, before, cell, shown = gates[t, b], cells[t, b], cells[t + 1, b], hidden[t + 1, b]
            sigmoids = gate[: 3 * size]
            for j in range(3 * size):
                sigmoids[j] = sigmoid(sigmoids[j])
            input_gate, forget_gate, output_gate, candidate = quarters(gate)
            for j in range(size):
                candidate[j] = tanh(candidate[j])
                cell[j] = forget_gate[j] * before[j] + input_gate[j] * candidate[j]
                shown[j] = output_gate[j] * tanh(cell[j])
    return States(gates, cells, hidden)


@kernel
def lstm_gradients(sequences, lengths, states, weights, grad_logits, gradient):
    """Add to `gradient`, `Weights`, that of a loss, by backpropagation in time.

    grad_logits: the loss's gradient at each logit, float32 [B]; the others as in `lstm_outputs`.
    """
    gates, cells, hidden = states
    steps, count, inputs = sequences.shape
    size, one = len(weights.readout), np.float32(1)
    back = np.zeros((4 * size, size), np.float32)  # weight_hh transposed
    for first in range(0, 4 * size, LANES):  # a strip at a time: 16 rows stay in the cache
        for j in range(len(weights.weight_hh)):
            for k in range(first, first + LANES):
                back[k, j] = weights.weight_hh[j, k]
    grad_gates = np.zeros_like(gates)
    grad_hidden = np.empty((count, size), np.float32)
    grad_cell = np.zeros_like(grad_hidden)
    for b in range(count):
        for j in range(size):
            grad_hidden[b, j] = grad_logits[b] * weights.readout[j]
            gradient.readout[j] += grad_logits[b] * hidden[steps, b, j]
        gradient.readout_bias[0] += grad_logits[b]
    for t in range(steps - 1, -1, -1):
        active = active_at(lengths, steps - t)
        for b in range(active):
            input_gate, forget_gate, output_gate, candidate = quarters(gates[t, b])
            grad_input, grad_forget, grad_output, grad_candidate = quarters(grad_gates[t, b])
            cell, before = cells[t + 1, b], cells[t, b]
            grad_shown, grad = grad_hidden[b], grad_cell[b]
            for j in range(size):
                shown = tanh(cell[j])
                grad_output[j] = grad_shown[j] * shown * output_gate[j] * (one - output_gate[j])
                grad[j] += grad_shown[j] * output_gate[j] * (one - shown * shown)
                grad_input[j] = grad[j] * candidate[j] * input_gate[j] * (one - input_gate[j])
                grad_forget[j] = grad[j] * before[j] * forget_gate[j] * (one - forget_gate[j])
                grad_candidate[j] = grad[j] * input_gate[j] * (one - candidate[j] * candidate[j])
                grad[j] *= forget_gate[j]
        product(grad_gates[t, :active], back, np.zeros(size, np.float32), grad_hidden[:active])
    rows = steps * count
    changes = grad_gates.reshape(rows, 4 * size)
    add_product(sequences.reshape(rows, inputs).T, changes, gradient.weight_ih)
    add_product(hidden[:-1].reshape(rows, size).T, changes, gradient.weight_hh)
    add_product(np.ones((1, rows), np.float32), changes, gradient.bias.reshape(1, 4 * size))
