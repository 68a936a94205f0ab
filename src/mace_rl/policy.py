"""The policy π(a|s), and its gradient."""

import math
from typing import NamedTuple

import numpy as np
from gymnasium.spaces import Box, Discrete

from mace_rl.network import MLP

HALF_LOG_TAU = 0.5 * math.log(2 * math.pi)


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
        """log π(a|s), float32 [N], from the network's outputs, [N, out], and actions.

        actions: int64 [N] or float32 [N, actions].
        """
        if self.discrete:
            return log_softmax(outputs)[np.arange(len(actions)), actions]
        deviations = (actions - outputs) * np.exp(-self.log_std)
        return (-0.5 * deviations * deviations - self.log_std - np.float32(HALF_LOG_TAU)).sum(1)

    def entropy(self, outputs: np.ndarray) -> np.ndarray:
        """Entropy of π(·|s), float32 [N], from the network's outputs, [N, out]."""
        if self.discrete:
            log_probs = log_softmax(outputs)
            return -(np.exp(log_probs) * log_probs).sum(1)
        return np.full(len(outputs), (self.log_std + 0.5 + HALF_LOG_TAU).sum(), np.float32)

    def gradient(
        self,
        activations: list[np.ndarray],
        actions: np.ndarray,
        weights: np.ndarray,
        entropy_weight: float = 0.0,
    ) -> np.ndarray:
        """∇_θ Σ_t (w_t log π(a_t|s_t) + entropy_weight · H(π(·|s_t))), float32 [n].

        activations: from `forward`; actions: as in `log_probs`; weights: float32 [N].
        """
        outputs = activations[-1]
        if self.discrete:
            log_probs = log_softmax(outputs)
            probs = np.exp(log_probs)
            slope = -weights[:, None] * probs
            slope[np.arange(len(actions)), actions] += weights
            if entropy_weight:
                entropy = -(probs * log_probs).sum(1, keepdims=True)
                slope -= np.float32(entropy_weight) * probs * (log_probs + entropy)
            return self.backward(activations, slope)
        inverse_std = np.exp(-self.log_std)
        deviations = (actions - outputs) * inverse_std
        gradient = self.backward(activations, weights[:, None] * deviations * inverse_std)
        gradient[-self.sizes[-1] :] = weights @ (
            deviations * deviations - 1
        ) + entropy_weight * len(outputs)
        return gradient


def log_softmax(logits: np.ndarray) -> np.ndarray:
    """Row-wise log-softmax, [N, actions]."""
    shifted = logits - logits.max(axis=1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=1, keepdims=True))
