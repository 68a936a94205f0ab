"""Episodes: the compiled ones against Gymnasium's own environments, the ordinary ones by hand."""

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv
from gymnasium.spaces import Box, Discrete

from mace_rl import compiled
from mace_rl.environments import Environment
from mace_rl.hyperparameters import ConfigError
from mace_rl.policy import ActingPolicy, Actor
from mace_rl.rollout import Episode, draw_noise, roll_out, roll_out_compiled, rollout_for

CLASSIC = ["CartPole-v1", "Acrobot-v1"]


def equal(one: Episode, other: Episode) -> bool:
    """The same episode to the bit, types included."""
    pairs = [
        (getattr(one, name), getattr(other, name))
        for name in ("observations", "actions", "log_probs", "rewards")
    ]
    same = all(a.dtype == b.dtype and a.tobytes() == b.tobytes() for a, b in pairs)
    return same and one.terminated is bool(other.terminated) and len(one) == len(other)


def policy_of(environment: Environment, kind: str, seed: int) -> ActingPolicy:
    """Policies that differ in what they make of an episode."""
    rng = np.random.default_rng(seed)
    size = environment.observation_size
    mean, std, clip = np.zeros(size), np.ones(size), np.inf
    hidden = [4] if kind == "skilled" else [64, 64]
    actor = Actor(size, environment.action_space, hidden, 0.0, rng)
    match kind:
        case "initial":
            pass
        case "large weights":  # nearly deterministic, erratic
            actor.parameters[:] = 3 * rng.standard_normal(len(actor.parameters))
        case "normalised":  # as in training with normalise_observations
            actor.parameters[:] = rng.standard_normal(len(actor.parameters))
            mean, std, clip = rng.standard_normal(size), np.exp(rng.standard_normal(size)), 1.5
        case "skilled":  # balances CartPole to the time limit; swings Acrobot up
            actor.parameters[:] = 0
            if environment.name == "CartPole-v1":
                actor.weights[0][:, 0] = [0.03, 0.1, 1.0, 0.5]
            else:
                actor.weights[0][4, 0] = -0.5
            sharpness = rng.uniform(20, 60)
            actor.weights[1][0, [0, -1]] = [-sharpness, sharpness]
    return actor.for_acting(mean, std, clip)


KINDS = {"initial": 20, "large weights": 80, "normalised": 80, "skilled": 120}  # episodes


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", CLASSIC)
def test_compiled_episode_equals_stepping_gymnasium(name, kind):
    """`gymnasium.make`'s environment stepped here, and its double-precision state step by step."""
    environment = Environment(name, seed=3)
    assert rollout_for(environment) is roll_out_compiled
    env = gymnasium.make(name)
    env.reset(seed=0)
    noise_generator = np.random.default_rng(5)
    lengths, ends = [], set()
    for number in range(KINDS[kind]):
        policy = policy_of(environment, kind, seed=number % 10)
        noise = draw_noise(environment, noise_generator)
        env.unwrapped.np_random.bit_generator.state = environment.generator.bit_generator.state
        episode = roll_out_compiled(environment, policy, noise)

        observation, _ = env.reset()
        assert observation.tobytes() == episode.observations[0].tobytes()
        state = np.array(env.unwrapped.state, np.float64)
        first_state = state.copy()
        terminated = truncated = False
        t = 0
        while not (terminated or truncated):
            action, log_prob = compiled.act_discrete(observation, *policy[:5], noise[t])
            observation, reward, terminated, truncated, _ = env.step(action)
            if name == "CartPole-v1":
                stepped = compiled.step_cartpole(state, action)
            else:
                stepped = compiled.step_acrobot(state, action, 2.0)
            assert state.tobytes() == np.asarray(env.unwrapped.state).tobytes()
            assert stepped == (reward, terminated)
            assert episode.actions[t] == action
            assert episode.log_probs[t] == np.float32(log_prob)
            assert episode.rewards[t] == reward
            t += 1
            assert episode.observations[t].tobytes() == observation.tobytes()
        assert t == len(episode)
        assert episode.terminated == terminated
        lengths.append(t)
        ends.add(terminated)
        # The compiled loop's own state, which the next step would start from.
        state = first_state
        compiled.classic_control_episode(
            compiled.CARTPOLE if name == "CartPole-v1" else compiled.ACROBOT,
            state,
            episode.observations[0],
            *policy[:5],
            noise,
        )
        assert state.tobytes() == np.asarray(env.unwrapped.state).tobytes()
    # The policies do what they are here for.
    if kind == "skilled":
        typical = np.median(lengths)
        assert typical == 500 if name == "CartPole-v1" else typical < 100
    if name == "CartPole-v1":
        assert (False in ends) == (kind == "skilled")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", CLASSIC)
