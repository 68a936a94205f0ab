"""Proximal Policy Optimization (Schulman et al. 2017) with one critic per kind of reward."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch

from mace_rl.agent import kernels
from mace_rl.agent.adam import Adam
from mace_rl.agent.advantages import generalised_advantages
from mace_rl.agent.learning import improve_policy, improve_values, policy_gradients
from mace_rl.agent.network import CompiledMLP, Network
from mace_rl.agent.normaliser import RunningNormaliser
from mace_rl.agent.policy import ActingPolicy, Policy
from mace_rl.agent.scale import AdvantageScale, RewardScale
from mace_rl.config.agent import PPOConfig
from mace_rl.finite import require_finite

TINY = 1e-8  # the smallest scale of a curiosity bonus
OBSERVATION_CLIP = 10.0  # bound of normalised observations, in standard deviations


@dataclass(frozen=True)
class Batch:
    """What one update learns from: N steps of whole episodes, one after the other."""

    observations: np.ndarray  # float32 [N, observation], normalised
    actions: np.ndarray  # int64 [N] or float32 [N, actions]
    log_probs: np.ndarray  # float32 [N], when the actions were taken
    advantages: np.ndarray  # float32 [N], of the total reward, normalised
    returns: dict[str, np.ndarray]  # for each critic the λ-returns it learns, float32 [N]

    def __len__(self) -> int:
        return len(self.log_probs)

    def __getitem__(self, index: Any) -> "Batch":
        """Some of the steps."""
        return Batch(
            self.observations[index],
            self.actions[index],
            self.log_probs[index],
            self.advantages[index],
            {kind: returns[index] for kind, returns in self.returns.items()},
        )


class Minibatches(NamedTuple):
    """Which steps of a batch each epoch learns from, and in which order."""

    epochs: np.ndarray  # int64 [K, N], permutations of the steps
    ends: np.ndarray  # int64 [M], where each minibatch of an epoch ends

    def of(self, batch: Batch) -> Iterator[Batch]:
        """The minibatches, epoch after epoch."""
        for order in self.epochs:
            for chosen in np.split(order, self.ends[:-1]):
                yield batch[chosen]


@dataclass
class Update:
    """What an update tells of itself."""

    gradient_norms: dict[str, float]  # of the last minibatch, before clipping, by network
    # Means over the steps of the last epoch, each as its minibatch was learnt from.
    approximate_kl: float = 0.0  # of the policy to the one that acted
    clip_fraction: float = 0.0  # of the ratios outside the clipping bounds
    entropy: float = 0.0  # of the policy, nats


class Critic(Protocol):
    """V(s) for one kind of reward, and how it learns."""

    @property
    def optimiser(self) -> Adam | None:
        """None: there is nothing that gradients change."""

    def values(self, observations: np.ndarray) -> np.ndarray:
        """V of each state, float64 [N]; observations: normalised, float32 [N, observation]."""

    def learn(self, batch: Batch, minibatches: Minibatches) -> float:
        """Learn in all epochs of an update; returns the last gradient's norm, 0 without one."""

    def remember(self, batch: Batch) -> None:
        """Take in all steps of an update, once, after its epochs."""

    def module(self) -> torch.nn.Module:
        """The same values as a torch module, [N, observation] → [N, 1]."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""


class NetworkCritic:
    """A network with one output that descends the mean squared error; see `Critic`."""

    def __init__(self, kind: str, network: Network, config: PPOConfig) -> None:
        self.kind, self.network = kind, network
        self.optimiser = Adam(
            network.parameters, config.critic_learning_rate, config.max_gradient_norm
        )

    def values(self, observations: np.ndarray) -> np.ndarray:
        """See `Critic`."""
        return self.network.forward(observations).outputs[:, 0].astype(np.float64)

    def learn(self, batch: Batch, minibatches: Minibatches) -> float:
        """See `Critic`."""
        if isinstance(self.network, CompiledMLP):
            observations, returns = batch.observations, batch.returns[self.kind]
            sizes, optimiser = self.network.sizes, self.optimiser.state
            return improve_values(observations, returns, *minibatches, sizes, optimiser)
        for steps in minibatches.of(batch):
            norm = self.optimiser.step(self.gradient(steps))
        return norm

    def gradient(self, batch: Batch) -> np.ndarray:
        """Gradient of the mean squared error of V(s) against the λ-returns, float32 [n]."""
        trace = self.network.forward(batch.observations)
        errors = trace.outputs - batch.returns[self.kind][:, None]
        return self.network.backward(trace, np.float32(2 / len(batch)) * errors)

    def remember(self, batch: Batch) -> None:
        """See `Critic`: everything is learnt in the epochs."""

    def module(self) -> torch.nn.Module:
        """See `Critic`."""
        return self.network.module()

    def state_dict(self) -> dict[str, Any]:
        """See `Critic`."""
        return self.optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `Critic`."""
        self.optimiser.load_state_dict(state)


