"""FastHopperBulletEnv against the library's HopperBulletEnv: every bit, at every step."""

import itertools
from collections.abc import Callable

import numpy as np
import pybullet
import pytest
from gymnasium.wrappers import TimeLimit
from pybullet_envs_gymnasium.gym_locomotion_envs import HopperBulletEnv
from pybullet_envs_gymnasium.scene_stadium import SinglePlayerStadiumScene

from mace_rl.environments import hopper
from mace_rl.environments.hopper import FastHopperBulletEnv

# The action [3] for a random generator, a state [15] and the number of the step in its episode.
Policy = Callable[[np.random.Generator, np.ndarray, int], np.ndarray]

# Found by random search: linear in the state, it stands for some 700 steps; with the swing added,
# it hops for some 400.
WEIGHTS = np.array(
    [
        [0.54, 0, 0, -0.8, 0, -1.24, 0, 0.95, 1.18, 0.88, 0.01, 2.58, -1.31, -0.81, 0],
        [-1.29, 0, 0, 0.72, 0, 0.28, 0, 0.94, 0.64, -0.32, -0.86, -1.02, 2.14, 0.9, 0],
        [0.57, 0, 0, -0.76, 0, -0.05, 0, -0.68, -0.34, -2.39, -0.11, -0.33, 0.37, 0.5, 0],
    ]
)  # [3, 15]
OFFSETS = np.array([0.65, -0.3, 0.21])
SWING = np.array([-0.36, -0.21, -0.03])


def uniform(bound: float, dtype: type = np.float32) -> Policy:
    return lambda rng, state, k: rng.uniform(-bound, bound, 3).astype(dtype)


def zero(rng: np.random.Generator, state: np.ndarray, k: int) -> np.ndarray:
    return np.zeros(3, np.float32)


def pushing(rng: np.random.Generator, state: np.ndarray, k: int) -> np.ndarray:
    """Full torques, more often one way than the other: joints at their limits."""
    return np.sign(rng.uniform(-1, 2, 3)).astype(np.float32)


def standing(rng: np.random.Generator, state: np.ndarray, k: int) -> np.ndarray:
    return (WEIGHTS @ state + OFFSETS).astype(np.float32)


def hopping(rng: np.random.Generator, state: np.ndarray, k: int) -> np.ndarray:
    return (WEIGHTS @ state + OFFSETS + SWING * np.sin(1.17 * k)).astype(np.float32)


def attributes(env: HopperBulletEnv) -> tuple:
    """What the library leaves behind after a reset or a step."""
    robot = env.robot
    return (
        *(v.tobytes() for v in (robot.joint_speeds, robot.feet_contact, robot.body_real_xyz)),
        *(robot.body_xyz, robot.body_rpy, robot.joints_at_limit),
        *(robot.initial_z, type(robot.initial_z)),  # numpy's, which the library's step relies on
        *(robot.walk_target_theta, robot.walk_target_dist),
        *(env.potential, env.reward, env.frame, env.done),
    )


def simulator(env: HopperBulletEnv) -> list:
    """What pybullet tells of the simulation, motors and parameters included."""
    body, client = env.robot.objects[0], env.physicsClientId
    return [
        pybullet.getLinkStates(body, range(10), 1, 0, client),
        pybullet.getJointStates(body, range(10), client),
        pybullet.getContactPoints(physicsClientId=client),
        pybullet.getPhysicsEngineParameters(client),
        [pybullet.getDynamicsInfo(body, link, client) for link in range(-1, 10)],
        [pybullet.getBasePositionAndOrientation(k, client) for k in range(2)],
    ]


def assert_same_state(ours: np.ndarray, theirs: np.ndarray) -> None:
    assert ours.tobytes() == theirs.tobytes(), (ours, theirs)
    assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape) == (np.float32, (15,))


