"""Proximal Policy Optimization (Schulman et al. 2017) with one critic per kind of reward."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor, nn

from mace_rl.environments import Environment
from mace_rl.hyperparameters import PPOConfig
from mace_rl.policy import ActingPolicy, Actor, critic
from mace_rl.standardise import RunningStandardiser
from mace_rl.streams import numpy_generator, torch_generator

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

    observations: Tensor  # float32 [N, observation], normalised
    actions: Tensor  # int64 [N] or float32 [N, actions]
    log_probs: Tensor  # float32 [N], when the actions were taken
    advantages: Tensor  # float32 [N], of the total reward, normalised
    returns: dict[str, Tensor]  # for each critic the λ-returns it learns, float32 [N]


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
        size, hidden = environment.observation_size, config.hidden_units
        self.actor = Actor(
            size,
            environment.action_space,
            hidden,
            config.initial_log_std,
            torch_generator(seed, "actor"),
        )
        kinds = ["extrinsic", "intrinsic"] if intrinsic else ["extrinsic"]
        self.critics = nn.ModuleDict(
            {kind: critic(size, hidden, torch_generator(seed, f"{kind}_critic")) for kind in kinds}
        )
        self.optimisers = {
            "actor": torch.optim.Adam(
                self.actor.parameters(), config.actor_learning_rate, eps=1e-5, fused=True
            )
        } | {
            kind: torch.optim.Adam(
                network.parameters(), config.critic_learning_rate, eps=1e-5, fused=True
            )
            for kind, network in self.critics.items()
        }
        self.standardiser = RunningStandardiser(size)
        self.minibatches = numpy_generator(seed, "minibatches")

    def normalise(self, observations: np.ndarray) -> Tensor:
        """What the networks see of `observations`, float32 [N, observation]."""
        if self.config.normalise_observations:
            observations = np.clip(
                self.standardiser(observations), -OBSERVATION_CLIP, OBSERVATION_CLIP
            )
        return torch.from_numpy(observations)

    def acting_policy(self) -> ActingPolicy:
        """A copy of the current policy for a rollout."""
        if self.config.normalise_observations:
            return self.actor.for_acting(
                self.standardiser.mean, self.standardiser.std, OBSERVATION_CLIP
            )
        size = len(self.standardiser.mean)
        return self.actor.for_acting(np.zeros(size), np.ones(size), np.inf)

    @torch.no_grad()
    def advantages_and_returns(
        self, kind: str, observations: Tensor, rewards: np.ndarray, terminated: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advantages and λ-returns of one episode for one kind of reward, float64 [T] each.

        observations: normalised, [T + 1, observation]. A terminal state is worth 0; a state the
        time limit cut off at is worth what the critic says.
        """
        values = self.critics[kind](observations).squeeze(1).double().numpy()
        if terminated:
            values[-1] = 0.0
        result = advantages(rewards, values, self.config.discount, self.config.gae_lambda)
        return result, result + values[:-1]

    def update(self, batch: Batch) -> dict[str, float]:
        """K epochs over `batch`; returns the last losses and gradient norms by name."""
        losses: dict[str, Tensor] = {}
        norms: dict[str, Tensor] = {}
        for index in self._minibatches(len(batch.log_probs)):
            observations = batch.observations[index]
            losses = {"actor": self._actor_loss(batch, index)} | {
                kind: nn.functional.mse_loss(
                    self.critics[kind](observations).squeeze(1), returns[index]
                )
                for kind, returns in batch.returns.items()
            }
            for optimiser in self.optimisers.values():
                optimiser.zero_grad()
            torch.stack(list(losses.values())).sum().backward()
            for name, optimiser in self.optimisers.items():
                norms[name] = nn.utils.clip_grad_norm_(
                    optimiser.param_groups[0]["params"], self.config.max_gradient_norm
                )
                optimiser.step()
        return {f"the {name}'s loss": loss.item() for name, loss in losses.items()} | {
            f"the {name}'s gradient norm": norm.item() for name, norm in norms.items()
        }

    def _actor_loss(self, batch: Batch, index: Any) -> Tensor:
        """The clipped surrogate with an entropy bonus, negated (Schulman et al. 2017, eq. 7)."""
        log_probs, entropy = self.actor.log_prob_and_entropy(
            batch.observations[index], batch.actions[index]
        )
        ratio = torch.exp(log_probs - batch.log_probs[index])
        clipped = ratio.clamp(1 - self.config.clip, 1 + self.config.clip)
        advantage = batch.advantages[index]
        surrogate = torch.minimum(ratio * advantage, clipped * advantage).mean()
        return -surrogate - self.config.entropy_coefficient * entropy.mean()

    def _minibatches(self, size: int) -> Iterator[Any]:
        """Indices of each minibatch of each epoch; the whole batch in order if none are asked."""
        for _ in range(self.config.epochs):
            if self.config.minibatch_size is None:
                yield slice(None)
            else:
                order = torch.from_numpy(self.minibatches.permutation(size))
                yield from order.split(self.config.minibatch_size)

    def policy_gradient(self, log_probs: Tensor, advantages: Tensor) -> Tensor:
        """∇_θ mean(log π(a|s) · A) as one flat vector; `log_probs` carries the graph."""
        gradients = torch.autograd.grad(
            (log_probs * advantages).mean(), list(self.actor.parameters()), retain_graph=True
        )
        return torch.cat([gradient.ravel() for gradient in gradients])

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimisers, normaliser and generator."""
        return {
            "actor": self.actor.state_dict(),
            "critics": self.critics.state_dict(),
            "optimisers": {name: item.state_dict() for name, item in self.optimisers.items()},
            "standardiser": self.standardiser.state_dict(),
            "minibatches": self.minibatches.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.actor.load_state_dict(state["actor"])
        self.critics.load_state_dict(state["critics"])
        for name, item in self.optimisers.items():
            item.load_state_dict(state["optimisers"][name])
        self.standardiser.load_state_dict(state["standardiser"])
        self.minibatches.bit_generator.state = state["minibatches"]
