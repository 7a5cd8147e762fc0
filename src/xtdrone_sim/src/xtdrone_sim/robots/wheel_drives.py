"""Motion of wheeled robots, without slip: differential drive and Ackermann steering.

The origin of a robot is on the ground below the centre of its driven axle. Speed, yaw rate and steering angle follow
their commands within limits of their rates; during a step, the origin moves on the exact arc of its speed and yaw rate.
K. Lynch and F. Park, *Modern Robotics*, 13.3, give the equations. On slopes the motion is along the robot's x axis, and
height and attitude follow the ground below the wheels, see ``wheels_on_uneven_ground``.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np

from xtdrone_common.poses import Pose, conjugate
from xtdrone_common.rotation import Vector, from_euler, multiply, yaw_of
from xtdrone_common.settings import SettingError
from xtdrone_sim.rays.solid_ground import SolidGround
from xtdrone_sim.robots.boat_dynamics import Boat
from xtdrone_sim.robots.wheels_on_uneven_ground import (
    STEP,
    Footprint,
    Heights,
    Stand,
    follow,
    heights_below,
    places,
    stand_on,
)
from xtdrone_worlds.worlds.robots.robot_model import AnyRobot, BoatModel, RobotModel
from xtdrone_worlds.worlds.robots.robot_settings import AckermannLimits, DifferentialLimits, DriveLimits, JointMotion

_NEVER = -1
_CASTORS = 0.4  # of the body's length, before and behind its middle


@dataclass(frozen=True)
class DriveState:
    """State of a robot.

    Attributes:
        x, y, z: m, map ENU.
        yaw: rad, counter-clockwise from east.
        speed: along its own x, m/s.
        rate: yaw rate, rad/s.
        steering: angle of a front wheel in the middle, rad; 0 with a differential drive.
        left, right: angles that the driven wheels have turned, rad.
        roll, pitch: rad; 0 on level ground.
        heights: heights of the ground below the wheels, m, see ``wheels_on_uneven_ground.places``.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    speed: float = 0.0
    rate: float = 0.0
    steering: float = 0.0
    left: float = 0.0
    right: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    heights: Heights = (0.0, 0.0, 0.0, 0.0)

    @property
    def pose(self) -> Pose:
        """Pose of the origin in the world."""
        return Pose((self.x, self.y, self.z), from_euler(self.roll, self.pitch, self.yaw))