def reset_both(ours: HopperBulletEnv, theirs: HopperBulletEnv, seed: int | None) -> np.ndarray:
    (state, info), (expected, expected_info) = ours.reset(seed=seed), theirs.reset(seed=seed)
    assert_same_state(state, expected)
    assert info == expected_info
    assert attributes(ours) == attributes(theirs)
    assert simulator(ours) == simulator(theirs)
    assert ours.robot.np_random is ours.np_random
    assert ours.np_random.bit_generator.state == theirs.np_random.bit_generator.state
    return state


def step_both(
    ours: HopperBulletEnv, theirs: HopperBulletEnv, action: object
) -> tuple[np.ndarray, bool]:
    state, *rest = ours.step(action)
    expected, *expected_rest = theirs.step(action)
    assert_same_state(state, expected)
    assert rest == expected_rest
    assert [type(v) for v in rest] == [type(v) for v in expected_rest]
    assert attributes(ours) == attributes(theirs)
    assert (ours._alive, ours.rewards) == (theirs._alive, theirs.rewards)
    return state, rest[1]


def run_both(
    ours: HopperBulletEnv, theirs: HopperBulletEnv, policy: Policy, steps: int, seed: int
) -> list[int]:
    """Steps both environments side by side; the lengths of the finished episodes."""
    rng = np.random.default_rng(seed)
    state, lengths, length = reset_both(ours, theirs, seed), [], 0
    for _ in range(steps):
        state, terminated = step_both(ours, theirs, policy(rng, state, length))
        length += 1
        if terminated or length == 1000:
            # A seed now and then, as a caller may give one at any reset.
            state = reset_both(ours, theirs, seed if len(lengths) % 50 == 49 else None)
            lengths.append(length)
            length = 0
    return lengths


@pytest.fixture
def pair():
    ours, theirs = FastHopperBulletEnv(), HopperBulletEnv()
    yield ours, theirs
    ours.close()
    theirs.close()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("policy", "steps", "longest"),
    [
        (uniform(1.0), 14_000, 15),
        (uniform(3.0), 4_000, 15),
        (uniform(2.0, np.float64), 4_000, 15),
        (standing, 8_000, 500),
        (hopping, 16_000, 250),
        (pushing, 4_000, 15),
        (zero, 1_000, 15),
    ],
    ids=["uniform", "out of range", "float64", "standing", "hopping", "pushing", "zero"],
)
def test_same_bits(pair, policy: Policy, steps: int, longest: int, seed: int) -> None:
    lengths = run_both(*pair, policy, steps, seed)
    assert pair[0].fast, pair[0].fallback_reason
    assert max(lengths) >= longest


def test_same_bits_away_from_the_plane(pair) -> None:
    """Turned aside, where none of the sines, products and sums is a zero."""
    rng = np.random.default_rng(4)
    run_both(*pair, uniform(1.0), 50, seed=4)
    for _ in range(20):
        reset_both(*pair, seed=None)
        turn = pybullet.getQuaternionFromEuler(rng.uniform(-0.3, 0.3, 3))
        shift = rng.uniform(-3, 3, 3)
        for env in pair:
            pybullet.resetBasePositionAndOrientation(
                env.robot.objects[0], shift, turn, physicsClientId=env.physicsClientId
            )
        for _ in range(30):
            step_both(*pair, rng.uniform(-1, 1, 3).astype(np.float32))
        assert pair[0].robot.body_xyz[1] != 0 != pair[0].robot.body_rpy[2]


def test_towards_target_whatever_the_signs_of_zero() -> None:
    special = [0.0, -0.0, 1.5, -2.7, np.inf, np.nan]
    angles = [0.0, -0.0, np.pi, -0.3]
    shortcuts = 0
    for dx, dy, yaw in itertools.product([999.7, -3.1], [0.0, -0.0, 0.1], angles):
        theta = np.arctan2(dy, dx)
        turn = np.array(
            [[np.cos(-yaw), -np.sin(-yaw), 0], [np.sin(-yaw), np.cos(-yaw), 0], [0, 0, 1]]
        )
        angle = theta - yaw
        place = [theta, np.linalg.norm([dy, dx]), np.sin(angle), np.cos(angle)]
        for speed in itertools.product(special, repeat=3):
            with np.errstate(invalid="ignore"):
                expected = np.array([*place, *np.dot(turn, np.array(speed))])
                results = [hopper.towards_target(dx, dy, yaw, *speed)]
            holds, short = hopper.in_plane(dx, dy, yaw, *speed)
            shortcuts += holds
            zero = expected == 0
            for found in map(np.array, [*results, short] if holds else results):
                np.testing.assert_array_equal(found, expected)
                np.testing.assert_array_equal(np.signbit(found[zero]), np.signbit(expected[zero]))
    assert shortcuts


