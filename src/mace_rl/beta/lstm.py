"""The meta network, an LSTM and a readout (paper, supplement), as it answers; it learns elsewhere.

`tools/meta` trains it, in PyTorch. Written out here, it has equal bits on every processor.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import fma, sigmoid, tanh


class MetaNetwork(NamedTuple):
    """The weights of an LSTM with H units (Hochreiter & Schmidhuber 1997) and a readout; float32.

    Columns of gates: input, forget and output gate, candidate.
    """

    weight_ih: np.ndarray  # [in, 4 H]
    weight_hh: np.ndarray  # [H, 4 H]
    bias: np.ndarray  # [4 H]
    readout: np.ndarray  # [H]
    readout_bias: np.ndarray  # [1]


def read_network(path: Path) -> MetaNetwork:
    """The network whose weights are in the file, by name."""
    with np.load(path, allow_pickle=False) as weights:
        return MetaNetwork(*(weights[name] for name in MetaNetwork._fields))


@kernel
def lstm_logit(sequence: np.ndarray, network: MetaNetwork) -> np.float32:
    """The readout of the last hidden state after a sequence, float32 [T, in], from a zero state."""
    size = len(network.readout)
    hidden, cell = np.zeros(size, np.float32), np.zeros(size, np.float32)
    for x in sequence:
        gates = network.bias.copy()
        accumulate(x, network.weight_ih, gates)
        accumulate(hidden, network.weight_hh, gates)
        for j in range(size):
            input_gate, forget_gate = sigmoid(gates[j]), sigmoid(gates[size + j])
            output_gate, candidate = sigmoid(gates[2 * size + j]), tanh(gates[3 * size + j])
            cell[j] = forget_gate * cell[j] + input_gate * candidate
            hidden[j] = output_gate * tanh(cell[j])
    logit = network.readout_bias.copy()
    accumulate(hidden, network.readout.reshape(-1, 1), logit)
    return logit[0]


@kernel
def accumulate(vector, weights, result):
    """Add vector · weights, [n] · [n, m], to `result`, [m]: chains of fused multiply-adds."""
    for i in range(len(vector)):
        for j in range(len(result)):
            result[j] = fma(vector[i], weights[i, j], result[j])
