"""Wind in a box of the world, such as a street between houses or the outlet of a fan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.settings import SettingError, Settings, setting
from xtdrone_sim.kernel import kernel

from .wind import add_wind

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
def _apply(vehicles, models, low, high, edge, wind, winds, force, torque):
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
        _apply(vehicles, models, self._low, self._high, edge, self._wind, self.winds, force, torque)
