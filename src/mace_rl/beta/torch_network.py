"""The meta-adaptation network in PyTorch, to read and to check by."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, from_numpy
from torch.nn.utils import clip_grad_norm_

from mace_rl.base.state import Stateful
from mace_rl.beta.lstm import MetaNetwork
from mace_rl.beta.network import initial_weights
from mace_rl.config.beta import MetaConfig
from mace_rl.numerics.adam import EPSILON


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
