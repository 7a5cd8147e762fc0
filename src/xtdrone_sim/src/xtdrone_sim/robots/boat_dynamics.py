"""Motion of a boat: a box that floats on waves, with drag and two thrusters.

The hull is divided into columns. Each displaces the water up to the surface above it, which lifts it (Archimedes) and,
where the surface is inclined, pushes it with the pressure gradient of the wave, -g times the slope (Froude and Krylov;
J. N. Newman, Marine Hydrodynamics, MIT Press 1977, 6.18). A hull accelerates some water with it (added mass), so that
with the added mass c m, heave in still water has the period 2 pi sqrt((1 + c) T / g) for a box of draught T. Drag is
linear and quadratic in the velocity against the water, along each of the hull's axes. A particle at the surface of a
wave of amplitude a moves on a circle of radius a; its horizontal acceleration is -g times the slope (6.2-6.3).

The origin is the centre of the hull at the waterline of its weight, and the centre of mass. The thrusters push along
the hull, at the height of the origin. Objects on deck add no weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from xtdrone_common.poses import Pose
from xtdrone_common.rotation import Vector, from_euler, yaw_of
from xtdrone_common.rotation_kernels import integrate, rotate, rotate_inverse
from xtdrone_common.settings import SettingError
from xtdrone_sim.kernel import kernel
from xtdrone_worlds.worlds.robots.robot_settings import (
    DENSITY,
    GRAVITY,
    BoatLimits,
    HullSettings,
    JointMotion,
    WaveSettings,
)

STATE = np.dtype(
    [("position", "f8", 3), ("q", "f8", 4), ("velocity", "f8", 3), ("rates", "f8", 3)]
)  # m, map; (w, x, y, z) boat to map; m/s, map; rad/s, boat

_ALONG, _ACROSS = 9, 5  # columns of the hull
_GAIN = 1.0, 2.0  # 1/s, gain with which speed and yaw rate follow their commands
_REST = 1e-3  # m/s and rad/s below which a boat on still water rests
_NEVER = -1


@kernel
def water_at(waves, x, y, time):
    """Return the water's surface at a place.

    Args:
        waves: (n,) ``WAVE``.
        x, y: m, map.
        time: s.

    Returns:
        Height above the still water, m; the water's velocity there (3 numbers), m/s; and its acceleration (3), m/s^2.
    """
    height, u, v, w, ax, ay, az = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(waves.shape[0]):
        one = waves[k]
        angle = one.kx * x + one.ky * y - one.frequency * time + one.phase
        c, s = one.amplitude * math.cos(angle), one.amplitude * math.sin(angle)
        number = math.sqrt(one.kx * one.kx + one.ky * one.ky)
        east, north = one.kx / number, one.ky / number
        speed, push = one.frequency * c, one.frequency * one.frequency * s
        height += c
        u += east * speed
        v += north * speed
        w += one.frequency * s
        ax += east * push
        ay += north * push
        az -= one.frequency * one.frequency * c
    return height, u, v, w, ax, ay, az


@kernel
def _pressure(boat, waves, level, time, hull, draught):
    """Return the water's effect on the hull, summed over its columns.

    Args:
        boat: ``STATE``.
        waves, level, time, hull, draught: see ``advance``.

    Returns:
        Force (3), N, and moment (3), N m, both in the map; mean velocity (3), m/s, and acceleration (3), m/s^2, of the
        displaced water, map; and the sum of the columns' depths, m.
    """
    cell = hull[0] * hull[1] / (_ALONG * _ACROSS)
    ux, uy, uz = rotate(boat.q, 0.0, 0.0, 1.0)
    force_x, force_y, force_z, moment_x, moment_y, moment_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    flow_x, flow_y, flow_z, surge_x, surge_y, surge_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    sunk = 0.0
    for i in range(_ALONG):
        for j in range(_ACROSS):
            a = ((i + 0.5) / _ALONG - 0.5) * hull[0]
            b = ((j + 0.5) / _ACROSS - 0.5) * hull[1]
            rx, ry, rz = rotate(boat.q, a, b, -draught)
            height, u, v, w, ax, ay, az = water_at(waves, boat.position[0] + rx, boat.position[1] + ry, time)
            depth = min(max(level + height - boat.position[2] - rz, 0.0), hull[2])
            rx, ry, rz = rx + 0.5 * depth * ux, ry + 0.5 * depth * uy, rz + 0.5 * depth * uz
            displaced = DENSITY * cell * depth
            fx, fy, fz = displaced * ax, displaced * ay, displaced * GRAVITY
            force_x, force_y, force_z = force_x + fx, force_y + fy, force_z + fz
            moment_x, moment_y = moment_x + (ry * fz - rz * fy), moment_y + (rz * fx - rx * fz)
            moment_z = moment_z + (rx * fy - ry * fx)
            flow_x, flow_y, flow_z = flow_x + depth * u, flow_y + depth * v, flow_z + depth * w
            surge_x, surge_y, surge_z = surge_x + depth * ax, surge_y + depth * ay, surge_z + depth * az
            sunk += depth
    total = sunk if sunk > 0.0 else 1.0  # in the air all sums are zero
    flow = flow_x / total, flow_y / total, flow_z / total
    surge = surge_x / total, surge_y / total, surge_z / total
    return (force_x, force_y, force_z), (moment_x, moment_y, moment_z), flow, surge, sunk


@kernel
def _accelerate(boat, force, flow, surge, wet, mass, added, linear, quadratic, push, dt):
    """Change the velocity by weight, water, drag and thrust.

    Args:
        boat: ``STATE``; ``velocity`` is updated.
        force, flow, surge: see ``_pressure``.
        wet: 0..1, share of drag and added mass.
        mass, added, linear, quadratic, push, dt: see ``advance``.
    """
    q, v = boat.q, boat.velocity
    f = rotate_inverse(q, force[0], force[1], force[2] - mass * GRAVITY)
    speed = rotate_inverse(q, v[0] - flow[0], v[1] - flow[1], v[2] - flow[2])
    pull = rotate_inverse(q, surge[0], surge[1], surge[2])
    ax = _acceleration_along(0, f[0] + push, speed, pull, wet, mass, added, linear, quadratic)
    ay = _acceleration_along(1, f[1], speed, pull, wet, mass, added, linear, quadratic)
    az = _acceleration_along(2, f[2], speed, pull, wet, mass, added, linear, quadratic)
    ax, ay, az = rotate(q, ax, ay, az)
    v[0] += ax * dt
    v[1] += ay * dt
    v[2] += az * dt


@kernel
def _acceleration_along(k, force, speed, pull, wet, mass, added, linear, quadratic):
    """Return the acceleration, m/s^2, along the hull's axis ``k`` by ``force``, N, and drag; see ``_accelerate``."""
    drawn = force - wet * (linear[k] + quadratic[k] * abs(speed[k])) * speed[k]
    return (drawn + wet * added[k] * mass * pull[k]) / (mass * (1.0 + wet * added[k]))


