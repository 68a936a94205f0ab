"""The meta-adaptation network as it learns: compiled, and in PyTorch to read and to check by."""

import math
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, from_numpy
from torch.nn.utils import clip_grad_norm_

from mace_rl.base.state import Stateful
from mace_rl.beta.lstm import MetaNetwork, add_gradient, lstm_output, lstm_states, read_out
from mace_rl.config.beta import MetaConfig
from mace_rl.numerics.adam import EPSILON, Adam, step
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import f32


class LearningNetwork(Protocol):
    """An LSTM with a readout o, and an Adam of its own (paper, supplement). λ: `output_decay`."""

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
        vector = initial_weights(inputs, config.hidden_units, generator)
        self.decay, shape = config.output_decay, (inputs, config.hidden_units)
        self.weights = MetaNetwork.of(vector, *shape)
        self.optimiser = Adam(vector, config.learning_rate, config.max_gradient_norm)
        self.gradient = np.empty_like(vector)
        self.gradients = MetaNetwork.of(self.gradient, *shape)

    def output(self, sequence: np.ndarray) -> float:
        return float(lstm_output(sequence, self.weights))

    def learn(self, sequences: list[np.ndarray], slope: float) -> None:
        steps, ends = np.concatenate(sequences), np.cumsum([len(each) for each in sequences])
        where = self.weights, self.gradient, self.gradients, self.optimiser.state
        descend(steps, ends, f32(slope), f32(self.decay), *where)


class TorchMetaNetwork(Stateful):
    """A `LearningNetwork` of `torch.nn.LSTM`, whose second bias stays 0."""

    STATE = ("lstm", "readout", "optimiser")

    def __init__(self, config: MetaConfig, inputs: int, generator: np.random.Generator) -> None:
        units, self.decay = config.hidden_units, config.output_decay
        self.largest = config.max_gradient_norm
        weights = MetaNetwork.of(initial_weights(inputs, units, generator), inputs, units)
        plain: Any = {"device": "cpu", "dtype": torch.float32}
        before = torch.get_rng_state()  # new layers draw weights, which are replaced
        self.lstm = torch.nn.LSTM(inputs, units, **plain)
        self.readout = torch.nn.Linear(units, 1, **plain)
        torch.set_rng_state(before)
        # PyTorch's order of gates: input, forget, candidate, output.
        order = np.concatenate([np.arange(units) + k * units for k in (0, 1, 3, 2)])
        values = {
            "weight_ih_l0": weights.weight_ih[:, order].T,
            "weight_hh_l0": weights.weight_hh[:, order].T,
            "bias_ih_l0": weights.bias[order],
            "bias_hh_l0": np.zeros(4 * units, np.float32),
        }
        self.lstm.load_state_dict({key: from_numpy(value) for key, value in values.items()})
        self.learnt = [part for name, part in self.lstm.named_parameters() if name != "bias_hh_l0"]
        self.learnt += self.readout.parameters()
        with torch.no_grad():
            for part in self.readout.parameters():
                part.zero_()
        self.optimiser = torch.optim.Adam(self.learnt, config.learning_rate, eps=EPSILON)

    def outputs(self, sequence: np.ndarray) -> Tensor:
        """o, [1]."""
        hidden, _ = self.lstm(from_numpy(sequence))
        answer: Tensor = self.readout(hidden[-1])
        return answer

    def output(self, sequence: np.ndarray) -> float:
        with torch.no_grad():
            return self.outputs(sequence).item()

    def learn(self, sequences: list[np.ndarray], slope: float) -> None:
        outputs = torch.cat([self.outputs(sequence) for sequence in sequences])
        loss = (slope * outputs + self.decay / 2 * outputs.square()).mean()
        self.optimiser.zero_grad()
        loss.backward()
        clip_grad_norm_(self.learnt, self.largest)
        self.optimiser.step()


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
        own = (decay * read_out(states[2], weights) + slope) / f32(len(ends))
        add_gradient(sequence, states, weights, own, gradients)
        first = end
    step(gradient, adam)
