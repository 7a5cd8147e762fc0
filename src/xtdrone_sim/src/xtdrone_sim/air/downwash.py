"""Downwash: the wake of each vehicle pushes vehicles below it.

The wake is one round jet that begins with the total area A of the discs and, by actuator disc theory, the speed
sqrt(2 T / (rho A)) for a thrust T. With the Gaussian profile exp(-(r/b)^2) its momentum flux is T, and stays T while it
spreads (N. Rajaratnam, "Turbulent jets", 1976: the radius of half the speed grows by about 0.1 per distance, so b by
0.1 / sqrt(ln 2) = 0.12). A vehicle in it has the drag of a plate, 1/2 rho C S w^2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from xtdrone_control.settings import Settings, setting
from xtdrone_sim.kernel import kernel

from .wind import DENSITY


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
        radius: of a disc with the area of all rotors, m.
        spread: growth of the wake's radius per distance.
    """
    if below <= 0.0:
        return 0.0
    wide = radius + spread * below
    return math.sqrt(2.0 * thrust / (DENSITY * math.pi)) / wide * math.exp(-((aside / wide) ** 2))


@kernel
def _apply(vehicles, models, rotor_radius, spread, drag, force):
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
        _apply(vehicles, models, s.rotor_radius, s.spread, s.drag, force)
