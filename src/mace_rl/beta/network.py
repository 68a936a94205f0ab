"""The meta-adaptation network as it learns, compiled; in PyTorch it is in `torch_network`."""

import math
from typing import Any, Protocol

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.beta.lstm import MetaNetwork, add_gradient, lstm_output, lstm_states, read_out
from mace_rl.config.beta import MetaConfig
from mace_rl.numerics.adam import Adam, step
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import f32


class LearningNetwork(Protocol):
    """An LSTM with a readout o, and an Adam of its own (paper, supplement). λ: `output_decay`."""

    def __init__(self, config: MetaConfig, inputs: int, generator: np.random.Generator) -> None: ...

    def output(self, sequence: np.ndarray) -> float:
        """o after a sequence, float32 [T, in]."""

    def learn(self, sequences: list[np.ndarray], slope: float) -> None:
        """One step down the mean over the sequences of L + λ o² / 2; slope: dL/do."""

    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: dict[str, Any]) -> None: ...


def initial_weights(inputs: int, units: int, generator: np.random.Generator) -> np.ndarray:
    """Uniform within ±1/√H, as `torch.nn.LSTM` has them; the readout says 0. Float32 [n]."""
    count = sum(math.prod(shape) for shape in MetaNetwork.shapes(inputs, units))
    vector = generator.uniform(-1, 1, count).astype(np.float32) / np.float32(math.sqrt(units))
    vector[-units - 1 :] = 0
    return vector


class CompiledMetaNetwork(Stateful):
    """A `LearningNetwork` in compiled code."""

    STATE = ("optimiser",)  # it holds the weights

    def __init__(self, config: MetaConfig, inputs: int, generator: np.random.Generator) -> None:
        units, self.decay = config.hidden_units, config.output_decay
        vector = initial_weights(inputs, units, generator)
        self.weights = MetaNetwork.of(vector, inputs, units)
        self.optimiser = Adam(vector, config.learning_rate, config.max_gradient_norm)
        self.gradient = np.empty_like(vector)
        self.gradients = MetaNetwork.of(self.gradient, inputs, units)

    def output(self, sequence: np.ndarray) -> float:
        return float(lstm_output(sequence, self.weights))

    def learn(self, sequences: list[np.ndarray], slope: float) -> None:
        steps, ends = np.concatenate(sequences), np.cumsum([len(each) for each in sequences])
        descend(
            steps,
            ends,
            f32(slope),
            f32(self.decay),
            self.weights,
            self.gradient,
            self.gradients,
            self.optimiser.state,
        )


@kernel
def descend(steps, ends, slope, decay, weights, gradient, gradients, adam):
    """`LearningNetwork.learn` from the sequences one after the other, float32 [N, in].

    ends: of each; gradient: a vector like all weights, overwritten; gradients: its parts.
    """
    gradient[:] = 0
    first = 0
    for end in ends:
        sequence = steps[first:end]
        states = lstm_states(sequence, weights)
        grad_output = (decay * read_out(states[2], weights) + slope) / f32(len(ends))
        add_gradient(sequence, states, weights, grad_output, gradients)
        first = end
    step(gradient, adam)
