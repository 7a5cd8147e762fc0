"""Moving joints of vehicles: gimbals, and landing gears that are raised in flight out of the camera's view.

A gimbal stabilises the direction of a camera against the motion of the body. It rotates about the body's z (yaw), then
x (roll), then y (pitch). The commanded direction slews to a new setpoint at a limited rate; the joints move to the
angles that point the camera in this direction for any attitude of the body, within their limits and speeds. The
camera's direction is roll, pitch, yaw as in MAVLink: from the level frame along the vehicle's heading by yaw (positive
to the right), pitch (positive up), roll (positive to the right).

The autopilot commands the position of a landing gear (PX4: raised in AUTO modes more than 2 m above home). Its joints
move at the speed of the slowest. Contact with the ground is that of the vehicle's collision box, independent of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_common.rotation_kernels import conjugate_multiply, constrain, multiply, wrap_pi, yaw_of
from xtdrone_sim.kernel import kernel
from xtdrone_sim.vehicles.vehicle_model import VehicleModel

YAW, ROLL, PITCH = range(3)  # joints, from the body outwards
_STEPS = 5  # steps between two exchanges with the autopilot: 50 Hz
_LEVEL = 1e-6  # rad of roll below which the order of rotations does not matter

GIMBAL = np.dtype(
    [
        ("fitted", "i8"),
        ("wanted", "f8", 3),  # roll, pitch, yaw, rad; NaN: level, ahead
        ("slewed", "f8", 3),  # roll, pitch, yaw, rad: slewed setpoint
        ("rate", "f8"),  # rad/s, slew rate
        ("joint", "f8", 3),  # rad, yaw, roll, pitch joint, about the body's z, x, y
        ("joint_rate", "f8", 3),  # rad/s
        ("lower", "f8", 3),  # rad
        ("upper", "f8", 3),
        ("speed", "f8", 3),  # rad/s, maximum
        ("attitude", "f8", 3),  # roll, pitch, yaw, rad: direction of the camera
    ],
    align=True,
)


@kernel
def _about(axis, angle):
    """Return the quaternion (w, x, y, z) of a turn about axis 0, 1 or 2."""
    c, s = math.cos(0.5 * angle), math.sin(0.5 * angle)
    return c, s if axis == 0 else 0.0, s if axis == 1 else 0.0, s if axis == 2 else 0.0


@kernel
def direction(heading, roll, pitch, yaw):
    """Return the attitude (w, x, y, z), FLU in ENU, of a camera with the direction roll, pitch, yaw (see above)."""
    return multiply(_about(2, heading - yaw), multiply(_about(1, -pitch), _about(0, roll)))


@kernel
def joints_of(q):
    """Return yaw, roll and pitch joint angles, rad, that turn the camera from the body by ``q`` (w, x, y, z)."""
    w, x, y, z = q
    roll = math.asin(constrain(2.0 * (y * z + w * x), -1.0, 1.0))
    yaw = math.atan2(-2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z))
    pitch = math.atan2(-2.0 * (x * z - w * y), 1.0 - 2.0 * (x * x + y * y))
    return yaw, roll, pitch


@kernel
def turn_of(yaw, roll, pitch):
    """Return the camera's turn (w, x, y, z) from the body under joint angles, rad: the inverse of ``joints_of``."""
    return multiply(_about(2, yaw), multiply(_about(0, roll), _about(1, pitch)))


@kernel
def _note_attitude(g, q, heading):
    """Fill g.attitude from the joints and the body's attitude."""
    camera = multiply(q, turn_of(g.joint[0], g.joint[1], g.joint[2]))
    level = conjugate_multiply(_about(2, heading), camera)
    yaw, roll, pitch = joints_of(level)
    if abs(roll) > _LEVEL:
        w, x, y, z = level
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        pitch = math.asin(constrain(2.0 * (w * y - z * x), -1.0, 1.0))
        roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    g.attitude[0] = roll
    g.attitude[1] = -pitch
    g.attitude[2] = wrap_pi(-yaw)


@kernel
def _slew(g, dt):
    """Slew the setpoint; yaw turns in the shorter direction if its joint has no limits."""
    step = g.rate * dt
    for i in range(3):
        wanted = g.wanted[i] if math.isfinite(g.wanted[i]) else 0.0
        error = wanted - g.slewed[i]
        if i == 2 and math.isinf(g.upper[0]) and math.isinf(g.lower[0]):
            error = wrap_pi(error)
        g.slewed[i] += constrain(error, -step, step)


