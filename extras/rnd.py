"""Random network distillation, RND (Burda et al. 2018)."""

import math
from typing import Any

import numpy as np

from extras.prediction_error import PredictionError, PredictorSettings
from mace_rl.config.section import Units, check
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.matmul import dot
from mace_rl.numerics.network import CompiledMLP, mlp


class Settings(PredictorSettings):
    """The arguments of `RND`."""

    feature_units: Units = 64  # outputs of both networks; the paper has 512 for images


class RND(PredictionError):
    """How badly a network predicts the features that a fixed random network gives a state.

    The bonus is the mean squared error of the features of s' (section 2.2), on which the predictor
    is trained too. Its size means nothing: `ppo.scale_rewards` divides it by the running standard
    deviation of its returns, as section 2.4 asks. Unlike there its returns end with the episode, as
    those of every bonus here, so that only the bonus differs.

    Raises `ConfigError` for arguments that are not as `Settings` has them.
    """

    STATE = (*PredictionError.STATE, "fixed")

    def __init__(self, spaces: Spaces, generator: np.random.Generator, **arguments: Any) -> None:
        settings = check(Settings, arguments, "arguments")
        sizes = [spaces.observation_size, settings.hidden_units, settings.feature_units]
        self.target, self.network = (
            CompiledMLP(mlp(sizes, math.sqrt(2), generator)) for _ in range(2)
        )
        self.fixed, parameters = self.target.parameters, self.network.parameters
        super().__init__(settings, parameters, spaces, generator)

    def inputs(self, episode: Episode) -> np.ndarray:
        """The states that the steps led to, whitened."""
        return self.whiten(episode.observations[1:])

    def errors(self, inputs: np.ndarray) -> np.ndarray:
        """See `PredictionError`."""
        difference = self.network.forward(inputs).outputs - self.target.forward(inputs).outputs
        return np.array([dot(row, row) for row in difference]) / difference.shape[1]

    def gradient(self, inputs: np.ndarray) -> np.ndarray:
        """Of the mean of `errors`."""
        trace = self.network.forward(inputs)
        difference = trace.outputs - self.target.forward(inputs).outputs
        return self.network.backward(trace, 2 * difference / np.float32(difference.size))
