"""A whole episode of CartPole-v1 or Acrobot-v1 in one compiled loop."""

import numpy as np

from mace_rl.agent.policy import act_discrete
from mace_rl.environments import classic_control
from mace_rl.numerics.compiling import njit


@njit(cache=True)
def play_compiled(which, state, first_observation, policy, uniforms):
    """One whole episode of CartPole (`which` = 0) or Acrobot (1) from a reset environment's state.

    state: float64 [4], overwritten; policy: a `CompiledActing`; uniforms: float64 [time limit], one
    a step. Returns the fields of an `Episode`.
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
        actions[t], log_probs[t] = act_discrete(observations[t], policy, uniforms[t])
        if which == classic_control.CARTPOLE:
            rewards[t], terminated = classic_control.step_cartpole(state, actions[t])
        else:
            rewards[t], terminated = classic_control.step_acrobot(state, actions[t], two)
        t += 1
        classic_control.observe(which, state, observations[t])
    return observations[: t + 1], actions[:t], log_probs[:t], rewards[:t], terminated
