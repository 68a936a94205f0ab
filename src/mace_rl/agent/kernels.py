"""The compiled functions of the networks and the policy (numba).

Networks of 64 units are too small for a tensor library, whose calls cost more than the work in
them. All arithmetic is float32, in an order that is written here or in `products` and `elementary`,
so the bits are the same on every processor, for one state as for many, step by step as in one loop.

A network is a flat vector of parameters and its sizes, int64 [layers + 1]. A layer's parameters are
its weights and, as the last row, its biases, [in + 1, padded out]: products want their columns in
multiples of 16, so columns of zeros are added. Their gradient is 0, so they stay zeros.
"""

import math

import numpy as np

from mace_rl.agent.elementary import exp, log, tanh
from mace_rl.agent.products import add_product, address, by_tiles, dot, padded, product
from mace_rl.compiling import njit

# Division by zero is Inf, not an error, which would keep loops from becoming vector operations.
kernel = njit(cache=True, error_model="numpy")
HALF_LOG_TAU = 0.9189385332046727  # log √(2π)
f32 = np.float32


@kernel
def room_for(count, sizes):
    """Room for what every layer puts out for `count` inputs, flat: [count, padded out] each."""
    width = 0
    for outs in sizes[1:]:
        width += padded(outs)
    return np.empty(count * width, np.float32)


@kernel
def forward(inputs, parameters, sizes, activations):
    """A tanh network's outputs for N inputs, a view of `activations`, [N, padded out].

    inputs: [N, in]; activations: from `room_for` at least N, filled with what every layer puts out.
    """
    below, below_row = address(inputs), inputs.shape[1]
    weights, end, width = address(parameters), 0, 0
    for layer in range(len(sizes) - 1):
        ins, width = sizes[layer], padded(sizes[layer + 1])
        bias = weights + 4 * ins * width
        above = activations[end : end + len(inputs) * width]
        by_tiles(
            *(below, below_row, 1, weights, width, bias, 0),
            *(address(above), width, len(inputs), width, ins),
        )
        if layer < len(sizes) - 2:
            for k in range(len(above)):
                above[k] = tanh(above[k])
        below, below_row, weights = address(above), width, bias + 4 * width
        end += len(above)
    return activations[end - len(inputs) * width : end].reshape(len(inputs), width)


@kernel
def transposed(parameters, sizes):
    """The weights of each layer, transposed for `backward`, [out, padded in]."""
    total = 0
    for layer in range(len(sizes) - 1):
        total += sizes[layer + 1] * padded(sizes[layer])
    result = np.zeros(total, np.float32)
    start = place = 0
    for layer in range(len(sizes) - 1):
        ins, outs = sizes[layer], sizes[layer + 1]
        end = start + (ins + 1) * padded(outs)
        weights = parameters[start:end].reshape(ins + 1, padded(outs))
        for j in range(outs):
            row = result[place : place + ins]
            for i in range(ins):
                row[i] = weights[i, j]
            place += padded(ins)
        start = end
    return result


@kernel
def backward(inputs, activations, grad_outputs, back, sizes, gradient, room, grad_inputs):
    """Add to `gradient`, like the parameters, that of a loss.

    inputs, activations: of `forward`; grad_outputs: the loss's gradient at the outputs, [N, padded
    out], with zeros in the columns added; back: the weights `transposed`; room: like `activations`,
    overwritten. grad_inputs: [N, padded in], filled in with the loss's gradient there; or [0, 0].
    """
    count, ones = len(inputs), np.ones((1, len(inputs)), np.float32)
    end = place = below_end = 0
    for layer in range(len(sizes) - 1):
        end += (sizes[layer] + 1) * padded(sizes[layer + 1])
        place += sizes[layer + 1] * padded(sizes[layer])
        if layer > 0:
            below_end += count * padded(sizes[layer])
    grad = grad_outputs
    for layer in range(len(sizes) - 2, -1, -1):
        ins, outs = sizes[layer], sizes[layer + 1]
        start = end - (ins + 1) * padded(outs)
        change = gradient[start:end].reshape(ins + 1, padded(outs))
        end = start
        add_product(ones, grad, change[ins:])
        width = padded(ins)
        weights = back[place - outs * width : place].reshape(outs, width)
        place -= outs * width
        if layer == 0:
            add_product(inputs.T, grad, change[:ins])
            if len(grad_inputs) > 0:
                product(grad, weights, np.zeros(width, np.float32), grad_inputs)
            break
        below_start = below_end - count * width
        below, flat = activations[below_start:below_end], room[below_start:below_end]
        below_end = below_start
        add_product(below.reshape(count, width).T, grad, change[:ins])
        grad_below = flat.reshape(count, width)
        product(grad, weights, np.zeros(width, np.float32), grad_below)
        for k in range(len(flat)):
            flat[k] *= f32(1) - below[k] * below[k]  # tanh'
        grad = grad_below


