"""Take off, fly round a building by lidar alone, return and land: the script of './xtdrone demo slam'.

``slam.py [VEHICLE [HEIGHT [X,Y ...]]]``: the route is relative to the start, m ENU; the last leg returns to it.
"""

import sys

from xtdrone_control.drone import FaultError, connect

WAY = ((27.5, 0), (27.5, 25), (67.5, 25), (67.5, -15), (27.5, -15), (27.5, 0))  # along the streets of the world city

name = sys.argv[1] if len(sys.argv) > 1 else "iris_slam_0"
height = float(sys.argv[2]) if len(sys.argv) > 2 else 3.0
way = [tuple(map(float, text.split(","))) for text in sys.argv[3:]] or WAY
with connect(name) as drone:
    drone.watch("lidar_odometry", "visual_odometry", "laser_odometry", patience=2.0)
    try:
        drone.arm()
        x, y, z = drone.position
        drone.takeoff(height)
        for east, north in way:
            drone.go_to(x + east, y + north, z + height, tolerance=1.0)
            print(drone)
        drone.go_to(x, y, z + height, tolerance=0.15)
        drone.wait(2)
    except FaultError as error:
        print(f"{error}; braking and landing while the autopilot still knows its velocity")
        if drone.armed:
            drone.brake()
    drone.land()
    print(drone)
