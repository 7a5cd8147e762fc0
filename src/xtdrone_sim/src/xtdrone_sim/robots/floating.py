"""Motion of a boat: a box that floats on waves, with drag and two thrusters.

The hull is divided into columns. Each displaces the water up to the surface above it, which lifts it (Archimedes) and,
where the surface is inclined, pushes it with the pressure gradient of the wave, -g times the slope (Froude and Krylov;
J. N. Newman, Marine Hydrodynamics, MIT Press 1977, 6.18). A hull accelerates some water with it (added mass), so that
with the added mass c m, heave in still water has the period 2 pi sqrt((1 + c) T / g) for a box of draught T. Drag is
linear and quadratic in the velocity against the water, along each of the hull's axes.

The origin is the middle of the hull at the waterline of its weight, and the centre of mass. The thrusters push along
the hull, at the height of the origin. What is on deck adds no weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from xtdrone_control.rotation import Vector, from_euler, yaw_of
from xtdrone_control.rotation_kernels import integrate, rotate, rotate_inverse
from xtdrone_control.settings import SettingError, Settings, setting
from xtdrone_sim.kernel import kernel
from xtdrone_sim.robots.kinematics import Joint
from xtdrone_sim.robots.waves import GRAVITY, WaveSettings, water_at
from xtdrone_sim.shapes.visual import Pose

DENSITY = 1000.0
"""Of fresh water, kg/m^3."""

STATE = np.dtype(
    [("position", "f8", 3), ("q", "f8", 4), ("velocity", "f8", 3), ("rates", "f8", 3)]
)  # m, map; (w, x, y, z) boat to map; m/s, map; rad/s, boat

_ALONG, _ACROSS = 9, 5  # columns of the hull
_GAIN = 1.0, 2.0  # 1/s, with which speed and yaw rate follow their commands
_REST = 1e-3  # m/s and rad/s below which a boat on still water rests
_NEVER = -1


@dataclass(frozen=True)
class HullSettings(Settings):
    """Hull of a boat, a box."""

    length: float = setting(3.0, low=0.05, high=100.0, unit="m", text="along its x")
    width: float = setting(1.6, low=0.05, high=30.0, unit="m", text="along its y")
    depth: float = setting(0.6, low=0.05, high=20.0, unit="m", text="from its bottom to its top")
    mass: float = setting(800.0, low=0.01, high=1e7, unit="kg", text="which gives its draught")
    colour: tuple[float, float, float] = setting((0.75, 0.3, 0.15), low=0.0, high=1.0, text="red, green, blue")

    def __post_init__(self) -> None:
        super().__post_init__()
        most = DENSITY * self.length * self.width * self.depth
        if self.mass > 0.95 * most:
            raise SettingError("mass", self.mass, f"at most {0.95 * most:.6g} kg: its box displaces {most:.6g} kg")
        draught, middle = self.draught, 0.5 * self.draught
        least = (draught - middle) * 12.0 * draught
        if self.width**2 <= least:  # KB + BM - KG, with the centre of mass at the waterline
            raise SettingError("width", self.width, f"more than {math.sqrt(least):.3g} m: it would capsize")

    @property
    def draught(self) -> float:
        """Of its weight in still water, m."""
        return self.mass / (DENSITY * self.length * self.width)


@dataclass(frozen=True)
class BoatLimits(Settings):
    """Thrusters and drag of a boat; forces of the drag are those at 1 m/s or 1 rad/s."""

    thrust: float = setting(250.0, low=0.0, high=1e6, unit="N", text="largest force of each thruster, either way")
    apart: float = setting(1.2, low=0.01, high=30.0, unit="m", text="distance of the two thrusters")
    speed: float = setting(3.0, low=0.01, high=50.0, unit="m/s", text="largest speed, forwards and backwards")
    turn_rate: float = setting(0.8, low=0.01, high=10.0, unit="rad/s", text="largest yaw rate")
    linear_drag: tuple[float, float, float] = setting(
        (40.0, 400.0, 2000.0), low=0.0, high=1e7, unit="N", text="linear drag along, across, up"
    )
    quadratic_drag: tuple[float, float, float] = setting(
        (40.0, 600.0, 1000.0), low=0.0, high=1e7, unit="N", text="quadratic drag along, across, up"
    )
    turning_drag: tuple[float, float, float] = setting(
        (400.0, 1500.0, 500.0), low=0.0, high=1e8, unit="N m", text="drag of roll, pitch and yaw, linear"
    )
    added_mass: tuple[float, float, float] = setting(
        (0.1, 0.6, 1.0), low=0.0, high=10.0, text="of the water that moves along, across, up, in masses of the boat"
    )
    timeout: float = setting(
        0.5, low=0.0, high=3600.0, unit="s", text="time without a command after which the thrusters stop; 0: never"
    )


@kernel
def advance(boats, waves, level, time, mass, hull, draught, added, linear, quadratic, turning, push, torque, dt):
    """Advance a boat by one step.

    Args:
        boats: (1,) ``STATE``, updated.
        waves, level: of the water.
        time: at the beginning, s.
        mass: kg.
        hull: (3,) length, width, depth, m.
        draught: m.
        added, linear, quadratic, turning: (3,) see ``BoatLimits``.
        push: force of the thrusters along its x, N.
        torque: of the thrusters about its z, N m.
        dt: s.
    """
    boat = boats[0]
    q = boat.q
    cell = hull[0] * hull[1] / (_ALONG * _ACROSS)
    ux, uy, uz = rotate(q, 0.0, 0.0, 1.0)
    force, moment, water, surge = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    sunk = 0.0
    for i in range(_ALONG):
        for j in range(_ACROSS):
            a = ((i + 0.5) / _ALONG - 0.5) * hull[0]
            b = ((j + 0.5) / _ACROSS - 0.5) * hull[1]
            rx, ry, rz = rotate(q, a, b, -draught)
            height, u, v, w, ax, ay, az = water_at(waves, boat.position[0] + rx, boat.position[1] + ry, time)
            depth = min(max(level + height - boat.position[2] - rz, 0.0), hull[2])
            rx, ry, rz = rx + 0.5 * depth * ux, ry + 0.5 * depth * uy, rz + 0.5 * depth * uz
            displaced = DENSITY * cell * depth
            fx, fy, fz = displaced * ax, displaced * ay, displaced * GRAVITY
            force[0] += fx
            force[1] += fy
            force[2] += fz
            moment[0] += ry * fz - rz * fy
            moment[1] += rz * fx - rx * fz
            moment[2] += rx * fy - ry * fx
            water[0] += depth * u
            water[1] += depth * v
            water[2] += depth * w
            surge[0] += depth * ax
            surge[1] += depth * ay
            surge[2] += depth * az
            sunk += depth
    if sunk > 0.0:
        for k in range(3):
            water[k] /= sunk
            surge[k] /= sunk
    force[2] -= mass * GRAVITY
    wet = min(sunk / (_ALONG * _ACROSS * draught), 1.0)  # a hull in the air has neither drag nor added mass
    f = np.empty(3)
    f[0], f[1], f[2] = rotate_inverse(q, force[0], force[1], force[2])
    flow, pull = np.empty(3), np.empty(3)
    flow[0], flow[1], flow[2] = rotate_inverse(
        q, boat.velocity[0] - water[0], boat.velocity[1] - water[1], boat.velocity[2] - water[2]
    )
    pull[0], pull[1], pull[2] = rotate_inverse(q, surge[0], surge[1], surge[2])
    f[0] += push
    for k in range(3):
        f[k] -= wet * (linear[k] + quadratic[k] * abs(flow[k])) * flow[k]
        f[k] = (f[k] + wet * added[k] * mass * pull[k]) / (mass * (1.0 + wet * added[k]))
    ax, ay, az = rotate(q, f[0], f[1], f[2])
    boat.velocity[0] += ax * dt
    boat.velocity[1] += ay * dt
    boat.velocity[2] += az * dt
    inertia = np.empty(3)
    inertia[0] = mass * (hull[1] ** 2 + hull[2] ** 2) / 12.0
    inertia[1] = mass * (hull[0] ** 2 + hull[2] ** 2) / 12.0
    inertia[2] = mass * (hull[0] ** 2 + hull[1] ** 2) / 12.0
    t = np.empty(3)
    t[0], t[1], t[2] = rotate_inverse(q, moment[0], moment[1], moment[2])
    t[2] += torque
    p, r, s = boat.rates[0], boat.rates[1], boat.rates[2]
    t[0] -= wet * turning[0] * p + (inertia[2] - inertia[1]) * r * s
    t[1] -= wet * turning[1] * r + (inertia[0] - inertia[2]) * s * p
    t[2] -= wet * turning[2] * s + (inertia[1] - inertia[0]) * p * r
    for k in range(3):
        boat.rates[k] += t[k] / inertia[k] * dt
        boat.position[k] += boat.velocity[k] * dt
    integrate(q, boat.rates[0] * dt, boat.rates[1] * dt, boat.rates[2] * dt)


@dataclass(frozen=True)
class BoatState:
    """State of a boat.

    Attributes:
        pose: of the origin in the map.
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

    yields = True  # to what stands
    floats = True  # the plane z = 0 is no ground to it

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
        """Float on the waves of ``clock()``, s, the time at the beginning of a step, instead of the boat's own time."""
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
        """Set the wanted speed ahead, m/s, and the wanted yaw rate, rad/s; beyond the limits, the limits count.

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
        """State at the present time."""
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
        """Whether it has not been moved by waves yet, or floats level at the map's height."""
        boat = self._record[0]
        return not (boat["position"][2] or boat["q"][1] or boat["q"][2])

    @property
    def is_still(self) -> bool:
        """Whether it rests on still water without a command."""
        boat = self._record[0]
        moves = max(abs(boat["velocity"]).max(), abs(boat["rates"]).max()) > _REST
        return not (len(self._waves) or moves or self._linear or self._angular)

    def joints(self) -> list[Joint]:
        """Return no joints."""
        return []

    def thrusts(self) -> tuple[float, float]:
        """Return the forces of the left and the right thruster, N, that follow the command."""
        if not self._is_driven:
            return 0.0, 0.0
        limits, (ahead, _, _) = self.limits, self.twist[0]
        drag = limits.linear_drag[0] + limits.quadratic_drag[0] * abs(self._linear)
        push = drag * self._linear + _GAIN[0] * self.hull.mass * (self._linear - ahead)
        inertia = self.hull.mass * (self.hull.length**2 + self.hull.width**2) / 12.0
        turn = limits.turning_drag[2] * self._angular
        turn += _GAIN[1] * inertia * (self._angular - float(self._record[0]["rates"][2]))
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
        """Make the step that was proposed last."""
        self._record[:] = self._next

    def block(self) -> None:
        """Stop where the boat is, instead of the step that was proposed last; it goes on floating."""
        self._record["velocity"][0, :2] = 0.0
        self._record["rates"][0, 2] = 0.0
        self._record["velocity"][0, 2] = self._next["velocity"][0, 2]
        self._record["position"][0, 2] = self._next["position"][0, 2]
