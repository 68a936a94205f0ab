"""The policy π(a|s), and its gradient."""

from typing import NamedTuple

import numpy as np
from gymnasium.spaces import Box, Discrete

from mace_rl import compiled
from mace_rl.network import MLP


class ActingPolicy(NamedTuple):
    """What a rollout needs of the policy, as plain arrays for the compiled functions."""

    mean: np.ndarray  # float32 [observation], subtracted from observations
    inverse_std: np.ndarray  # float32 [observation]
    clip: np.float32  # bound of normalised observations
    parameters: np.ndarray  # float32, see network.MLP
    sizes: np.ndarray  # int64 [layers + 1]
    log_std: np.ndarray | None  # float32 [actions]; None for Discrete actions


class Actor(MLP):
    """Categorical for Discrete actions, diagonal Gaussian for Box ones.

    The Gaussian's log standard deviation does not depend on the state; its samples are clipped to
    the action bounds only when acting.
    """

    def __init__(
        self,
        observation_size: int,
        action_space: Discrete | Box,
        hidden_units: list[int],
        initial_log_std: float,
        generator: np.random.Generator,
    ) -> None:
        self.discrete = isinstance(action_space, Discrete)
        outputs = int(action_space.n) if self.discrete else action_space.shape[0]
        # A small last layer starts near the uniform policy, or at means near 0.
        super().__init__(
            [observation_size, *hidden_units, outputs],
            output_gain=0.01,
            generator=generator,
            extra=0 if self.discrete else outputs,
        )
        if not self.discrete:
            self.log_std[:] = initial_log_std

    @property
    def log_std(self) -> np.ndarray:
        """Log standard deviations, a view of `parameters`, [actions]; Box actions only."""
        return self.parameters[-self.sizes[-1] :]

    def for_acting(self, mean: np.ndarray, std: np.ndarray, clip: float) -> ActingPolicy:
        """The policy with observation normalisation in front of it; follows later updates."""
        return ActingPolicy(
            mean=mean.astype(np.float32),
            inverse_std=(1.0 / std).astype(np.float32),
            clip=np.float32(clip),
            parameters=self.parameters,
            sizes=self.sizes,
            log_std=None if self.discrete else self.log_std,
        )

    def log_probs(self, outputs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """log π(a|s), [N], from the network's outputs, [N, out], and actions.

        actions: int64 [N] or float32 [N, actions].
        """
        if self.discrete:
            return compiled.categorical_log_probs(outputs, actions)
        return compiled.gaussian_log_probs(outputs, self.log_std, actions)

    def gradient(
        self,
        activations: tuple[np.ndarray, ...],
        actions: np.ndarray,
        weights: np.ndarray,
        entropy_weight: float = 0.0,
    ) -> np.ndarray:
        """∇_θ Σ_t (w_t log π(a_t|s_t) + entropy_weight · H(π(·|s_t))), float32 [n].

        activations: from `forward`; actions: as in `log_probs`; weights: float32 [N].
        """
        outputs = activations[-1]
        if self.discrete:
            slope = compiled.categorical_slope(outputs, actions, weights, entropy_weight)
            return self.backward(activations, slope)
        slope, log_std_slope = compiled.gaussian_slopes(
            outputs, self.log_std, actions, weights, entropy_weight
        )
        gradient = self.backward(activations, slope)
        gradient[-len(log_std_slope) :] = log_std_slope
        return gradient
