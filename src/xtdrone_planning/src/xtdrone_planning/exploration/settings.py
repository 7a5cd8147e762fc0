"""Settings of an exploration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from xtdrone_common.settings import SettingError, Settings, setting

_MOST_CELLS = 4_000_000
"""Larger floors are rejected: their maps would exhaust memory and radio bandwidth."""


def parse_bounds(value: Any) -> tuple[float, float, float, float]:
    """Return bounds from a list or from text with commas.

    Raises:
        ValueError: not four numbers in order.
    """
    parts = value.split(",") if isinstance(value, str) else value
    numbers = tuple(float(part) for part in parts)
    if (
        len(numbers) != 4
        or not all(map(math.isfinite, numbers))
        or numbers[0] >= numbers[2]
        or numbers[1] >= numbers[3]
    ):
        raise ValueError("four numbers x0,y0,x1,y1 with x0 < x1 and y0 < y1, m in map")
    return numbers[0], numbers[1], numbers[2], numbers[3]


@dataclass(frozen=True)
class ExplorationSettings(Settings):
    """Area to explore, and parameters of the exploration."""

    bounds: tuple[float, float, float, float] = setting(
        (20.0, -5.0, 44.0, 15.0), parse=parse_bounds, unit="m", text="x0,y0,x1,y1 of the floor to explore, in map"
    )
    margin: float = setting(
        5.0, low=0.0, high=100.0, unit="m", text="border around the floor: mapped for path planning, not explored"
    )
    cell: float = setting(0.15, low=0.05, high=1.0, unit="m", text="cell size; must equal that of the local maps")
    flight_height: float = setting(1.5, low=0.3, high=100.0, unit="m", text="height of flight")
    clearance: float = setting(0.6, low=0.1, high=5.0, unit="m", text="minimum distance from paths to obstacles")
    smallest: float = setting(0.9, low=0.0, high=100.0, unit="m", text="frontiers shorter than this are ignored")
    region: float = setting(5.0, low=1.0, high=100.0, unit="m", text="side length of the square regions")
    ahead: float = setting(5.0, low=1.0, high=50.0, unit="m", text="distance of the planner's goals along the path")
    lost_after: float = setting(
        5.0, low=0.5, high=600.0, unit="s", text="a vehicle silent for longer counts as lost; others take its regions"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        x0, y0, x1, y1 = self.bounds
        cells = (x1 - x0 + 2.0 * self.margin) * (y1 - y0 + 2.0 * self.margin) / self.cell**2
        if cells > _MOST_CELLS:
            raise SettingError("bounds", self.bounds, f"at most {_MOST_CELLS} cells with margin, not {cells:.0f}")
