"""The node that publishes the plan of the world; see ``nodes/world_map.py``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rospy
from nav_msgs.msg import MapMetaData, OccupancyGrid
from numpy.typing import NDArray

from xtdrone_control import lockstep
from xtdrone_control.programs.node_command_line import ArgumentError, check_no_arguments
from xtdrone_sim.worlds.floor_plan import FloorPlanSettings, floor_plan
from xtdrone_sim.worlds.sdf import load_world_file

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
