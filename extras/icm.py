"""The intrinsic curiosity module, ICM (Pathak et al. 2017)."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from pydantic import Field, PositiveFloat

from extras.prediction_error import PredictionError, PredictorSettings
from mace_rl.agent.distribution import log_prob_gradient
from mace_rl.config.section import ConfigError, Units, check
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.matmul import dot
from mace_rl.numerics.network import CompiledMLP, mlp


class Settings(PredictorSettings):
    """The arguments of `ICM`."""

    feature_units: Units = 32  # numbers in φ(s); the paper has 288 for images
    forward_weight: float = Field(default=0.2, ge=0, le=1)  # β of its equation 7, the paper's
    scale: PositiveFloat = 1.0  # η


class ICM(PredictionError):
    """How badly the forward model predicts the features of the next state: η L_F (equation 6).

    Features φ of states come from a network, and two others learn them, each with one hidden layer:

    - the inverse model says from φ(s) and φ(s') which action led from one to the other, so that φ
      need not hold what no action can influence. L_I (equation 3) is the negative log-probability
      of the action: softmax for Discrete ones, Gaussian with standard deviation 1 for Box;
    - the forward model says from φ(s) and the action what φ(s') is. L_F (equation 5) is half the
      squared error.

    All are trained together on (1 - `forward_weight`) L_I + `forward_weight` L_F (equation 7,
    without the policy's term, which is PPO's here).

    Raises `ConfigError` for arguments that are not as `Settings` has them, and for actions that are
    several choices at once.
    """

    def __init__(self, spaces: Spaces, generator: np.random.Generator, **arguments: Any) -> None:
        settings = check(Settings, arguments, "arguments")
        if not isinstance(spaces.action_space, Discrete | Box):
            raise ConfigError(f"it is for Discrete and Box actions, not {spaces.action_space}")

        def new(inputs: int, outputs: int) -> CompiledMLP:
            return CompiledMLP(mlp([inputs, settings.hidden_units, outputs], 1.0, generator))

        size, actions = spaces.observation_size, spaces.action_size
        features = settings.feature_units
        self.features = new(size, features)
        self.inverse_model = new(2 * features, actions)
        self.forward_model = new(features + actions, features)
        networks = self.features, self.inverse_model, self.forward_model
        ends = np.cumsum([len(one.parameters) for one in networks])
        parameters = np.empty(ends[-1], np.float32)
        for one, memory in zip(networks, np.split(parameters, ends[:-1]), strict=True):
            one.move_to(memory)
        super().__init__(settings, parameters, spaces, generator)
        self.discrete = isinstance(spaces.action_space, Discrete)
        # Of the inverse model.
        self.log_std = np.zeros(0 if self.discrete else actions, np.float32)
        self.ends = np.cumsum([size, size])  # of s and s' in `inputs`

    def inputs(self, episode: Episode) -> np.ndarray:
        """s and s', whitened, and the action as the environment took it, side by side."""
        seen = self.whiten(episode.observations)
        space = self.spaces.action_space
        if isinstance(space, Discrete):
            actions = np.eye(int(space.n), dtype=np.float32)[episode.actions]
        else:
            actions = episode.actions.astype(np.float32)
            if self.spaces.clips_actions:
                actions = actions.clip(space.low.ravel(), space.high.ravel()).astype(np.float32)
        return np.concatenate([seen[:-1], seen[1:], actions], axis=1)

    def errors(self, inputs: np.ndarray) -> np.ndarray:
        """See `PredictionError`."""
        state, next_state, action = np.split(inputs, self.ends, axis=1)
        before = self.features.forward(state).outputs
        predicted = self.forward_model.forward(np.hstack([before, action])).outputs
        difference = predicted - self.features.forward(next_state).outputs
        return self.settings.scale * np.array([0.5 * dot(row, row) for row in difference])

    def gradient(self, inputs: np.ndarray) -> np.ndarray:
        """Of the mean of the joint loss, which reaches the features through both models."""
        count, weight = len(inputs), self.settings.forward_weight
        state, next_state, action = np.split(inputs, self.ends, axis=1)
        features = self.features.forward(np.concatenate([state, next_state]))
        before, after = features.outputs[:count], features.outputs[count:]
        inverse = self.inverse_model.forward(np.hstack([before, after]))
        forward = self.forward_model.forward(np.hstack([before, action]))

        taken = action.argmax(1) if self.discrete else action
        weights, unused = np.full(count, (weight - 1) / count, np.float32), self.log_std.copy()
        none = np.empty(0, np.int64)
        grad, _ = log_prob_gradient(
            inverse.outputs, self.log_std, taken, weights, 0.0, unused, none
        )
        grad_action = np.ascontiguousarray(grad[:, : action.shape[1]])
        grad_predicted = np.float32(weight / count) * (forward.outputs - after)
        inverse_gradient, to_both = self.inverse_model.gradients(inverse, grad_action)
        forward_gradient, to_before = self.forward_model.gradients(forward, grad_predicted)
        size = before.shape[1]
        grad_before = to_both[:, :size] + to_before[:, :size]
        grad_after = to_both[:, size:] - grad_predicted
        gradient = self.features.backward(features, np.concatenate([grad_before, grad_after]))
        return np.concatenate([gradient, inverse_gradient, forward_gradient])