@kernel
def _turn(boat, moment, wet, mass, hull, turning, torque, dt):
    """Change the rates by water, drag and thrust (Euler's equations of a box).

    Args:
        boat: ``STATE``; ``rates`` is updated.
        moment: see ``_pressure``.
        wet: 0..1, share of drag.
        mass, hull, turning, torque, dt: see ``advance``.
    """
    x = mass * (hull[1] ** 2 + hull[2] ** 2) / 12.0  # moments of inertia, kg m^2
    y = mass * (hull[0] ** 2 + hull[2] ** 2) / 12.0
    z = mass * (hull[0] ** 2 + hull[1] ** 2) / 12.0
    tx, ty, tz = rotate_inverse(boat.q, moment[0], moment[1], moment[2])
    p, r, s = boat.rates[0], boat.rates[1], boat.rates[2]
    boat.rates[0] += (tx - (wet * turning[0] * p + (z - y) * r * s)) / x * dt
    boat.rates[1] += (ty - (wet * turning[1] * r + (x - z) * s * p)) / y * dt
    boat.rates[2] += (tz + torque - (wet * turning[2] * s + (y - x) * p * r)) / z * dt


@kernel
def advance(boats, waves, level, time, mass, hull, draught, added, linear, quadratic, turning, push, torque, dt):
    """Advance a boat by one step.

    Args:
        boats: (1,) ``STATE``, updated.
        waves: (n,) ``robot_settings.WAVE``.
        level: level of the still water, m, map.
        time: time at the beginning, s.
        mass: kg.
        hull: (3,) length, width, depth, m.
        draught: m.
        added, linear, quadratic, turning: (3,) see ``BoatLimits``.
        push: force of the thrusters along its x, N.
        torque: torque of the thrusters about its z, N m.
        dt: s.
    """
    boat = boats[0]
    force, moment, flow, surge, sunk = _pressure(boat, waves, level, time, hull, draught)
    wet = min(sunk / (_ALONG * _ACROSS * draught), 1.0)  # a hull in the air has neither drag nor added mass
    _accelerate(boat, force, flow, surge, wet, mass, added, linear, quadratic, push, dt)
    _turn(boat, moment, wet, mass, hull, turning, torque, dt)
    for k in range(3):
        boat.position[k] += boat.velocity[k] * dt
    integrate(boat.q, boat.rates[0] * dt, boat.rates[1] * dt, boat.rates[2] * dt)


