"""Random network distillation, RND (Burda et al. 2018)."""

import math

import numpy as np
from gymnasium.spaces import Box, Discrete

from mace_rl.bonus.intrinsic import PredictionError
from mace_rl.config.bonus import RNDBonus
from mace_rl.environments.rollout import Episode
from mace_rl.numerics.network import CompiledMLP, mlp
from mace_rl.numerics.products import dot


class RandomNetworkDistillation(PredictionError):
    """How badly a network predicts the features that a fixed random network gives a state.

    The bonus is the mean squared error of the features of s' (section 2.2), on which the predictor
    is trained too. Its size means nothing: `ppo.scale_rewards` divides it by the running standard
    deviation of its returns, as section 2.4 asks. Unlike there its returns end with the episode, as
    those of every bonus here, so that only the bonus differs.
    """

    STATE = (*PredictionError.STATE, "fixed")

    def __init__(
        self,
        config: RNDBonus,
        observation_space: Box | Discrete,
        observation_size: int,
        generator: np.random.Generator,
    ) -> None:
        sizes = [observation_size, config.hidden_units, config.feature_units]
        self.target, self.network = (
            CompiledMLP(mlp(sizes, math.sqrt(2), generator)) for _ in range(2)
        )
        self.fixed, parameters = self.target.parameters, self.network.parameters
        super().__init__(config, parameters, observation_space, observation_size, generator)

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
