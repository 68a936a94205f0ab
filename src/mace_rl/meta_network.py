"""The meta-adaptation network: an LSTM over one episode that answers β (paper, supplement).

Its gradient is written out and compiled, like the other networks': over 32 short steps PyTorch's
is nearly all call overhead.
"""

import math

import numpy as np

from mace_rl import compiled
from mace_rl.hyperparameters import MetaConfig


class MetaNetwork:
    """LSTM whose last output is mapped to β in (0, 1), with the derivative of β.

    `parameters` is one float32 vector, [n]; the weights, see `compiled.lstm_states`, are views of
    it.
    """

    def __init__(
        self, input_size: int, config: MetaConfig, initial: float, generator: np.random.Generator
    ) -> None:
        self.units = config.hidden_units
        self.input_size = input_size
        self.parameters = np.zeros(
            4 * self.units * (input_size + self.units + 1) + self.units + 1, np.float32
        )
        views = self.split(self.parameters)
        self.inward, self.recurrent, self.bias, self.readout, self.readout_bias = views
        for weights in (self.inward, self.recurrent, self.bias):
            weights[:] = generator.uniform(-1, 1, weights.shape) / math.sqrt(self.units)
        # Untrained it answers about `initial` to every episode.
        self.readout[:] = generator.uniform(-0.01, 0.01, self.units)
        self.readout_bias[:] = math.log(initial / (1 - initial))

    def split(self, flat: np.ndarray) -> list[np.ndarray]:
        """Views of a vector like `parameters`: each kind of weights."""
        gates = 4 * self.units
        shapes = [(self.input_size, gates), (self.units, gates), (gates,), (self.units,), (1,)]
        ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
        return [
            part.reshape(shape) for part, shape in zip(np.split(flat, ends), shapes, strict=True)
        ]

    def __call__(self, sequence: np.ndarray) -> float:
        """β from one episode, float32 [T, input]."""
        *_, outputs = compiled.lstm_states(sequence, self.inward, self.recurrent, self.bias)
        return self._beta(outputs)

    def gradient(self, sequence: np.ndarray, weight: float = 1.0) -> np.ndarray:
        """`weight` · dβ/dφ for one episode, float32 [T, input]: φ is `parameters`, [n]."""
        gates, cells, outputs = compiled.lstm_states(
            sequence, self.inward, self.recurrent, self.bias
        )
        beta = self._beta(outputs)
        slope = np.float32(weight * beta * (1 - beta))
        gradient = np.empty_like(self.parameters)
        *lstm, readout, readout_bias = self.split(gradient)
        compiled.lstm_gradients(
            sequence, self.recurrent, gates, cells, outputs, slope * self.readout, *lstm
        )
        readout[:] = slope * outputs[-1]
        readout_bias[:] = slope
        return gradient

    def _beta(self, outputs: np.ndarray) -> float:
        """The sigmoid of the readout of the last output."""
        logit = float(self.readout @ outputs[-1] + self.readout_bias[0])
        return 0.5 + 0.5 * math.tanh(0.5 * logit)  # never overflows