@dataclass(frozen=True)
class BoatState:
    """State of a boat.

    Attributes:
        pose: pose of the origin in the map.
        velocity: m/s, map.
        rates: rad/s, in the boat.
    """

    pose: Pose
    velocity: Vector
    rates: Vector

    @property
    def yaw(self) -> float:
        """Heading, rad, counter-clockwise from east."""
        return yaw_of(self.pose.orientation)


class Boat:
    """A boat on waves: the drive of its body, see ``movable_bodies.Drive``."""

    yields = True  # static bodies stop it
    floats = True  # the plane z = 0 is not ground for it

    def __init__(
        self,
        hull: HullSettings,
        limits: BoatLimits,
        waves: WaveSettings,
        pose: Pose = Pose(),  # noqa: B008, immutable
    ) -> None:
        """Float at the place and heading of a pose, at rest."""
        self.hull, self.limits, self.sea = hull, limits, waves
        self._waves = waves.waves if waves.amplitude else waves.waves[:0]
        self._box = np.array([hull.length, hull.width, hull.depth])
        self._constants = tuple(
            np.array(each)
            for each in (limits.added_mass, limits.linear_drag, limits.quadratic_drag, limits.turning_drag)
        )
        self._own_time = 0.0
        self._clock: Callable[[], float] | None = None
        self._record, self._next = np.zeros(1, STATE), np.zeros(1, STATE)
        self.place(pose)

    def follow_clock(self, clock: Callable[[], float]) -> None:
        """Use the waves at ``clock()``, s, the time at the beginning of a step, instead of the boat's own time."""
        self._clock = clock

    def place(self, pose: Pose) -> None:
        """Float at the place and heading of a pose, at rest; the command ends."""
        x, y, _ = pose.position
        self._record["position"], self._record["q"] = (
            (x, y, self.sea.level),
            from_euler(0.0, 0.0, yaw_of(pose.orientation)),
        )
        self._record["velocity"] = self._record["rates"] = 0.0
        self._linear = self._angular = 0.0
        self._left_us, self._is_driven = _NEVER, False
        self._next[:] = self._record

    def command(self, linear: float, angular: float) -> None:
        """Set the wanted forward speed, m/s, and yaw rate, rad/s, both clamped to the limits.

        Raises:
            ValueError: a value is not finite.
        """
        for name, value in (("linear.x", linear), ("angular.z", angular)):
            if not math.isfinite(value):
                raise SettingError(name, value, "a finite number")
        self._linear = max(-self.limits.speed, min(self.limits.speed, linear))
        self._angular = max(-self.limits.turn_rate, min(self.limits.turn_rate, angular))
        self._left_us, self._is_driven = round(self.limits.timeout * 1e6) if self.limits.timeout else _NEVER, True

    @property
    def state(self) -> BoatState:
        """State at the current time."""
        boat = self._record[0]
        x, y, z = boat["position"].tolist()
        w, i, j, k = boat["q"].tolist()
        return BoatState(Pose((x, y, z), (w, i, j, k)), tuple(boat["velocity"].tolist()), tuple(boat["rates"].tolist()))

    @property
    def twist(self) -> tuple[Vector, Vector]:
        """Velocity, m/s, and rates, rad/s, both along the boat's axes."""
        boat = self._record[0]
        return rotate_inverse(boat["q"], *boat["velocity"].tolist()), tuple(boat["rates"].tolist())

    @property
    def is_level(self) -> bool:
        """Whether waves have not moved it yet, or it floats level at the map's height."""
        boat = self._record[0]
        return not (boat["position"][2] or boat["q"][1] or boat["q"][2])

    @property
    def is_still(self) -> bool:
        """Whether it rests on still water without a command."""
        boat = self._record[0]
        moves = max(abs(boat["velocity"]).max(), abs(boat["rates"]).max()) > _REST
        return not (len(self._waves) or moves or self._linear or self._angular)

    def joints(self) -> list[JointMotion]:
        """Return no joints."""
        return []

    def thrusts(self) -> tuple[float, float]:
        """Return the forces of the left and the right thruster, N, for the current command."""
        if not self._is_driven:
            return 0.0, 0.0
        limits, (ahead, _, _) = self.limits, self.twist[0]
        drag = limits.linear_drag[0] + limits.quadratic_drag[0] * abs(self._linear)
        push = drag * self._linear + _GAIN[0] * self.hull.mass * (self._linear - ahead)
        turn = limits.turning_drag[2] * self._angular
        turn += _GAIN[1] * self.hull.inertia[2] * (self._angular - float(self._record[0]["rates"][2]))
        both, apart = 0.5 * push, turn / limits.apart
        left, right = (max(-limits.thrust, min(limits.thrust, both + side * apart)) for side in (-1.0, 1.0))
        return left, right

    def propose(self, dt: float) -> tuple[Pose, Vector, Vector]:
        """Return pose, mean velocity, m/s, and spin, rad/s, in the map, of a step of ``dt``, s; see ``accept``."""
        if self._left_us != _NEVER:
            self._left_us -= round(dt * 1e6)
            if self._left_us < 0:
                self._left_us, self._is_driven, self._linear, self._angular = _NEVER, False, 0.0, 0.0
        left, right = self.thrusts()
        self._next[:] = self._record
        time = self._clock() if self._clock is not None else self._own_time
        advance(
            self._next, self._waves, self.sea.level, time, self.hull.mass, self._box, self.hull.draught,
            *self._constants, left + right, 0.5 * self.limits.apart * (right - left), dt,
        )  # fmt: skip
        self._own_time += dt
        new = self._next[0]
        x, y, z = new["position"].tolist()
        w, i, j, k = new["q"].tolist()
        return Pose((x, y, z), (w, i, j, k)), tuple(new["velocity"].tolist()), rotate(new["q"], *new["rates"].tolist())

    def accept(self) -> None:
        """Apply the step that was proposed last."""
        self._record[:] = self._next

    def block(self) -> None:
        """Stop where the boat is, instead of the step that was proposed last; it keeps heaving, without turning."""
        self._record["velocity"][0, :2] = 0.0
        self._record["rates"] = 0.0  # as its attitude stays
        self._record["velocity"][0, 2] = self._next["velocity"][0, 2]
        self._record["position"][0, 2] = self._next["position"][0, 2]
