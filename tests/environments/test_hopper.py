"""FastHopperBulletEnv against the library's HopperBulletEnv: every bit, at every step."""

import itertools
from collections.abc import Callable

import numpy as np
import pybullet
import pytest
from pybullet_envs_gymnasium.gym_locomotion_envs import HopperBulletEnv
from pybullet_envs_gymnasium.scene_stadium import SinglePlayerStadiumScene

from mace_rl.environments import hopper
from mace_rl.environments.hopper import FastHopperBulletEnv

# The action [3] for a random generator, a state [15] and the number of the step in its episode.
Policy = Callable[[np.random.Generator, np.ndarray, int], np.ndarray]

# Found by random search: linear in the state, with a swing added, it hops for some 400 steps.
WEIGHTS = """
    0.54 0 0 -0.8 0 -1.24 0 0.95 1.18 0.88 0.01 2.58 -1.31 -0.81 0
    -1.29 0 0 0.72 0 0.28 0 0.94 0.64 -0.32 -0.86 -1.02 2.14 0.9 0
    0.57 0 0 -0.76 0 -0.05 0 -0.68 -0.34 -2.39 -0.11 -0.33 0.37 0.5 0
"""
WEIGHTS = np.array(WEIGHTS.split(), float).reshape(3, 15)
OFFSETS = np.array([0.65, -0.3, 0.21])
SWING = np.array([-0.36, -0.21, -0.03])


def uniform(bound: float, dtype: type = np.float32) -> Policy:
    return lambda rng, state, k: rng.uniform(-bound, bound, 3).astype(dtype)


def pushing(rng: np.random.Generator, state: np.ndarray, k: int) -> np.ndarray:
    return np.sign(rng.uniform(-1, 2, 3)).astype(np.float32)


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
        pybullet.getPhysicsEngineParameters(client),
        [pybullet.getDynamicsInfo(body, link, client) for link in range(-1, 10)],
    ]


def reset_both(ours: HopperBulletEnv, theirs: HopperBulletEnv, seed: int | None) -> np.ndarray:
    (state, info), (expected, expected_info) = ours.reset(seed=seed), theirs.reset(seed=seed)
    assert (state.tobytes(), state.dtype, info) == (expected.tobytes(), np.float32, expected_info)
    assert attributes(ours) == attributes(theirs) and simulator(ours) == simulator(theirs)
    assert ours.robot.np_random is ours.np_random
    assert ours.np_random.bit_generator.state == theirs.np_random.bit_generator.state
    return state


def step_both(ours: HopperBulletEnv, theirs: HopperBulletEnv, action) -> tuple[np.ndarray, bool]:
    state, *rest = ours.step(action)
    expected, *expected_rest = theirs.step(action)
    assert (state.tobytes(), state.dtype) == (expected.tobytes(), np.float32), (state, expected)
    assert rest == expected_rest and [*map(type, rest)] == [*map(type, expected_rest)]
    assert attributes(ours) == attributes(theirs)
    assert (ours._alive, ours.rewards) == (theirs._alive, theirs.rewards)
    return state, rest[1]


def run_both(ours, theirs, policy: Policy, steps: int, seed: int) -> list[int]:
    """Steps both environments side by side; the lengths of the finished episodes."""
    rng = np.random.default_rng(seed)
    state, lengths, length = reset_both(ours, theirs, seed), [], 0
    for _ in range(steps):
        action, before = policy(rng, state, length), state
        before[:] = 100.0  # a state is its caller's: not read again, nor written to
        state, terminated = step_both(ours, theirs, action)
        assert (before == 100.0).all()
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


@pytest.mark.parametrize(
    ("policy", "steps", "longest"),
    [
        (uniform(2.0), 4_000, 15),
        (uniform(2.0, np.float64), 1_000, 15),
        (hopping, 3_000, 250),
        (pushing, 2_000, 15),
    ],
)
def test_same_bits(pair, policy: Policy, steps: int, longest: int) -> None:
    lengths = run_both(*pair, policy, steps, seed=0)
    assert pair[0].fast, pair[0].fallback_reason
    assert max(lengths) >= longest


