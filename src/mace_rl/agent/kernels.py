"""The compiled functions of the networks and the policy (numba).

Networks of 64 units are too small for a tensor library, whose calls cost more than the work in
them. Acting is float32 in a fixed order of operations, so the ordinary rollout, which calls
`act_discrete` or `act_box` step by step, and the compiled one, which runs the same functions inside
its loop, take the same actions to the bit.

A network is a flat vector of parameters, per layer the weights [in, out] row by row, then the
biases [out], and its sizes, int64 [layers + 1].
"""

import math

import numpy as np
import scipy.linalg.cython_blas  # noqa: F401  (np.dot's, loaded before threads are limited)
from numba import njit

# "contract" lets a product and a sum become one instruction; more than that would lose NaN, by
# which a run that goes bad is noticed. Division by zero is Inf, not an error, which would keep
# loops from becoming vector operations.
kernel = njit(cache=True, fastmath={"contract"}, error_model="numpy")


@kernel
def tanh(x):
    """Hyperbolic tangent of a float32 or float64 to 2e-7, as arithmetic that loops vectorise.

    tanh 2y = 2t / (1 + t²) with t = tanh y ≈ y p(y²) / q(y²), Lambert's continued fraction cut off
    after its seventh term: an error of 1e-8, and float32's rounding, by which the result can exceed
    1. From x = 9.2 on all is 1 in float32. NaN stays NaN: mind the order of arguments below.
    """
    y = x * np.float32(0.5)
    y = min(max(y, np.float32(-4.6)), np.float32(4.6))
    s = y * y
    p = y * (((s + np.float32(378)) * s + np.float32(17325)) * s + np.float32(135135))
    q = ((np.float32(28) * s + np.float32(3150)) * s + np.float32(62370)) * s + np.float32(135135)
    return np.float32(2) * p * q / (q * q + p * p)


@kernel
def network_outputs(activations, parameters, sizes):
    """Fill in a tanh network's activations for N inputs.

    activations: the inputs, [N, sizes[0]], then an array to fill for each layer, [N, sizes[1]] ...,
    the outputs last; contiguous and of one type, as a tuple.
    """
    start = 0
    for layer in range(len(sizes) - 1):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        biases = start + inputs * outputs
        result = activations[layer + 1]
        np.dot(activations[layer], parameters[start:biases].reshape(inputs, outputs), result)
        start = biases + outputs
        bias = parameters[biases:start]
        if layer < len(sizes) - 2:
            for n in range(len(result)):
                for j in range(outputs):
                    result[n, j] = tanh(result[n, j] + bias[j])
        else:
            for n in range(len(result)):
                for j in range(outputs):
                    result[n, j] += bias[j]


@kernel
def network_gradient(activations, grad_outputs, parameters, sizes):
    """Gradient, [n], with respect to the parameters of a loss.

    grad_outputs: the loss's gradient at the outputs, [N, out]; activations: as `network_outputs`
    left them. Parameters past the last layer's get 0.
    """
    gradient = np.zeros_like(parameters)
    grad = grad_outputs
    end = 0
    for layer in range(len(sizes) - 1):
        end += (sizes[layer] + 1) * sizes[layer + 1]
    for layer in range(len(sizes) - 2, -1, -1):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        biases = end - outputs
        start = biases - inputs * outputs
        hidden = activations[layer]
        np.dot(hidden.T, grad, gradient[start:biases].reshape(inputs, outputs))
        bias = gradient[biases:end]
        for n in range(len(grad)):
            for j in range(outputs):
                bias[j] += grad[n, j]
        if layer > 0:
            weights = parameters[start:biases].reshape(inputs, outputs)
            grad = np.dot(grad, weights.T)
            flat, flat_hidden = grad.ravel(), hidden.ravel()
            for k in range(len(flat)):
                flat[k] *= np.float32(1) - flat_hidden[k] * flat_hidden[k]  # tanh'
        end = start
    return gradient


@kernel
def forward(observation, parameters, sizes):
    """Output of a tanh network for one observation, [sizes[0]]; float32 [sizes[-1]]."""
    activation = observation
    start = 0
    for layer in range(len(sizes) - 1):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        biases = start + inputs * outputs
        weights = parameters[start:biases].reshape(inputs, outputs)
        start = biases + outputs
        result = parameters[biases:start].copy()
        # Inputs outside, outputs inside: the inner loop is a vector operation without reduction.
        for i in range(inputs):
            value, row = activation[i], weights[i]
            for j in range(len(result)):
                result[j] += value * row[j]
        if layer < len(sizes) - 2:
            for j in range(len(result)):
                result[j] = tanh(result[j])
        activation = result
    return activation


@kernel
def log_sum_exp(logits):
    """log Σ exp of a vector, without overflow."""
    largest = logits[0]
    for logit in logits:
        largest = max(largest, logit)
    total = np.float32(0.0)
    for logit in logits:
        total += math.exp(logit - largest)
    return largest + math.log(total)


@kernel
def categorical_log_probs(logits, actions):
    """log π(a|s), [N], of a softmax policy; logits: [N, actions], actions: int64 [N]."""
    result = np.empty(len(logits), logits.dtype)
    for n in range(len(logits)):
        result[n] = logits[n, actions[n]] - log_sum_exp(logits[n])
    return result


