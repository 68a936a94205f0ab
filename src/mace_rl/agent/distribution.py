"""Distributions over actions: softmax for Discrete ones, else a diagonal Gaussian; compiled.

The Gaussian's log standard deviations, `log_std`, float32 [actions], do not depend on the state.
For other actions `log_std` is empty. Actions of several parts (MultiDiscrete, MultiBinary) have an
independent softmax each: `parts`, int64 [parts], has the number of choices in each, whose logits
follow one another; it is empty for Discrete and Box actions.
"""

import numpy as np

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import HALF_LOG_TAU, exp, f32, log
from mace_rl.numerics.matmul import padded


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
def log_probs(outputs, log_std, actions, parts):
    """log π(a|s), float32 [N].

    outputs: logits or means, [N, outputs]; actions: int64 [N], int64 [N, parts] or float32
    [N, actions].
    """
    result = np.empty(len(outputs), np.float32)
    if actions.ndim == 1:
        for n in range(len(actions)):
            result[n] = outputs[n, actions[n]] - log_sum_exp(outputs[n])
    elif len(parts):
        result[:] = 0
        first = 0
        for j in range(len(parts)):
            for n in range(len(actions)):
                logits = outputs[n, first : first + parts[j]]
                result[n] += logits[int(actions[n, j])] - log_sum_exp(logits)
            first += parts[j]
    else:
        for n in range(len(actions)):
            total = f32(0)
            for j in range(len(log_std)):
                deviation = (actions[n, j] - outputs[n, j]) * exp(-log_std[j])
                total -= f32(0.5) * deviation * deviation + log_std[j] + f32(HALF_LOG_TAU)
            result[n] = total
    return result


@kernel
def softmax_gradient(logits, chosen, weight, entropy_weight, grad):
    """Of weight · log π(chosen) + entropy_weight · H at `logits`, into `grad`, 0 before; H."""
    log_total, entropy = log_sum_exp(logits), f32(0)
    for i in range(len(logits)):
        log_prob = logits[i] - log_total
        grad[i] = exp(log_prob)
        entropy -= grad[i] * log_prob
    for i in range(len(logits)):
        log_prob = logits[i] - log_total
        grad[i] *= -(weight + entropy_weight * (log_prob + entropy))
    grad[chosen] += weight
    return entropy


@kernel
def log_prob_gradient(outputs, log_std, actions, weights, entropy_weight, grad_log_std, parts):
    """Gradient of Σ_n (w_n log π(a_n|s_n) + entropy_weight · H(π(·|s_n))) at outputs and log_std.

    weights: float32 [N]; outputs, log_std, actions, parts: as in `log_probs`. Adds to grad_log_std,
    like log_std. Returns the gradient at the outputs, [N, padded], and the entropies H, [N].
    """
    entropy_weight = f32(entropy_weight)
    grad = np.zeros((len(outputs), padded(outputs.shape[1])), np.float32)
    entropies = np.empty(len(outputs))
    if actions.ndim == 1:
        for n in range(len(actions)):
            logits, grad_logits = outputs[n], grad[n, : outputs.shape[1]]
            entropies[n] = softmax_gradient(
                logits, actions[n], weights[n], entropy_weight, grad_logits
            )
    elif len(parts):
        entropies[:] = 0
        first = 0
        for j in range(len(parts)):
            end = first + parts[j]
            for n in range(len(actions)):
                logits, grad_logits = outputs[n, first:end], grad[n, first:end]
                entropies[n] += softmax_gradient(
                    logits, int(actions[n, j]), weights[n], entropy_weight, grad_logits
                )
            first = end
    else:
        entropies[:] = 0
        for j in range(len(log_std)):
            entropies += log_std[j] + f32(HALF_LOG_TAU + 0.5)
            inverse_std = exp(-log_std[j])
            for n in range(len(actions)):
                deviation = (actions[n, j] - outputs[n, j]) * inverse_std
                grad[n, j] = weights[n] * deviation * inverse_std
                grad_log_std[j] += weights[n] * (deviation * deviation - f32(1)) + entropy_weight
    return grad, entropies


@kernel
def sample_categorical(logits, uniform):
    """An action from 0 and its log-probability; uniform: in [0, 1), where the CDF is inverted."""
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
    """An action, means + exp(log_std) · normal, float32 [actions], and its log-probability."""
    action = np.empty(len(log_std), np.float32)
    for i in range(len(log_std)):
        action[i] = means[i] + exp(log_std[i]) * f32(normal[i])
    parts = np.empty(0, np.int64)
    return action, log_probs(means.reshape(1, -1), log_std, action.reshape(1, -1), parts)[0]


@kernel
def sample_parts(logits, parts, uniforms):
    """An action of several parts, int64 [parts], and its log-probability; uniforms: [parts]."""
    action, total, first = np.empty(len(parts), np.int64), f32(0), 0
    for j in range(len(parts)):
        end = first + parts[j]
        action[j], log_prob = sample_categorical(logits[first:end], uniforms[j])
        total += log_prob
        first = end
    return action, total
