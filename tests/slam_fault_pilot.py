"""A script for './xtdrone demo slam': in flight the lidar fails by the environment variable SLAM_FAULT.

It succeeds if odometry names the fault on /diagnostics, no pose reaches the autopilot from then on, and the vehicle
descends slowly: at rest by the autopilot's failsafe, or at speed as in slam.py, where it brakes and lands at once.
"""

from __future__ import annotations

import math
import os
import sys

import pytest
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import PoseStamped
from xtdrone_msgs.srv import SetLidarFailure

import xtdrone_lockstep as lockstep
from xtdrone_control.drone import FaultError, connect

FAULT = os.environ["SLAM_FAULT"]  # SPEED KIND VALUE TEXT: m/s, for the failure service, and the text in diagnostics
DESCENT_LIMIT = 45.0  # s
SINK_LIMIT = 2.0  # m/s
GRACE = 0.6  # s from the fault to the last pose: the scan before it is in progress, and detection needs another one
FED = 0.5  # s, longest time between poses of a healthy odometry
PATIENCE = 2.0  # s, that of slam.py
LANDING_LIMIT, WAY_LIMIT = 14.0, 20.0  # s and m from a fault at speed to the place of the landing

name = sys.argv[1]
speed, kind, value, text = FAULT.split(" ", 3)
said: list[str] = []
fed: list[float] = []
places: list[tuple[float, float, float, float]] = []


def on_diagnostics(message: DiagnosticArray) -> None:
    """Keep the status that odometry publishes."""
    said.extend(status.message for status in message.status if status.name.endswith("lidar_odometry"))


def on_models(message: ModelStates) -> None:
    """Keep the true place."""
    p = message.pose[message.name.index(name)].position
    places.append((rospy.get_time(), p.x, p.y, p.z))


with connect(name) as drone:
    lockstep.Subscriber("/diagnostics", DiagnosticArray, on_diagnostics)
    lockstep.Subscriber("/gazebo/model_states", ModelStates, on_models)
    lockstep.Subscriber(f"/{name}/mavros/vision_pose/pose", PoseStamped, lambda _: fed.append(rospy.get_time()))
    drone.watch("lidar_odometry", patience=PATIENCE)
    drone.arm()
    drone.takeoff(3)
    drone.wait(2)
    if float(speed):
        drone.set_velocity(float(speed), 0.0, 0.0)
        drone.wait(3)
        assert math.hypot(*drone.velocity) > 0.8 * float(speed), drone.velocity
    assert said[-1] == "good", said[-1]
    assert rospy.get_time() - fed[-1] < FED
    begin, place = rospy.get_time(), places[-1]
    answer = rospy.ServiceProxy(f"/{name}/velodyne_points/failure", SetLidarFailure)(kind, float(value))
    assert answer.success, answer
    with pytest.raises(FaultError, match=text):
        drone.wait(5)
    assert rospy.get_time() < begin + GRACE + PATIENCE, rospy.get_time() - begin
    if float(speed):
        drone.brake()
        drone.land()
    while drone.armed and rospy.get_time() < begin + DESCENT_LIMIT:
        lockstep.sleep(0.5)
    assert text in said, said[-3:]
    assert fed[-1] < begin + GRACE, fed[-1] - begin
    assert not drone.armed, f"not landed {DESCENT_LIMIT} s after the fault"
    after, way = rospy.get_time() - begin, math.dist(places[-1][1:3], place[1:3])
    if float(speed):
        assert after < LANDING_LIMIT, after
        assert way < WAY_LIMIT, way
    sink = max(a[3] - b[3] for a, b in zip(places, places[10:], strict=False) if b[0] > a[0]) / (
        places[10][0] - places[0][0]
    )
    assert sink < SINK_LIMIT, sink
    print(f"{kind}: {text}; landed {after:.1f} s later and {way:.1f} m on, sinking at {sink:.2f} m/s at most")
