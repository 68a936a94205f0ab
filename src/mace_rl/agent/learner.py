"""The interface of PPO's update, which is in `torch_learner`, to read, and `compiled_learner`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from mace_rl.agent.policy import ActingPolicy, Policy
from mace_rl.config.agent import PPOConfig
from mace_rl.numerics.network import Network
from mace_rl.numerics.normaliser import Normalisation


class Batch(NamedTuple):
    """What the policy learns from: N steps of whole episodes, one after the other."""

    observations: np.ndarray  # float32 [N, observation], normalised
    actions: np.ndarray  # as in an `Episode`
    log_probs: np.ndarray  # float32 [N], when the actions were taken
    advantages: np.ndarray  # float32 [N], of the total reward, normalised


class Minibatches(NamedTuple):
    """Which steps of a batch each epoch learns from, and in which order."""

    epochs: np.ndarray  # int64 [K, N], permutations of the steps
    ends: np.ndarray  # int64 [M], where each minibatch of an epoch ends


@dataclass
class Update:
    """Diagnostics of an update."""

    gradient_norms: dict[str, float]  # of the last minibatch, before clipping, by network
    # Means over the steps of the last epoch, before each minibatch's update.
    approximate_kl: float  # of the policy to the one that acted (Schulman 2020)
    clip_fraction: float  # share of the ratios outside the clipping bounds
    entropy: float  # of the policy, nats


class Learner(Protocol):
    """Changes the parameters of the policy and the critics, which share none, in place."""

    parameters: dict[str, np.ndarray]  # see `parameters_of`

    def __init__(self, config: PPOConfig, policy: Policy, critics: Any) -> None: ...

    @staticmethod
    def acting(policy: Policy, normalisation: Normalisation) -> ActingPolicy:
        """The policy for rollouts."""

    def update(
        self, batch: Batch, returns: Mapping[str, np.ndarray], minibatches: Minibatches
    ) -> Update:
        """Descend PPO's losses in all minibatches; returns: each critic's λ-returns, [N]."""

    def policy_gradients(
        self, observations: np.ndarray, actions: np.ndarray, advantages: list[np.ndarray]
    ) -> list[np.ndarray]:
        """∇_θ of the mean of log π(a|s) · A for each of several advantages, [N]; float32 [n]."""

    def preconditioned(self, direction: np.ndarray) -> np.ndarray:
        """`Adam.preconditioned` of the policy's optimiser."""

    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: dict[str, Any]) -> None: ...


def parameters_of(policy: Policy, critics: Mapping[str, Network]) -> dict[str, np.ndarray]:
    """Those of "actor" and of each critic, float32 [n]: the same memory."""
    networks = {kind: critic.parameters for kind, critic in critics.items()}
    return {"actor": policy.parameters} | networks
