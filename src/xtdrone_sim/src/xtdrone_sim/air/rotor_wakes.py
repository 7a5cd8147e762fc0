"""Wakes of rotors: more thrust near the ground, and a push on vehicles below.

Ground effect: I. C. Cheeseman, W. E. Bennett, "The effect of the ground on a helicopter rotor in forward flight", ARC
R&M 3021, 1955: for a rotor of radius R at the height z, T / T_free = 1 / (1 - (R / 4z)^2). The formula has a pole at
z = R/4; below z = R/2, where it has not been verified, the ratio at that height, 4/3, is kept. The ground is the plane
z = 0.

Downwash: the wake is one round jet that begins with the total area A of the discs and, by actuator disc theory, the
speed sqrt(2 T / (rho A)) for a thrust T. With the Gaussian profile exp(-(r/b)^2) its momentum flux is T, and stays T
while it spreads (N. Rajaratnam, "Turbulent jets", 1976: the radius of half the speed grows by about 0.1 per distance,
so b by 0.1 / sqrt(ln 2) = 0.12). A vehicle in it has the drag of a plate, 1/2 rho C S w^2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from xtdrone_common.rotation_kernels import rotate
from xtdrone_common.settings import Settings, setting
from xtdrone_sim.air.wind import DENSITY
from xtdrone_sim.kernel import kernel


@dataclass(frozen=True)
class GroundSettings(Settings):
    """Settings of the ground effect."""

    rotor_radius: float = setting(0.127, above=0.0, high=5.0, unit="m", text="radius of the rotors (iris: 10 inch)")


@kernel
def thrust_ratio(height, radius):
    """Return the thrust at a height (m) above ground relative to that far from it, for rotors of a radius (m)."""
    ratio = radius / (4.0 * max(height, 0.5 * radius))
    return 1.0 / (1.0 - ratio * ratio)


@kernel
def _apply_ground_effect(vehicles, models, radius, force, torque):
    for i in range(len(vehicles)):
        v, m = vehicles[i], models[i]
        total = 0.0
        for k in range(m.rotor_count):
            px, py, pz = m.rotor_position[k, 0], m.rotor_position[k, 1], m.rotor_position[k, 2]
            _, _, up = rotate(v.q, px, py, pz)
            gain = thrust_ratio(v.position[2] + up, radius) - 1.0
            more = gain * m.thrust_constant * v.rotor_speed[k] ** 2
            total += more
            torque[i, 0] += py * more
            torque[i, 1] -= px * more
        x, y, z = rotate(v.q, 0.0, 0.0, total)
        force[i, 0] += x
        force[i, 1] += y
        force[i, 2] += z


class GroundEffect:
    """Thrust that grows near the ground."""

    name = "ground_effect"

    def __init__(self, **values: Any) -> None:
        """Create it with settings of ``GroundSettings``.

        Raises:
            SettingError: a value is not allowed.
        """
        self.settings = GroundSettings(**values)

    def __call__(
        self, time: float, vehicles: NDArray[Any], models: NDArray[Any], force: NDArray[Any], torque: NDArray[Any]
    ) -> None:
        """Add the additional thrust of each rotor."""
        _apply_ground_effect(vehicles, models, self.settings.rotor_radius, force, torque)


@dataclass(frozen=True)
class DownwashSettings(Settings):
    """Settings of the downwash."""

    rotor_radius: float = setting(0.127, above=0.0, high=5.0, unit="m", text="radius of the rotors (iris: 10 inch)")
    spread: float = setting(
        0.12, low=0.0, high=1.0, text="growth of the wake's radius b, per distance below the rotors"
    )
    drag: float = setting(1.0, low=0.0, high=5.0, text="drag coefficient of a vehicle's top, referred to its box")


@kernel
def wake_speed(below, aside, thrust, radius, spread):
    """Return the speed of a wake, m/s downwards.

    Args:
        below: distance below the rotors, m; 0 above them.
        aside: distance from the wake's axis, m.
        thrust: N.
        radius: radius of a disc with the area of all rotors, m.
        spread: growth of the wake's radius per distance.
    """
    if below <= 0.0:
        return 0.0
    wide = radius + spread * below
    return math.sqrt(2.0 * thrust / (DENSITY * math.pi)) / wide * math.exp(-((aside / wide) ** 2))


@kernel
def _apply_downwash(vehicles, models, rotor_radius, spread, drag, force):
    for i in range(len(vehicles)):
        m = models[i]
        thrust = 0.0
        for k in range(m.rotor_count):
            thrust += m.thrust_constant * vehicles[i].rotor_speed[k] ** 2
        radius = rotor_radius * math.sqrt(m.rotor_count)
        for j in range(len(vehicles)):
            x = vehicles[i].position[0] - vehicles[j].position[0]
            y = vehicles[i].position[1] - vehicles[j].position[1]
            below = vehicles[i].position[2] - vehicles[j].position[2]
            speed = wake_speed(below, math.sqrt(x * x + y * y), thrust, radius, spread)
            top = models[j].box[0] * models[j].box[1]
            force[j, 2] -= 0.5 * DENSITY * drag * top * speed * speed


class Downwash:
    """Wakes of vehicles, which push those below them."""

    name = "downwash"

    def __init__(self, **values: Any) -> None:
        """Create it with settings of ``DownwashSettings``.

        Raises:
            SettingError: a value is not allowed.
        """
        self.settings = DownwashSettings(**values)

    def __call__(
        self, time: float, vehicles: NDArray[Any], models: NDArray[Any], force: NDArray[Any], torque: NDArray[Any]
    ) -> None:
        """Push each vehicle by the wakes of all above it."""
        s = self.settings
        _apply_downwash(vehicles, models, s.rotor_radius, s.spread, s.drag, force)
