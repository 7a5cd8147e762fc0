"""A lockstep participant for tests: takes iris_3d_lidar_0 off, acts as EGO-Planner, sends goals to its planner, lets
its lidar fail, and has ``./xtdrone gcs goto --avoid`` send the last goal.

Writes the planner's states and its reports on /diagnostics, as they change, with the simulated time, and ends.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator

import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from mavros_msgs.msg import State
from quadrotor_msgs.msg import PositionCommand
from std_msgs.msg import String
from xtdrone_msgs.msg import SplineTrajectory
from xtdrone_msgs.srv import SetLidarFailure

import xtdrone_lockstep as lockstep
from xtdrone_control.communication.commands import CommandRequest
from xtdrone_control.communication.multirotor import MavrosServices

RATE = 20.0
VEHICLE = "iris_3d_lidar_0"
GOAL = (40.0, 5.0, 2.0)
LAST_GOAL = (36.0, 3.0, 2.5)  # by the ground station
EGO_WAY, EGO_TIME = 3.0, 4.0  # m to the north, s: as EGO-Planner sends it, from rest to rest
ARRIVED = "hovering at the goal"
LIMIT = 60.0  # s for each wait


class Pilot:
    def __init__(self, file: str) -> None:
        self._out = open(file, "w", buffering=1)  # noqa: SIM115 - ends with the process
        self._services = MavrosServices(VEHICLE, in_lockstep=True)
        self._goal = lockstep.Publisher(f"/{VEHICLE}/planner/goal", PoseStamped)
        self._commands = lockstep.Publisher(f"/xtdrone/{VEHICLE}/planning/pos_cmd", PositionCommand)
        self._mavros = State()
        self._pose = self._camera = PoseStamped()
        self._planner = ""
        self._arrivals = 0
        self._report = (-1, "")
        lockstep.Subscriber(f"/{VEHICLE}/mavros/state", State, self._on_state)
        lockstep.Subscriber(f"/{VEHICLE}/mavros/local_position/pose", PoseStamped, self._on_pose)
        lockstep.Subscriber(f"/{VEHICLE}/camera_pose", PoseStamped, self._on_camera)
        lockstep.Subscriber(f"/{VEHICLE}/planner/state", String, self._on_planner)
        lockstep.Subscriber(f"/{VEHICLE}/planner/trajectory", SplineTrajectory, self._on_trajectory)
        lockstep.Subscriber("/diagnostics", DiagnosticArray, self._on_diagnostics)

    def _note(self, kind: str, **values: object) -> None:
        print(json.dumps({"kind": kind, "time": round(rospy.get_time(), 3), **values}), file=self._out)

    def _on_state(self, message: State) -> None:
        self._mavros = message

    def _on_pose(self, message: PoseStamped) -> None:
        self._pose = message

    def _on_camera(self, message: PoseStamped) -> None:
        self._camera = message

    def _on_planner(self, message: String) -> None:
        self._planner = message.data
        self._arrivals += message.data == ARRIVED
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

    def _until_arrival(self, number: int) -> Iterator[None]:
        """Wait for the ``number``-th arrival at a goal, which may already have taken place."""
        end = rospy.get_time() + LIMIT
        while self._arrivals < number:
            if rospy.get_time() > end:
                raise TimeoutError(f"{self._planner}, {self._arrivals} arrivals, not {number}")
            yield

    def _wait(self, seconds: float) -> Iterator[None]:
        end = rospy.get_time() + seconds
        while rospy.get_time() < end:
            yield

    def _follow_commands(self) -> Iterator[None]:
        """Fly another planner's commands, forwarded by ego_transfer.py; record the deviation of the vehicle."""
        start, begun, most = self._pose.pose.position, rospy.get_time(), 0.0
        while rospy.get_time() - begun < EGO_TIME + 3.0:
            since = rospy.get_time() - begun
            if self._mavros.mode != "OFFBOARD" and since > 1.0:
                self._services.submit(CommandRequest("OFFBOARD", None))
            turned = math.pi * min(1.0, max(0.0, since - 2.0) / EGO_TIME)
            rate, half = math.pi / EGO_TIME * (0.0 < turned < math.pi), 0.5 * EGO_WAY
            command = PositionCommand(trajectory_flag=PositionCommand.TRAJECTORY_STATUS_READY)
            command.header.stamp, command.header.frame_id = rospy.Time.now(), "world"
            command.position.x, command.position.z = start.x, start.z
            command.position.y = start.y + half * (1.0 - math.cos(turned))
            command.velocity.y, command.acceleration.y = (
                half * rate * math.sin(turned),
                half * rate**2 * math.cos(turned),
            )
            self._commands.publish(command)
            yield
            place = self._pose.pose.position
            most = max(most, math.dist((place.x, place.y), (command.position.x, command.position.y)))
        turn, place = self._camera.pose.orientation, self._camera.pose.position
        self._note(
            "ego",
            mode=self._mavros.mode,
            off=most,
            north=self._pose.pose.position.y - start.y,
            frame=self._camera.header.frame_id,
            camera=[turn.x, turn.y, turn.z, turn.w],
            lag=math.dist((place.x, place.y), (self._pose.pose.position.x, self._pose.pose.position.y)),
        )
        self._services.submit(CommandRequest("AUTO.LOITER", None))
        while self._mavros.mode != "AUTO.LOITER":
            yield

    def _by_ground_station(self) -> Iterator[None]:
        goal = [str(value) for value in LAST_GOAL]
        command = [sys.executable, "-m", "xtdrone_interaction", "gcs", "goto", *goal, "--avoid", "--vehicle", VEHICLE]
        station = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        while station.poll() is None:
            yield
        assert station.stdout is not None
        self._note("station", status=station.returncode, text=station.stdout.read())

    def fly(self) -> Iterator[None]:
        """Take off; fly another planner's commands, rejected goals, a frozen and then silent lidar; arrive twice."""
        yield from self._wait(1.0)
        self._send(GOAL)  # on the ground: dropped
        yield from self._wait(4.0)
        while not self._mavros.armed:
            self._services.submit(CommandRequest("ARM", True))
            yield from self._wait(1.0)
        self._services.submit(CommandRequest("AUTO.TAKEOFF", None))
        yield from self._wait(2.0)
        while self._mavros.mode != "AUTO.LOITER":
            yield
        yield from self._follow_commands()
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
        yield from self._until_arrival(1)
        yield from self._by_ground_station()  # ends while the vehicle is under way, or after it has arrived
        yield from self._until_arrival(2)
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
