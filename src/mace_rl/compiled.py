"""The compiled inner loops (numba): networks, acting, classic-control episodes.

Networks of 64 units are too small for a tensor library, whose calls cost more than the work in
them. Acting is float32 in a fixed order of operations, so the ordinary rollout, which calls
`act_discrete` or `act_box` step by step, and the compiled one, which runs the same functions inside
its loop, take the same actions to the bit.

A network is a flat vector of parameters, per layer the weights [in, out] row by row, then the
biases [out], and its sizes, int64 [layers + 1]. All compiled functions that call one another stand
in this one file because numba's on-disk cache does not notice changes in other files.
"""

import math

import numpy as np
import scipy.linalg.cython_blas  # noqa: F401  (np.dot's, loaded before threads are limited)
from numba import njit

CARTPOLE, ACROBOT = 0, 1

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
def network_gradient(activations, slope, parameters, sizes):
    """Gradient, [n], with respect to the parameters of a loss.

    slope: the loss's gradient with respect to the outputs, [N, out]; activations: as
    `network_outputs` left them. Parameters past the last layer's get 0.
    """
    gradient = np.zeros_like(parameters)
    end = 0
    for layer in range(len(sizes) - 1):
        end += (sizes[layer] + 1) * sizes[layer + 1]
    for layer in range(len(sizes) - 2, -1, -1):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        biases = end - outputs
        start = biases - inputs * outputs
        hidden = activations[layer]
        np.dot(hidden.T, slope, gradient[start:biases].reshape(inputs, outputs))
        bias = gradient[biases:end]
        for n in range(len(slope)):
            for j in range(outputs):
                bias[j] += slope[n, j]
        if layer > 0:
            weights = parameters[start:biases].reshape(inputs, outputs)
            slope = np.dot(slope, weights.T)
            flat, flat_hidden = slope.ravel(), hidden.ravel()
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
def categorical_slope(logits, actions, weights, entropy_weight):
    """Gradient of Σ_n (w_n log π(a_n|s_n) + entropy_weight · H(π(·|s_n))) at the logits.

    logits: [N, actions]; actions: int64 [N]; weights: [N].
    """
    slope = np.empty_like(logits)
    for n in range(len(logits)):
        log_total = log_sum_exp(logits[n])
        entropy = 0.0
        for j in range(logits.shape[1]):
            log_prob = logits[n, j] - log_total
            entropy -= math.exp(log_prob) * log_prob
        for j in range(logits.shape[1]):
            log_prob = logits[n, j] - log_total
            prob = math.exp(log_prob)
            slope[n, j] = -prob * (weights[n] + entropy_weight * (log_prob + entropy))
        slope[n, actions[n]] += weights[n]
    return slope


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
def gaussian_slopes(means, log_std, actions, weights, entropy_weight):
    """Gradient of Σ_n (w_n log π(a_n|s_n) + entropy_weight · H(π(·|s_n))) at the means and log_std.

    means and actions: [N, actions]; weights: [N]. Returns arrays like `means` and `log_std`.
    """
    inverse_std = np.exp(-log_std)
    slope = np.empty_like(means)
    log_std_slope = np.full_like(log_std, entropy_weight * len(means))
    for n in range(len(means)):
        for j in range(len(log_std)):
            deviation = (actions[n, j] - means[n, j]) * inverse_std[j]
            slope[n, j] = weights[n] * deviation * inverse_std[j]
            log_std_slope[j] += weights[n] * (deviation * deviation - 1)
    return slope, log_std_slope


@kernel
def surrogate_weights(log_probs, old_log_probs, advantages, clip):
    """What the gradient of PPO's clipped surrogate weighs each ∇ log π(a|s) with, float32 [N].

    The surrogate min(rA, clip(r)A), with ratio r, is flat where the ratio is already past the bound
    that the advantage pushes it to; elsewhere its gradient is r A ∇ log π.
    """
    weights = np.zeros(len(log_probs), np.float32)
    for n in range(len(weights)):
        ratio, advantage = math.exp(log_probs[n] - old_log_probs[n]), advantages[n]
        flat = ratio > 1 + clip if advantage > 0 else ratio < 1 - clip
        if not flat:
            weights[n] = ratio * advantage
    return weights


@kernel
def sigmoid(x):
    """The logistic function of a float32 or float64."""
    return np.float32(0.5) + np.float32(0.5) * tanh(np.float32(0.5) * x)


@kernel
def quarters(vector):
    """Four views of a vector, [4 H]."""
    size = len(vector) // 4
    return vector[:size], vector[size : 2 * size], vector[2 * size : 3 * size], vector[3 * size :]


