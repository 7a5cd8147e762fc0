"""Winds in addition to the world's: their wrench on a vehicle, their use by other effects, and the density of air.

An effect with an attribute ``winds``, (N, 3) m/s ENU of its latest step, is a wind that later effects can use: an
effect with a method ``feel`` gets the earlier winds when a world begins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.programs.user_classes import import_user_module
from xtdrone_common.rotation_kernels import rotate, rotate_inverse
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_sim.kernel import kernel

DENSITY = 1.225  # kg/m^3, standard atmosphere at sea level


@kernel
def add_wind(v, m, x, y, z, force, torque):
    """Add the wrench that an additional wind exerts on one vehicle.

    The drag of rotors and body is linear in the air speed (``plant.rotor_wrench``), so the result is that of a plant
    whose wind contains it.

    Args:
        v, m: the vehicle's ``PLANT`` and ``MODEL``.
        x, y, z: additional wind, m/s ENU.
        force: (3,) N, ENU; added to.
        torque: (3,) N m, body FLU; added to.
    """
    gx, gy, _ = rotate_inverse(v.q, x, y, z)
    fx = fy = 0.0
    for i in range(m.rotor_count):
        drag = m.drag_coefficient * v.rotor_speed[i]
        rolling = m.rolling_moment_coefficient * v.rotor_speed[i]
        px, py, pz = m.rotor_position[i, 0], m.rotor_position[i, 1], m.rotor_position[i, 2]
        fx += drag * gx
        fy += drag * gy
        torque[0] += rolling * gx - pz * drag * gy
        torque[1] += rolling * gy + pz * drag * gx
        torque[2] += px * drag * gy - py * drag * gx
    wx, wy, wz = rotate(v.q, fx, fy, 0.0)
    force[0] += wx + m.linear_drag * x
    force[1] += wy + m.linear_drag * y
    force[2] += wz + m.linear_drag * z


_FAR = 1e5  # m
_STRONGEST = 100.0  # m/s


@dataclass(frozen=True)
class RegionSettings(Settings):
    """Settings of a region of wind."""

    low: tuple[float, float, float] = setting(
        (-_FAR, -_FAR, 0.0), unit="m", low=-_FAR, high=_FAR, text="minimum x, y, z, ENU"
    )
    high: tuple[float, float, float] = setting(
        (_FAR, _FAR, _FAR), unit="m", low=-_FAR, high=_FAR, text="maximum x, y, z, ENU"
    )
    wind: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        unit="m/s",
        low=-_STRONGEST,
        high=_STRONGEST,
        text="wind in the box, ENU, in addition to the world's",
    )
    edge: float = setting(1.0, low=0.0, high=1e3, unit="m", text="distance inside the box over which the wind rises")

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            SettingError: a value is not allowed.
        """
        for name in ("low", "high", "wind"):
            value = getattr(self, name)
            object.__setattr__(self, name, tuple(value) if isinstance(value, list) else value)
        super().__post_init__()
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise SettingError("high", self.high, f"above low, {self.low}, on each axis")


@kernel
def share(position, low, high, edge):
    """Return the share of the wind at a position: 0 outside, 1 deeper than ``edge`` inside, smooth (C1) between."""
    depth = np.inf
    for k in range(3):
        depth = min(depth, position[k] - low[k], high[k] - position[k])
    if depth <= 0.0:
        return 0.0
    if depth >= edge:
        return 1.0
    s = depth / edge
    return s * s * (3.0 - 2.0 * s)


@kernel
def _apply_region(vehicles, models, low, high, edge, wind, winds, force, torque):
    for i in range(len(vehicles)):
        part = share(vehicles[i].position, low, high, edge)
        for k in range(3):
            winds[i, k] = part * wind[k]
        if part > 0.0:
            add_wind(vehicles[i], models[i], part * wind[0], part * wind[1], part * wind[2], force[i], torque[i])


class WindRegion:
    """Wind inside a box."""

    name = "wind_region"

    def __init__(self, **values: Any) -> None:
        """Create it with settings of ``RegionSettings``.

        Raises:
            SettingError: a value is not allowed.
        """
        self.settings = s = RegionSettings(**values)
        self._low, self._high, self._wind = np.array(s.low), np.array(s.high), np.array(s.wind)
        self.winds: NDArray[Any] = np.zeros((0, 3))

    def __call__(
        self, time: float, vehicles: NDArray[Any], models: NDArray[Any], force: NDArray[Any], torque: NDArray[Any]
    ) -> None:
        """Add the wrench of the wind on the vehicles inside."""
        if len(self.winds) != len(vehicles):
            self.winds = np.zeros((len(vehicles), 3))
        edge = self.settings.edge
        _apply_region(vehicles, models, self._low, self._high, edge, self._wind, self.winds, force, torque)


@kernel
def _apply_field(vehicles, models, wind, force, torque):
    for i in range(len(vehicles)):
        add_wind(vehicles[i], models[i], wind[i, 0], wind[i, 1], wind[i, 2], force[i], torque[i])


class WindField:
    """Wind of a function ``wind(time, positions)``: s and (N, 3) m ENU to (N, 3) or (3,) m/s ENU."""

    name = "wind_field"

    def __init__(self, function: str | Callable[[float, NDArray[np.float64]], Any]) -> None:
        """Create it.

        Args:
            function: the function, or ``FILE.py:NAME`` or ``module:NAME``.

        Raises:
            ValueError: the text does not have this form.
        """
        if isinstance(function, str):
            place, _, name = function.rpartition(":")
            if not place or not name:
                raise ValueError(f"function: {function!r} is not allowed, FILE.py:NAME or module:NAME")
            function = getattr(import_user_module(place), name)
        if not callable(function):
            raise ValueError(f"function: {function!r} is not allowed, a function (time, positions)")
        self._function = function
        self.winds: NDArray[Any] = np.zeros((0, 3))

    def __call__(
        self, time: float, vehicles: NDArray[Any], models: NDArray[Any], force: NDArray[Any], torque: NDArray[Any]
    ) -> None:
        """Add the wrench of the wind at each vehicle.

        Raises:
            ValueError: the function returns an array of another shape.
        """
        given = np.asarray(self._function(time, np.ascontiguousarray(vehicles["position"])), dtype=float)
        if given.shape not in ((3,), (len(vehicles), 3)):
            raise ValueError(f"the wind has the shape {given.shape}, it must be ({len(vehicles)}, 3) or (3,)")
        self.winds = np.ascontiguousarray(np.broadcast_to(given, (len(vehicles), 3)))
        _apply_field(vehicles, models, self.winds, force, torque)