@kernel
def categorical_grad(logits, actions, weights, entropy_weight):
    """Gradient of Σ_n (w_n log π(a_n|s_n) + entropy_weight · H(π(·|s_n))) at the logits.

    logits: [N, actions]; actions: int64 [N]; weights: [N]. Returns an array like `logits`, and
    Σ_n H(π(·|s_n)).
    """
    grad = np.empty_like(logits)
    total_entropy = 0.0
    for n in range(len(logits)):
        log_total = log_sum_exp(logits[n])
        entropy = 0.0
        for j in range(logits.shape[1]):
            log_prob = logits[n, j] - log_total
            entropy -= math.exp(log_prob) * log_prob
        total_entropy += entropy
        for j in range(logits.shape[1]):
            log_prob = logits[n, j] - log_total
            prob = math.exp(log_prob)
            grad[n, j] = -prob * (weights[n] + entropy_weight * (log_prob + entropy))
        grad[n, actions[n]] += weights[n]
    return grad, total_entropy


@kernel
def gaussian_log_probs(means, log_std, actions):
    """log π(a|s) of a diagonal Gaussian policy, [N]; means and actions: [N, actions]."""
    inverse_std = np.exp(-log_std)
    constant = log_std.sum() + 0.5 * math.log(2 * math.pi) * len(log_std)
    result = np.empty(len(means), means.dtype)
    for n in range(len(means)):
        squares = 0.0
        for j in range(len(log_std)):
            squares += ((actions[n, j] - means[n, j]) * inverse_std[j]) ** 2
        result[n] = -0.5 * squares - constant
    return result


@kernel
def gaussian_grads(means, log_std, actions, weights, entropy_weight):
    """Gradient of Σ_n (w_n log π(a_n|s_n) + entropy_weight · H(π(·|s_n))) at the means and log_std.

    means and actions: [N, actions]; weights: [N]. Returns arrays like `means` and `log_std`, and
    Σ_n H(π(·|s_n)).
    """
    inverse_std = np.exp(-log_std)
    grad = np.empty_like(means)
    log_std_grad = np.full_like(log_std, entropy_weight * len(means))
    for n in range(len(means)):
        for j in range(len(log_std)):
            deviation = (actions[n, j] - means[n, j]) * inverse_std[j]
            grad[n, j] = weights[n] * deviation * inverse_std[j]
            log_std_grad[j] += weights[n] * (deviation * deviation - 1)
    entropy = log_std.sum() + 0.5 * (1 + math.log(2 * math.pi)) * len(log_std)
    return grad, log_std_grad, entropy * len(means)


@kernel
def surrogate_weights(log_probs, old_log_probs, advantages, clip):
    """What the gradient of PPO's clipped surrogate weighs each ∇ log π(a|s) with, float32 [N].

    The surrogate min(rA, clip(r)A), with ratio r, is flat where the ratio is already past the bound
    that the advantage pushes it to; elsewhere its gradient is r A ∇ log π.

    Returns also the sums over n of r - 1 - log r, whose mean estimates the KL divergence from the
    policy that acted (Schulman 2020), and of whether r is outside the bounds.
    """
    weights = np.zeros(len(log_probs), np.float32)
    divergence, outside = 0.0, 0
    for n in range(len(weights)):
        log_ratio = log_probs[n] - old_log_probs[n]
        ratio, advantage = math.exp(log_ratio), advantages[n]
        flat = ratio > 1 + clip if advantage > 0 else ratio < 1 - clip
        if not flat:
            weights[n] = ratio * advantage
        divergence += ratio - 1 - log_ratio
        outside += abs(ratio - 1) > clip
    return weights, divergence, outside


@njit(cache=True)
def normalise(observation, mean, inverse_std, clip):
    """(observation - mean) / std, clipped to ±clip; float32 [size]."""
    result = np.empty(observation.shape[0], np.float32)
    for i in range(observation.shape[0]):
        value = (observation[i] - mean[i]) * inverse_std[i]
        result[i] = min(max(value, -clip), clip)
    return result


@njit(cache=True, error_model="numpy")
def sample_categorical(logits, uniform):
    """Sample a categorical action by inverting its distribution function at `uniform` in [0, 1).

    Returns (action from 0, log-probability as float32).
    """
    largest = logits.max()
    total = np.float32(0.0)
    for i in range(logits.shape[0]):
        total += math.exp(logits[i] - largest)
    cumulative = 0.0
    action = logits.shape[0] - 1  # stays if rounding leaves the sum below `uniform`
    for i in range(logits.shape[0]):
        cumulative += math.exp(logits[i] - largest) / total
        if uniform < cumulative:
            action = i
            break
    return action, np.float32(logits[action] - largest - math.log(total))


@njit(cache=True)
def sample_gaussian(means, log_std, normal):
    """Sample a diagonal Gaussian action, means + exp(log_std) · normal; `normal`: [actions].

    Returns (action float32 [actions], not clipped to the bounds; log-probability as float32).
    """
    action = np.empty(means.shape[0], np.float32)
    log_prob = 0.0
    for i in range(means.shape[0]):
        action[i] = means[i] + math.exp(log_std[i]) * normal[i]
        log_prob -= 0.5 * normal[i] * normal[i] + log_std[i] + 0.5 * math.log(2 * math.pi)
    return action, np.float32(log_prob)


@njit(cache=True, error_model="numpy")
def act_discrete(observation, mean, inverse_std, clip, parameters, sizes, uniform):
    """`sample_categorical` from the network's logits for one observation, not yet normalised."""
    logits = forward(normalise(observation, mean, inverse_std, clip), parameters, sizes)
    return sample_categorical(logits, uniform)


@njit(cache=True)
def act_box(observation, mean, inverse_std, clip, parameters, sizes, log_std, normal):
    """`sample_gaussian` around the network's means for one observation, not yet normalised."""
    means = forward(normalise(observation, mean, inverse_std, clip), parameters, sizes)
    return sample_gaussian(means, log_std, normal)
