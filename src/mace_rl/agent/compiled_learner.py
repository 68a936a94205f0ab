"""PPO's update in compiled code: K epochs over the minibatches in one call for each network.

It computes what `TorchLearner` does, with gradients written out. A minibatch goes through the
network in blocks that fit into the nearest cache: `matmul` continue the sum over steps.
"""

import math
from collections.abc import Mapping
from typing import cast

import numpy as np

from mace_rl.agent.distribution import log_prob_gradient, log_probs
from mace_rl.agent.learner import Batch, Minibatches, Update, parameters_of
from mace_rl.agent.policy import ActingPolicy, CompiledActing, Policy
from mace_rl.base.state import Stateful
from mace_rl.config.agent import PPOConfig
from mace_rl.numerics.adam import Adam, step
from mace_rl.numerics.arrays import mean
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import exp, f32
from mace_rl.numerics.matmul import padded
from mace_rl.numerics.network import CompiledMLP
from mace_rl.numerics.network_kernels import activation_buffer, backward, forward, transposed
from mace_rl.numerics.normaliser import Normalisation

BLOCK = 64  # steps; 32 to 128 are as fast


class CompiledLearner(Stateful):
    """A `Learner` for policies and critics of `CompiledMLP`."""

    STATE = ("optimisers",)  # they hold the parameters

    def __init__(
        self, config: PPOConfig, policy: Policy, critics: Mapping[str, CompiledMLP]
    ) -> None:
        self.config, self.policy, self.critics = config, policy, critics
        self.network = cast(CompiledMLP, policy.network)
        rates = dict.fromkeys(critics, config.critic_learning_rate)
        rates["actor"] = config.actor_learning_rate
        self.parameters = parameters_of(policy, critics)
        self.optimisers = {
            name: Adam(parameters, rates[name], config.max_gradient_norm or math.inf)
            for name, parameters in self.parameters.items()
        }

    @staticmethod
    def acting(policy: Policy, normalisation: Normalisation) -> ActingPolicy:
        network = cast(CompiledMLP, policy.network)
        of_network = network.parameters, network.sizes, policy.log_std, policy.parts
        return CompiledActing(normalisation, *of_network, *network.scratch)

    def update(
        self, batch: Batch, returns: Mapping[str, np.ndarray], minibatches: Minibatches
    ) -> Update:
        """As `Learner` says: each network goes through all epochs before the next one."""
        adam = {name: optimiser.state for name, optimiser in self.optimisers.items()}
        norm, approximate_kl, clip_fraction, entropy = update_policy(
            batch,
            minibatches,
            self.network.sizes,
            self.config.clip,
            self.config.entropy_coefficient,
            self.config.learn_log_std,
            adam["actor"],
            self.policy.parts,
        )
        norms = {"actor": norm}
        for kind, critic in self.critics.items():
            norms[kind] = update_critic(
                batch.observations, returns[kind], minibatches, critic.sizes, adam[kind]
            )
        return Update(norms, approximate_kl, clip_fraction, entropy)

    def policy_gradients(
        self, observations: np.ndarray, actions: np.ndarray, advantages: list[np.ndarray]
    ) -> list[np.ndarray]:
        observations = np.ascontiguousarray(observations, np.float32)
        parameters = self.policy.parameters
        gradients = policy_gradients(
            observations,
            actions,
            np.stack(advantages),
            parameters,
            self.network.sizes,
            self.policy.parts,
        )
        if not self.config.learn_log_std:
            gradients[:, len(parameters) - len(self.policy.log_std) :] = 0
        return list(gradients)

    def preconditioned(self, direction: np.ndarray) -> np.ndarray:
        return self.optimisers["actor"].preconditioned(direction)


@kernel
def update_policy(steps, minibatches, sizes, clip, entropy_coefficient, learn_log_std, adam, parts):
    """Descend the clipped surrogate and entropy bonus (Schulman et al. 2017, eq. 7).

    steps: a `Batch`; sizes: the network's; adam: an `AdamState`, whose parameters are a `Policy`'s;
    parts: its.

    Returns the fields of an `Update`, with this network's gradient norm alone.
    """
    parameters, count = adam.parameters, len(steps.advantages)
    log_std = log_std_part(parameters, sizes)
    activations, scratch = activation_buffer(BLOCK, sizes), activation_buffer(BLOCK, sizes)
    gradient, norm = np.empty_like(parameters), 0.0
    new_log_probs, entropies = np.empty(count, np.float32), np.empty(count)
    for order in minibatches.epochs:
        first = 0
        for end in minibatches.ends:
            back = transposed(parameters, sizes)
            gradient[:] = 0
            grad_log_std, share = log_std_part(gradient, sizes), -1 / (end - first)
            for start in range(first, end, BLOCK):
                stop = min(start + BLOCK, end)
                chosen, new = order[start:stop], new_log_probs[start:stop]
                observations = gather(steps.observations, chosen)
                actions = gather(steps.actions, chosen)
                outputs = forward(observations, parameters, sizes, activations)[:, : sizes[-1]]
                new[:] = log_probs(outputs, log_std, actions, parts)
                weights = surrogate_weights(new, steps, chosen, clip, share)
                grad, entropies[start:stop] = log_prob_gradient(
                    outputs,
                    log_std,
                    actions,
                    weights,
                    share * entropy_coefficient,
                    grad_log_std,
                    parts,
                )
                backward(observations, activations, grad, back, sizes, gradient, scratch)
            if not learn_log_std:
                grad_log_std[:] = 0
            norm = step(gradient, adam)
            first = end
    old_log_probs = gather(steps.log_probs, minibatches.epochs[-1])
    return norm, *policy_change(new_log_probs, old_log_probs, clip), mean(entropies)