@kernel
def network_outputs(inputs, parameters, sizes):
    """A tanh network's outputs for N inputs, [N, out], and its activations."""
    activations = room_for(len(inputs), sizes)
    outputs = forward(inputs, parameters, sizes, activations)
    return outputs[:, : sizes[-1]].copy(), activations


@kernel
def network_gradient(inputs, activations, parameters, grad_outputs, sizes, grad_inputs):
    """Gradient, like the parameters, of a loss.

    activations: of `network_outputs`; grad_outputs: the loss's gradient at the outputs, [N, out];
    grad_inputs: see `backward`.
    """
    padded_grad = np.zeros((len(inputs), padded(sizes[-1])), np.float32)
    padded_grad[:, : sizes[-1]] = grad_outputs
    gradient = np.zeros_like(parameters)
    back, room = transposed(parameters, sizes), np.empty_like(activations)
    backward(inputs, activations, padded_grad, back, sizes, gradient, room, grad_inputs)
    return gradient


@kernel
def orthonormal(matrix):
    """Orthonormal columns that span what the columns of `matrix` do, float64 [M, N], M ≥ N.

    Gram and Schmidt's, each column twice for the sake of rounding. Of a Gaussian matrix it is
    uniform over all that are possible.
    """
    result = matrix.copy()
    for j in range(result.shape[1]):
        column = result[:, j].copy()
        for before in range(2 * j):
            other = result[:, before % j].copy()
            along = dot(other, column)
            for i in range(len(column)):
                column[i] -= along * other[i]
        result[:, j] = column / math.sqrt(dot(column, column))
    return result


@kernel
def shuffled(draws):
    """Permutations of N, int64 [K, N], by Fisher and Yates, from draws in [0, 1), [K, N].

    The k-th is uniform if the draws are; a draw of almost 1 leaves a place as it is.
    """
    order = np.empty(draws.shape, np.int64)
    for k in range(len(draws)):
        for n in range(draws.shape[1]):
            order[k, n] = n
        for n in range(draws.shape[1] - 1, 0, -1):
            other = min(int(draws[k, n] * (n + 1)), n)
            order[k, n], order[k, other] = order[k, other], order[k, n]
    return order


@kernel
def log_sum_exp(logits):
    """log Σ exp of a vector, without overflow."""
    largest = logits[0]
    for logit in logits:
        largest = max(largest, logit)
    total = f32(0)
    for logit in logits:
        total += exp(logit - largest)
    return largest + log(total)


@kernel
def log_probs(outputs, log_std, actions, result):
    """Fill in log π(a|s), float32 [N]: a softmax policy's, or a diagonal Gaussian's.

    outputs: the network's, [N, ≥ actions]: logits or means; log_std: [actions], empty for Discrete
    actions; actions: int64 [N] or float32 [N, actions].
    """
    if actions.ndim == 1:
        for n in range(len(actions)):
            result[n] = outputs[n, actions[n]] - log_sum_exp(outputs[n])
    else:
        for n in range(len(actions)):
            total = f32(0)
            for j in range(len(log_std)):
                deviation = (actions[n, j] - outputs[n, j]) * exp(-log_std[j])
                total -= f32(0.5) * deviation * deviation + log_std[j] + f32(HALF_LOG_TAU)
            result[n] = total


