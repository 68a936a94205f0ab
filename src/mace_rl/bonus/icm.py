"""The intrinsic curiosity module, ICM (Pathak et al. 2017)."""

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from torch.nn.functional import log_softmax

from mace_rl.agent.network import TorchNetwork, mlp
from mace_rl.bonus.intrinsic import PredictionError
from mace_rl.config.bonus import ICMBonus
from mace_rl.environments.rollout import Episode


class Dynamics(torch.nn.Module):
    """Features φ of states, and the two models that learn them, each with one hidden layer.

    The inverse model says from φ(s) and φ(s') which action led from one to the other, so that φ
    need not hold what no action can influence; the forward model says from φ(s) and the action what
    φ(s') is.
    """

    def __init__(
        self,
        config: ICMBonus,
        action_space: Box | Discrete,
        observation_size: int,
        generator: np.random.Generator,
    ) -> None:
        super().__init__()
        hidden, features = config.hidden_units, config.feature_units
        self.discrete_actions = isinstance(action_space, Discrete)
        actions = (
            int(action_space.n) if isinstance(action_space, Discrete) else action_space.shape[0]
        )
        self.parts = [observation_size, observation_size, actions]
        self.features = mlp([observation_size, hidden, features], 1.0, generator)
        self.inverse_model = mlp([2 * features, hidden, actions], 1.0, generator)
        self.forward_model = mlp([features + actions, hidden, features], 1.0, generator)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """L_I and L_F (equations 3 and 5) of each transition, [N, 2].

        inputs: s, s' and the action, [N, 2 · observation + actions]; Discrete actions are one-hot.
        L_I is the cross-entropy of the action, or half the squared error of an action that is a
        vector.
        """
        state, next_state, action = inputs.split(self.parts, dim=1)
        before, after = self.features(state), self.features(next_state)
        found = self.inverse_model(torch.cat([before, after], dim=1))
        if self.discrete_actions:
            inverse = -(action * log_softmax(found, dim=1)).sum(dim=1)
        else:
            inverse = 0.5 * (found - action).square().sum(dim=1)
        predicted = self.forward_model(torch.cat([before, action], dim=1))
        return torch.stack([inverse, 0.5 * (predicted - after).square().sum(dim=1)], dim=1)


class IntrinsicCuriosityModule(PredictionError):
    """How badly the forward model predicts the features of the next state: η L_F (equation 6).

    All parts are trained together on (1 - `forward_weight`) L_I + `forward_weight` L_F (equation 7,
    without the policy's term, which is PPO's here). It is a torch module with either engine, since
    the features' gradient comes through both models.
    """

    config: ICMBonus

    def __init__(
        self,
        config: ICMBonus,
        observation_space: Box | Discrete,
        action_space: Box | Discrete,
        observation_size: int,
        generator: np.random.Generator,
    ) -> None:
        network = TorchNetwork(Dynamics(config, action_space, observation_size, generator))
        super().__init__(config, network, observation_space, observation_size, generator)
        self.action_space = action_space
        self.weights = np.array([1 - config.forward_weight, config.forward_weight], np.float32)

    def inputs(self, episode: Episode) -> np.ndarray:
        """s and s', whitened, and the action as the environment took it, side by side."""
        seen = self.whiten(episode.observations)
        space = self.action_space
        if isinstance(space, Discrete):
            actions = np.eye(int(space.n), dtype=np.float32)[episode.actions]
        else:
            actions = episode.actions.clip(space.low, space.high).astype(np.float32)
        return np.concatenate([seen[:-1], seen[1:], actions], axis=1)

    def errors(self, inputs: np.ndarray) -> np.ndarray:
        """See `PredictionError`."""
        return self.config.scale * self.network.forward(inputs).outputs[:, 1]

    def gradient(self, inputs: np.ndarray) -> np.ndarray:
        """Of the mean of the joint loss."""
        trace = self.network.forward(inputs)
        count = np.float32(len(inputs))
        return self.network.backward(trace, np.tile(self.weights / count, (len(inputs), 1)))