@kernel
def update_critic(observations, returns, minibatches, sizes, adam):
    """`update_policy` for V(s), by the mean squared error against the λ-returns, float32 [N]."""
    parameters = adam.parameters
    activations, scratch = activation_buffer(BLOCK, sizes), activation_buffer(BLOCK, sizes)
    gradient, norm = np.empty_like(parameters), 0.0
    for order in minibatches.epochs:
        first = 0
        for end in minibatches.ends:
            back = transposed(parameters, sizes)
            gradient[:] = 0
            for start in range(first, end, BLOCK):
                chosen = order[start : min(start + BLOCK, end)]
                states = gather(observations, chosen)
                values = forward(states, parameters, sizes, activations)
                grad = np.zeros_like(values)
                for n in range(len(chosen)):
                    grad[n, 0] = f32(2 / (end - first)) * (values[n, 0] - returns[chosen[n]])
                backward(states, activations, grad, back, sizes, gradient, scratch)
            norm = step(gradient, adam)
            first = end
    return norm


@kernel
def policy_gradients(observations, actions, advantages, parameters, sizes, parts):
    """∇_θ of the mean of log π(a|s) · A for each row of advantages, [K, N]; float32 [K, n]."""
    weights = (advantages / len(observations)).astype(np.float32)
    log_std, back = log_std_part(parameters, sizes), transposed(parameters, sizes)
    activations, scratch = activation_buffer(BLOCK, sizes), activation_buffer(BLOCK, sizes)
    gradients = np.zeros((len(weights), len(parameters)), np.float32)
    for start in range(0, len(observations), BLOCK):
        end = min(start + BLOCK, len(observations))
        states, chosen = observations[start:end], actions[start:end]
        outputs = forward(states, parameters, sizes, activations)[:, : sizes[-1]]
        for k in range(len(weights)):
            grad_log_std = log_std_part(gradients[k], sizes)
            grad, _ = log_prob_gradient(
                outputs, log_std, chosen, weights[k, start:end], 0.0, grad_log_std, parts
            )
            backward(states, activations, grad, back, sizes, gradients[k], scratch)
    return gradients


@kernel
def log_std_part(vector, sizes):
    """The part for log_std of a vector like a `Policy`'s parameters: what follows the network's."""
    count = 0
    for layer in range(len(sizes) - 1):
        count += (sizes[layer] + 1) * padded(sizes[layer + 1])
    return vector[count:]


@kernel
def gather(array, chosen):
    """The chosen rows, or elements, of an array, [N, …]."""
    result = np.empty((len(chosen), *array.shape[1:]), array.dtype)
    for n in range(len(chosen)):
        result[n] = array[chosen[n]]
    return result


@kernel
def surrogate_weights(new_log_probs, steps, chosen, clip, scale):
    """The weight of each ∇ log π(a|s) in the gradient of PPO's clipped surrogate, float32 [N].

    The surrogate min(rA, clip(r)A) is flat where the ratio r is beyond the bound to which the
    advantage A pushes it. Elsewhere its gradient is r A ∇ log π, here times `scale`.
    """
    weights = np.empty_like(new_log_probs)
    for n in range(len(weights)):
        ratio = exp(new_log_probs[n] - steps.log_probs[chosen[n]])
        advantage = steps.advantages[chosen[n]]
        flat = ratio > 1 + clip if advantage > 0 else ratio < 1 - clip
        weights[n] = f32(0) if flat else f32(scale) * ratio * advantage
    return weights


@kernel
def policy_change(new_log_probs, old_log_probs, clip):
    """Approximate KL divergence and clip fraction, from log π(a|s) of both policies, float32 [N].

    The former is the mean of r - 1 - log r (Schulman 2020), the latter the share of the ratios r
    outside the clipping bounds.
    """
    divergence, outside = 0.0, 0.0
    for n in range(len(new_log_probs)):
        log_ratio = new_log_probs[n] - old_log_probs[n]
        ratio = exp(log_ratio)
        divergence += ratio - f32(1) - log_ratio
        outside += abs(ratio - 1) > clip
    return divergence / len(new_log_probs), outside / len(new_log_probs)
