"""Settings of navigation in the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.settings import SettingError, Settings, setting

Array = NDArray[np.float64]

_MOST_CELLS = 4_000_000
"""Larger maps are rejected: they would exhaust memory."""


class NavigationGoalError(ValueError):
    """A goal that is not allowed; the message names it, its value and what is allowed."""


@dataclass(frozen=True)
class CostmapSettings(Settings):
    """The plane map and its inputs."""

    scan_topic: str = setting("scan", text="topic of the 2D lidar, below the vehicle's name; empty: none")
    scan_position: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.06), low=-10.0, high=10.0, unit="m", text="position of the 2D lidar in base_link"
    )
    scan_yaw: float = setting(0.0, low=-math.pi, high=math.pi, unit="rad", text="yaw of the 2D lidar in base_link")
    slab: float = setting(
        0.4, low=0.05, high=10.0, unit="m", text="rays count up to this height above and below the lidar"
    )
    map_topic: str = setting("", text="topic of a given map, nav_msgs/OccupancyGrid, such as /map; empty: none")
    cell: float = setting(0.1, low=0.02, high=1.0, unit="m", text="cell size; a given map must have the same")
    side: float = setting(
        80.0, low=4.0, high=400.0, unit="m", text="side of the map around the first position, without a given map"
    )
    local_side: float = setting(8.0, low=2.0, high=40.0, unit="m", text="side of the local costmap")
    inflation: float = setting(
        0.8, low=0.1, high=2.0, unit="m", text="distance up to which obstacles add cost; at least radius + margin"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.side / self.cell) ** 2 > _MOST_CELLS:
            raise SettingError("side", self.side, f"at most {_MOST_CELLS} cells, {_MOST_CELLS**0.5 * self.cell:g} m")


@dataclass(frozen=True)
class WindowSettings(Settings):
    """Limits of the motion, and weights of the dynamic window."""

    radius: float = setting(0.4, low=0.05, high=5.0, unit="m", text="radius of the circle around the vehicle")
    margin: float = setting(0.1, low=0.0, high=2.0, unit="m", text="clearance of the path beyond the radius")
    speed: float = setting(1.0, low=0.05, high=5.0, unit="m/s", text="greatest speed")
    acceleration: float = setting(0.8, low=0.05, high=5.0, unit="m/s²", text="maximum linear acceleration")
    turn_rate: float = setting(1.0, low=0.05, high=5.0, unit="rad/s", text="maximum yaw rate")
    turn_acceleration: float = setting(2.0, low=0.05, high=20.0, unit="rad/s²", text="maximum yaw acceleration")
    horizon: float = setting(1.5, low=0.2, high=10.0, unit="s", text="prediction horizon of motions")
    lag: float = setting(0.15, low=0.0, high=2.0, unit="s", text="delay between a command and the vehicle's motion")
    ahead: float = setting(1.5, low=0.2, high=10.0, unit="m", text="lookahead along the path to the target point")
    heading_bias: float = setting(1.0, low=0.0, high=100.0, text="weight of the heading error to the target point")
    progress_bias: float = setting(1.5, low=0.0, high=100.0, text="weight of the progress towards the target point")
    path_bias: float = setting(0.6, low=0.0, high=100.0, unit="1/m", text="weight of the distance from the path")
    clearance_bias: float = setting(0.3, low=0.0, high=100.0, text="weight of the clearance to obstacles")
    speed_bias: float = setting(0.2, low=0.0, high=100.0, text="weight of the speed")


@dataclass(frozen=True)
class NavigatorSettings(Settings):
    """Timing and tolerances of the navigation."""

    replan_period: float = setting(1.0, low=0.05, high=60.0, unit="s", text="time between two global plans")
    patience: float = setting(
        3.0, low=0.1, high=120.0, unit="s", text="time without a path or progress after which a recovery begins"
    )
    tolerance: float = setting(0.2, low=0.02, high=5.0, unit="m", text="position error at which a goal is reached")
    yaw_tolerance: float = setting(0.15, low=0.01, high=3.2, unit="rad", text="yaw error at which a goal is reached")


def check_reach(costs: CostmapSettings, limits: WindowSettings) -> None:
    """Check that distances are known up to where paths may be.

    Raises:
        SettingError: inflation is below radius + margin.
    """
    if costs.inflation < limits.radius + limits.margin:
        least = limits.radius + limits.margin
        raise SettingError("inflation", costs.inflation, f"at least radius + margin, {least:g} m")