@kernel
def lstm_states(sequence, inward, recurrent, bias):
    """Long short-term memory over a sequence, [T, in], from a zero state.

    inward: [in, 4 H], recurrent: [H, 4 H], bias: [4 H], for H units, whose columns are the input,
    forget and output gates and the new content. Returns these four in one array, [T, 4 H], the
    cells' contents and their outputs, [T + 1, H] each, the zero state included.
    """
    size = len(recurrent)
    gates = np.dot(sequence, inward)
    cells = np.zeros((len(sequence) + 1, size), gates.dtype)
    outputs = np.zeros_like(cells)
    for t in range(len(sequence)):
        gate, cell, output = gates[t], cells[t + 1], outputs[t + 1]
        recurring, before = np.dot(outputs[t], recurrent), cells[t]
        for j in range(3 * size):
            gate[j] = sigmoid(gate[j] + recurring[j] + bias[j])
        for j in range(3 * size, 4 * size):
            gate[j] = tanh(gate[j] + recurring[j] + bias[j])
        let_in, keep, let_out, new = quarters(gate)
        for j in range(size):
            cell[j] = keep[j] * before[j] + let_in[j] * new[j]
            output[j] = let_out[j] * tanh(cell[j])
    return gates, cells, outputs


@kernel
def lstm_gradients(
    sequence,
    recurrent,
    gates,
    cells,
    outputs,
    slope,
    inward_gradient,
    recurrent_gradient,
    bias_gradient,
):
    """Fill in the gradients with respect to weights and bias, by backpropagation in time.

    slope: the loss's gradient with respect to the last output, [H]; gates, cells and outputs as
    `lstm_states` returned them.
    """
    size, one = len(recurrent), np.float32(1)
    slopes = np.empty_like(gates)
    cell_slope = np.zeros_like(slope)
    backward = recurrent.T
    for t in range(len(sequence) - 1, -1, -1):
        let_in, keep, let_out, new = quarters(gates[t])
        let_in_slope, keep_slope, let_out_slope, new_slope = quarters(slopes[t])
        cell, before = cells[t + 1], cells[t]
        for j in range(size):
            shown = tanh(cell[j])
            let_out_slope[j] = slope[j] * shown * let_out[j] * (one - let_out[j])
            cell_slope[j] += slope[j] * let_out[j] * (one - shown * shown)
            let_in_slope[j] = cell_slope[j] * new[j] * let_in[j] * (one - let_in[j])
            keep_slope[j] = cell_slope[j] * before[j] * keep[j] * (one - keep[j])
            new_slope[j] = cell_slope[j] * let_in[j] * (one - new[j] * new[j])
            cell_slope[j] *= keep[j]
        slope = np.dot(slopes[t], backward)
    np.dot(sequence.T, slopes, inward_gradient)
    np.dot(outputs[:-1].T, slopes, recurrent_gradient)
    bias_gradient[:] = 0
    for row in slopes:
        for j in range(len(row)):
            bias_gradient[j] += row[j]


@njit(cache=True)
def normalise(observation, mean, inverse_std, clip):
    """(observation - mean) / std, clipped to ±clip; float32 [size]."""
    result = np.empty(observation.shape[0], np.float32)
    for i in range(observation.shape[0]):
        value = (observation[i] - mean[i]) * inverse_std[i]
        result[i] = min(max(value, -clip), clip)
    return result


@njit(cache=True, error_model="numpy")
def act_discrete(observation, mean, inverse_std, clip, parameters, sizes, uniform):
    """Sample a categorical action by inverting its distribution function at `uniform` in [0, 1).

    Returns (action from 0, log-probability as float32).
    """
    logits = forward(normalise(observation, mean, inverse_std, clip), parameters, sizes)
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
def act_box(observation, mean, inverse_std, clip, parameters, sizes, log_std, normal):
    """Sample a diagonal Gaussian action, means + exp(log_std) · normal; `normal`: [actions].

    Returns (action float32 [actions], not clipped to the bounds; log-probability as float32).
    """
    means = forward(normalise(observation, mean, inverse_std, clip), parameters, sizes)
    action = np.empty(means.shape[0], np.float32)
    log_prob = 0.0
    for i in range(means.shape[0]):
        action[i] = means[i] + math.exp(log_std[i]) * normal[i]
        log_prob -= 0.5 * normal[i] * normal[i] + log_std[i] + 0.5 * math.log(2 * math.pi)
    return action, np.float32(log_prob)


@njit(cache=True)
def step_cartpole(state, action):
    """One step of Gymnasium's CartPole-v1 in its own order of operations.

    state: float64 [4], advanced in place. Returns (reward, terminated).
    """
    x, x_dot, theta, theta_dot = state[0], state[1], state[2], state[3]
    total_mass = 0.1 + 1.0
    polemass_length = 0.1 * 0.5
    force = 10.0 if action == 1 else -10.0
    costheta = math.cos(theta)
    sintheta = math.sin(theta)
    temp = (force + polemass_length * (theta_dot * theta_dot) * sintheta) / total_mass
    thetaacc = (9.8 * sintheta - costheta * temp) / (
        0.5 * (4.0 / 3.0 - 0.1 * (costheta * costheta) / total_mass)
    )
    xacc = temp - polemass_length * thetaacc * costheta / total_mass
    state[0] = x + 0.02 * x_dot
    state[1] = x_dot + 0.02 * xacc
    state[2] = theta + 0.02 * theta_dot
    state[3] = theta_dot + 0.02 * thetaacc
    threshold = 12 * 2 * math.pi / 360
    terminated = abs(state[0]) > 2.4 or abs(state[2]) > threshold
    return 1.0, terminated


