"""Proximal Policy Optimization (Schulman et al. 2017) with one critic per kind of reward."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import reduce
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

# Steps that go through a network at once in an update. Arrays for many more would not fit into the
# processor's cache, and the system takes back their memory after each use: a quarter more time for
# 2048 steps.
BLOCK = 512
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
        for minibatch in self._minibatches(batch):
            norms["actor"] = self.learners["actor"].descend(self.actor_gradient(minibatch))
            for kind in self.critics:
                norms[kind] = self.learners[kind].descend(self.critic_gradient(kind, minibatch))
        return norms

    def actor_gradient(self, batch: Batch) -> np.ndarray:
        """∇_θ of the negated clipped surrogate and entropy bonus (Schulman et al. 2017, eq. 7)."""

        def gradient(steps: Batch) -> np.ndarray:
            activations = self.actor.forward(steps.observations)
            log_probs = self.actor.log_probs(activations[-1], steps.actions)
            weights = compiled.surrogate_weights(
                log_probs, steps.log_probs, steps.advantages, self.config.clip
            )
            return self.actor.gradient(
                activations, steps.actions, weights, self.config.entropy_coefficient
            )

        return -mean_gradient(gradient, batch)

    def critic_gradient(self, kind: str, batch: Batch) -> np.ndarray:
        """Gradient of the mean squared error of a critic's V(s) against the λ-returns."""
        critic = self.critics[kind]

        def gradient(steps: Batch) -> np.ndarray:
            activations = critic.forward(steps.observations)
            errors = activations[-1] - steps.returns[kind][:, None]
            return critic.backward(activations, 2 * errors)

        return mean_gradient(gradient, batch)

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

    def _minibatches(self, batch: Batch) -> Iterator[Batch]:
        """Each minibatch of each epoch; the whole batch in order if none are asked for."""
        for _ in range(self.config.epochs):
            if self.config.minibatch_size is None:
                yield batch
            else:
                order = self.minibatches.permutation(len(batch))
                for start in range(0, len(batch), self.config.minibatch_size):
                    yield batch[order[start : start + self.config.minibatch_size]]

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


def mean_gradient(gradient: Callable[[Batch], np.ndarray], batch: Batch) -> np.ndarray:
    """The mean over a batch of a gradient, [n], that is a sum over its steps."""
    parts = (gradient(batch[start : start + BLOCK]) for start in range(0, len(batch), BLOCK))
    return reduce(np.add, parts) / np.float32(len(batch))