class Drive(ABC):
    """A robot's wheels and motors.

    Attributes:
        state: state at the current time.
    """

    limits: DriveLimits
    yields = True  # static bodies stop it
    floats = False

    def __init__(self, pose: Pose = Pose()) -> None:  # noqa: B008, immutable
        """Place the robot at rest at a pose, of which only position and yaw are used."""
        self.state = DriveState()
        self._ground: SolidGround | None = None
        self._feet = Footprint(-1.0, 1.0, 1.0)
        self.place(pose)

    def stand_on(self, ground: SolidGround, feet: Footprint) -> None:
        """Follow ground that need not be level, from the current position on.

        Args:
            ground: the ground; surfaces far above the robot are ignored.
            feet: contact points of the wheels.
        """
        self._ground, self._feet = ground, feet
        self.place(self.state.pose)

    def place(self, pose: Pose) -> None:
        """Place the robot at rest at a pose in the world, upright or on the ground below it; the command ends."""
        x, y, z = pose.position
        self.state = replace(DriveState(), x=x, y=y, z=z, yaw=yaw_of(pose.orientation), heights=(z, z, z, z))
        if self._ground is not None:
            at = places(x, y, self.state.yaw, self._feet)
            span = max(map(abs, self._feet))  # the ground may rise by 45 degrees
            self.state = self._standing(self.state, heights_below(self._ground, at, (z + span,) * 4))
        self._linear = self._angular = 0.0
        self._left_us, self._next = _NEVER, self.state

    def command(self, linear: float, angular: float) -> None:
        """Set the wanted speed, m/s, and the wanted yaw rate, rad/s (of a car: steering angle, rad).

        Values beyond the limits are clamped.

        Raises:
            ValueError: a value is not finite.
        """
        for name, value in (("linear.x", linear), ("angular.z", angular)):
            if not math.isfinite(value):
                raise SettingError(name, value, "a finite number")
        self._linear, self._angular = _clip(linear, self.limits.speed), angular
        self._left_us = round(self.limits.timeout * 1e6) if self.limits.timeout else _NEVER

    @property
    def twist(self) -> tuple[Vector, Vector]:
        """Velocity, m/s, and spin, rad/s, both along the robot's axes."""
        return (self.state.speed, 0.0, 0.0), (0.0, 0.0, self.state.rate)

    @property
    def is_level(self) -> bool:
        """Whether the robot stands on the plane z = 0."""
        return not (self.state.z or self.state.roll or self.state.pitch)

    @property
    def is_still(self) -> bool:
        """Whether the robot stands and has no command to move."""
        return not (self.state.speed or self.state.rate or self._linear or self._turns())

    def propose(self, dt: float) -> tuple[Pose, Vector, Vector]:
        """Return pose, mean velocity, m/s, and spin, rad/s, in the world of a step of ``dt``, s; see ``accept``."""
        if self._left_us != _NEVER:
            self._left_us -= round(dt * 1e6)
            if self._left_us < 0:
                self._left_us, self._linear = _NEVER, 0.0
                self._stop_turning()
        old = self.state
        self._next = new = self._move(dt)
        pace = ((new.x - old.x) / dt, (new.y - old.y) / dt, (new.z - old.z) / dt)
        return new.pose, pace, _spin(old, new, dt)

    def accept(self) -> None:
        """Apply the step that was proposed last."""
        self.state = self._next

    def block(self) -> None:
        """Stop at once where the robot is, instead of the step that was proposed last."""
        self.state = replace(self.state, speed=0.0, rate=0.0)

    def _move(self, dt: float) -> DriveState:
        old = self.state
        change = self.limits.acceleration * dt
        speed = old.speed + _clip(self._linear - old.speed, change)
        steering, rate = self._turn(old, speed, dt)
        half = 0.5 * rate * dt
        way = speed * dt * (math.sin(half) / half if half else 1.0)  # the chord of the arc
        way *= math.cos(old.pitch)
        yaw = math.remainder(old.yaw + rate * dt, math.tau)
        apart = 0.5 * self.limits.track * rate
        new = DriveState(
            old.x + way * math.cos(old.yaw + half),
            old.y + way * math.sin(old.yaw + half),
            old.z,
            yaw,
            speed,
            rate,
            steering,
            old.left + (speed - apart) / self.limits.wheel_radius * dt,
            old.right + (speed + apart) / self.limits.wheel_radius * dt,
            old.roll,
            old.pitch,
            old.heights,
        )
        return new if self._ground is None else self._roll(old, new, self._ground)

    def _roll(self, old: DriveState, new: DriveState, ground: SolidGround) -> DriveState:
        """Return ``new`` on the ground, or the current state at rest if the slope or step there is too large."""
        before, after = (places(one.x, one.y, one.yaw, self._feet) for one in (old, new))
        ways = np.hypot(*(after - before).T).tolist()
        below = heights_below(ground, after, old.heights)
        heights = follow(old.heights, below, ways, STEP * self.limits.wheel_radius)
        if heights is not None:
            stands = self._standing(new, heights)
            tilts = [Stand(0.0, one.roll, one.pitch).tilt for one in (old, stands)]
            if tilts[1] <= max(self.limits.slope, tilts[0]):
                return stands
        return replace(old, speed=0.0, rate=0.0, steering=new.steering)

    def _standing(self, state: DriveState, heights: Heights) -> DriveState:
        z, roll, pitch = stand_on(heights, self._feet)
        return replace(state, z=z, roll=roll, pitch=pitch, heights=heights)

    def _wheels(self, left: str, right: str) -> list[JointMotion]:
        state, apart = self.state, 0.5 * self.limits.track * self.state.rate
        return [
            JointMotion(left, state.left, (state.speed - apart) / self.limits.wheel_radius),
            JointMotion(right, state.right, (state.speed + apart) / self.limits.wheel_radius),
        ]

    @abstractmethod
    def _turn(self, old: DriveState, speed: float, dt: float) -> tuple[float, float]:
        """Return the steering angle and the yaw rate of a step."""

    @abstractmethod
    def _turns(self) -> bool:
        """Return whether the command makes a robot at rest turn its wheels or steering."""

    @abstractmethod
    def _stop_turning(self) -> None:
        """End the turning command after the timeout."""

    @abstractmethod
    def joints(self) -> list[JointMotion]:
        """Return the states of all joints."""


