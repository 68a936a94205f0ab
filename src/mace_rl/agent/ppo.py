"""Proximal Policy Optimization (Schulman et al. 2017) with one critic per kind of reward."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mace_rl.agent.advantages import generalised_advantages
from mace_rl.agent.learner import Batch, Learner, Minibatches, Update
from mace_rl.agent.policy import ActingPolicy, Policy
from mace_rl.agent.scale import AdvantageScale, RewardScale
from mace_rl.config.agent import PPOConfig
from mace_rl.numerics.arrays import shuffled
from mace_rl.numerics.finite import require_finite
from mace_rl.numerics.network import Network
from mace_rl.numerics.normaliser import Normalisation, RunningNormaliser
from mace_rl.state import Stateful

TINY = 1e-8  # the smallest scale of a curiosity bonus
OBSERVATION_CLIP = 10.0  # bound of normalised observations, in standard deviations


@dataclass(eq=False)
class ActorCritic:
    """What plays: the policy, the critics, and the normalisation of what they see."""

    config: PPOConfig
    policy: Policy
    critics: Mapping[str, Network]
    normaliser: RunningNormaliser
    learner_of: type[Learner]  # what trains such networks

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
        return self.learner_of.acting(self.policy, Normalisation.of(*self.normalisation()))


class PPO(ActorCritic, Stateful):
    """An actor and critics with the learner that trains them.

    The total reward R_E + β R_I is a sum, so its advantage is A_E + β A_I with a value function
    for each part: "extrinsic" always, "intrinsic" with a curiosity bonus. The parts share no
    weights: the bonus can reach the extrinsic critic in no way, and the actor only through β.
    """

    STATE = ("learner", "normaliser", "generator", "reward_scales", "advantage_scales")

    def __init__(self, networks: ActorCritic, generator: np.random.Generator) -> None:
        super().__init__(**vars(networks))
        self.generator = generator
        self.learner = self.learner_of(self.config, self.policy, self.critics)
        smallest = {"extrinsic": (1.0, self.config.smallest_advantage)}
        self.reward_scales: dict[str, RewardScale] = {}
        self.advantage_scales: dict[str, AdvantageScale] = {}
        for kind in self.critics:
            least_reward, least_advantage = smallest.get(kind, (TINY, TINY))
            self.reward_scales[kind] = RewardScale(self.config.discount, least_reward)
            self.advantage_scales[kind] = AdvantageScale(least_advantage)

    def advantages_and_returns(
        self, kind: str, observations: np.ndarray, rewards: np.ndarray, terminated: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advantages and λ-returns of one episode for one kind of reward, float64 [T] each.

        observations: normalised, [T + 1, observation]; rewards: [T], as they were paid. A terminal
        state is worth 0; a state the time limit cut off at is worth what the critic says, unless
        the settings say otherwise. With
        `scale_rewards` all is in units of the reward's scale, this episode included.
        """
        if self.config.scale_rewards:
            self.reward_scales[kind].update(rewards)
            rewards = rewards / self.reward_scale(kind)
        values = self.critics[kind].outputs(observations)[:, 0].astype(np.float64)
        if terminated or not self.config.bootstrap_at_time_limit:
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

    def update(self, batch: Batch, returns: Mapping[str, np.ndarray]) -> Update:
        """K epochs over `batch`; returns: for each critic the λ-returns of its steps."""
        return self.learner.update(batch, returns, self.minibatches(len(batch.advantages)))

    def minibatches(self, count: int) -> Minibatches:
        """The minibatches of an update on so many steps; all in order if that is one."""
        size = self.config.minibatch_size
        shape = self.config.epochs, count
        if size is None or count <= size:
            return Minibatches(shuffled(np.ones(shape)), np.array([count]))
        # As even as can be: a last one of two samples would step as far as one of 128.
        parts = math.ceil(count / size)
        ends = np.arange(1, parts + 1) * count // parts
        return Minibatches(shuffled(self.generator.random(shape)), ends)
