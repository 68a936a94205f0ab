"""The meta-adaptation network as it learns: compiled, and in PyTorch to read and to check by."""

import math
from typing import Any, Protocol

import numpy as np
import torch
from torch import from_numpy
from torch.nn.utils import clip_grad_norm_

from mace_rl.beta.lstm import MetaNetwork, add_gradient, lstm_logit, lstm_states, read_out
from mace_rl.config.beta import MetaConfig
from mace_rl.numerics.adam import EPSILON, Adam, step
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import f32
from mace_rl.state import Stateful


class LearningNetwork(Protocol):
    """An LSTM with a readout o, and an Adam of its own (paper, supplement)."""

    def output(self, sequence: np.ndarray) -> float:
        """o after a sequence, float32 [T, in]."""

    def learn(self, sequences: list[np.ndarray], credit: float) -> None:
        """One step down the mean over the sequences of L = -c o + λ o² / 2, c being the credit."""

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
        return float(lstm_logit(sequence, self.weights))

    def learn(self, sequences: list[np.ndarray], credit: float) -> None:
        steps, ends = np.concatenate(sequences), np.cumsum([len(each) for each in sequences])
        where = self.weights, self.gradient, self.gradients, self.optimiser.state
        learn(steps, ends, f32(credit), f32(self.decay), *where)


class TorchMetaNetwork(torch.nn.Module):
    """A `LearningNetwork` of `torch.nn.LSTM`, whose second bias stays 0."""

    def __init__(self, config: MetaConfig, inputs: int, generator: np.random.Generator) -> None:
        super().__init__()
        units, self.decay = config.hidden_units, config.output_decay
        self.largest = config.max_gradient_norm
        weights = MetaNetwork.of(initial_weights(inputs, units, generator), inputs, units)
        plain: Any = {"device": "cpu", "dtype": torch.float32}
        before = torch.get_rng_state()  # new layers draw weights, which are replaced
        self.lstm, self.readout = (
            torch.nn.LSTM(inputs, units, **plain),
            torch.nn.Linear(units, 1, **plain),
        )
        torch.set_rng_state(before)
        # PyTorch's order of gates: input, forget, candidate, output.
        order = np.concatenate([np.arange(units) + k * units for k in (0, 1, 3, 2)])
        with torch.no_grad():
            self.lstm.weight_ih_l0.copy_(from_numpy(weights.weight_ih[:, order].T))
            self.lstm.weight_hh_l0.copy_(from_numpy(weights.weight_hh[:, order].T))
            self.lstm.bias_ih_l0.copy_(from_numpy(weights.bias[order]))
            self.lstm.bias_hh_l0.zero_().requires_grad_(False)
            self.readout.weight.zero_()
            self.readout.bias.zero_()
        self.learnt = [part for part in self.parameters() if part.requires_grad]
        self.optimiser = torch.optim.Adam(self.learnt, config.learning_rate, eps=EPSILON)

    def forward(self, sequence: np.ndarray) -> torch.Tensor:
        """o, [1]."""
        hidden, _ = self.lstm(from_numpy(sequence))
        return self.readout(hidden[-1])

    def output(self, sequence: np.ndarray) -> float:
        with torch.no_grad():
            return self(sequence).item()

    def learn(self, sequences: list[np.ndarray], credit: float) -> None:
        outputs = torch.cat([self(sequence) for sequence in sequences])
        loss = (-credit * outputs + self.decay / 2 * outputs.square()).mean()
        self.optimiser.zero_grad()
        loss.backward()
        clip_grad_norm_(self.learnt, self.largest)
        self.optimiser.step()

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Weights and the optimiser's state."""
        return {"weights": super().state_dict(*args, **kwargs), "adam": self.optimiser.state_dict()}

    def load_state_dict(self, state: Any, *args: Any, **kwargs: Any) -> Any:
        """Restore what `state_dict` returned."""
        self.optimiser.load_state_dict(state["adam"])
        return super().load_state_dict(state["weights"], *args, **kwargs)


@kernel
def learn(steps, ends, credit, decay, weights, gradient, gradients, adam):
    """`LearningNetwork.learn` from the sequences one after the other, float32 [N, in].

    ends: of each; gradient: a vector like all weights, overwritten; gradients: its parts.
    """
    gradient[:] = 0
    first = 0
    for end in ends:
        sequence = steps[first:end]
        states = lstm_states(sequence, weights)
        slope = (decay * read_out(states[2], weights) - credit) / f32(len(ends))
        add_gradient(sequence, states, weights, slope, gradients)
        first = end
    step(gradient, adam)
