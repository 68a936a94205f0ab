"""Long short-term memory and a readout in compiled code, with gradients by backpropagation in time.

For so few units a library of tensors takes longer to be called than to compute. All arithmetic is
float32 in a fixed order, the same bits on every processor.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import f32, fma, sigmoid, tanh
from mace_rl.numerics.matmul import add_product, padded, product


class MetaNetwork(NamedTuple):
    """The weights of an LSTM with H units (Hochreiter & Schmidhuber 1997) and a readout; float32.

    Columns of gates: input, forget and output gate, candidate. H is a multiple of 4.
    """

    weight_ih: np.ndarray  # [in, 4 H]
    weight_hh: np.ndarray  # [H, 4 H]
    bias: np.ndarray  # [4 H]
    readout: np.ndarray  # [H]
    readout_bias: np.ndarray  # [1]

    @classmethod
    def shapes(cls, inputs: int, units: int) -> "list[tuple[int, ...]]":
        """Of the weights, in their order."""
        return [(inputs, 4 * units), (units, 4 * units), (4 * units,), (units,), (1,)]

    @classmethod
    def of(cls, vector: np.ndarray, inputs: int, units: int) -> "MetaNetwork":
        """Views of a vector that has all weights one after the other, float32 [n]."""
        views, start = [], 0
        for shape in cls.shapes(inputs, units):
            end = start + int(np.prod(shape))
            views.append(vector[start:end].reshape(shape))
            start = end
        return cls(*views)


def read_network(path: Path) -> MetaNetwork:
    """The network whose weights are in the file, by name."""
    with np.load(path, allow_pickle=False) as weights:
        return MetaNetwork(*(weights[name] for name in MetaNetwork._fields))


@kernel
def lstm_states(sequence, network):
    """Gates after their functions, [T, 4 H], cells and hidden states, [T + 1, H], from zero states.

    sequence: float32 [T, in].
    """
    steps, size = len(sequence), len(network.readout)
    gates = np.empty((steps, 4 * size), np.float32)
    product(sequence, network.weight_ih, network.bias, gates)
    cells, hidden = np.zeros((2, steps + 1, size), np.float32)
    for t in range(steps):
        add_product(hidden[t : t + 1], network.weight_hh, gates[t : t + 1])
        gate, cell_before, cell, hidden_after = gates[t], cells[t], cells[t + 1], hidden[t + 1]
        sigmoids, candidate = gate[: 3 * size], gate[3 * size :]
        for j in range(3 * size):
            sigmoids[j] = sigmoid(sigmoids[j])
        for j in range(size):
            candidate[j] = tanh(candidate[j])
        for j in range(size):
            cell[j] = gate[size + j] * cell_before[j] + gate[j] * candidate[j]
        for j in range(size):
            hidden_after[j] = gate[2 * size + j] * tanh(cell[j])
    return gates, cells, hidden


@kernel
def read_out(hidden, network):
    """The readout of the last hidden state: a chain of fused multiply-adds."""
    output, last = network.readout_bias[0], hidden[-1]
    for j in range(len(last)):
        output = fma(last[j], network.readout[j], output)
    return output


@kernel
def lstm_output(sequence: np.ndarray, network: MetaNetwork) -> np.float32:
    """The readout of the last hidden state after a sequence, float32 [T, in], from a zero state."""
    return read_out(lstm_states(sequence, network)[2], network)


@kernel
def add_gradient(sequence, states, network, grad_output, gradient):
    """Add ∇ of `grad_output` times the readout to `gradient`, a `MetaNetwork` of arrays alike.

    states: of `lstm_states` for this sequence. Backpropagation through time.
    """
    (gates, cells, hidden), size, one = states, len(network.readout), f32(1)
    steps = len(sequence)
    back = np.zeros((4 * size, padded(size)), np.float32)
    back[:, :size] = network.weight_hh.T
    changes, grad_cell = np.empty_like(gates), np.zeros(size, np.float32)
    grad_hidden = np.zeros((1, padded(size)), np.float32)
    nothing = np.zeros(padded(size), np.float32)
    for j in range(size):
        grad_hidden[0, j] = grad_output * network.readout[j]
        gradient.readout[j] += grad_output * hidden[steps, j]
    gradient.readout_bias[0] += grad_output
    for t in range(steps - 1, -1, -1):
        gate, change, grad = gates[t], changes[t], grad_hidden[0]
        for j in range(size):
            input_gate, forget_gate = gate[j], gate[size + j]
            output_gate, candidate = gate[2 * size + j], gate[3 * size + j]
            shown = tanh(cells[t + 1, j])
            grad_cell[j] += grad[j] * output_gate * (one - shown * shown)
            change[j] = grad_cell[j] * candidate * input_gate * (one - input_gate)
            change[size + j] = grad_cell[j] * cells[t, j] * forget_gate * (one - forget_gate)
            change[2 * size + j] = grad[j] * shown * output_gate * (one - output_gate)
            change[3 * size + j] = grad_cell[j] * input_gate * (one - candidate * candidate)
            grad_cell[j] *= forget_gate
        product(changes[t : t + 1], back, nothing, grad_hidden)
    add_product(sequence.T, changes, gradient.weight_ih)
    add_product(hidden[:-1].T, changes, gradient.weight_hh)
    ones = np.ones((1, steps), np.float32)
    add_product(ones, changes, gradient.bias.reshape(1, 4 * size))
