"""Episodes: the compiled ones against Gymnasium's own environments, the ordinary ones by hand."""

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv
from gymnasium.spaces import Box, Discrete
from shared import ENGINES, acting, environment_of

from mace_rl.agent.policy import ActingPolicy, Policy
from mace_rl.environments import classic_control
from mace_rl.environments.environment import Environment
from mace_rl.environments.episode import Episode
from mace_rl.numerics.network import mlp
from mace_rl.training.compiled_episode import play_compiled
from mace_rl.training.rollout import (
    draw_noise,
    fallback_reason,
    roll_out,
    roll_out_compiled,
    rollout_for,
)

CLASSIC = ["CartPole-v1", "Acrobot-v1"]


def bits(episode: Episode) -> list[tuple]:
    return [(value.dtype, value.tobytes()) for value in map(np.asarray, vars(episode).values())]


def new_policy(environment: Environment, hidden, rng, log_std=0.0, engine="compiled") -> Policy:
    layers = mlp([environment.observation_size, *hidden, environment.action_size], 0.01, rng)
    return Policy(ENGINES[engine](layers), environment.actions, log_std)


def uniform_policy(environment: Environment, **settings) -> ActingPolicy:
    """Nearly the same distribution in every state."""
    size = environment.observation_size
    policy = new_policy(environment, [4], np.random.default_rng(0), **settings)
    return acting(policy, np.zeros(size), np.ones(size), np.inf)


def policy_of(environment: Environment, kind: str, seed: int) -> ActingPolicy:
    """Policies that differ in what they make of an episode."""
    rng, size = np.random.default_rng(seed), environment.observation_size
    policy = new_policy(environment, [4] if kind == "skilled" else [64, 64], rng)
    if kind == "erratic":  # and normalised, as in training with normalise_observations
        policy.parameters[:] = 2 * rng.standard_normal(len(policy.parameters))
        return acting(policy, rng.standard_normal(size), np.exp(rng.standard_normal(size)), 1.5)
    # Balances CartPole to the time limit; swings Acrobot up.
    policy.parameters[:] = 0
    (weights, _), (readout, _) = policy.network.layers(policy.network.parameters)
    if environment.name == "CartPole-v1":
        weights[:, 0] = [0.03, 0.1, 1.0, 0.5]
    else:
        weights[4, 0] = -0.5
    sharpness = rng.uniform(20, 60)
    readout[0, [0, -1]] = [-sharpness, sharpness]
    return acting(policy, np.zeros(size), np.ones(size), np.inf)


@pytest.mark.parametrize("kind", ["erratic", "skilled"])
@pytest.mark.parametrize("name", CLASSIC)
def test_both_rollouts_play_the_same_episodes(name, kind):
    one, other = environment_of(name, 1), environment_of(name, 1)
    generators = np.random.default_rng(2), np.random.default_rng(2)
    episodes = []
    for number in range(40):
        policy = policy_of(one, kind, seed=number % 10)
        noise = draw_noise(one, generators[0])
        episodes.append(roll_out_compiled(one, policy, noise))
        again = roll_out(other, policy, draw_noise(other, generators[1]))
        assert bits(episodes[-1]) == bits(again)
        # The compiled loop's own state, in double precision, which the next step would start from.
        start, final = (np.array(each.env.unwrapped.state, np.float64) for each in (one, other))
        which = classic_control.CARTPOLE if name == "CartPole-v1" else classic_control.ACROBOT
        play_compiled(which, start, again.observations[0], policy, noise)
        assert start.tobytes() == final.tobytes()
    assert one.generator.bit_generator.state == other.generator.bit_generator.state
    if kind == "skilled":  # the policies do what they are here for
        typical = np.median([len(episode) for episode in episodes])
        assert typical == 500 if name == "CartPole-v1" else typical < 100
    if name == "CartPole-v1":
        assert all(episode.terminated for episode in episodes) == (kind != "skilled")


@pytest.mark.parametrize(
    ("make", "step", "actions", "spreads"),
    [
        (CartPoleEnv, classic_control.step_cartpole, 2, [1e-3, 0.1, 1.0, 10.0]),
        (AcrobotEnv, lambda *x: classic_control.step_acrobot(*x, 2.0), 3, [1e-3, 1.0, 10.0, 40.0]),
    ],
)
def test_compiled_steps_equal_gymnasium_s_anywhere(make, step, actions, spreads):
    """Also where episodes seldom get: several turns, velocities at and beyond their bounds."""
    rng, env = np.random.default_rng(0), make()
    env.reset()
    for _ in range(2000):
        state = rng.standard_normal(4) * rng.choice(spreads, 4)
        action = int(rng.integers(actions))
        env.state, env.steps_beyond_terminated = state.copy(), None
        _, reward, terminated, _, _ = env.step(action)
        assert step(state, action) == (reward, terminated)
        assert state.tobytes() == env.state.tobytes()


