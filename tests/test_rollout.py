"""Episodes: the compiled ones against Gymnasium's own environments, the ordinary ones by hand."""

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from shared import ENGINES, environment_of

from mace_rl.agent.network import mlp
from mace_rl.agent.policy import ActingPolicy, Policy
from mace_rl.config.section import ConfigError
from mace_rl.environments import classic_control
from mace_rl.environments.environment import Environment
from mace_rl.environments.rollout import (
    Episode,
    draw_noise,
    fallback_reason,
    roll_out,
    roll_out_compiled,
    rollout_for,
)

CLASSIC = ["CartPole-v1", "Acrobot-v1"]


def bits(episode: Episode) -> list[tuple]:
    """All of an episode, types included."""
    return [(value.dtype, value.tobytes()) for value in map(np.asarray, vars(episode).values())]


def new_policy(environment: Environment, hidden, rng, log_std=0.0, engine="compiled") -> Policy:
    """A policy as training starts with it."""
    space = environment.action_space
    outputs = space.n if isinstance(space, Discrete) else space.shape[0]
    module = mlp([environment.observation_size, *hidden, int(outputs)], 0.01, rng)
    return Policy(ENGINES[engine](module), space, log_std)


def uniform_policy(environment: Environment, **settings) -> ActingPolicy:
    """Nearly the same distribution in every state."""
    size = environment.observation_size
    policy = new_policy(environment, [4], np.random.default_rng(0), **settings)
    return policy.for_acting(np.zeros(size), np.ones(size), np.inf)


def policy_of(environment: Environment, kind: str, seed: int) -> ActingPolicy:
    """Policies that differ in what they make of an episode."""
    rng = np.random.default_rng(seed)
    size = environment.observation_size
    mean, std, clip = np.zeros(size), np.ones(size), np.inf
    policy = new_policy(environment, [4] if kind == "skilled" else [64, 64], rng)
    match kind:
        case "initial":
            pass
        case "large weights":  # nearly deterministic, erratic
            policy.parameters[:] = 3 * rng.standard_normal(len(policy.parameters))
        case "normalised":  # as in training with normalise_observations
            policy.parameters[:] = rng.standard_normal(len(policy.parameters))
            mean, std, clip = rng.standard_normal(size), np.exp(rng.standard_normal(size)), 1.5
        case "skilled":  # balances CartPole to the time limit; swings Acrobot up
            policy.parameters[:] = 0
            (weights, _), (readout, _) = policy.network.layers(policy.network.parameters)
            if environment.name == "CartPole-v1":
                weights[:, 0] = [0.03, 0.1, 1.0, 0.5]
            else:
                weights[4, 0] = -0.5
            sharpness = rng.uniform(20, 60)
            readout[0, [0, -1]] = [-sharpness, sharpness]
    return policy.for_acting(mean, std, clip)


def play(environment: Environment, **settings) -> Episode:
    """An episode of nearly uniform actions."""
    noise = draw_noise(environment, np.random.default_rng(0))
    policy = uniform_policy(environment, **settings)
    return rollout_for(environment, policy)(environment, policy, noise)


KINDS = {"initial": 20, "large weights": 80, "normalised": 80, "skilled": 120}  # episodes


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", CLASSIC)
def test_both_rollouts_play_the_same_episodes(name, kind):
    """One after the other on two environments, so that the generators stay together too."""
    one, other = environment_of(name, 1), environment_of(name, 1)
    generators = np.random.default_rng(2), np.random.default_rng(2)
    lengths, ends = [], set()
    for number in range(KINDS[kind]):
        policy = policy_of(one, kind, seed=number % 10)
        noise = draw_noise(one, generators[0])
        episode = roll_out_compiled(one, policy, noise)
        again = roll_out(other, policy, draw_noise(other, generators[1]))
        assert bits(episode) == bits(again)
        # The compiled loop's own state, in double precision, which the next step would start from.
        start, final = (np.array(each.env.unwrapped.state, np.float64) for each in (one, other))
        which = classic_control.CARTPOLE if name == "CartPole-v1" else classic_control.ACROBOT
        classic_control.episode(which, start, episode.observations[0], *policy[:5], noise)
        assert start.tobytes() == final.tobytes()
        lengths.append(len(episode))
        ends.add(episode.terminated)
    assert one.generator.bit_generator.state == other.generator.bit_generator.state
    # The policies do what they are here for.
    if kind == "skilled":
        typical = np.median(lengths)
        assert typical == 500 if name == "CartPole-v1" else typical < 100
    if name == "CartPole-v1":
        assert (False in ends) == (kind == "skilled")