@kernel
def step_all(gimbals, plant, dt):
    """Advance the gimbals of all vehicles by ``dt`` s, for the bodies' current attitudes.

    Args:
        gimbals: (n,) ``GIMBAL``.
        plant: (n,) ``PLANT``.
        dt: s.
    """
    for i in range(gimbals.shape[0]):
        g = gimbals[i]
        if not g.fitted:
            continue
        q = plant[i].q
        _slew(g, dt)
        heading = yaw_of(q)
        camera = direction(heading, g.slewed[0], g.slewed[1], g.slewed[2])
        yaw, roll, pitch = joints_of(conjugate_multiply(q, camera))
        yaw = g.joint[0] + wrap_pi(yaw - g.joint[0])  # no jump where the angle wraps
        angles = (yaw, roll, pitch)
        for k in range(3):
            wanted = constrain(angles[k], g.lower[k], g.upper[k])
            turned = constrain(wanted - g.joint[k], -g.speed[k] * dt, g.speed[k] * dt)
            g.joint[k] += turned
            g.joint_rate[k] = turned / dt
        _note_attitude(g, q, heading)


class Gimbals:
    """The gimbals of a fleet.

    Attributes:
        records: (n,) ``GIMBAL``.
        any: whether a vehicle has one.
    """

    def __init__(self, models: Sequence[VehicleModel]) -> None:
        """Create the gimbals, pointing ahead.

        Args:
            models: one per vehicle.
        """
        self.records = np.zeros(len(models), GIMBAL)
        for index, model in enumerate(models):
            self.fit(index, model)

    def fit(self, index: int, model: VehicleModel | None) -> None:
        """Fit the vehicle ``index`` with the gimbal of a model, pointing ahead; None removes it."""
        self.records[index] = np.zeros(1, GIMBAL)[0]
        gimbal = None if model is None else model.gimbal
        if gimbal is not None:
            record = self.records[index]
            record["fitted"], record["wanted"], record["rate"] = 1, math.nan, gimbal.rate
            for k, (joint, sign) in enumerate(zip(gimbal.joints, gimbal.signs, strict=True)):
                record["lower"][k], record["upper"][k] = sorted((sign * joint.lower, sign * joint.upper))
                record["speed"][k] = joint.velocity
        self._fitted: list[int] = np.flatnonzero(self.records["fitted"]).tolist()
        self.any = bool(self._fitted)

    def reset(self, index: int) -> None:
        """Point the gimbal of vehicle ``index`` ahead, without a setpoint."""
        record = self.records[index]
        for field in ("slewed", "joint", "joint_rate", "attitude"):
            record[field] = 0.0
        record["wanted"] = math.nan

    def step(self, steps: int, plant: NDArray[np.void], commanders: Sequence[Commander], dt: float) -> None:
        """Advance by one step; exchange setpoints and attitudes with the autopilots at 50 Hz.

        Args:
            steps: number of this step.
            plant: (n,) ``PLANT``.
            commanders: one per vehicle; empty for external autopilots.
            dt: s.
        """
        exchange = bool(commanders) and steps % _STEPS == 0
        if exchange:
            for i in self._fitted:
                self.records["wanted"][i] = commanders[i].navigator.payload.gimbal
        step_all(self.records, plant, dt)
        if exchange:
            for i in self._fitted:
                roll, pitch, yaw = self.records["attitude"][i].tolist()
                commanders[i].navigator.payload.gimbal_attitude = (roll, pitch, yaw)


GEAR = np.dtype(
    [
        ("raised", "f8"),  # 0 down, 1 up
        ("rate", "f8"),  # 1/s, rate of ``raised``
        ("speed", "f8"),  # 1/s, maximum rate; 0: no landing gear
    ],
    align=True,
)


class LandingGears:
    """The landing gears of a fleet.

    Attributes:
        records: (n,) ``GEAR``.
        any: whether a vehicle has one.
    """

    def __init__(self, models: Sequence[VehicleModel]) -> None:
        """Create the landing gears, lowered.

        Args:
            models: one per vehicle.
        """
        self.records = np.zeros(len(models), GEAR)
        for index, model in enumerate(models):
            self.fit(index, model)

    def fit(self, index: int, model: VehicleModel | None) -> None:
        """Fit the vehicle ``index`` with the landing gear of a model, lowered; None removes it."""
        joints = () if model is None else model.landing_gear
        self.records[index] = np.zeros(1, GEAR)[0]
        self.records[index]["speed"] = min((joint.velocity / joint.upper for joint in joints), default=0.0)
        self._fitted: list[int] = np.flatnonzero(self.records["speed"]).tolist()
        self.any = bool(self._fitted)

    def reset(self, index: int) -> None:
        """Lower the landing gear of vehicle ``index`` at once."""
        self.records[index]["raised"] = self.records[index]["rate"] = 0.0

    def step(self, steps: int, commanders: Sequence[Commander], dt: float) -> None:
        """Advance by one step.

        Args:
            steps: number of this step.
            commanders: one per vehicle; empty for external autopilots: the gears stay down.
            dt: s.
        """
        if steps % _STEPS or not commanders:
            return
        for i in self._fitted:
            gear = self.records[i]
            before = float(gear["raised"])
            change = float(gear["speed"]) * dt * _STEPS
            raised = min(before + change, 1.0) if commanders[i].gear_up else max(before - change, 0.0)
            gear["raised"] = raised
            gear["rate"] = (raised - before) / (dt * _STEPS)
