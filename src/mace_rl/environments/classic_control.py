"""Steps of CartPole-v1 and Acrobot-v1 in compiled code, equal to Gymnasium's to the bit.

All arithmetic is in Gymnasium's order.
"""

import math

from mace_rl.numerics.compiling import njit

CARTPOLE, ACROBOT = 0, 1


@njit(cache=True)
def step_cartpole(state, action):
    """One step of CartPole-v1; changes `state`, float64 [4]; returns (reward, terminated)."""
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
    """Time derivatives of the four state variables ("book" equations); masses and lengths are 1.

    `two` is 2.0, unknown to the compiler: Gymnasium squares with the C library's `pow`, which
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
def _advance(state, step, derivative):
    (a, b, c, d), (da, db, dc, dd) = state, derivative
    return a + step * da, b + step * db, c + step * dc, d + step * dd


@njit(cache=True)
def _wrap(angle):
    while angle > math.pi:
        angle = angle - 2 * math.pi
    while angle < -math.pi:
        angle = angle + 2 * math.pi
    return angle


@njit(cache=True)
def step_acrobot(state, action, two):
    """One step of Acrobot-v1; changes `state`, float64 [4]; returns (reward, terminated)."""
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
def observe(which, state, observation):
    if which == CARTPOLE:
        for i in range(4):
            observation[i] = state[i]
    else:
        observation[0], observation[1] = math.cos(state[0]), math.sin(state[0])
        observation[2], observation[3] = math.cos(state[1]), math.sin(state[1])
        observation[4], observation[5] = state[2], state[3]