def test_compiled_steps_equal_gymnasium_s_anywhere_in_the_state_space():
    """Also where episodes seldom get: several turns, velocities at and beyond their bounds."""
    rng = np.random.default_rng(0)
    cartpole, acrobot = CartPoleEnv(), AcrobotEnv()
    cartpole.reset(), acrobot.reset()
    for _ in range(5000):
        state = rng.standard_normal(4) * rng.choice([1e-3, 0.1, 1.0, 10.0], 4)
        action = int(rng.integers(2))
        cartpole.state, cartpole.steps_beyond_terminated = state.copy(), None
        _, reward, terminated, _, _ = cartpole.step(action)
        assert classic_control.step_cartpole(state, action) == (reward, terminated)
        assert state.tobytes() == cartpole.state.tobytes()

        state = rng.standard_normal(4) * rng.choice([1e-3, 1.0, 10.0, 40.0], 4)
        action = int(rng.integers(3))
        acrobot.state = state.copy()
        _, reward, terminated, _, _ = acrobot.step(action)
        assert classic_control.step_acrobot(state, action, 2.0) == (reward, terminated)
        assert state.tobytes() == acrobot.state.tobytes()


# --- Which rollout ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "attribute", "value"),
    [
        ("CartPole-v1", "gravity", 9.8000001),
        ("CartPole-v1", "force_mag", 11.0),
        ("CartPole-v1", "tau", 0.01),
        ("CartPole-v1", "kinematics_integrator", "semi-implicit euler"),
        ("CartPole-v1", "x_threshold", 2.0),
        ("CartPole-v1", "_sutton_barto_reward", True),
        ("Acrobot-v1", "book_or_nips", "nips"),
        ("Acrobot-v1", "torque_noise_max", 0.1),
        ("Acrobot-v1", "dt", 0.1),
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


class HeavyCartPole(CartPoleEnv):
    """Not Gymnasium's class, though all but its name is."""


@pytest.mark.parametrize("name", ["FrozenLake-v1", "Pendulum-v1", "MountainCar-v0", "CartPole-v1"])
def test_others_take_the_ordinary_rollout(register, name):
    """Other environments, a subclass, and policies that are not compiled."""
    if name == "CartPole-v1":
        environment = environment_of(name)
        policy = uniform_policy(environment, engine="torch")
        assert rollout_for(environment, policy) is roll_out
        register(name, HeavyCartPole, 500)
    environment = environment_of(name)
    assert rollout_for(environment, uniform_policy(environment)) is roll_out
    assert fallback_reason(environment) == ""


# --- Any environment ----------------------------------------------------------------------------


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
    """At length 10 both come in the same step: the state is terminal."""
    environment = environment_of(register("Corridor-v0", Corridor, 10, length=length))
    episode = play(environment)
    assert (len(episode), episode.terminated) == (steps, terminated)
    assert episode.rewards.tolist() == [0.5 * (t + 1) for t in range(steps)]
    assert episode.rewards.dtype == np.float64


def test_discrete_observations_are_one_hot_and_spaces_may_start_anywhere(register):
    environment = environment_of(register("Corridor-v0", Corridor, 10, length=6))
    noise = np.array([0.1, 0.9, 0.1, 0.9, 0.9, 0.1, 0, 0, 0, 0])
    episode = roll_out(environment, uniform_policy(environment), noise)
    assert (episode.observations == np.eye(9)[:7]).all()
    assert episode.observations.dtype == np.float32
    assert episode.actions.tolist() == [0, 1, 0, 1, 1, 0]
    assert environment.env.unwrapped.given == [-1, 0, -1, 0, 0, -1]


@pytest.mark.parametrize("name", [*CLASSIC, "FrozenLake-v1", "Pendulum-v1"])
def test_an_episode_is_what_gymnasium_s_own_environment_gives(name):
    """`gymnasium.make`'s, stepped here with the policy's actions."""
    environment, env = environment_of(name, 4), gymnasium.make(name)
    env.reset(seed=0)
    policy = uniform_policy(environment)
    for number in range(20):
        env.unwrapped.np_random.bit_generator.state = environment.generator.bit_generator.state
        noise = draw_noise(environment, np.random.default_rng(number))
        episode = roll_out(environment, policy, noise)
        observation, _ = env.reset()
        for t, taken in enumerate(episode.actions):
            action, log_prob = policy.act(environment.encode(observation), noise[t])
            assert (episode.observations[t] == environment.encode(observation)).all()
            assert (taken == action).all() and episode.log_probs[t] == np.float32(log_prob)
            if name == "Pendulum-v1":
                action = np.clip(action, -2, 2)
            observation, reward, terminated, truncated, _ = env.step(action)
            assert reward == episode.rewards[t]
        assert terminated == episode.terminated and (terminated or truncated)


class Recorder(gymnasium.Env):
    """Keeps the actions it is given; observations are 2 × 2 and always the same array."""

    observation_space = Box(-1, 1, (2, 2), np.float32)
    action_space = Box(np.float32([-0.5, -2]), np.float32([0.25, 3]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.given, self.state = [], np.zeros((2, 2), np.float32)
        return self.state, {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.given.append(action.copy())
        self.state += 1
        return self.state, 0.0, False, False, {}


def test_box_actions_are_clipped_for_the_environment_only(register):
    environment = environment_of(register("Recorder-v0", Recorder, 50))
    noise = draw_noise(environment, np.random.default_rng(0))
    episode = play(environment, log_std=1.0)
    given = np.stack(environment.env.unwrapped.given)
    low, high = np.float32([-0.5, -2]), np.float32([0.25, 3])
    assert (episode.actions < low).any() and (episode.actions > high).any()
    assert (given == np.minimum(np.maximum(episode.actions, low), high)).all()
    # Actions and log-probabilities are those of the unclipped draw: means are near 0 here.
    np.testing.assert_allclose(episode.actions, np.e * noise, atol=0.05)
    assert episode.observations.dtype == np.float32
    assert (episode.observations == np.arange(51)[:, None].repeat(4, 1)).all()  # copied in time


def test_noise_is_drawn_up_to_the_time_limit():
    """So that the stream is used up alike, however long an episode is."""
    generator = np.random.default_rng(0)
    drawn = draw_noise(environment_of("CartPole-v1"), generator)
    assert (drawn == np.random.default_rng(0).random(500)).all()
    normals = draw_noise(environment_of("Pendulum-v1"), np.random.default_rng(0))
    assert (normals == np.random.default_rng(0).standard_normal((200, 1))).all()


def test_a_short_episode_holds_no_more_memory_than_its_own(register):
    environment = environment_of(register("Corridor-v0", Corridor, 1000, length=4))
    episode = play(environment)
    for array in (episode.observations, episode.actions, episode.log_probs, episode.rewards):
        assert array.base is None and len(array) <= 5


# --- Environments -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*CLASSIC, "HopperBulletEnv-v0", "Pendulum-v1"])
def test_fresh_environment_with_an_aged_one_s_generator_replays_it(name):
    """What resuming rests on; in Hopper the very first episode is unlike all later ones."""
    aged, fresh = environment_of(name), environment_of(name, 99)
    policy = uniform_policy(aged)
    roll = rollout_for(aged, policy)
    noise = [draw_noise(aged, np.random.default_rng(number)) for number in range(6)]
    for row in noise[:3]:
        roll(aged, policy, row)
    fresh.generator.bit_generator.state = aged.generator.bit_generator.state
    for row in noise[3:]:
        assert bits(roll(aged, policy, row)) == bits(roll(fresh, policy, row))


def test_environments_with_the_same_seed_are_the_same_and_others_differ():
    starts = [environment_of("Acrobot-v1", seed).env.reset()[0].tolist() for seed in (0, 0, 1)]
    assert starts[0] == starts[1] != starts[2]


PLAIN = {"observation_space": Box(-1, 1, (2,)), "action_space": Discrete(2)}


@pytest.mark.parametrize(
    ("spaces", "limit", "message"),
    [
        ({}, None, "has no time limit .*set one"),
        ({"observation_space": MultiBinary(3)}, 10, "multibinary observations.*Discrete ones work"),
        ({"observation_space": Dict({"x": Discrete(3)})}, 10, "dict observations, Dict"),
        ({"observation_space": Tuple([Discrete(3)] * 2)}, 10, "tuple observations, Tuple"),
        ({"observation_space": Box(0, 255, (8, 8, 3), np.uint8)}, 10, "image observations, Box"),
        ({"observation_space": Box(0, 255, (8, 8), np.uint8)}, 10, "image observations, Box"),
        ({"action_space": MultiDiscrete([2, 2])}, 10, "Discrete and one-dim"),
        ({"action_space": Box(-1, 1, (2, 2))}, 10, "Discrete and one-dim"),
    ],
)
def test_environments_that_do_not_fit_are_refused_by_name(register, spaces, limit, message):
    name = register("Unfit-v0", type("Unfit", (gymnasium.Env,), PLAIN | spaces), limit)
    with pytest.raises(ConfigError, match=rf"^[^\n]*Unfit-v0[^\n]*{message}[^\n]*$"):
        environment_of(name)


@pytest.mark.parametrize(("name", "message"), [("NoSuch-v0", ""), ("Blackjack-v1", "tuple obs")])
def test_gymnasium_s_own_that_do_not_fit_are_refused_by_name(name, message):
    with pytest.raises(ConfigError, match=f"{name}.*{message}"):
        environment_of(name, 0, 10)


def test_max_episode_steps_goes_before_the_environment_s_own():
    for name, own in (("CliffWalking-v1", None), ("CartPole-v1", 500)):
        environment = environment_of(name, 0, 7)
        assert environment.max_steps == 7 != own
        episode = play(environment)
        assert (len(episode), episode.terminated) == (7, False)


def test_arguments_reach_the_constructor():
    """Without slipping an action in FrozenLake leads where it points; a wrong one is refused."""
    environment = environment_of("FrozenLake-v1", 0, None, {"is_slippery": False})
    transitions = environment.env.unwrapped.P
    assert {len(outcomes) for state in transitions.values() for outcomes in state.values()} == {1}
    policy = uniform_policy(environment_of("CartPole-v1"))
    changed = environment_of("CartPole-v1", 0, None, {"sutton_barto_reward": True})
    assert rollout_for(changed, policy) is roll_out
    for arguments in ({"slippery": False}, {"map_name": "9x9"}):
        with pytest.raises(ConfigError, match=r"^[^\n]*FrozenLake-v1[^\n]*(slippery|9x9)[^\n]*$"):
            environment_of("FrozenLake-v1", 0, None, arguments)
