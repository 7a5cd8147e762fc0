"""The node that publishes the floor plan of the world, an occupancy grid for robots; see ``nodes/world_map.py``.

The plan shows what is between two heights, as map_server provides it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rospy
from nav_msgs.msg import MapMetaData, OccupancyGrid
from numpy.typing import NDArray

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError, check_no_arguments
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_sim.rays.scene import RayScene
from xtdrone_worlds.worlds.sdf import SdfWorld, load_world_file

FREE, OCCUPIED = 0, 100

_MOST_CELLS = 4_000_000
_BELOW = 1e-3  # m from a cell's edge, along which walls may run exactly


def parse_bounds(value: Any) -> tuple[float, float, float, float]:
    """Return bounds from a list or from text with commas.

    Raises:
        ValueError: not four numbers in order.
    """
    allowed = "four numbers x0,y0,x1,y1 with x0 < x1 and y0 < y1, m in map"
    parts = value.split(",") if isinstance(value, str) else value
    try:
        x0, y0, x1, y1 = (float(part) for part in parts)
    except (TypeError, ValueError) as error:
        raise ValueError(allowed) from error
    if not all(map(math.isfinite, (x0, y0, x1, y1))) or x0 >= x1 or y0 >= y1:
        raise ValueError(allowed)
    return x0, y0, x1, y1


@dataclass(frozen=True)
class FloorPlanSettings(Settings):
    """Extent, resolution and heights of a floor plan."""

    bounds: tuple[float, float, float, float] = setting(
        (0.0, -20.0, 60.0, 30.0), parse=parse_bounds, unit="m", text="x0,y0,x1,y1 of the plan, in map"
    )
    cell: float = setting(0.1, low=0.02, high=2.0, unit="m", text="side of a cell")
    low: float = setting(0.1, low=0.01, high=1000.0, unit="m", text="lowest height of obstacles")
    high: float = setting(0.6, low=0.01, high=1000.0, unit="m", text="highest height of obstacles")
    step: float = setting(
        0.25, low=0.01, high=100.0, unit="m", text="maximum distance between the levels that are evaluated"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.high < self.low:
            raise SettingError("high", self.high, f"at least low, {self.low:g} m")
        if math.prod(self.shape) * self.levels > _MOST_CELLS:
            raise SettingError("bounds", self.bounds, f"at most {_MOST_CELLS} cells on all levels")

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along x and y."""
        x0, y0, x1, y1 = self.bounds
        return max(1, math.ceil((x1 - x0) / self.cell - 1e-6)), max(1, math.ceil((y1 - y0) / self.cell - 1e-6))

    @property
    def levels(self) -> int:
        """Number of heights that are evaluated."""
        return 1 + math.ceil((self.high - self.low) / self.step - 1e-6)


def floor_plan(world: SdfWorld, settings: FloorPlanSettings) -> NDArray[np.int8]:
    """Return the plan of a world's models except those that move: (nx, ny), 0 free, 100 occupied.

    A cell is occupied if a surface crosses its middle line along x or y at one of the levels; the inside of a solid is
    free, but enclosed.

    Args:
        world: world with its models at the poses of its file.
        settings: extent, resolution and heights of the plan.

    Raises:
        ValueError: the world has too many triangles, or an invalid mesh.
    """
    scene = RayScene(world.models)
    nx, ny = settings.shape
    plan = np.zeros((nx, ny), np.int8)
    x = settings.bounds[0] + settings.cell * np.arange(nx)
    y = settings.bounds[1] + settings.cell * np.arange(ny)
    for z in np.linspace(settings.low, settings.high, settings.levels).tolist():
        for axis in (0, 1):
            across = 0.5 * settings.cell
            xs, ys = (x - _BELOW, y + across) if axis == 0 else (x + across, y - _BELOW)
            origins = np.stack([*np.meshgrid(xs, ys, indexing="ij"), np.full((nx, ny), z)], axis=-1).reshape(-1, 3)
            directions = np.zeros_like(origins)
            directions[:, axis] = 1.0
            ranges = scene.cast(origins, directions, settings.cell + 2.0 * _BELOW).ranges.reshape(nx, ny)
            plan[np.isfinite(ranges)] = OCCUPIED
    return plan


USAGE = "world_map.py"
RATE = 1.0  # Hz; nothing is done after the first turn

_FRAME = "map"


def map_message(plan: NDArray[np.int8], settings: FloorPlanSettings, stamp: rospy.Time) -> OccupancyGrid:
    """Return a plan (nx, ny) as a message, at height 0 of map."""
    message = OccupancyGrid()
    message.header.stamp, message.header.frame_id = stamp, _FRAME
    message.info.map_load_time, message.info.resolution = stamp, settings.cell
    message.info.width, message.info.height = plan.shape
    origin = message.info.origin
    origin.position.x, origin.position.y = settings.bounds[:2]
    origin.orientation.w = 1.0
    message.data = plan.T.ravel().tolist()
    return message


def main(arguments: Sequence[str]) -> None:
    """Publish the plan in the first turn, latched, and wait for the end.

    Raises:
        ArgumentError: an argument or parameter is not allowed, or the world cannot be used.
    """
    check_no_arguments(arguments)
    lockstep.init_node("world_map", rate=RATE)
    settings = FloorPlanSettings.from_parameters(rospy.get_param)
    publisher = lockstep.Publisher("/map", OccupancyGrid, latch=True)
    metadata = lockstep.Publisher("/map_metadata", MapMetaData, latch=True)
    lockstep.start()
    world = str(rospy.get_param("~world", rospy.get_param("/xtdrone/world", "empty")))
    try:
        plan = floor_plan(load_world_file(world), settings)
    except ValueError as error:
        raise ArgumentError(f"no map of the world {world}: {error}") from error
    message = map_message(plan, settings, rospy.Time.now())
    publisher.publish(message)
    metadata.publish(message.info)
    lockstep.spin(lambda: None)