@kernel
def log_prob_gradient(outputs, log_std, actions, weights, entropy_weight, grad, grad_log_std, sums):
    """Gradient of Σ_n (w_n log π(a_n|s_n) + entropy_weight · H(π(·|s_n))) at outputs and log_std.

    weights: float32 [N]; outputs, log_std, actions: as in `log_probs`. Fills in grad, like outputs,
    and adds to grad_log_std, like log_std, and to sums[2] the entropies H.
    """
    entropy_weight = f32(entropy_weight)
    if actions.ndim == 1:
        for n in range(len(actions)):
            logits = outputs[n]
            log_total, entropy = log_sum_exp(logits), f32(0)
            for j in range(len(logits)):
                log_prob = logits[j] - log_total
                grad[n, j] = exp(log_prob)
                entropy -= grad[n, j] * log_prob
            sums[2] += entropy
            for j in range(len(logits)):
                log_prob = logits[j] - log_total
                grad[n, j] *= -(weights[n] + entropy_weight * (log_prob + entropy))
            grad[n, actions[n]] += weights[n]
    else:
        entropy = 0.0
        for j in range(len(log_std)):
            entropy += log_std[j] + f32(HALF_LOG_TAU + 0.5)
            inverse_std = exp(-log_std[j])
            for n in range(len(actions)):
                deviation = (actions[n, j] - outputs[n, j]) * inverse_std
                grad[n, j] = weights[n] * deviation * inverse_std
                grad_log_std[j] += weights[n] * (deviation * deviation - f32(1)) + entropy_weight
        for _ in range(len(actions)):
            sums[2] += entropy


@kernel
def surrogate_weights(log_probs, old_log_probs, advantages, clip, scale, weights, sums):
    """What the gradient of PPO's clipped surrogate weighs each ∇ log π(a|s) with, float32 [N].

    The surrogate min(rA, clip(r)A), with ratio r, is flat where the ratio is already past the bound
    that the advantage pushes it to; elsewhere its gradient is r A ∇ log π, here times `scale`.

    Adds to sums, float64 [3], r - 1 - log r, whose mean estimates the KL divergence from the
    policy that acted (Schulman 2020), and whether r is outside the bounds; the third is for the
    entropy.
    """
    scale = f32(scale)
    for n in range(len(weights)):
        log_ratio = log_probs[n] - old_log_probs[n]
        ratio, advantage = exp(log_ratio), advantages[n]
        flat = ratio > 1 + clip if advantage > 0 else ratio < 1 - clip
        weights[n] = f32(0) if flat else scale * ratio * advantage
        sums[0] += ratio - f32(1) - log_ratio
        sums[1] += abs(ratio - 1) > clip


@kernel
def normalise(observation, mean, inverse_std, clip, result):
    """Fill in, and return, (observation - mean) / std, clipped to ±clip; float32 [size]."""
    for i in range(len(observation)):
        result[i] = min(max((observation[i] - mean[i]) * inverse_std[i], -clip), clip)
    return result


@kernel
def sample_categorical(logits, uniform):
    """Sample a categorical action by inverting its distribution function at `uniform` in [0, 1).

    Returns (action from 0, log-probability, float32).
    """
    log_total = log_sum_exp(logits)
    cumulative = 0.0
    action = len(logits) - 1  # stays if rounding leaves the sum below `uniform`
    for i in range(len(logits)):
        cumulative += exp(logits[i] - log_total)
        if uniform < cumulative:
            action = i
            break
    return action, logits[action] - log_total


@kernel
def sample_gaussian(means, log_std, normal):
    """Sample a diagonal Gaussian action, means + exp(log_std) · normal; `normal`: [actions].

    Returns (action float32 [actions], not clipped to the bounds; log-probability, float32).
    """
    action = np.empty(len(log_std), np.float32)
    log_prob = np.empty(1, np.float32)
    for i in range(len(log_std)):
        action[i] = means[i] + exp(log_std[i]) * f32(normal[i])
    log_probs(means.reshape(1, -1), log_std, action.reshape(1, -1), log_prob)
    return action, log_prob[0]


@kernel
def act_discrete(observation, policy, uniform):
    """`sample_categorical` from the network's logits for one observation, not yet normalised.

    policy: a `CompiledActing`.
    """
    normalise(observation, policy.mean, policy.inverse_std, policy.clip, policy.seen[0])
    outputs = forward(policy.seen, policy.parameters, policy.sizes, policy.activations)
    return sample_categorical(outputs[0, : policy.sizes[-1]], uniform)


@kernel
def act_box(observation, policy, normal):
    """`sample_gaussian` around the network's means; arguments as in `act_discrete`."""
    normalise(observation, policy.mean, policy.inverse_std, policy.clip, policy.seen[0])
    outputs = forward(policy.seen, policy.parameters, policy.sizes, policy.activations)
    return sample_gaussian(outputs[0, : policy.sizes[-1]], policy.log_std, normal)