def test_same_bits_away_from_the_plane(pair) -> None:
    rng = np.random.default_rng(4)
    run_both(*pair, uniform(1.0), 50, seed=4)
    for _ in range(20):
        reset_both(*pair, seed=None)
        turn = pybullet.getQuaternionFromEuler(rng.uniform(-0.3, 0.3, 3))
        shift = rng.uniform(-3, 3, 3)
        for env in pair:
            body, client = env.robot.objects[0], env.physicsClientId
            pybullet.resetBasePositionAndOrientation(body, shift, turn, client)
        for _ in range(30):
            step_both(*pair, rng.uniform(-1, 1, 3).astype(np.float32))
        assert pair[0].robot.body_xyz[1] != 0 != pair[0].robot.body_rpy[2]


def test_towards_target_whatever_the_signs_of_zero() -> None:
    special, shortcuts = [0.0, -0.0, 1.5, -2.7, np.inf, np.nan], 0
    angles = [0.0, -0.0, np.pi, -0.3]
    for dx, dy, yaw in itertools.product([999.7, -3.1], [0.0, -0.0, 0.1], angles):
        theta, sin, cos = np.arctan2(dy, dx), np.sin(-yaw), np.cos(-yaw)
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        place = [theta, np.linalg.norm([dy, dx]), np.sin(theta - yaw), np.cos(theta - yaw)]
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
        body, joint = env.robot.objects[0], env.ordered_joints[1].jointIndex
        pybullet.resetJointState(body, joint, -0.1, speed, env.physicsClientId)
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


def test_unusual_actions_take_the_librarys_step_and_non_finite_ones_are_refused(pair) -> None:
    reset_both(*pair, seed=6)
    small = np.array([10, -10, 7], np.int8)  # squares that an int8 could not add up
    for action in 2 * [[0.1, -0.2, 0.3], np.array([1, -1, 0]), small, np.full(3, 0.4, np.float16)]:
        step_both(*pair, np.float32([0.5, -0.5, 0.1]))
        step_both(*pair, action)
    for env in pair:
        for bad in (np.nan, np.inf, -np.inf):
            with pytest.raises(AssertionError):
                env.step(np.array([0.1, bad, 0.1], np.float32))
    step_both(*pair, np.float32([0.5, -0.5, 0.1]))  # and left no torque behind


def other_scene(env: HopperBulletEnv, client: object) -> SinglePlayerStadiumScene:
    kind = type("OtherScene", (SinglePlayerStadiumScene,), {})
    env.stadium_scene = kind(client, gravity=9.8, timestep=0.0165 / 4, frame_skip=4)
    return env.stadium_scene


@pytest.mark.parametrize(
    ("where", "name", "value", "reason"),
    [
        (hopper, "VERIFIED", {"pybullet": "3.2.8"}, "pybullet is 3.2.7, verified with 3.2.8"),
        (hopper, "VERIFIED", {"no-such-package": "1"}, "no-such-package is unknown"),
        (hopper, "mean_of_11", lambda v: sum(v.tolist()) / 11, "numpy"),  # another order of adding
        (hopper, "JOINTS", {"thigh_joint": 4, "leg_joint": 6, "foot_joint": 7}, "laid out"),
        (hopper, "PARTS", dict(list(hopper.PARTS.items())[1:]), "laid out"),
        (FastHopperBulletEnv, "create_single_player_scene", other_scene, "scene"),
        (None, "rgb_array", None, "render_mode is 'rgb_array', not None"),
    ],
)
def test_falls_back(monkeypatch, where, name: str, value: object, reason: str) -> None:
    uncached = hopper.numpy_adds_as_assumed.__wrapped__
    monkeypatch.setattr(hopper, "numpy_adds_as_assumed", uncached)
    if where:
        monkeypatch.setattr(where, name, value)
    arguments = () if where else (name,)
    ours, theirs = FastHopperBulletEnv(*arguments), HopperBulletEnv(*arguments)
    assert not ours.fast
    assert ours.fallback_reason == "undecided before the first reset"
    run_both(ours, theirs, uniform(1.0), 100, seed=9)
    monkeypatch.undo()  # decided once: a changed mind would mix the two paths
    run_both(ours, theirs, uniform(1.0), 100, seed=9)
    assert not ours.fast and reason in ours.fallback_reason
