"""Settings of robots' motion: wheels, hulls, thrusters, and the waves on which boats float.

A wave of amplitude a, wave vector k and frequency w raises the surface of deep water by a cos(k x - w t + p), with
w^2 = g |k| (Airy's linear theory for small waves; J. N. Newman, Marine Hydrodynamics, MIT Press 1977, 6.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.rotation import Vector
from xtdrone_common.settings import SettingError, Settings, setting

STEP = 0.004
"""Step of the simulation in which robots move, s."""

GRAVITY = 9.80665  # m/s^2
DENSITY = 1000.0
"""Of fresh water, kg/m^3."""
STEEPEST = 0.25
"""Largest sum of amplitude times wave number: linear theory holds for small slopes, and waves break at 0.44."""
_BAND = 0.3  # periods of several waves are within this share of the period
WAVE = np.dtype([("amplitude", "f8"), ("kx", "f8"), ("ky", "f8"), ("frequency", "f8"), ("phase", "f8")])


class JointMotion(NamedTuple):
    """State of a joint: name, angle, rad, and rate, rad/s."""

    name: str
    angle: float
    rate: float


@dataclass(frozen=True, kw_only=True)
class DriveLimits(Settings):
    """Wheels and limits of a robot."""

    wheel_radius: float = setting(0.15, low=0.01, high=2.0, unit="m", text="radius of the driven wheels")
    track: float = setting(0.8, low=0.05, high=10.0, unit="m", text="distance of left and right wheels")
    speed: float = setting(2.0, low=0.01, high=50.0, unit="m/s", text="largest speed, forwards and backwards")
    acceleration: float = setting(2.0, low=0.01, high=50.0, unit="m/s^2", text="largest change of the speed")
    slope: float = setting(0.35, low=0.0, high=0.7, unit="rad", text="steepest slope; a steeper one stops the robot")
    timeout: float = setting(
        0.5, low=0.0, high=3600.0, unit="s", text="time without a command after which the robot stops; 0: never"
    )


@dataclass(frozen=True, kw_only=True)
class DifferentialLimits(DriveLimits):
    """Limits of a differential drive."""

    turn_rate: float = setting(2.0, low=0.01, high=50.0, unit="rad/s", text="largest yaw rate")
    turn_acceleration: float = setting(6.0, low=0.01, high=500.0, unit="rad/s^2", text="largest change of the yaw rate")


@dataclass(frozen=True, kw_only=True)
class AckermannLimits(DriveLimits):
    """Limits of a car."""

    wheelbase: float = setting(2.62, low=0.1, high=20.0, unit="m", text="distance of front and rear axle")
    steering: float = setting(0.52, low=0.01, high=1.4, unit="rad", text="largest angle of a front wheel in the middle")
    steering_rate: float = setting(1.0, low=0.01, high=50.0, unit="rad/s", text="largest change of the steering angle")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.wheelbase / math.tan(self.steering) <= 0.5 * self.track:
            most = math.atan(2.0 * self.wheelbase / self.track)
            raise SettingError(
                "steering", self.steering, f"below {most:.3f} rad: the inner wheel would turn on the spot"
            )


@dataclass(frozen=True)
class HullSettings(Settings):
    """Hull of a boat, a box."""

    length: float = setting(3.0, low=0.05, high=100.0, unit="m", text="length along x")
    width: float = setting(1.6, low=0.05, high=30.0, unit="m", text="width along y")
    depth: float = setting(0.6, low=0.05, high=20.0, unit="m", text="height from bottom to top")
    mass: float = setting(800.0, low=0.01, high=1e7, unit="kg", text="mass, which gives the draught")
    colour: tuple[float, float, float] = setting((0.75, 0.3, 0.15), low=0.0, high=1.0, text="red, green, blue")

    def __post_init__(self) -> None:
        super().__post_init__()
        most = DENSITY * self.length * self.width * self.depth
        if self.mass > 0.95 * most:
            raise SettingError("mass", self.mass, f"at most {0.95 * most:.6g} kg: its box displaces {most:.6g} kg")
        draught, middle = self.draught, 0.5 * self.draught
        least = (draught - middle) * 12.0 * draught
        for name, side in (("width", self.width), ("length", self.length)):
            if side**2 <= least:  # KB + BM - KG, with the centre of mass at the waterline
                raise SettingError(name, side, f"more than {math.sqrt(least):.3g} m: it would capsize")

    @property
    def draught(self) -> float:
        """Draught in still water, m."""
        return self.mass / (DENSITY * self.length * self.width)

    @property
    def inertia(self) -> Vector:
        """Moments of inertia about its axes, kg m^2: those of a box."""
        x, y, z = self.length**2, self.width**2, self.depth**2
        return self.mass * (y + z) / 12.0, self.mass * (x + z) / 12.0, self.mass * (x + y) / 12.0


@dataclass(frozen=True)
class BoatLimits(Settings):
    """Thrusters and drag of a boat; forces of the drag are those at 1 m/s or 1 rad/s."""

    thrust: float = setting(
        250.0, low=0.0, high=1e6, unit="N", text="largest force of each thruster in either direction"
    )
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
        (0.1, 0.6, 1.0), low=0.0, high=10.0, text="added mass along, across, up, as a multiple of the mass"
    )
    timeout: float = setting(
        0.5, low=0.0, high=3600.0, unit="s", text="time without a command after which the thrusters stop; 0: never"
    )


def check_step(hull: HullSettings, limits: BoatLimits, dt: float) -> None:
    """Raise SettingError if steps of ``dt``, s, are too long for buoyancy or drag, so that the motion would blow up."""
    least = DENSITY * hull.length * hull.width * GRAVITY * dt**2
    if hull.mass < least:
        raise SettingError("hull mass", hull.mass, f"at least {least:.3g} kg: with less, steps of {dt} s are too long")
    pairs = zip(limits.linear_drag, limits.quadratic_drag, strict=True)
    drags = [linear + quadratic * limits.speed for linear, quadratic in pairs]
    masses = [hull.mass * (1.0 + share) for share in limits.added_mass]
    kinds = ("linear_drag and quadratic_drag", drags, masses), ("turning_drag", limits.turning_drag, hull.inertia)
    for name, drag, inertia in kinds:
        most = [each / dt for each in inertia]
        if any(each > limit for each, limit in zip(drag, most, strict=True)):
            text = ", ".join(f"{each:.3g}" for each in most)
            raise SettingError(f"limits {name}", list(drag), f"at most {text} at the largest speed in steps of {dt} s")


@dataclass(frozen=True)
class WaveSettings(Settings):
    """Waves on the water that a boat floats on; boats with equal settings float on the same waves."""

    level: float = setting(0.0, low=-1000.0, high=1000.0, unit="m", text="height of the still water in the map")
    amplitude: float = setting(
        0.0,
        low=0.0,
        high=10.0,
        unit="m",
        text="amplitude of the wave, or of one with the energy of all waves; 0: still water",
    )
    period: float = setting(4.0, low=0.5, high=30.0, unit="s", text="wave period; of several waves, the middle one")
    direction: float = setting(
        0.0, low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad", text="direction of travel, from east counter-clockwise"
    )
    spread: float = setting(
        0.3, low=0.0, high=1.5, unit="rad", text="largest deviation of the direction of one of several waves"
    )
    count: int = setting(1, low=1, high=50, text="number of waves: 1 is regular, more are irregular")
    seed: int = setting(0, low=0, high=2**31 - 1, text="seed of periods, directions and phases of several waves")

    def __post_init__(self) -> None:
        super().__post_init__()
        steep = float(np.sum(self.waves["amplitude"] * np.hypot(self.waves["kx"], self.waves["ky"])))
        if steep > STEEPEST:
            most = self.amplitude * STEEPEST / steep
            raise SettingError(
                "amplitude", self.amplitude, f"at most {most:.3g} m with this period and count: waves are not steep"
            )

    @property
    def waves(self) -> NDArray[np.void]:
        """The waves (count,) ``WAVE``; a single one has its crest at the map's origin at time 0."""
        waves = np.zeros(self.count, WAVE)
        waves["amplitude"] = self.amplitude / math.sqrt(self.count)
        random = np.random.Generator(np.random.PCG64(self.seed)).random((3, self.count))
        several = self.count > 1
        for k in range(self.count):
            period, direction = self.period, self.direction
            if several:
                period *= 1.0 + _BAND * (2.0 * float(random[0, k]) - 1.0)
                direction += self.spread * (2.0 * float(random[1, k]) - 1.0)
                waves["phase"][k] = math.tau * float(random[2, k])
            frequency = math.tau / period
            number = frequency * frequency / GRAVITY
            waves["frequency"][k] = frequency
            waves["kx"][k], waves["ky"][k] = number * math.cos(direction), number * math.sin(direction)
        return waves
