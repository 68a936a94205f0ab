"""HopperBulletEnv-v0, the same to the bit, about three times as fast.

The library calls the simulator some 25 times a step, through a slow wrapper; here a step is six
calls. The rest is compiled arithmetic in the library's order, with numpy's bits. For sin, cos,
arctan2 and dot either the result is exact, or the same numpy function is called.
"""

import math
import struct
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import pybullet
from numpy.typing import NDArray
from pybullet_envs_gymnasium.gym_locomotion_envs import HopperBulletEnv
from pybullet_envs_gymnasium.robot_locomotors import Hopper
from pybullet_envs_gymnasium.scene_stadium import SinglePlayerStadiumScene

from mace_rl.numerics.compiling import njit

VERIFIED = {"pybullet": "3.2.7", "pybullet_envs_gymnasium": "0.6.0"}
# Pybullet's numbers of the robot's parts, in the library's order of averaging positions.
PARTS = {"link0_2": 0, "torso": 3, "link0_3": 1, "link0_4": 2, "link0_6": 4}
PARTS |= {"thigh": 5, "link0_8": 6, "leg": 7, "link0_10": 8, "foot": 9}
LINKS = list(PARTS.values())
JOINTS = {"thigh_joint": 4, "leg_joint": 6, "foot_joint": 8}
JOINT_NUMBERS = list(JOINTS.values())
AT_LIMIT = np.float32(0.99)  # the library compares float32 with 0.99, rounded to float32
BOUND = np.float32(5.0)  # of every number in the state
write_raw = struct.Struct("42d").pack_into  # faster than numpy's assignment


@njit(cache=True)
def mean_of_11(v: NDArray[np.float64]) -> float:
    """`np.mean` of 11 doubles: numpy adds the first eight pairwise, then the rest in order."""
    first8 = ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7]))
    return (first8 + v[8] + v[9] + v[10]) / 11


@cache
def numpy_adds_as_assumed() -> bool:
    """Whether this numpy adds 3 or 11 numbers, and takes a norm, in the order written here."""
    # Sizes so different that another order gives other bits.
    rng = np.random.default_rng(0)
    tried = rng.standard_normal((50, 33)) * 10.0 ** rng.integers(-3, 4, (50, 33))
    return all(
        v[0::3].mean() == mean_of_11(v[0::3].copy())
        and v[:3].astype(np.float32).mean() == sum(v[:3].astype(np.float32)) / 3
        and np.linalg.norm(v[:2].tolist()) == math.sqrt(v[:2].dot(v[:2]))
        for v in tried
    )


@njit(cache=True)
def in_plane(dx, dy, yaw, vx, vy, vz):
    """Whether the hopper moves in the plane y = 0, facing the target; `towards_target` if so.

    Then products with dy, vy or yaw are zeros, each added to a 0.0; sin(0), cos(0), arctan2(0, dx)
    and sqrt(dx * dx) are exact. This holds until the hopper has fallen.
    """
    yaw_positive, vy_positive = math.copysign(1.0, yaw) > 0.0, math.copysign(1.0, vy) > 0.0
    facing = yaw == 0.0 and dy == 0.0 and dx > 0.0 and (vx != 0.0 or yaw_positive)
    holds = facing and vy == 0.0 and vy_positive and math.isfinite(vx + vz)
    return holds, (dy, dx, dy - yaw, 1.0, vx + 0.0, 0.0, vz + 0.0)


def towards_target(dx, dy, yaw, vx, vy, vz):
    """Angle and distance of the target, sin and cos of the turn to it, speed turned by -yaw."""
    theta = np.arctan2(dy, dx)
    target = np.array((dy, dx))
    sin, cos = np.sin(-yaw), np.cos(-yaw)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    speed = np.dot(rotation, np.array((vx, vy, vz))).tolist()
    angle = theta - yaw
    return theta, math.sqrt(target.dot(target)), float(np.sin(angle)), float(np.cos(angle)), *speed


