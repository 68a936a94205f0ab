"""Proximal Policy Optimization (Schulman et al. 2017) with one critic per kind of reward."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mace_rl.agent.advantages import episode_advantages
from mace_rl.agent.learner import Batch, Learner, Minibatches, Update
from mace_rl.agent.policy import ActingPolicy, Policy
from mace_rl.agent.scale import AdvantageScale, RewardScale
from mace_rl.base.state import Stateful
from mace_rl.config.agent import PPOConfig
from mace_rl.numerics.arrays import shuffled
from mace_rl.numerics.finite import require_finite
from mace_rl.numerics.network import Network
from mace_rl.numerics.normaliser import Normalisation, RunningNormaliser

TINY = 1e-8  # the smallest scale of a curiosity bonus
OBSERVATION_CLIP = 10.0  # bound of normalised observations, in standard deviations


class Evaluation(NamedTuple):
    """What a critic makes of one kind of reward in an episode of T steps."""

    advantages: np.ndarray  # float64 [T]
    returns: np.ndarray  # λ-returns, float64 [T]
    scale: float  # `PPO.advantage_scale`, by which the advantages are divided


@dataclass(eq=False)
class ActorCritic:
    """Policy, critics, and the normalisation of their inputs."""

    config: PPOConfig
    policy: Policy
    critics: Mapping[str, Network]
    normaliser: RunningNormaliser
    learner_of: type[Learner]  # trains such networks

    def normalise(self, observations: np.ndarray) -> np.ndarray:
        """`observations` as the networks see them, float32 [N, observation]."""
        if not self.config.normalise_observations:
            return observations
        return self.normaliser(observations, OBSERVATION_CLIP)

    def normalisation(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Mean, standard deviation, [observation] each, and bound; (0, 1, ∞) without one."""
        if self.config.normalise_observations:
            return self.normaliser.mean, self.normaliser.std, OBSERVATION_CLIP
        size = len(self.normaliser.mean)
        return np.zeros(size), np.ones(size), np.inf

    def acting_policy(self) -> ActingPolicy:
        """The current policy for a rollout."""
        return self.learner_of.acting(self.policy, Normalisation.of(*self.normalisation()))


class PPO(ActorCritic, Stateful):
    """An actor and critics with the learner that trains them.

    The advantage of the total reward R_E + β R_I is A_E + β A_I, with a critic for each part:
    "extrinsic" always, "intrinsic" with a bonus. The networks share no weights, so the bonus
    reaches the actor only through β.
    """

    STATE = ("learner", "normaliser", "generator", "reward_scales", "advantage_scales")

    def __init__(self, networks: ActorCritic, generator: np.random.Generator) -> None:
        super().__init__(**vars(networks))
        self.generator = generator
        config = self.config
        self.learner = self.learner_of(config, self.policy, self.critics)
        rewards, advantages = {"extrinsic": 1.0}, {"extrinsic": config.smallest_advantage}
        self.reward_scales = {
            kind: RewardScale(config.discount, rewards.get(kind, TINY)) for kind in self.critics
        }
        self.advantage_scales = {
            kind: AdvantageScale(advantages.get(kind, TINY)) for kind in self.critics
        }

    def advantages(
        self, kind: str, observations: np.ndarray, rewards: np.ndarray, terminated: bool
    ) -> Evaluation:
        """Advantages and λ-returns of one episode for one kind of reward.

        observations: normalised, [T + 1, observation]; rewards: [T], before scaling. The last state
        is worth 0 if it is terminal (with `bootstrap_at_time_limit` false always), else what the
        critic says. The unit is `reward_scale`.
        """
        if self.config.scale_rewards:
            self.reward_scales[kind].update(rewards)
        ends = terminated or not self.config.bootstrap_at_time_limit
        unit, values = self.reward_scale(kind), self.critics[kind].outputs(observations)
        advantages, returns = episode_advantages(
            rewards, unit, values, ends, self.config.discount, self.config.gae_lambda
        )
        self.advantage_scales[kind].update(advantages)
        require_finite(f"an advantage or value of the {kind} reward", advantages)
        return Evaluation(advantages, returns, self.advantage_scale(kind))

    def reward_scale(self, kind: str) -> float:
        """The divisor of one kind of rewards."""
        return self.reward_scales[kind].value if self.config.scale_rewards else 1.0

    def advantage_scale(self, kind: str) -> float:
        """The divisor of one kind of advantages, before β weighs them."""
        return self.advantage_scales[kind].value if self.config.scale_advantages else 1.0

    def unit(self, kind: str) -> float:
        """Raw reward per unit of scaled advantage."""
        return self.reward_scale(kind) * self.advantage_scale(kind)

    def update(self, batch: Batch, returns: Mapping[str, np.ndarray]) -> Update:
        """K epochs over `batch`; returns: for each critic the λ-returns of its steps."""
        targets = {kind: values.astype(np.float32) for kind, values in returns.items()}
        return self.learner.update(batch, targets, self.minibatches(len(batch.advantages)))

    def minibatches(self, count: int) -> Minibatches:
        """The minibatches of an update on `count` steps: in random order, unless there is one."""
        shape, size = (self.config.epochs, count), self.config.minibatch_size or count
        # Of equal size: a last one of two steps would change as much as one of 128.
        parts = math.ceil(count / size)
        ends = np.arange(1, parts + 1) * count // parts
        if parts > 1:
            return Minibatches(shuffled(self.generator.random(shape)), ends)
        return Minibatches(np.tile(np.arange(count), (self.config.epochs, 1)), ends)