class Differential(Drive):
    """Two driven wheels: yaw rate and speed follow from their speeds."""

    def __init__(self, limits: DifferentialLimits, pose: Pose = Pose()) -> None:  # noqa: B008, immutable
        """Stand at a pose."""
        self.limits: DifferentialLimits = limits
        super().__init__(pose)

    def _turn(self, old: DriveState, speed: float, dt: float) -> tuple[float, float]:
        wanted = _clip(self._angular, self.limits.turn_rate)
        return 0.0, old.rate + _clip(wanted - old.rate, self.limits.turn_acceleration * dt)

    def _turns(self) -> bool:
        return self._angular != 0.0

    def _stop_turning(self) -> None:
        self._angular = 0.0

    def joints(self) -> list[JointMotion]:
        """Return the states of the two wheels."""
        return self._wheels("left_wheel_joint", "right_wheel_joint")


class Ackermann(Drive):
    """A car: the rear axle drives, both front wheels point at right angles to the centre of the curve."""

    def __init__(self, limits: AckermannLimits, pose: Pose = Pose()) -> None:  # noqa: B008, immutable
        """Stand at a pose."""
        self.limits: AckermannLimits = limits
        super().__init__(pose)

    def _turn(self, old: DriveState, speed: float, dt: float) -> tuple[float, float]:
        wanted = _clip(self._angular, self.limits.steering)
        steering = old.steering + _clip(wanted - old.steering, self.limits.steering_rate * dt)
        return steering, speed * math.tan(steering) / self.limits.wheelbase

    def _turns(self) -> bool:
        return _clip(self._angular, self.limits.steering) != self.state.steering

    def _stop_turning(self) -> None:
        """Keep the steering angle after the timeout, like a car without a driver."""

    def joints(self) -> list[JointMotion]:
        """Return the states of the rear wheels, of the front wheels and of their steering.

        cot(left) = cot(steering) - track / (2 wheelbase), cot(right) likewise with +. The speed of a front wheel is
        that of the origin times the ratio of their distances from the centre of the curve.
        """
        state, limits = self.state, self.limits
        slope = math.tan(state.steering) / limits.wheelbase  # curvature of the origin's path, 1/m
        found = self._wheels("rear_left_wheel_joint", "rear_right_wheel_joint")
        for side, name, turned in ((-1.0, "front_left", state.left), (1.0, "front_right", state.right)):
            share = 1.0 + 0.5 * side * limits.track * slope
            angle = math.atan2(limits.wheelbase * slope, share)
            rate = state.speed * math.hypot(share, limits.wheelbase * slope) / limits.wheel_radius
            found.append(JointMotion(f"{name}_steering_joint", angle, 0.0))
            found.append(JointMotion(f"{name}_wheel_joint", turned, rate))
        return found


def drive_of(model: AnyRobot, pose: Pose, ground: SolidGround | None = None) -> Drive | Boat:
    """Return the drive of a robot at rest.

    Args:
        model: type of the robot.
        pose: its start; of a boat, only position and heading are used.
        ground: ground of wheels, if it is not level.
    """
    if isinstance(model, BoatModel):
        return Boat(model.hull, model.limits, model.waves, pose)
    drive: Drive
    if isinstance(model.limits, AckermannLimits):
        drive = Ackermann(model.limits, pose)
    else:
        drive = Differential(model.limits, pose)
    if ground is not None:
        drive.stand_on(ground, feet_of(model))
    return drive


def feet_of(model: RobotModel) -> Footprint:
    """Return the contact points with the ground: the wheels; of a robot with two, also castors in front and behind."""
    side = 0.5 * model.limits.track
    if isinstance(model.limits, AckermannLimits):
        return Footprint(0.0, model.limits.wheelbase, side)
    half = _CASTORS * model.body.length
    return Footprint(model.body.ahead - half, model.body.ahead + half, side)


def _spin(old: DriveState, new: DriveState, dt: float) -> Vector:
    """Return the mean spin of a step, rad/s, world: that of the yaw alone while the robot is level."""
    if not (old.roll or old.pitch or new.roll or new.pitch):
        return (0.0, 0.0, new.rate)
    w, x, y, z = multiply(new.pose.orientation, conjugate(old.pose.orientation))
    scale = math.copysign(2.0, w) / dt  # the sine of half a small angle
    return (scale * x, scale * y, scale * z)


def _clip(value: float, most: float) -> float:
    return max(-most, min(most, value))