@pytest.mark.parametrize("speed", [1e3, -1e6, np.nan])
def test_same_bits_when_the_simulator_blows_up(pair, speed: float) -> None:
    run_both(*pair, uniform(1.0), 50, seed=5)
    for env in pair:
        env.robot.alive_bonus = lambda z, pitch: 1  # so that only a NaN can end the episode
        reset_joint = env.ordered_joints[1].jointIndex
        pybullet.resetJointState(
            env.robot.objects[0], reset_joint, -0.1, speed, physicsClientId=env.physicsClientId
        )
    ours, theirs = (env.step(np.zeros(3, np.float32)) for env in pair)
    np.testing.assert_array_equal(ours[0], theirs[0])  # a NaN's sign is the processor's affair
    np.testing.assert_array_equal(ours[1], theirs[1])
    assert ours[2:] == theirs[2:]
    assert (np.abs(ours[0]).max() == 5) != ours[2] == np.isnan(speed)


def test_a_reset_puts_the_librarys_physics_back(pair) -> None:
    run_both(*pair, uniform(1.0), 50, seed=13)
    for env in pair:
        client = env.physicsClientId
        pybullet.setGravity(0, 0, -1.6, client)
        pybullet.setPhysicsEngineParameter(numSolverIterations=50, physicsClientId=client)
    for _ in range(5):
        step_both(*pair, np.float32([0.5, -0.5, 0.1]))
    run_both(*pair, uniform(1.0), 50, seed=13)
    assert pybullet.getPhysicsEngineParameters(client)["gravityAccelerationZ"] == -9.8


def test_unusual_actions_take_the_librarys_step(pair) -> None:
    reset_both(*pair, seed=6)
    small = np.array([10, -10, 7], np.int8)  # squares that an int8 could not add up
    for action in 2 * [[0.1, -0.2, 0.3], np.array([1, -1, 0]), small, np.full(3, 0.4, np.float16)]:
        step_both(*pair, np.float32([0.5, -0.5, 0.1]))
        step_both(*pair, action)


def test_non_finite_actions_are_refused(pair) -> None:
    reset_both(*pair, seed=7)
    for env in pair:
        for bad in (np.nan, np.inf, -np.inf):
            with pytest.raises(AssertionError):
                env.step(np.array([0.1, bad, 0.1], np.float32))
    step_both(*pair, np.float32([0.5, -0.5, 0.1]))  # and left no torque behind


@pytest.mark.parametrize("fresh_class", [FastHopperBulletEnv, HopperBulletEnv])
@pytest.mark.parametrize("aged_class", [FastHopperBulletEnv, HopperBulletEnv])
def test_a_fresh_environment_replays_an_aged_one(aged_class: type, fresh_class: type) -> None:
    """After one throw-away reset; what resuming an interrupted run rests on."""
    aged, fresh, hasty = aged_class(), fresh_class(), fresh_class()
    rng = np.random.default_rng(8)
    aged.reset(seed=8)
    for _ in range(600):
        if aged.step(rng.uniform(-1, 1, 3).astype(np.float32))[2]:
            aged.reset()

    fresh.reset()
    for env in (fresh, hasty):
        env.robot.np_random.bit_generator.state = aged.robot.np_random.bit_generator.state
        env.reset()
    action = np.float32([0.5, -0.5, 0.1])
    (state, reward, *_), (hasty_state, hasty_reward, *_) = (e.step(action) for e in (fresh, hasty))
    assert_same_state(hasty_state, state)
    assert hasty_reward != reward  # why one reset is thrown away

    fresh.robot.np_random.bit_generator.state = aged.robot.np_random.bit_generator.state
    for _ in range(6):
        state, _ = aged.reset()
        assert_same_state(fresh.reset()[0], state)
        for k in range(100):
            action = hopping(rng, state, k)
            state, *rest = aged.step(action)
            replayed, *replayed_rest = fresh.step(action)
            assert_same_state(replayed, state)
            assert replayed_rest == rest
    for env in (aged, fresh, hasty):
        env.close()