@njit(cache=True)
def _acrobot_derivatives(state, torque, two):
    """Time derivatives of the four state variables ("book" equations), all masses, lengths 1.

    `two` is 2.0, kept from the compiler: Gymnasium squares with the C library's `pow`, which
    differs from x * x in the last bit for about one value in a thousand.
    """
    theta1, theta2, dtheta1, dtheta2 = state
    d1 = 0.25 + (1.0 + 0.25 + 2 * 0.5 * math.cos(theta2)) + 1.0 + 1.0
    d2 = (0.25 + 0.5 * math.cos(theta2)) + 1.0
    phi2 = 0.5 * 9.8 * math.cos(theta1 + theta2 - math.pi / 2.0)
    phi1 = (
        -0.5 * math.pow(dtheta2, two) * math.sin(theta2)
        - 2 * 0.5 * dtheta2 * dtheta1 * math.sin(theta2)
        + (0.5 + 1.0) * 9.8 * math.cos(theta1 - math.pi / 2)
        + phi2
    )
    ddtheta2 = (
        torque + d2 / d1 * phi1 - 0.5 * math.pow(dtheta1, two) * math.sin(theta2) - phi2
    ) / (0.25 + 1.0 - math.pow(d2, two) / d1)
    ddtheta1 = -(d2 * ddtheta2 + phi1) / d1
    return dtheta1, dtheta2, ddtheta1, ddtheta2


@njit(cache=True)
def _advance(state, step, slope):
    return (
        state[0] + step * slope[0],
        state[1] + step * slope[1],
        state[2] + step * slope[2],
        state[3] + step * slope[3],
    )


@njit(cache=True)
def _wrap(angle):
    while angle > math.pi:
        angle = angle - 2 * math.pi
    while angle < -math.pi:
        angle = angle + 2 * math.pi
    return angle


@njit(cache=True)
def step_acrobot(state, action, two):
    """One step of Gymnasium's Acrobot-v1 in its own order of operations.

    state: float64 [4], advanced in place. Returns (reward, terminated).
    """
    torque = action - 1.0
    start = (state[0], state[1], state[2], state[3])
    k1 = _acrobot_derivatives(start, torque, two)
    k2 = _acrobot_derivatives(_advance(start, 0.2 / 2.0, k1), torque, two)
    k3 = _acrobot_derivatives(_advance(start, 0.2 / 2.0, k2), torque, two)
    k4 = _acrobot_derivatives(_advance(start, 0.2, k3), torque, two)
    for i in range(4):
        state[i] = start[i] + 0.2 / 6.0 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i])
    state[0] = _wrap(state[0])
    state[1] = _wrap(state[1])
    state[2] = min(max(state[2], -4 * math.pi), 4 * math.pi)
    state[3] = min(max(state[3], -9 * math.pi), 9 * math.pi)
    terminated = -math.cos(state[0]) - math.cos(state[1] + state[0]) > 1.0
    return (0.0 if terminated else -1.0), terminated


@njit(cache=True)
def _observe(which, state, observation):
    if which == CARTPOLE:
        for i in range(4):
            observation[i] = state[i]
    else:
        observation[0] = math.cos(state[0])
        observation[1] = math.sin(state[0])
        observation[2] = math.cos(state[1])
        observation[3] = math.sin(state[1])
        observation[4] = state[2]
        observation[5] = state[3]


@njit(cache=True)
def classic_control_episode(
    which, state, first_observation, mean, inverse_std, clip, parameters, sizes, uniforms
):
    """One whole episode of CartPole (`which` = 0) or Acrobot (1) from a reset environment's state.

    state: float64 [4], left at the final state; uniforms: float64 [time limit], one a step.
    Returns observations float32 [T + 1, size], actions int64 [T], log-probabilities float32 [T],
    rewards float64 [T], terminated.
    """
    limit = uniforms.shape[0]
    two = np.full(1, 2.0)[0]
    observations = np.empty((limit + 1, first_observation.shape[0]), np.float32)
    actions = np.empty(limit, np.int64)
    log_probs = np.empty(limit, np.float32)
    rewards = np.empty(limit, np.float64)
    observations[0] = first_observation
    terminated = False
    t = 0
    while t < limit and not terminated:
        actions[t], log_probs[t] = act_discrete(
            observations[t], mean, inverse_std, clip, parameters, sizes, uniforms[t]
        )
        if which == CARTPOLE:
            rewards[t], terminated = step_cartpole(state, actions[t])
        else:
            rewards[t], terminated = step_acrobot(state, actions[t], two)
        t += 1
        _observe(which, state, observations[t])
    return observations[: t + 1], actions[:t], log_probs[:t], rewards[:t], terminated
