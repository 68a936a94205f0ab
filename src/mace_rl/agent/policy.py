"""The policy π(a|s): a distribution over actions on the outputs of a network."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete

from mace_rl.agent import kernels
from mace_rl.agent.network import CompiledMLP, Network, Trace

Action = int | np.ndarray  # from 0, or float32 [actions] before clipping to the bounds


class ActingPolicy(Protocol):
    """What a rollout needs of the policy, with observation normalisation in front of it."""

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        """An action for one observation, float32 [observation], and its log-probability.

        noise: uniform in [0, 1) for Discrete actions, else standard normal, [actions].
        """


class CompiledActing(NamedTuple):
    """Acting with a compiled network: plain arrays, for compiled rollouts too."""

    mean: np.ndarray  # float32 [observation], subtracted from observations
    inverse_std: np.ndarray  # float32 [observation]
    clip: np.float32  # bound of normalised observations
    parameters: np.ndarray  # float32, see kernels.forward
    sizes: np.ndarray  # int64 [layers + 1]
    log_std: np.ndarray | None  # float32 [actions]; None for Discrete actions

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        """See `ActingPolicy`."""
        if self.log_std is None:
            return kernels.act_discrete(observation, *self[:5], noise)
        return kernels.act_box(observation, *self, noise)


@dataclass(frozen=True)
class NetworkActing:
    """Acting with any network."""

    policy: "Policy"
    mean: np.ndarray  # float32 [observation]
    inverse_std: np.ndarray  # float32 [observation]
    clip: np.float32

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        """See `ActingPolicy`."""
        seen = kernels.normalise(observation, self.mean, self.inverse_std, self.clip)
        with torch.no_grad():
            outputs = self.policy.network.forward(seen[None]).outputs[0]
        if self.policy.discrete:
            return kernels.sample_categorical(outputs, noise)
        return kernels.sample_gaussian(outputs, self.policy.log_std, noise)


class Policy:
    """Categorical for Discrete actions, diagonal Gaussian for Box ones.

    The Gaussian's log standard deviation does not depend on the state; its samples are clipped to
    the action bounds only when acting. `parameters`, float32 [n], are the network's, then the log
    standard deviations.
    """

    def __init__(
        self, network: Network, action_space: Discrete | Box, initial_log_std: float
    ) -> None:
        self.network = network
        self.discrete = isinstance(action_space, Discrete)
        own = 0 if isinstance(action_space, Discrete) else action_space.shape[0]
        count = len(network.parameters)
        self.parameters = np.full(count + own, initial_log_std, np.float32)
        network.move_to(self.parameters[:count])
        self.log_std = self.parameters[count:]  # float32 [actions]; empty for Discrete actions

    def forward(self, observations: np.ndarray) -> Trace:
        """The network's outputs for normalised observations, [N, observation]."""
        return self.network.forward(observations)

    def log_probs(self, outputs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """log π(a|s), [N], from the network's outputs, [N, out], and actions.

        actions: int64 [N] or float32 [N, actions].
        """
        if self.discrete:
            return kernels.categorical_log_probs(outputs, actions)
        return kernels.gaussian_log_probs(outputs, self.log_std, actions)

    def gradient(
        self,
        trace: Trace,
        actions: np.ndarray,
        weights: np.ndarray,
        entropy_weight: float = 0.0,
    ) -> tuple[np.ndarray, float]:
        """∇_θ Σ_t (w_t log π(a_t|s_t) + entropy_weight · H(π(·|s_t))), float32 [n], and Σ_t H.

        trace: from `forward`; actions: as in `log_probs`; weights: float32 [N].
        """
        if self.discrete:
            grad_outputs, entropy = kernels.categorical_grad(
                trace.outputs, actions, weights, entropy_weight
            )
            return self.network.backward(trace, grad_outputs), entropy
        grad_outputs, grad_log_std, entropy = kernels.gaussian_grads(
            trace.outputs, self.log_std, actions, weights, entropy_weight
        )
        gradient = self.network.backward(trace, grad_outputs)
        return np.concatenate([gradient, grad_log_std]), entropy

    def for_acting(self, mean: np.ndarray, std: np.ndarray, clip: float) -> ActingPolicy:
        """The policy with observation normalisation in front of it.

        Its weights follow later updates; `mean` and `std` stay as they are now.
        """
        normalisation = mean.astype(np.float32), (1.0 / std).astype(np.float32), np.float32(clip)
        if isinstance(self.network, CompiledMLP):
            log_std = None if self.discrete else self.log_std
            return CompiledActing(
                *normalisation, self.network.parameters, self.network.sizes, log_std
            )
        return NetworkActing(self, *normalisation)