@njit(cache=True)
def state_in_plane(raw, ranges, floor_xyz, target_x, target_y, initial_z, feet_contact):
    """`robot.calc_state` if `in_plane` holds; otherwise state[1:6] is wrong.

    raw: float64 [42], the ten parts' positions [10, 3], the joints' angles and speeds [3, 2], the
    torso's speed [3], roll, pitch and yaw; ranges: the joints' lowest and highest angles, [3, 2].
    Returns the state, float32 [15]; the joints' speeds, float32 [3], and how many joints are at
    their limits; the parts' mean x and y; and whether `in_plane` holds.
    """
    xyz, joints = raw[:30].reshape(10, 3), raw[30:36].reshape(3, 2)
    vx, vy, vz, roll, pitch, yaw = raw[36:]
    column = np.empty(11)
    column[:10], column[10] = xyz[:, 0], floor_xyz[0]
    x = mean_of_11(column)
    column[:10], column[10] = xyz[:, 1], floor_xyz[1]
    y = mean_of_11(column)
    holds, towards = in_plane(target_x - x, target_y - y, yaw, vx, vy, vz)

    state = np.empty(15, np.float32)
    state[0] = xyz[1, 2] - initial_z
    state[1], state[2] = towards[2], towards[3]
    state[3], state[4], state[5] = 0.3 * towards[4], 0.3 * towards[5], 0.3 * towards[6]
    state[6], state[7] = roll, pitch
    at_limit = 0
    for k in range(3):  # each joint's position within its range, from -1 to 1, a tenth of its speed
        low, high = ranges[k]
        state[8 + 2 * k] = 2 * (joints[k, 0] - low) / (high - low) - 1.0
        state[9 + 2 * k] = 0.1 * joints[k, 1]
        at_limit += abs(state[8 + 2 * k]) > AT_LIMIT
    state[14] = feet_contact[0]
    speeds = state[9:14:2].copy()
    for k in range(15):
        if abs(state[k]) > BOUND:  # a NaN stays NaN
            state[k] = math.copysign(BOUND, state[k])
    return state, speeds, at_limit, x, y, holds


@njit(cache=True)
def effort(action: NDArray[np.floating], speeds: NDArray[np.float32]) -> tuple[float, float]:
    """Means of |action · speed| and action², in the precision of `action` [3] (as in numpy)."""
    (a1, a2, a3), three = action, action.dtype.type(3)
    power = (abs(a1 * speeds[0]) + abs(a2 * speeds[1]) + abs(a3 * speeds[2])) / three
    return float(power), float((a1 * a1 + a2 * a2 + a3 * a3) / three)