class PPO:
    """Policy and critics with their optimisers, and the update.

    The total reward R_E + β R_I is a sum, so its advantage is A_E + β A_I with a value function
    for each part: "extrinsic" always, "intrinsic" with a curiosity bonus. The parts share no
    weights: the bonus can reach the extrinsic critic in no way, and the actor only through β.
    """

    def __init__(
        self,
        config: PPOConfig,
        policy: Policy,
        critics: Mapping[str, Critic],
        normaliser: RunningNormaliser,
        generator: np.random.Generator,
    ) -> None:
        self.config = config
        self.policy = policy
        self.critics = dict(critics)
        self.optimisers = {
            "actor": Adam(policy.parameters, config.actor_learning_rate, config.max_gradient_norm)
        } | {
            kind: critic.optimiser
            for kind, critic in critics.items()
            if critic.optimiser is not None
        }
        self.normaliser = normaliser
        self.generator = generator
        smallest = {"extrinsic": (1.0, config.smallest_advantage)}
        self.reward_scales: dict[str, RewardScale] = {}
        self.advantage_scales: dict[str, AdvantageScale] = {}
        for kind in critics:
            least_reward, least_advantage = smallest.get(kind, (TINY, TINY))
            self.reward_scales[kind] = RewardScale(config.discount, least_reward)
            self.advantage_scales[kind] = AdvantageScale(least_advantage)

    def normalise(self, observations: np.ndarray) -> np.ndarray:
        """What the networks see of `observations`, float32 [N, observation]."""
        if not self.config.normalise_observations:
            return observations
        return self.normaliser(observations, OBSERVATION_CLIP)

    def normalisation(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Mean and standard deviation of observations, [observation], and the normalised's bound.

        What leaves observations as they are if they are not to be normalised.
        """
        if self.config.normalise_observations:
            return self.normaliser.mean, self.normaliser.std, OBSERVATION_CLIP
        size = len(self.normaliser.mean)
        return np.zeros(size), np.ones(size), np.inf

    def acting_policy(self) -> ActingPolicy:
        """The current policy for a rollout."""
        return self.policy.for_acting(*self.normalisation())

    def advantages_and_returns(
        self, kind: str, observations: np.ndarray, rewards: np.ndarray, terminated: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advantages and λ-returns of one episode for one kind of reward, float64 [T] each.

        observations: normalised, [T + 1, observation]; rewards: [T], as they were paid. A terminal
        state is worth 0; a state the time limit cut off at is worth what the critic says. With
        `scale_rewards` all is in units of the reward's scale, this episode included.
        """
        if self.config.scale_rewards:
            self.reward_scales[kind].update(rewards)
            rewards = rewards / self.reward_scale(kind)
        values = self.critics[kind].values(observations)
        if terminated:
            values[-1] = 0.0
        advantages = generalised_advantages(
            rewards, values, self.config.discount, self.config.gae_lambda
        )
        self.advantage_scales[kind].update(advantages)
        require_finite(f"an advantage or value of the {kind} reward", advantages)
        return advantages, advantages + values[:-1]

    def reward_scale(self, kind: str) -> float:
        """The unit of rewards, advantages and returns of one kind, in what was paid."""
        return self.reward_scales[kind].value if self.config.scale_rewards else 1.0

    def advantage_scale(self, kind: str) -> float:
        """What advantages of one kind are divided by before β weighs them."""
        return self.advantage_scales[kind].value if self.config.scale_advantages else 1.0

    def unit(self, kind: str) -> float:
        """What was paid for an advantage of 1 where β weighs it."""
        return self.reward_scale(kind) * self.advantage_scale(kind)

    def update(self, batch: Batch) -> Update:
        """K epochs over `batch`.

        Actor and critics share no weights, so each goes through all epochs before the next one.
        """
        minibatches = self.minibatches_of(batch)
        norm, sums = self.improve_policy(batch, minibatches)
        norms = {"actor": norm}
        for kind, critic in self.critics.items():
            norms[kind] = critic.learn(batch, minibatches)
            critic.remember(batch)
        return Update(norms, *(sums / len(batch)).tolist())

    def improve_policy(self, batch: Batch, minibatches: Minibatches) -> tuple[float, np.ndarray]:
        """Descend the surrogate in all epochs.

        Returns the last minibatch's gradient norm, and sums over the steps of the last epoch: of
        what `Update` has the means of.
        """
        network, optimiser = self.policy.network, self.optimisers["actor"]
        if isinstance(network, CompiledMLP):
            return improve_policy(
                *(batch.observations, batch.actions, batch.log_probs, batch.advantages),
                *(*minibatches, network.sizes, len(network.parameters)),
                *(self.config.clip, self.config.entropy_coefficient, optimiser.state),
            )
        for done, steps in enumerate(minibatches.of(batch)):
            if done % len(minibatches.ends) == 0:  # an epoch begins
                sums = np.zeros(3)
            norm = optimiser.step(self.actor_gradient(steps, sums))
        return norm, sums

    def actor_gradient(self, batch: Batch, sums: np.ndarray) -> np.ndarray:
        """∇_θ of the negated clipped surrogate and entropy bonus (Schulman et al. 2017, eq. 7).

        sums: float64 [3], see `improve_policy`; the batch's are added.
        """
        share = -1 / len(batch)
        trace = self.policy.forward(batch.observations)
        log_probs = self.policy.log_probs(trace.outputs, batch.actions)
        weights = np.empty_like(log_probs)
        kernels.surrogate_weights(
            *(log_probs, batch.log_probs, batch.advantages, self.config.clip, share),
            *(weights, sums),
        )
        entropy_weight = share * self.config.entropy_coefficient
        return self.policy.gradient(trace, batch.actions, weights, entropy_weight, sums)

    def policy_gradients(
        self, observations: np.ndarray, actions: np.ndarray, advantages: list[np.ndarray]
    ) -> list[np.ndarray]:
        """∇_θ of the mean of log π(a|s) · A for each of several advantages, [N]; float32 [n]."""
        network = self.policy.network
        weights = np.empty((len(advantages), len(actions)), np.float32)
        for row, item in zip(weights, advantages, strict=True):
            row[:] = item / len(item)
        if isinstance(network, CompiledMLP):
            observations = np.ascontiguousarray(observations, np.float32)
            return list(
                policy_gradients(
                    *(observations, actions, weights, self.policy.parameters),
                    *(network.sizes, len(network.parameters)),
                )
            )
        trace = self.policy.forward(observations)
        return [self.policy.gradient(trace, actions, row) for row in weights]

    def minibatches_of(self, batch: Batch) -> Minibatches:
        """The minibatches of an update; the whole batch in order if it is one."""
        size, count = self.config.minibatch_size, len(batch)
        shape = self.config.epochs, count
        if size is None or count <= size:
            return Minibatches(kernels.shuffled(np.ones(shape)), np.array([count]))
        # As even as can be: a last one of two samples would step as far as one of 128.
        parts = math.ceil(count / size)
        ends = np.arange(1, parts + 1) * count // parts
        return Minibatches(kernels.shuffled(self.generator.random(shape)), ends)

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimisers, normaliser and generator."""
        return {
            "actor": self.optimisers["actor"].state_dict(),
            "critics": {kind: critic.state_dict() for kind, critic in self.critics.items()},
            "normaliser": self.normaliser.state_dict(),
            "minibatches": self.generator.bit_generator.state,
            "scales": [
                {kind: scale.state_dict() for kind, scale in scales.items()}
                for scales in (self.reward_scales, self.advantage_scales)
            ],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.optimisers["actor"].load_state_dict(state["actor"])
        for kind, critic in self.critics.items():
            critic.load_state_dict(state["critics"][kind])
        self.normaliser.load_state_dict(state["normaliser"])
        self.generator.bit_generator.state = state["minibatches"]
        scales: list[Mapping[str, RewardScale | AdvantageScale]]
        scales = [self.reward_scales, self.advantage_scales]
        for group, saved in zip(scales, state["scales"], strict=True):
            for kind, scale in group.items():
                scale.load_state_dict(saved[kind])