@pytest.mark.parametrize(
    ("name", "attribute", "value"),
    [
        ("CartPole-v1", "gravity", 9.8000001),
        ("CartPole-v1", "_sutton_barto_reward", True),
        ("Acrobot-v1", "torque_noise_max", 0.1),
        ("Acrobot-v1", "AVAIL_TORQUE", [-1.0, 0.0, 2.0]),
    ],
)
def test_changed_physics_take_the_ordinary_rollout(name, attribute, value):
    environment = environment_of(name)
    policy, before = uniform_policy(environment), environment.generator.bit_generator.state
    assert rollout_for(environment, policy) is roll_out_compiled
    assert fallback_reason(environment) == ""
    setattr(environment.env.unwrapped, attribute, value)
    assert rollout_for(environment, policy) is roll_out
    assert "steps are not equal" in fallback_reason(environment)
    assert environment.generator.bit_generator.state == before


def test_others_take_the_ordinary_rollout(register):
    plain = environment_of("CartPole-v1")
    assert rollout_for(plain, uniform_policy(plain, engine="torch")) is roll_out
    heavy = register("Heavy-v0", type("HeavyCartPole", (CartPoleEnv,), {}), 500)
    for name in ("FrozenLake-v1", "Pendulum-v1", "MountainCar-v0", heavy):
        environment = environment_of(name)
        assert rollout_for(environment, uniform_policy(environment)) is roll_out
        assert fallback_reason(environment) == ""


class Corridor(gymnasium.Env):
    """Walk right from 0; the end at `length` terminates. Remembers what it was given."""

    observation_space = Discrete(9, start=3)
    action_space = Discrete(2, start=-1)

    def __init__(self, length=100):
        self.length, self.given = length, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return 3, {}

    def step(self, action):
        self.given.append(action)
        self.place += 1
        reward = 0.5 * self.place
        return 3 + min(self.place, 8), reward, self.place == self.length, False, {}


@pytest.mark.parametrize(
    ("length", "steps", "terminated"),
    [(100, 10, False), (4, 4, True), (10, 10, True), (11, 10, False)],
)
def test_time_limit_is_no_termination(register, length, steps, terminated):
    """At length 10 both come in the same step: the state is terminal.

    Discrete observations are one-hot, and spaces may start anywhere.
    """
    environment = environment_of(register("Corridor-v0", Corridor, 10, length=length))
    noise = np.array([0.1, 0.9, 0.1, 0.9, 0.9, 0.1, 0.1, 0.9, 0.1, 0.9])
    episode = roll_out(environment, uniform_policy(environment), noise)
    assert (len(episode), episode.terminated) == (steps, terminated)
    assert episode.rewards.tolist() == [0.5 * (t + 1) for t in range(steps)]
    assert episode.actions.tolist() == (noise > 0.5)[:steps].astype(int).tolist()
    assert environment.env.unwrapped.given == [action - 1 for action in episode.actions]
    assert (episode.observations == np.eye(9)[[min(t, 8) for t in range(steps + 1)]]).all()
    assert (episode.observations.dtype, episode.rewards.dtype) == (np.float32, np.float64)
    for array in (episode.observations, episode.actions, episode.log_probs, episode.rewards):
        assert array.base is None  # holds no more memory than its own


@pytest.mark.parametrize("name", [*CLASSIC, "FrozenLake-v1", "Pendulum-v1"])
def test_an_episode_is_what_gymnasium_s_own_environment_gives(name):
    """`gymnasium.make`'s, stepped here with the policy's actions, clipped for it only."""
    environment, env = environment_of(name, 4), gymnasium.make(name)
    env.reset(seed=0)
    policy, box = uniform_policy(environment, log_std=1.0), isinstance(env.action_space, Box)
    for number in range(10):
        env.unwrapped.np_random.bit_generator.state = environment.generator.bit_generator.state
        noise = draw_noise(environment, np.random.default_rng(number))
        episode = roll_out(environment, policy, noise)
        assert not box or (np.abs(episode.actions) > 2).any()
        observation, _ = env.reset()
        for t, taken in enumerate(episode.actions):
            action, log_prob = policy.act(environment.encode(observation), noise[t])
            assert (episode.observations[t] == environment.encode(observation)).all()
            assert (taken == action).all() and episode.log_probs[t] == np.float32(log_prob)
            if box:
                action = np.minimum(np.maximum(action, -2), 2)
            observation, reward, terminated, truncated, _ = env.step(action)
            assert reward == episode.rewards[t]
        assert (episode.observations[-1] == environment.encode(observation)).all()
        assert terminated == episode.terminated and (terminated or truncated)


def test_noise_is_drawn_up_to_the_time_limit():
    """So that the stream is used up alike, however long an episode is."""
    one, other = np.random.default_rng(0), np.random.default_rng(0)
    assert (draw_noise(environment_of("CartPole-v1"), one) == other.random(500)).all()
    assert (draw_noise(environment_of("Pendulum-v1"), one) == other.normal(size=(200, 1))).all()
