"""The policy π(a|s): a network whose outputs say a distribution over actions; acting with it."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from mace_rl.agent.distribution import (
    log_probs,
    sample_categorical,
    sample_gaussian,
    sample_parts,
)
from mace_rl.environments.actions import Action, Actions
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.network import Network
from mace_rl.numerics.network_kernels import forward
from mace_rl.numerics.normaliser import Normalisation, normalise


class Policy:
    """Categorical for Discrete actions, several for those of parts, diagonal Gaussian for Box ones.

    Samples are clipped to the action bounds only for the environment. `parameters`, float32 [n],
    are the network's, then the log standard deviations, which do not depend on the state.
    """

    def __init__(self, network: Network, actions: Actions, initial_log_std: float) -> None:
        self.network = network
        self.discrete, self.parts = actions.discrete, actions.parts
        deviations = actions.outputs if actions.continuous else 0
        count = len(network.parameters)
        self.parameters = np.full(count + deviations, initial_log_std, np.float32)
        network.move_to(self.parameters[:count])
        self.log_std = self.parameters[count:]  # float32 [actions]; empty unless they are Box ones

    def log_probs(self, outputs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """log π(a|s), float32 [N]; outputs: the network's, [N, out]; actions: as in `Batch`."""
        return log_probs(outputs, self.log_std, actions, self.parts)


class ActingPolicy(Protocol):
    """A policy for rollouts, which takes observations before normalisation.

    Its weights follow later updates; the normalisation stays as it was when this was made.
    """

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        """An action for one observation, float32 [observation], and its log-probability.

        noise: uniform in [0, 1) for Discrete actions, [parts] for those of parts, else standard
        normal, [actions].
        """


@dataclass(frozen=True)
class NetworkActing:
    """An `ActingPolicy` of any network."""

    policy: Policy
    normalisation: Normalisation

    def outputs(self, observation: np.ndarray) -> np.ndarray:
        """The network's for one observation, [1, out]."""
        seen = np.empty_like(self.normalisation.mean)
        normalise(observation, self.normalisation, seen)
        return self.policy.network.outputs(seen[None])

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        outputs = self.outputs(observation)[0]
        if self.policy.discrete:
            return sample_categorical(outputs, noise)
        if len(self.policy.parts):
            return sample_parts(outputs, self.policy.parts, noise)
        return sample_gaussian(outputs, self.policy.log_std, noise)


class CompiledActing(NamedTuple):
    """An `ActingPolicy` of a compiled network: plain arrays, for compiled rollouts too."""

    normalisation: Normalisation
    parameters: np.ndarray  # float32, see `network_kernels`
    sizes: np.ndarray  # int64 [layers + 1]
    log_std: np.ndarray  # float32 [actions]; empty unless they are Box ones
    parts: np.ndarray  # int64 [parts]; empty unless they have several
    seen: np.ndarray  # the network's scratch memory, like the next
    activations: np.ndarray

    def act(self, observation: np.ndarray, noise: float | np.ndarray) -> tuple[Action, np.float32]:
        sample = act_box if len(self.log_std) else act_parts if len(self.parts) else act_discrete
        return sample(observation, self, noise)


@kernel
def means_or_logits(observation, policy):
    """The network's outputs for one observation before normalisation; policy: `CompiledActing`."""
    normalise(observation, policy.normalisation, policy.seen[0])
    outputs = forward(policy.seen, policy.parameters, policy.sizes, policy.activations)
    return outputs[0, : policy.sizes[-1]]


@kernel
def act_discrete(observation, policy, uniform):
    """`sample_categorical` from the network's logits for one observation."""
    return sample_categorical(means_or_logits(observation, policy), uniform)


@kernel
def act_parts(observation, policy, uniforms):
    """`sample_parts` from the network's logits for one observation."""
    return sample_parts(means_or_logits(observation, policy), policy.parts, uniforms)


@kernel
def act_box(observation, policy, normal):
    """`sample_gaussian` around the network's means for one observation."""
    return sample_gaussian(means_or_logits(observation, policy), policy.log_std, normal)
