"""Playing one episode with a policy, by stepping any environment.

CartPole-v1 and Acrobot-v1 run in one compiled loop, which gives the same episode to the bit.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv

from mace_rl.agent.policy import ActingPolicy, CompiledActing
from mace_rl.config.section import ConfigError
from mace_rl.environments import classic_control
from mace_rl.environments.environment import Environment
from mace_rl.environments.episode import Episode
from mace_rl.numerics.finite import TOO_LARGE, require_finite
from mace_rl.training.compiled_episode import play_compiled

COMPILED = {"CartPole-v1": CartPoleEnv, "Acrobot-v1": AcrobotEnv}  # what the compiled loop plays


def draw_noise(environment: Environment, generator: np.random.Generator) -> np.ndarray:
    """The random numbers that turn policy outputs into actions, up to the time limit."""
    return environment.actions.noise(environment.max_steps, generator)


def roll_out(environment: Environment, policy: ActingPolicy, noise: np.ndarray) -> Episode:
    """Play one episode by stepping the environment; see `Episode`."""
    kind, clips = environment.actions, environment.clips_actions
    observations = np.empty((len(noise) + 1, environment.observation_size), np.float32)
    actions = np.empty(noise.shape, np.float32 if kind.continuous else np.int64)
    log_probs = np.empty(len(noise), np.float32)
    rewards = np.empty(len(noise))
    observations[0] = environment.encode(environment.reset(), 0)
    terminated = truncated = False
    t = 0
    while not (terminated or truncated):
        if t == len(noise):
            raise ConfigError(f"environment {environment.name!r} {endless(environment)}")
        action: Any
        action, log_prob = policy.act(observations[t], noise[t])
        actions[t], log_probs[t] = action, log_prob
        given = kind.given(action, clips)
        observation, rewards[t], terminated, truncated = environment.step(given, t + 1)
        t += 1
        observations[t] = environment.encode(observation, t)
    # Copies: an episode that ended early should not hold the memory of a whole one.
    states, actions, log_probs = observations[: t + 1].copy(), actions[:t].copy(), log_probs[:t]
    return Episode(states, actions, log_probs.copy(), rewards[:t].copy(), terminated)


def endless(environment: Environment) -> str:
    """What is wrong with an episode that does not end."""
    steps, setting = environment.max_steps, "environment_settings.ENV.max_episode_steps"
    if environment.ends_by_itself:
        return (
            f"has no time limit, and an episode of it goes on after {steps} steps: "
            f"in training --max-episode-steps or {setting} should set one"
        )
    return f"goes on after {steps} steps, its time limit: a wrapper hides `truncated`"


def roll_out_compiled(
    environment: Environment, policy: CompiledActing, noise: np.ndarray
) -> Episode:
    """Play one episode of CartPole-v1 or Acrobot-v1 in compiled code, equal to `roll_out`."""
    inner: Any = environment.env.unwrapped
    observation, _ = inner.reset()  # wrappers count steps and calls, of which there are none
    cartpole = isinstance(inner, CartPoleEnv)
    which = classic_control.CARTPOLE if cartpole else classic_control.ACROBOT
    state = np.array(inner.state, np.float64)
    episode = Episode(*play_compiled(which, state, observation, policy, noise))
    require_finite("an observation", episode.observations, too_large=TOO_LARGE)
    return episode


def rollout_for(
    environment: Environment, policy: ActingPolicy
) -> Callable[[Environment, Any, np.ndarray], Episode]:
    """The fastest rollout that is exact for this environment and this kind of policy."""
    made_for_it = _is_compiled(environment) and isinstance(policy, CompiledActing)
    return roll_out_compiled if made_for_it and not fallback_reason(environment) else roll_out


def fallback_reason(environment: Environment) -> str:
    """Why this environment's fast path cannot be taken; "" if it can or there is none.

    Other parameters, another version or a C library with another sine need the ordinary rollout.
    """
    inner: Any = environment.env.unwrapped
    if _is_compiled(environment):
        same = takes_compiled_steps(inner)
        return "" if same else "the environment's steps are not equal to the compiled ones"
    return getattr(inner, "fallback_reason", "")  # `FastHopperBulletEnv` has one


def _is_compiled(environment: Environment) -> bool:
    plain = type(environment.env.unwrapped) is COMPILED.get(environment.name)
    return plain and not environment.wrapped


def takes_compiled_steps(inner: Any) -> bool:
    """Whether 300 steps of a CartPoleEnv or AcrobotEnv, from anywhere, equal the compiled ones."""
    states = np.random.default_rng(0)
    generator = inner.np_random.bit_generator.state
    same = True
    for _ in range(300):
        state = states.standard_normal(4) * states.choice([0.01, 0.1, 1.0, 10.0], 4)
        action = int(states.integers(inner.action_space.n))
        inner.state, inner.steps_beyond_terminated = state.copy(), None
        _, reward, terminated, _, _ = inner.step(action)
        if isinstance(inner, CartPoleEnv):
            expected = classic_control.step_cartpole(state, action)
        else:
            expected = classic_control.step_acrobot(state, action, 2.0)
        same = (reward, terminated) == expected and np.array_equal(inner.state, state) and same
    same = same and inner.np_random.bit_generator.state == generator  # torque noise draws
    inner.np_random.bit_generator.state = generator
    return same
