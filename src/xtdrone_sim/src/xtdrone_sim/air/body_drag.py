"""Quadratic drag of the body: 1/2 rho C A v |v| on each axis of the body, with the sides of its box as areas.

The vehicles' own drag is linear (PX4's Gazebo model): accurate at low speeds, too small in a fall or a storm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.rotation_kernels import rotate, rotate_inverse
from xtdrone_common.settings import Settings, setting
from xtdrone_sim.kernel import kernel

from .wind import DENSITY


@dataclass(frozen=True)
class BodyDragSettings(Settings):
    """Settings of the body's drag."""

    coefficient: float = setting(1.0, low=0.0, high=5.0, text="drag coefficient C, referred to the sides of the box")


@kernel
def _apply(vehicles, models, coefficient, winds, force):
    for i in range(len(vehicles)):
        v, m = vehicles[i], models[i]
        ax = v.velocity[0] - v.wind[0] - winds[i, 0]
        ay = v.velocity[1] - v.wind[1] - winds[i, 1]
        az = v.velocity[2] - v.wind[2] - winds[i, 2]
        x, y, z = rotate_inverse(v.q, ax, ay, az)
        half = -0.5 * DENSITY * coefficient
        fx, fy, fz = rotate(
            v.q,
            half * m.box[1] * m.box[2] * x * abs(x),
            half * m.box[0] * m.box[2] * y * abs(y),
            half * m.box[0] * m.box[1] * z * abs(z),
        )
        force[i, 0] += fx
        force[i, 1] += fy
        force[i, 2] += fz


class BodyDrag:
    """Drag proportional to the square of the airspeed, in the world's wind and the winds of earlier effects."""

    name = "body_drag"

    def __init__(self, **values: Any) -> None:
        """Create it with settings of ``BodyDragSettings``.

        Raises:
            SettingError: a value is not allowed.
        """
        self.settings = BodyDragSettings(**values)
        self._winds: Sequence[Any] = ()

    def feel(self, winds: Sequence[Any]) -> None:
        """Include these winds from now on."""
        self._winds = tuple(winds)

    def __call__(
        self, time: float, vehicles: NDArray[Any], models: NDArray[Any], force: NDArray[Any], torque: NDArray[Any]
    ) -> None:
        """Add each vehicle's drag."""
        total = np.zeros((len(vehicles), 3))
        for wind in self._winds:
            total += wind.winds
        _apply(vehicles, models, self.settings.coefficient, total, force)
