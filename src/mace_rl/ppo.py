"""Proximal Policy Optimization (Schulman et al. 2017) with one critic per kind of reward."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from mace_rl import compiled
from mace_rl.environments import Environment
from mace_rl.hyperparameters import PPOConfig
from mace_rl.learner import Learner
from mace_rl.network import MLP
from mace_rl.policy import ActingPolicy, Actor
from mace_rl.standardise import RunningStandardiser
from mace_rl.streams import numpy_generator

OBSERVATION_CLIP = 10.0  # bound of normalised observations, in standard deviations


@njit(cache=True)
def advantages(rewards, values, discount, gae_lambda):
    """Generalised advantage estimation over one episode (Schulman et al. 2016, eq. 16).

    rewards: [T]; values: [T + 1], V(s_0) … V(s_T), where V(s_T) is 0 if s_T is terminal and the
    critic's value if the time limit cut the episode off. Returns float64 [T]; adding values[:T]
    gives the λ-returns.
    """
    result = np.empty(len(rewards))
    following = 0.0
    for t in range(len(rewards) - 1, -1, -1):
        delta = rewards[t] + discount * values[t + 1] - values[t]
        following = delta + discount * gae_lambda * following
        result[t] = following
    return result


@dataclass(frozen=True)
class Batch:
    """What one update learns from: N steps of whole episodes, one after the other."""

    observations: np.ndarray  # float32 [N, observation], normalised
    actions: np.ndarray  # int64 [N] or float32 [N, actions]
    log_probs: np.ndarray  # float32 [N], when the actions were taken
    advantages: np.ndarray  # float32 [N], of the total reward, normalised
    returns: dict[str, np.ndarray]  # for each critic the λ-returns it learns, float32 [N]


class PPO:
    """Actor and critics with their optimisers, and the update.

    The total reward R_E + β R_I is a sum, so its advantage is A_E + β A_I with a value function
    for each part: "extrinsic" always, "intrinsic" with a curiosity bonus. The parts share no
    weights: the bonus can reach the extrinsic critic in no way, and the actor only through β.
    """

    def __init__(
        self, config: PPOConfig, environment: Environment, seed: int, intrinsic: bool
    ) -> None:
        self.config = config
        size = environment.observation_size
        self.actor = Actor(
            size,
            environment.action_space,
            config.hidden_units,
            config.initial_log_std,
            numpy_generator(seed, "actor"),
        )
        kinds = ["extrinsic", "intrinsic"] if intrinsic else ["extrinsic"]
        self.critics = {
            kind: MLP([size, *config.hidden_units, 1], 1.0, numpy_generator(seed, f"{kind}_critic"))
            for kind in kinds
        }
        rates = {"actor": config.actor_learning_rate} | dict.fromkeys(
            kinds, config.critic_learning_rate
        )
        self.learners = {
            name: Learner(network.parameters, rates[name], config.max_gradient_norm)
            for name, network in ({"actor": self.actor} | self.critics).items()
        }
        self.standardiser = RunningStandardiser(size)
        self.minibatches = numpy_generator(seed, "minibatches")

    def normalise(self, observations: np.ndarray) -> np.ndarray:
        """What the networks see of `observations`, float32 [N, observation]."""
        if not self.config.normalise_observations:
            return observations
        return np.clip(self.standardiser(observations), -OBSERVATION_CLIP, OBSERVATION_CLIP)

    def acting_policy(self) -> ActingPolicy:
        """The current policy for a rollout."""
        if self.config.normalise_observations:
            return self.actor.for_acting(
                self.standardiser.mean, self.standardiser.std, OBSERVATION_CLIP
            )
        size = len(self.standardiser.mean)
        return self.actor.for_acting(np.zeros(size), np.ones(size), np.inf)

    def advantages_and_returns(
        self, kind: str, observations: np.ndarray, rewards: np.ndarray, terminated: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advantages and λ-returns of one episode for one kind of reward, float64 [T] each.

        observations: normalised, [T + 1, observation]. A terminal state is worth 0; a state the
        time limit cut off at is worth what the critic says.
        """
        values = self.critics[kind].forward(observations)[-1][:, 0].astype(np.float64)
        if terminated:
            values[-1] = 0.0
        result = advantages(rewards, values, self.config.discount, self.config.gae_lambda)
        return result, result + values[:-1]

    def update(self, batch: Batch) -> dict[str, float]:
        """K epochs over `batch`; returns the last gradient norms by name."""
        norms: dict[str, float] = {}
        for index in self._minibatches(len(batch.log_probs)):
            observations = batch.observations[index]
            norms["actor"] = self.learners["actor"].descend(self.actor_gradient(batch, index))
            for kind, returns in batch.returns.items():
                norms[kind] = self.learners[kind].descend(
                    value_gradient(self.critics[kind], observations, returns[index])
                )
        return norms

    def actor_gradient(self, batch: Batch, index: Any = slice(None)) -> np.ndarray:
        """∇_θ of the negated clipped surrogate and entropy bonus (Schulman et al. 2017, eq. 7).

        `index` chooses the steps of a minibatch.
        """
        actions, advantages = batch.actions[index], batch.advantages[index]
        activations = self.actor.forward(batch.observations[index])
        weights = compiled.surrogate_weights(
            self.actor.log_probs(activations[-1], actions),
            batch.log_probs[index],
            advantages,
            self.config.clip,
        )
        entropy_weight = self.config.entropy_coefficient / len(advantages)
        return -self.actor.gradient(activations, actions, weights, entropy_weight)

    def policy_gradients(
        self, observations: np.ndarray, actions: np.ndarray, advantages: list[np.ndarray]
    ) -> list[np.ndarray]:
        """∇_θ of the mean of log π(a|s) · A for each of several advantages, [N]; float32 [n]."""
        activations = self.actor.forward(observations)
        return [
            self.actor.gradient(
                activations, actions, (item / len(item)).astype(activations[-1].dtype)
            )
            for item in advantages
        ]

    def _minibatches(self, size: int) -> Iterator[Any]:
        """Indices of each minibatch of each epoch; the whole batch in order if none are asked."""
        for _ in range(self.config.epochs):
            if self.config.minibatch_size is None:
                yield slice(None)
            else:
                order = self.minibatches.permutation(size)
                for start in range(0, size, self.config.minibatch_size):
                    yield order[start : start + self.config.minibatch_size]

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimisers, normaliser and generator."""
        return {
            "learners": {name: learner.state_dict() for name, learner in self.learners.items()},
            "standardiser": self.standardiser.state_dict(),
            "minibatches": self.minibatches.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        for name, learner in self.learners.items():
            learner.load_state_dict(state["learners"][name])
        self.standardiser.load_state_dict(state["standardiser"])
        self.minibatches.bit_generator.state = state["minibatches"]


def value_gradient(critic: MLP, observations: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Gradient of the mean squared error of V(s) against `returns`, [N]; float32 [n]."""
    activations = critic.forward(observations)
    errors = activations[-1] - returns[:, None]
    return critic.backward(activations, errors * np.float32(2 / len(returns)))
