"""An update's K epochs over its minibatches in one compiled call, for a policy or a critic.

The gradient of a minibatch is a sum over its steps, in order. `products` continue a sum where it
was left, so the steps go through the network in blocks that fit into the processor's nearest cache,
with the bits that all at once would have.
"""

import numpy as np

from mace_rl.agent import adam
from mace_rl.agent.kernels import (
    backward,
    forward,
    kernel,
    log_prob_gradient,
    log_probs,
    room_for,
    surrogate_weights,
    transposed,
)

BLOCK = 64  # steps; 32 to 128 are as fast


@kernel
def improve_policy(
    observations,
    actions,
    old_log_probs,
    advantages,
    epochs,
    ends,
    sizes,
    log_std_at,
    clip,
    entropy_coefficient,
    optimiser,
):
    """Descend PPO's clipped surrogate and entropy bonus (Schulman et al. 2017, eq. 7).

    observations: float32 [N, observation]; actions, old_log_probs, advantages: [N, …], see `Batch`;
    epochs: int64 [K, N], the steps in the order of each epoch; ends: int64 [M], where its
    minibatches end; sizes: the network's; log_std_at: where its parameters end in the policy's;
    optimiser: `Adam.state`, the parameters first.

    Returns the last minibatch's gradient norm and the last epoch's sums over its steps: of the KL
    divergence, of ratios outside the bounds, and of the policy's entropy.
    """
    parameters = optimiser[0]
    log_std, outs = parameters[log_std_at:], sizes[-1]
    seen = np.empty((BLOCK, observations.shape[1]), np.float32)
    done = actions[:BLOCK].copy()
    old, gain = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    new, weights = np.empty_like(old), np.empty_like(old)
    activations, room = room_for(BLOCK, sizes), room_for(BLOCK, sizes)
    gradient, nobody_s = np.empty_like(parameters), np.empty((0, 0), np.float32)
    sums, norm = np.zeros(3), 0.0
    for order in epochs:
        sums[:] = 0
        first = 0
        for end in ends:
            back = transposed(parameters, sizes)
            gradient[:] = 0
            share = -1 / (end - first)
            for start in range(first, end, BLOCK):
                chosen = order[start : min(start + BLOCK, end)]
                count = len(chosen)
                for n in range(count):
                    seen[n] = observations[chosen[n]]
                    done[n] = actions[chosen[n]]
                    old[n], gain[n] = old_log_probs[chosen[n]], advantages[chosen[n]]
                outputs = forward(seen[:count], parameters, sizes, activations)
                grad = np.zeros_like(outputs)
                log_probs(outputs[:, :outs], log_std, done[:count], new[:count])
                surrogate_weights(
                    *(new[:count], old[:count], gain[:count], clip, share, weights[:count], sums),
                )
                log_prob_gradient(
                    *(outputs[:, :outs], log_std, done[:count], weights[:count]),
                    *(share * entropy_coefficient, grad[:, :outs], gradient[log_std_at:], sums),
                )
                backward(seen[:count], activations, grad, back, sizes, gradient, room, nobody_s)
            norm = adam.step(gradient, *optimiser)
            first = end
    return norm, sums


@kernel
def improve_values(observations, returns, epochs, ends, sizes, optimiser):
    """Descend the mean squared error of V(s) against the λ-returns, float32 [N].

    The other arguments as in `improve_policy`. Returns the last minibatch's gradient norm.
    """
    parameters = optimiser[0]
    seen = np.empty((BLOCK, observations.shape[1]), np.float32)
    activations, room = room_for(BLOCK, sizes), room_for(BLOCK, sizes)
    gradient, nobody_s = np.empty_like(parameters), np.empty((0, 0), np.float32)
    norm = 0.0
    for order in epochs:
        first = 0
        for end in ends:
            back = transposed(parameters, sizes)
            gradient[:] = 0
            for start in range(first, end, BLOCK):
                chosen = order[start : min(start + BLOCK, end)]
                for n in range(len(chosen)):
                    seen[n] = observations[chosen[n]]
                inputs = seen[: len(chosen)]
                values = forward(inputs, parameters, sizes, activations)
                grad = np.zeros_like(values)
                for n in range(len(chosen)):
                    grad[n, 0] = value_grad(values[n, 0], returns[chosen[n]], end - first)
                backward(inputs, activations, grad, back, sizes, gradient, room, nobody_s)
            norm = adam.step(gradient, *optimiser)
            first = end
    return norm


@kernel
def value_grad(value, target, count):
    """Gradient of the mean of `count` squared errors at one of the values."""
    return np.float32(2 / count) * (value - target)


@kernel
def policy_gradients(observations, actions, weights, parameters, sizes, log_std_at):
    """∇_θ Σ_t w_t log π(a_t|s_t) for each row of weights, float32 [K, N]; float32 [K, n].

    parameters: the policy's; the other arguments as in `improve_policy`.
    """
    log_std, outs = parameters[log_std_at:], sizes[-1]
    activations, room = room_for(BLOCK, sizes), room_for(BLOCK, sizes)
    back, sums = transposed(parameters, sizes), np.zeros(3)
    gradients = np.zeros((len(weights), len(parameters)), np.float32)
    nobody_s = np.empty((0, 0), np.float32)
    for start in range(0, len(observations), BLOCK):
        end = min(start + BLOCK, len(observations))
        seen, done = observations[start:end], actions[start:end]
        outputs = forward(seen, parameters, sizes, activations)
        grad = np.zeros_like(outputs)
        for k in range(len(weights)):
            log_prob_gradient(
                *(outputs[:, :outs], log_std, done, weights[k, start:end], 0.0),
                *(grad[:, :outs], gradients[k, log_std_at:], sums),
            )
            backward(seen, activations, grad, back, sizes, gradients[k], room, nobody_s)
    return gradients
