#!/usr/bin/env python3
"""A planner of your own, from the parts of xtdrone_planning: paths through the local map, flown by a script.

To fly it::

    ./xtdrone launch multi_vehicle vehicles:=iris_3d_lidar:1 lidars:=true world:=forest
    python src/xtdrone_planning/examples/round_trees.py iris_3d_lidar_0 20 5      # x, y of the goal
"""

import sys

import numpy as np

from xtdrone_control.drone import connect
from xtdrone_planning.mapping.map_feed import MapFeed, SensorSettings
from xtdrone_planning.mapping.sensor_watch import SensorWatch
from xtdrone_planning.mapping.voxel_grid import LocalMap, MapSettings
from xtdrone_planning.paths.local_path import PathQuery, PathSearch

HEIGHT, HEIGHTS = 2.0, (1.0, 4.0)  # m
RADIUS, CLEARANCE = 0.4, 0.8  # m, of the vehicle, and of its path from obstacles
AHEAD = 6.0  # m


def next_corner(grid, start, goal):
    """Return the end of the first straight line of a path to the goal on a map, (3,) m; None: there is no path."""
    path = PathSearch(25_000).find(grid, PathQuery(start, goal, CLEARANCE, RADIUS, HEIGHTS, AHEAD))
    return path.points[1] if len(path.points) > 1 else None


def fly_to(name, x, y):
    """Take off, fly to (x, y), m in map, around everything that the lidar sees, and land."""
    local_map, goal, settings = LocalMap(MapSettings(), 2.0 * RADIUS), np.array([x, y, HEIGHT]), SensorSettings()
    with connect(name) as drone:
        MapFeed(name, local_map, SensorWatch(settings.watch), settings)
        drone.arm()
        drone.takeoff(HEIGHT)
        while np.linalg.norm(np.array(drone.position) - goal) > 0.5:
            corner = next_corner(local_map.grid, np.array(drone.position), goal)
            if corner is None:
                drone.wait(0.5)
            else:
                drone.go_to(*corner.tolist())
                print(drone)
        drone.land()


if __name__ == "__main__":
    fly_to(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]))
