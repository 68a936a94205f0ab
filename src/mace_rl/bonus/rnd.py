"""Random network distillation, RND (Burda et al. 2018)."""

import math
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete

from mace_rl.agent.network import CompiledMLP, Network, TorchNetwork, mlp
from mace_rl.agent.products import dot
from mace_rl.bonus.intrinsic import PredictionError
from mace_rl.config.bonus import RNDBonus
from mace_rl.environments.rollout import Episode


class RandomNetworkDistillation(PredictionError):
    """How badly a network predicts the features that a fixed random network gives a state.

    The bonus is the mean squared error of the features of s' (section 2.2), on which the predictor
    is trained too. Its size means nothing: `ppo.scale_rewards` divides it by the running standard
    deviation of its returns, as section 2.4 asks. Unlike there its returns end with the episode, as
    those of every bonus here, so that only the bonus differs.
    """

    def __init__(
        self,
        config: RNDBonus,
        engine: str,
        observation_space: Box | Discrete,
        observation_size: int,
        generator: np.random.Generator,
    ) -> None:
        sizes = [observation_size, config.hidden_units, config.feature_units]

        def new() -> Network:
            module = mlp(sizes, math.sqrt(2), generator)
            return CompiledMLP(module) if engine == "compiled" else TorchNetwork(module)

        self.target, self.network = new(), new()
        parameters = self.network.parameters
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

    def state_dict(self) -> dict[str, Any]:
        """See `IntrinsicReward`."""
        target = torch.from_numpy(self.target.parameters.copy())
        return super().state_dict() | {"target": target}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `IntrinsicReward`."""
        super().load_state_dict(state)
        self.target.parameters[:] = state["target"].numpy()