class FastHopperBulletEnv(HopperBulletEnv):
    """The library's `HopperBulletEnv`: same constructor, spaces, numbers and random stream.

    `fast` says whether the fast path is in use, `fallback_reason` why not ("" if it is). Both are
    decided after the first reset, which is the library's own. An action that is not a float32 or
    float64 array of shape (3,) takes the library's step.

    Randomness is `robot.np_random`, three uniform draws a reset. To restore a generator, set its
    `bit_generator.state`: assigning `env.np_random` does not reach the robot. As in the library,
    the first reward of an instance is off: its first reset averages positions without the floor.
    """

    scene: Any  # the library's, from its first reset on
    robot: Any  # the library's
    reward: Any  # an int, to which the library adds floats
    _raw: Any  # float64 [42]; for mypy an ndarray is a buffer from Python 3.12 on

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.fast = False
        self.fallback_reason = "undecided before the first reset"
        self._decided = False

    def _reason_to_fall_back(self) -> str:
        """The first condition of the fast path that does not hold, or ""."""
        for package, verified in VERIFIED.items():
            try:
                found = version(package)
            except PackageNotFoundError:
                found = "unknown"
            if found != verified:
                return f"{package} is {found}, verified with {verified}"
        if not numpy_adds_as_assumed():
            return f"numpy {np.__version__} adds numbers in another order than verified"
        if self.render_mode is not None:
            return f"render_mode is {self.render_mode!r}, not None"
        connection = pybullet.getConnectionInfo(self.physicsClientId)["connectionMethod"]
        if not self.ownsPhysicsClient or connection != pybullet.DIRECT:
            return "the simulator is not a headless one of this environment's own"
        if type(self.scene) is not SinglePlayerStadiumScene or type(self.robot) is not Hopper:
            return "the scene or the robot is not the library's"
        on_body = [[k, p.bodies[p.bodyIndex], p.bodyPartIndex] for k, p in self.parts.items()]
        joints = [[j.joint_name, j.bodies[j.bodyIndex], j.jointIndex] for j in self.ordered_joints]
        hopper, floor = self.robot.objects[0], self.scene.ground_plane_mjcf[0]
        if (
            on_body != [*([k, hopper, n] for k, n in PARTS.items()), ["floor", floor, -1]]
            or joints != [[k, hopper, n] for k, n in JOINTS.items()]
            or self.robot.robot_body is not self.parts["torso"]
            or self.robot.feet != [self.parts["foot"]]
            or self.ground_ids != {(floor, -1)}
        ):
            return "the robot's parts are not laid out as verified"
        return ""

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """The library's reset, from the second one on without what then changes nothing."""
        if not self.fast:
            result = super().reset(seed=seed, options=options)
            if not self._decided:
                self._decided = True
                self.fallback_reason = self._reason_to_fall_back()
                self.fast = not self.fallback_reason
            if self.fast:
                self._hopper, self._floor = self.robot.objects[0], self.scene.ground_plane_mjcf[0]
                self._ranges = np.array([(j.lowerLimit, j.upperLimit) for j in self.ordered_joints])
                self._floor_xyz = self.parts["floor"].get_position()  # fixed
                self._raw = np.empty(42)
            return result
        robot, client = self.robot, self.physicsClientId
        pybullet.restoreState(self.stateId, physicsClientId=client)
        if seed is not None:
            self.seed(seed)
        self.scene.episode_restart(self._p)
        self.frame = self.done = self.reward = 0
        robot.feet_contact, robot.initial_z = np.zeros(1, dtype=np.float32), None
        for joint, angle in zip(JOINT_NUMBERS, robot.np_random.uniform(-0.1, 0.1, 3), strict=True):
            pybullet.resetJointState(self._hopper, joint, angle, 0, client)
        off, gains = [0, 0, 0], [0.1, 0.1, 0.1]
        mode = pybullet.POSITION_CONTROL
        pybullet.setJointMotorControlArray(
            self._hopper, JOINT_NUMBERS, mode, off, off, off, gains, gains, client
        )
        state = self._observe()
        self.potential = -robot.walk_target_dist / self.scene.dt
        return state, {}

    def step(
        self, a: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One step of 16.5 ms under action `a` [3]; see the library for the terms of the reward."""
        is_array = type(a) is np.ndarray and a.shape == (3,) and a.dtype.char in "fd"
        if not (self.fast and is_array):
            return super().step(a)
        robot, client = self.robot, self.physicsClientId
        torques = []
        for joint, u in zip(self.ordered_joints, a.tolist(), strict=True):
            assert math.isfinite(u)
            clipped = u if -1.0 <= u <= 1.0 else math.copysign(1.0, u)
            torques.append(robot.power * joint.power_coef * clipped)
        mode = pybullet.TORQUE_CONTROL
        pybullet.setJointMotorControlArray(
            self._hopper, JOINT_NUMBERS, mode, forces=torques, physicsClientId=client
        )
        pybullet.stepSimulation(client)

        state = self._observe()
        height = state.item(0) + float(robot.initial_z)
        self._alive = float(robot.alive_bonus(height, robot.body_rpy[1]))
        done = self._isDone() or math.isnan(sum(state.tolist()))

        potential_old = self.potential
        self.potential = -robot.walk_target_dist / self.scene.dt
        progress = float(self.potential - potential_old)

        foot = PARTS["foot"]
        on_ground = pybullet.getContactPoints(self._hopper, self._floor, foot, -1, client)
        robot.feet_contact[0] = 1.0 if on_ground else 0.0

        power, stall = effort(a, robot.joint_speeds)
        electricity = self.electricity_cost * power + self.stall_torque_cost * stall
        at_limit = float(self.joints_at_limit_cost * robot.joints_at_limit)
        self.rewards = [self._alive, progress, electricity, at_limit, 0.0]
        self.HUD(state, a, done)
        reward = sum(self.rewards)
        self.reward += reward
        return state, reward, bool(done), False, {}

    def _observe(self) -> NDArray[np.float32]:
        """`robot.calc_state`, setting what it sets; the state [15]."""
        robot, client = self.robot, self.physicsClientId
        links = pybullet.getLinkStates(self._hopper, LINKS, 1, 0, client)  # 1: with velocities
        joints = pybullet.getJointStates(self._hopper, JOINT_NUMBERS, client)
        xyz, quaternion, _, _, _, _, (vx, _, vz), turning = links[1]  # the torso
        robot.body_real_xyz = np.array(xyz)
        robot.body_rpy = pybullet.getEulerFromQuaternion(quaternion)
        if robot.initial_z is None:
            robot.initial_z = np.float64(xyz[2])  # numpy's, lest the library's step add in float32

        raw = []
        for link in links:
            raw += link[0]
        for joint in joints:
            raw += joint[:2]
        # By a slip in `BodyPart.speed`, the library's vy is the torso's turning speed about z.
        velocity = vx, turning[2], vz
        write_raw(self._raw, 0, *raw, *velocity, *robot.body_rpy)
        target = target_x, target_y = robot.walk_target_x, robot.walk_target_y
        fixed = self._ranges, self._floor_xyz, *target, robot.initial_z, robot.feet_contact
        state, robot.joint_speeds, robot.joints_at_limit, x, y, holds = state_in_plane(
            self._raw, *fixed
        )
        theta, distance = dy, dx = target_y - y, target_x - x
        if not holds:
            theta, distance, *rest = towards_target(dx, dy, robot.body_rpy[2], *velocity)
            scaled = np.array(rest) * (1, 1, 0.3, 0.3, 0.3)
            state[1:6] = scaled.astype(np.float32).clip(-BOUND, BOUND)
        robot.walk_target_theta, robot.walk_target_dist = theta, distance
        robot.body_xyz = (x, y, xyz[2])
        return state