class OtherScene(SinglePlayerStadiumScene):
    pass


def other_scene(env: HopperBulletEnv, client: object) -> SinglePlayerStadiumScene:
    env.stadium_scene = OtherScene(client, gravity=9.8, timestep=0.0165 / 4, frame_skip=4)
    return env.stadium_scene


@pytest.mark.parametrize(
    ("where", "name", "value", "reason"),
    [
        (hopper, "VERIFIED", {"pybullet": "3.2.8"}, "pybullet is 3.2.7, verified with 3.2.8"),
        (hopper, "VERIFIED", {"no-such-package": "1"}, "no-such-package is unknown"),
        (hopper, "numpy_adds_as_assumed", lambda: False, "numpy"),
        (hopper, "JOINTS", {"thigh_joint": 4, "leg_joint": 6, "foot_joint": 7}, "laid out"),
        (hopper, "PARTS", dict(list(hopper.PARTS.items())[1:]), "laid out"),
        (FastHopperBulletEnv, "create_single_player_scene", other_scene, "scene"),
    ],
)
def test_falls_back(monkeypatch, where, name: str, value: object, reason: str) -> None:
    monkeypatch.setattr(where, name, value)
    ours, theirs = FastHopperBulletEnv(), HopperBulletEnv()
    assert not ours.fast
    assert ours.fallback_reason == "undecided before the first reset"
    run_both(ours, theirs, uniform(1.0), 300, seed=9)
    assert not ours.fast
    assert reason in ours.fallback_reason
    monkeypatch.undo()  # decided once: a changed mind would mix the two paths
    run_both(ours, theirs, uniform(1.0), 300, seed=9)
    assert not ours.fast


def test_falls_back_with_a_render_mode() -> None:
    ours, theirs = FastHopperBulletEnv("rgb_array"), HopperBulletEnv("rgb_array")
    run_both(ours, theirs, uniform(1.0), 100, seed=10)
    assert not ours.fast
    assert ours.fallback_reason == "render_mode is 'rgb_array', not None"


def test_another_order_of_addition_is_noticed(monkeypatch) -> None:
    assert hopper.numpy_adds_as_assumed.__wrapped__()
    monkeypatch.setattr(hopper, "mean_of_11", lambda v: sum(v.tolist()) / 11)
    assert not hopper.numpy_adds_as_assumed.__wrapped__()


def test_is_the_same_environment_to_a_caller(pair) -> None:
    ours, theirs = pair
    assert isinstance(ours, HopperBulletEnv)
    assert ours.action_space == theirs.action_space
    assert ours.observation_space == theirs.observation_space
    assert ours.metadata == theirs.metadata

    env = TimeLimit(ours, 1000)
    state, info = env.reset(seed=11)
    assert info == {}
    for _ in range(1000):
        assert ours.observation_space.contains(state)
        state, reward, _, truncated, info = env.step((WEIGHTS @ state).astype(np.float32))
        assert type(reward) is float
        assert info == {}
    assert truncated


def test_states_are_the_callers_to_keep(pair) -> None:
    """A returned state is neither overwritten later nor read again."""
    ours, theirs = pair
    state = reset_both(ours, theirs, seed=12)
    kept, copy = state, state.copy()
    action = np.float32([0.5, -0.5, 0.1])
    for _ in range(5):
        ours.step(action)[0][:] = 100.0
        theirs.step(action)
        step_both(ours, theirs, action)
    assert kept.tobytes() == copy.tobytes()
