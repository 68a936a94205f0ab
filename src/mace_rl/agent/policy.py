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
    parameters: np.ndarray  # float32, see kernels
    sizes: np.ndarray  # int64 [layers + 1]
    log_std: np.ndarray  # float32 [actions]; empty for Discrete actions
    seen: np.ndarray  # overwritten, like the next, see kernels.act_discrete
    activations: np.ndarray

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        """See `ActingPolicy`."""
        sample = kernels.act_box if len(self.log_std) else kernels.act_discrete
        return sample(observation, self, noise)


@dataclass(frozen=True)
class NetworkActing:
    """Acting with any network."""

    policy: "Policy"
    mean: np.ndarray  # float32 [observation]
    inverse_std: np.ndarray  # float32 [observation]
    clip: np.float32

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        """See `ActingPolicy`."""
        seen = np.empty_like(self.mean)
        kernels.normalise(observation, self.mean, self.inverse_std, self.clip, seen)
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
        result = np.empty(len(outputs), np.float32)
        kernels.log_probs(outputs, self.log_std, actions, result)
        return result

    def gradient(
        self,
        trace: Trace,
        actions: np.ndarray,
        weights: np.ndarray,
        entropy_weight: float = 0.0,
        sums: np.ndarray | None = None,
    ) -> np.ndarray:
        """∇_θ Σ_t (w_t log π(a_t|s_t) + entropy_weight · H(π(·|s_t))), float32 [n].

        trace: from `forward`; actions: as in `log_probs`; weights: float32 [N]. To sums[2] the
        entropies are added.
        """
        sums = np.zeros(3) if sums is None else sums
        grad_outputs, gradient = np.empty_like(trace.outputs), np.zeros_like(self.parameters)
        count = len(gradient) - len(self.log_std)
        kernels.log_prob_gradient(
            *(trace.outputs, self.log_std, actions, weights, entropy_weight),
            *(grad_outputs, gradient[count:], sums),
        )
        gradient[:count] = self.network.backward(trace, grad_outputs)
        return gradient

    def for_acting(self, mean: np.ndarray, std: np.ndarray, clip: float) -> ActingPolicy:
        """The policy with observation normalisation in front of it.

        Its weights follow later updates; `mean` and `std` stay as they are now.
        """
        normalisation = mean.astype(np.float32), (1.0 / std).astype(np.float32), np.float32(clip)
        if not isinstance(self.network, CompiledMLP):
            return NetworkActing(self, *normalisation)
        sizes = self.network.sizes
        return CompiledActing(
            *(*normalisation, self.network.parameters, sizes, self.log_std),
            np.empty((1, sizes[0]), np.float32),
            kernels.room_for(1, sizes),
        )