def test_both_rollouts_play_the_same_episodes(name, kind):
    """One after the other on two environments, so that the generators stay together too."""
    one, other = Environment(name, seed=1), Environment(name, seed=1)
    generators = np.random.default_rng(2), np.random.default_rng(2)
    for number in range(6):
        policy = policy_of(one, kind, seed=number)
        compiled_episode = roll_out_compiled(one, policy, draw_noise(one, generators[0]))
        ordinary_episode = roll_out(other, policy, draw_noise(other, generators[1]))
        assert equal(compiled_episode, ordinary_episode)
    states = [environment.generator.bit_generator.state for environment in (one, other)]
    assert states[0] == states[1]


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
        assert compiled.step_cartpole(state, action) == (reward, terminated)
        assert state.tobytes() == cartpole.state.tobytes()

        state = rng.standard_normal(4) * rng.choice([1e-3, 1.0, 10.0, 40.0], 4)
        action = int(rng.integers(3))
        acrobot.state = state.copy()
        _, reward, terminated, _, _ = acrobot.step(action)
        assert compiled.step_acrobot(state, action, 2.0) == (reward, terminated)
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
    environment = Environment(name, 0)
    before = environment.generator.bit_generator.state
    assert rollout_for(environment) is roll_out_compiled
    setattr(environment.env.unwrapped, attribute, value)
    assert rollout_for(environment) is roll_out
    assert environment.generator.bit_generator.state == before


class HeavyCartPole(CartPoleEnv):
    """Not Gymnasium's class, though all but its name is."""


def test_a_subclass_takes_the_ordinary_rollout(register):
    register("CartPole-v1", HeavyCartPole, 500)
    assert rollout_for(Environment("CartPole-v1", 0)) is roll_out


@pytest.mark.parametrize("name", ["FrozenLake-v1", "Pendulum-v1", "MountainCar-v0"])
def test_other_environments_take_the_ordinary_rollout(name):
    assert rollout_for(Environment(name, 0)) is roll_out


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


def uniform_policy(environment: Environment, log_std=0.0) -> ActingPolicy:
    size = environment.observation_size
    actor = Actor(size, environment.action_space, [4], log_std, np.random.default_rng(0))
    return actor.for_acting(np.zeros(size), np.ones(size), np.inf)


@pytest.mark.parametrize(
    ("length", "steps", "terminated"),
    [(100, 10, False), (4, 4, True), (10, 10, True), (11, 10, False)],
)
def test_time_limit_is_no_termination(register, length, steps, terminated):
    """At length 10 both come in the same step: the state is terminal."""
    environment = Environment(register("Corridor-v0", Corridor, 10, length=length), 0)
    noise = draw_noise(environment, np.random.default_rng(0))
    assert noise.shape == (10,)
    episode = roll_out(environment, uniform_policy(environment), noise)
    assert (len(episode), episode.terminated) == (steps, terminated)
    assert episode.rewards.tolist() == [0.5 * (t + 1) for t in range(steps)]
    assert episode.rewards.dtype == np.float64


def test_discrete_observations_are_one_hot_and_spaces_may_start_anywhere(register):
    environment = Environment(register("Corridor-v0", Corridor, 10, length=6), 0)
    noise = np.array([0.1, 0.9, 0.1, 0.9, 0.9, 0.1, 0, 0, 0, 0])
    episode = roll_out(environment, uniform_policy(environment), noise)
    assert (episode.observations == np.eye(9)[:7]).all()
    assert episode.observations.dtype == np.float32
    assert episode.actions.tolist() == [0, 1, 0, 1, 1, 0]
    assert environment.env.unwrapped.given == [-1, 0, -1, 0, 0, -1]


def test_frozen_lake_episode_replays_on_gymnasium_s_own():
    environment = Environment("FrozenLake-v1", 4)
    env = gymnasium.make("FrozenLake-v1")
    env.reset(seed=0)
    for number in range(20):
        env.unwrapped.np_random.bit_generator.state = environment.generator.bit_generator.state
        noise = draw_noise(environment, np.random.default_rng(number))
        episode = roll_out(environment, uniform_policy(environment), noise)
        states = [env.reset()[0]]
        for t, action in enumerate(episode.actions):
            state, reward, terminated, _, _ = env.step(int(action))
            states.append(state)
            assert reward == episode.rewards[t]
        assert (episode.observations == np.eye(16)[states]).all()
        assert terminated == episode.terminated


