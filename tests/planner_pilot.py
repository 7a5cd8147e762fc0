"""A lockstep participant for tests: takes iris_3d_lidar_0 off, sends goals to its planner, and lets its lidar fail.

Writes the planner's states and its reports on /diagnostics, as they change, with the simulated time, and ends.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator

import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from mavros_msgs.msg import State
from std_msgs.msg import String
from xtdrone_msgs.msg import SplineTrajectory
from xtdrone_msgs.srv import SetLidarFailure

from xtdrone_control import lockstep
from xtdrone_control.communication.commands import Request
from xtdrone_control.communication.multirotor import MavrosServices

RATE = 20.0
VEHICLE = "iris_3d_lidar_0"
GOAL = (40.0, 5.0, 2.0)
LIMIT = 60.0  # s for each thing that is waited for


class Pilot:
    def __init__(self, file: str) -> None:
        self._out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process
        self._services = MavrosServices(VEHICLE, in_lockstep=True)
        self._goal = lockstep.Publisher(f"/{VEHICLE}/planner/goal", PoseStamped)
        self._mavros = State()
        self._planner = ""
        self._report = (-1, "")
        lockstep.Subscriber(f"/{VEHICLE}/mavros/state", State, self._on_state)
        lockstep.Subscriber(f"/{VEHICLE}/planner/state", String, self._on_planner)
        lockstep.Subscriber(f"/{VEHICLE}/planner/trajectory", SplineTrajectory, self._on_trajectory)
        lockstep.Subscriber("/diagnostics", DiagnosticArray, self._on_diagnostics)

    def _note(self, kind: str, **values: object) -> None:
        print(json.dumps({"kind": kind, "time": round(rospy.get_time(), 3), **values}), file=self._out)

    def _on_state(self, message: State) -> None:
        self._mavros = message

    def _on_planner(self, message: String) -> None:
        self._planner = message.data
        self._note("state", text=message.data)

    def _on_trajectory(self, message: SplineTrajectory) -> None:
        last = message.control_points[-1]
        self._note("trajectory", id=message.id, end=[last.x, last.y, last.z])

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            report = (status.level, status.message)
            if status.name == f"{VEHICLE}: planner" and report != self._report:
                self._report = report
                self._note("report", level=status.level, text=status.message)

    def _send(self, goal: tuple[float, float, float]) -> None:
        message = PoseStamped()
        message.header.frame_id = "map"
        message.pose.position.x, message.pose.position.y, message.pose.position.z = goal
        self._goal.publish(message)

    def _fail(self, failure: str) -> None:
        answer = rospy.ServiceProxy(f"/{VEHICLE}/velodyne_points/failure", SetLidarFailure)(failure, 0.0)
        self._note("failure", text=failure, success=answer.success)

    def _until(self, *states: str) -> Iterator[None]:
        end = rospy.get_time() + LIMIT
        while self._planner not in states:
            if rospy.get_time() > end:
                raise TimeoutError(f"{self._planner}, not {states}")
            yield

    def _wait(self, seconds: float) -> Iterator[None]:
        end = rospy.get_time() + seconds
        while rospy.get_time() < end:
            yield

    def fly(self) -> Iterator[None]:
        """Take off; goals that are not allowed; a lidar that freezes, then one that is silent; arrive."""
        yield from self._wait(1.0)
        self._send(GOAL)  # on the ground: dropped
        yield from self._wait(4.0)
        while not self._mavros.armed:
            self._services.submit(Request("ARM", True))
            yield from self._wait(1.0)
        self._services.submit(Request("AUTO.TAKEOFF", None))
        yield from self._wait(2.0)
        while self._mavros.mode != "AUTO.LOITER":
            yield
        self._send((40.0, 5.0, 50.0))  # too high: ignored
        yield from self._wait(0.5)
        self._send(GOAL)
        yield from self._until("following")
        yield from self._wait(2.0)
        for failure in ("frozen", "off"):
            self._fail(failure)
            yield from self._until("braking")
            yield from self._until("planning")
            yield from self._wait(1.5)
            self._fail("ok")
            yield from self._until("following")
            yield from self._wait(1.0)
        yield from self._until("hovering at the goal")
        self._note("end")


def main() -> None:
    lockstep.init_node("planner_pilot", rate=RATE)
    pilot = Pilot(sys.argv[1])
    lockstep.start()
    rate = lockstep.Rate()
    for _ in pilot.fly():
        rate.sleep()


if __name__ == "__main__":
    main()
