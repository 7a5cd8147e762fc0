"""Fly a square of 4 m: the script of './xtdrone demo hello'."""

from xtdrone_control.drone import connect

with connect("iris_0") as drone:
    drone.arm()
    drone.takeoff(2)
    x, y, z = drone.position
    for east, north in ((4, 0), (4, 4), (0, 4), (0, 0)):
        drone.go_to(x + east, y + north, z)
        print(drone)
    drone.land()