class Recorder(gymnasium.Env):
    """Keeps the actions it is given; observations are 2 × 2."""

    observation_space = Box(-1, 1, (2, 2), np.float64)
    action_space = Box(np.float32([-0.5, -2]), np.float32([0.25, 3]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.given = []
        return self.np_random.random((2, 2)), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.given.append(action.copy())
        return self.np_random.random((2, 2)), 0.0, False, False, {}


def test_box_actions_are_clipped_for_the_environment_only(register):
    environment = Environment(register("Recorder-v0", Recorder, 50), 0)
    noise = draw_noise(environment, np.random.default_rng(0))
    assert noise.shape == (50, 2)
    episode = roll_out(environment, uniform_policy(environment, log_std=1.0), noise)
    given = np.stack(environment.env.unwrapped.given)
    low, high = np.float32([-0.5, -2]), np.float32([0.25, 3])
    assert (episode.actions < low).any() and (episode.actions > high).any()
    assert (given == np.minimum(np.maximum(episode.actions, low), high)).all()
    # Actions and log-probabilities are those of the unclipped draw: means are near 0 here.
    np.testing.assert_allclose(episode.actions, np.e * noise, atol=0.05)
    assert episode.observations.shape == (51, 4) and episode.observations.dtype == np.float32


def test_noise_is_drawn_up_to_the_time_limit():
    """So that the stream is used up alike, however long an episode is."""
    generator = np.random.default_rng(0)
    drawn = draw_noise(Environment("CartPole-v1", 0), generator)
    assert (drawn == np.random.default_rng(0).random(500)).all()
    normals = draw_noise(Environment("Pendulum-v1", 0), np.random.default_rng(0))
    assert (normals == np.random.default_rng(0).standard_normal((200, 1))).all()


class Reuser(Recorder):
    """Returns the same array every time, changed in place."""

    action_space = Discrete(2)

    def reset(self, *, seed=None, options=None):
        super(Recorder, self).reset(seed=seed)
        self.state = np.zeros(4, np.float32)
        return self.state, {}

    def step(self, action):
        self.state += 1
        return self.state, 0.0, False, False, {}


def test_observations_are_copied(register):
    environment = Environment(register("Reuser-v0", Reuser, 3), 0)
    noise = draw_noise(environment, np.random.default_rng(0))
    observations = roll_out(environment, uniform_policy(environment), noise).observations
    assert observations[:, 0].tolist() == [0, 1, 2, 3]


def test_a_short_episode_holds_no_more_memory_than_its_own(register):
    environment = Environment(register("Corridor-v0", Corridor, 1000, length=4), 0)
    noise = draw_noise(environment, np.random.default_rng(0))
    episode = roll_out(environment, uniform_policy(environment), noise)
    for array in (episode.observations, episode.actions, episode.log_probs, episode.rewards):
        assert array.base is None and len(array) <= 5


# --- Environments -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*CLASSIC, "HopperBulletEnv-v0", "Pendulum-v1"])
def test_fresh_environment_with_an_aged_one_s_generator_replays_it(name):
    """What resuming rests on; in Hopper the very first episode is unlike all later ones."""
    aged, fresh = Environment(name, 0), Environment(name, 99)
    play = rollout_for(aged)
    policy = uniform_policy(aged)
    noise = [draw_noise(aged, np.random.default_rng(number)) for number in range(6)]
    for row in noise[:3]:
        play(aged, policy, row)
    fresh.generator.bit_generator.state = aged.generator.bit_generator.state
    for row in noise[3:]:
        assert equal(play(aged, policy, row), play(fresh, policy, row))


def test_environments_with_the_same_seed_are_the_same_and_others_differ():
    starts = [Environment("Acrobot-v1", seed).env.reset()[0].tolist() for seed in (0, 0, 1)]
    assert starts[0] == starts[1] != starts[2]


@pytest.mark.parametrize(
    ("attributes", "limit", "message"),
    [
        ({}, None, "no time limit"),
        ({"observation_space": gymnasium.spaces.MultiBinary(3)}, 10, "Box and Discrete work"),
        ({"action_space": gymnasium.spaces.MultiDiscrete([2, 2])}, 10, "Discrete and one-dim"),
        ({"action_space": Box(-1, 1, (2, 2))}, 10, "Discrete and one-dim"),
    ],
)
def test_environments_that_do_not_fit_are_refused_by_name(register, attributes, limit, message):
    entry_point = type("Unfit", (Corridor,), attributes)
    name = register("Unfit-v0", entry_point, limit)
    with pytest.raises(ConfigError, match=rf"Unfit-v0.*{message}"):
        Environment(name, 0)
    with pytest.raises(ConfigError, match="NoSuch-v0"):
        Environment("NoSuch-v0", 0)
