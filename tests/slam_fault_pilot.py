"""A script for './xtdrone demo slam': in flight the lidar fails by the environment variable SLAM_FAULT.

It succeeds if odometry names the fault on /diagnostics, no pose reaches the autopilot from then on, and the vehicle
descends slowly by itself.
"""

from __future__ import annotations

import os
import sys

import rospy
from diagnostic_msgs.msg import DiagnosticArray
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import PoseStamped
from xtdrone_msgs.srv import SetLidarFailure

from xtdrone_control import lockstep
from xtdrone_control.drone import connect

FAULT = os.environ["SLAM_FAULT"]  # KIND VALUE TEXT: for the failure service, and the text in diagnostics
DESCENT_LIMIT = 45.0  # s
SINK_LIMIT = 2.0  # m/s
GRACE = 0.6  # s from the fault to the last pose: the scan before it is in progress, and detection needs another one
FED = 0.5  # s, longest time between poses of a healthy odometry

name = sys.argv[1]
kind, value, text = FAULT.split(" ", 2)
said: list[str] = []
fed: list[float] = []
heights: list[tuple[float, float]] = []


def on_diagnostics(message: DiagnosticArray) -> None:
    """Keep the status that odometry publishes."""
    said.extend(status.message for status in message.status if status.name.endswith("lidar_odometry"))


def on_models(message: ModelStates) -> None:
    """Keep the true height."""
    heights.append((rospy.get_time(), message.pose[message.name.index(name)].position.z))


with connect(name) as drone:
    lockstep.Subscriber("/diagnostics", DiagnosticArray, on_diagnostics)
    lockstep.Subscriber("/gazebo/model_states", ModelStates, on_models)
    lockstep.Subscriber(f"/{name}/mavros/vision_pose/pose", PoseStamped, lambda _: fed.append(rospy.get_time()))
    drone.arm()
    drone.takeoff(3)
    drone.wait(2)
    assert said[-1] == "good", said[-1]
    assert rospy.get_time() - fed[-1] < FED
    begin = rospy.get_time()
    answer = rospy.ServiceProxy(f"/{name}/velodyne_points/failure", SetLidarFailure)(kind, float(value))
    assert answer.success, answer
    while drone.armed and rospy.get_time() < begin + DESCENT_LIMIT:
        lockstep.sleep(0.5)
    assert text in said, said[-3:]
    assert fed[-1] < begin + GRACE, fed[-1] - begin
    assert not drone.armed, f"not landed {DESCENT_LIMIT} s after the fault"
    sink = max(a[1] - b[1] for a, b in zip(heights, heights[10:], strict=False) if b[0] > a[0]) / (
        heights[10][0] - heights[0][0]
    )
    assert sink < SINK_LIMIT, sink
    print(f"{kind}: {text}; landed {rospy.get_time() - begin:.1f} s later, sinking at {sink:.2f} m/s at most")
