"""PPO in plain PyTorch: its losses (Schulman et al. 2017), autograd and `torch.optim.Adam`."""

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, from_numpy
from torch.nn.utils import clip_grad_norm_

from mace_rl.agent.learner import Batch, Minibatches, Update, parameters_of
from mace_rl.agent.policy import ActingPolicy, NetworkActing, Policy
from mace_rl.agent.torch_policy import TorchPolicy
from mace_rl.base.state import Stateful
from mace_rl.config.agent import PPOConfig
from mace_rl.numerics.adam import DECAY_SQUARE, EPSILON
from mace_rl.numerics.network import Network
from mace_rl.numerics.normaliser import Normalisation


class TorchLearner(Stateful):
    """A `Learner` for any torch modules; `CompiledLearner` computes the same."""

    STATE = ("parameters", "optimiser")

    def __init__(self, config: PPOConfig, policy: Policy, critics: Mapping[str, Network]) -> None:
        self.config = config
        self.parameters = parameters_of(policy, critics)
        self.actor = TorchPolicy(policy, validate=False)  # NaN is found in the gradients' norms
        if self.actor.continuous and not config.learn_log_std:
            self.actor.log_std.register_hook(torch.zeros_like)
        self.critics = {kind: critic.module() for kind, critic in critics.items()}
        log_std = [self.actor.log_std] if self.actor.continuous else []
        self.weights = {"actor": [*self.actor.network.parameters(), *log_std]}  # as a `Policy` has
        self.weights |= {kind: list(critic.parameters()) for kind, critic in self.critics.items()}
        rates = dict.fromkeys(critics, config.critic_learning_rate)
        rates["actor"] = config.actor_learning_rate
        groups = [{"params": part, "lr": rates[name]} for name, part in self.weights.items()]
        self.optimiser = torch.optim.Adam(groups, eps=EPSILON)

    def losses(self, batch: Batch, returns: dict[str, np.ndarray]) -> tuple[Tensor, Tensor]:
        """The loss of a minibatch, and its approximate KL, clip fraction and entropy, [3]."""
        observations, actions, log_probs, advantages = map(from_numpy, batch)
        policy, epsilon = self.actor(observations), self.config.clip
        log_ratio = policy.log_prob(actions) - log_probs
        ratio = log_ratio.exp()
        clipped = ratio.clip(1 - epsilon, 1 + epsilon)
        surrogate = torch.min(ratio * advantages, clipped * advantages).mean()  # eq. 7
        entropy = policy.entropy().mean()
        loss = -surrogate - self.config.entropy_coefficient * entropy
        for kind, critic in self.critics.items():
            loss += (critic(observations)[:, 0] - from_numpy(returns[kind])).square().mean()
        outside = ((ratio - 1).abs() > epsilon).float()
        return loss, torch.stack([(ratio - 1 - log_ratio).mean(), outside.mean(), entropy]).detach()

    def update(
        self, batch: Batch, returns: Mapping[str, np.ndarray], minibatches: Minibatches
    ) -> Update:
        """As `Learner` says. The losses are summed: the networks share no weights."""
        for order in minibatches.epochs:
            told = np.zeros(3)
            for chosen in np.split(order, minibatches.ends[:-1]):
                targets = {kind: values[chosen] for kind, values in returns.items()}
                loss, means = self.losses(Batch(*(part[chosen] for part in batch)), targets)
                self.optimiser.zero_grad()
                loss.backward()
                most = self.config.max_gradient_norm or math.inf
                norms = {n: clip_grad_norm_(part, most).item() for n, part in self.weights.items()}
                self.optimiser.step()
                told += means.numpy() * len(chosen) / len(order)
        return Update(norms, *told.tolist())

    @staticmethod
    def acting(policy: Policy, normalisation: Normalisation) -> ActingPolicy:
        return NetworkActing(policy, normalisation)

    def policy_gradients(
        self, observations: np.ndarray, actions: np.ndarray, advantages: list[np.ndarray]
    ) -> list[np.ndarray]:
        log_probs = self.actor(from_numpy(observations)).log_prob(from_numpy(actions))
        gradients = []
        for item in advantages:
            mean = (log_probs * from_numpy(item.astype(np.float32))).mean()
            parts = torch.autograd.grad(
                mean, self.weights["actor"], retain_graph=True, materialize_grads=True
            )
            gradients.append(torch.cat([part.ravel() for part in parts]).numpy())
        return gradients

    def preconditioned(self, direction: np.ndarray) -> np.ndarray:
        """As `Learner` says. `direction` is 0 for weights that have had no gradient."""
        states = [self.optimiser.state.get(part) or None for part in self.weights["actor"]]
        if not any(states):
            return direction
        units = [
            torch.ones_like(part)
            if state is None
            else (state["exp_avg_sq"] / (1 - DECAY_SQUARE ** state["step"])).sqrt() + EPSILON
            for part, state in zip(self.weights["actor"], states, strict=True)
        ]
        return direction / torch.cat([part.detach().ravel() for part in units]).numpy()
