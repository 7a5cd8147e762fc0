"""ROS node of a vehicle's planner.

For each vehicle ``T`` (as ``iris_3d_lidar_0``), in addition to the sensor's topics of ``mapping.map_feed``:

==================================  ==============================  ==================================================
topic                               type                            meaning
==================================  ==============================  ==================================================
/T/planner/goal                     geometry_msgs/PoseStamped       in: goal in map; its orientation is not used
/move_base_simple/goal              geometry_msgs/PoseStamped       in: rviz's 2D Nav Goal, at the vehicle's height
/xtdrone/T/cmd_vel_enu              geometry_msgs/Twist             in, with ``~carry``: moves the goal
/T/planner/cancel                   std_msgs/Empty                  in: drop the goal, brake and hover
/T/mavros/local_position/pose       geometry_msgs/PoseStamped       in, as velocity_local (TwistStamped)
/T/mavros/state, extended_state     mavros_msgs/State, ...          in: mode; whether it is armed and in the air
/T/mavros/setpoint_raw/local        mavros_msgs/PositionTarget      out: position, velocity, acceleration and yaw
/T/planner/trajectory               xtdrone_msgs/SplineTrajectory   out: latched, each new trajectory
/T/planner/path                     nav_msgs/Path                   out: its positions, for rviz
/T/planner/state                    std_msgs/String                 out: latched, on change: see ``flight_states``
/T/map/occupied                     sensor_msgs/PointCloud2         out, while subscribed: centres of occupied voxels
/T/map/slice                        nav_msgs/OccupancyGrid          out, while subscribed: the layer of flight
/diagnostics                        diagnostic_msgs/DiagnosticArray out: once a second, and on change
==================================  ==============================  ==================================================

With ``~carry`` the planner replaces the communication node for velocity commands: it follows them around obstacles and
other vehicles. The goal is the position that the velocity would reach in the time ``~carry``. This starts with a goal
on /T/planner/goal, and ends when the vehicle leaves OFFBOARD.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
import rospy
from geometry_msgs.msg import Point, PoseStamped, Twist, Vector3
from mavros_msgs.msg import PositionTarget
from nav_msgs.msg import OccupancyGrid, Path
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Empty, String
from xtdrone_msgs.msg import SplineTrajectory

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import cloud_message
from xtdrone_common.rotation import yaw_of
from xtdrone_common.settings import Settings, setting
from xtdrone_control.communication.commands import CommandRequest
from xtdrone_control.communication.multirotor import MavrosServices
from xtdrone_control.vehicle_topics import VehicleReport, VehicleTopics
from xtdrone_planning.mapping.map_feed import MapFeed, SensorSettings
from xtdrone_planning.mapping.map_messages import FRAME, slice_at
from xtdrone_planning.mapping.sensor_watch import SensorWatch
from xtdrone_planning.mapping.voxel_grid import LocalMap, MapSettings
from xtdrone_planning.planner_settings import AgreementSettings, GoalError, PlannerSettings, TrajectorySettings
from xtdrone_planning.replanning.flight_states import PlannerCommand, Situation
from xtdrone_planning.replanning.planner import Planner
from xtdrone_planning.replanning.swarm_planner import SwarmPlanner
from xtdrone_planning.replanning.swarm_topics import SwarmTopics
from xtdrone_planning.stopwatch import Stopwatch, write_summaries
from xtdrone_planning.trajectories.trajectory_messages import path_message, spline_message

RATE = 50.0  # Hz, as in the MAVROS layer

_STREAM_LEAD = 0.5  # s of setpoints before OFFBOARD is requested; PX4 rejects it without a stream
_REQUEST_SPACING = 2.0  # s between requests
_STALE_POSE = 0.5  # s
_START_UP = 5.0  # s within which the first position and measurement are expected
_MAP_PERIOD = 0.5  # s between two publications of the map
_WARNINGS = 5.0  # s between two warnings


@dataclass(frozen=True)
class TimingSettings(Settings):
    """Reports written when the node ends."""

    timings: str = setting("", text="file for the wall times of map updates and plans, JSON; empty: none")


@dataclass(frozen=True)
class PlannerNodeSettings:
    """All settings of the node.

    Attributes:
        sensor: Settings of the sensor.
        grid: Settings of the local map.
        limits: Limits of the trajectories.
        planner: Settings of the planner.
        report: Report at the end.
        swarm: coordination with other vehicles; None: others are ignored.
    """

    sensor: SensorSettings
    grid: MapSettings
    limits: TrajectorySettings
    planner: PlannerSettings
    report: TimingSettings
    swarm: AgreementSettings | None = None


def read_settings() -> PlannerNodeSettings:
    """Return the settings read from the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    return PlannerNodeSettings(
        SensorSettings.read(),
        MapSettings.from_parameters(rospy.get_param),
        TrajectorySettings.from_parameters(rospy.get_param),
        PlannerSettings.from_parameters(rospy.get_param),
        TimingSettings.from_parameters(rospy.get_param),
        AgreementSettings.from_parameters(rospy.get_param) if rospy.get_param("~swarm", False) else None,
    )


class VehiclePlanner:
    """ROS topics of one vehicle's planner."""

    def __init__(self, name: str, fleet: Sequence[str], settings: PlannerNodeSettings, *, rviz_goal: bool) -> None:
        """Declare the topics.

        Args:
            name: Name of the vehicle.
            fleet: names of all vehicles.
            settings: see ``PlannerNodeSettings``.
            rviz_goal: whether this vehicle subscribes to /move_base_simple/goal.
        """
        self.name = name
        self._settings = settings
        self._watch = SensorWatch(settings.sensor.watch)
        self._map = LocalMap(settings.grid, 2.0 * settings.limits.radius)
        self.stopwatch = Stopwatch()
        timed = self.stopwatch.measuring
        self._swarm: SwarmTopics | None = None
        if settings.swarm is None:
            self.planner = Planner(self._map.grid, settings.planner, settings.limits, lambda: timed("plan"))
        else:
            self.planner = planner = SwarmPlanner(
                self._map.grid,
                settings.planner,
                settings.limits,
                settings.swarm,
                fleet.index(name),
                lambda: timed("plan"),
            )
            self._swarm = SwarmTopics(name, fleet, planner, FRAME)
            self._map.others = planner.places_of_others
        self._map.is_used = lambda: self.planner.state.uses_map
        MapFeed(name, self._map, self._watch, settings.sensor, lambda: timed("map"))
        self._services = MavrosServices(name, in_lockstep=lockstep.is_active())
        self._setpoint = lockstep.Publisher(f"/{name}/mavros/setpoint_raw/local", PositionTarget)
        if self._swarm is None:
            self._trajectory = lockstep.Publisher(f"/{name}/planner/trajectory", SplineTrajectory, latch=True)
        self._path = lockstep.Publisher(f"/{name}/planner/path", Path)
        self._state = lockstep.Publisher(f"/{name}/planner/state", String, latch=True)
        self._occupied = lockstep.Publisher(f"/{name}/map/occupied", PointCloud2)
        self._slice = lockstep.Publisher(f"/{name}/map/slice", OccupancyGrid)
        self._diagnostics = VehicleReport(name, "planner")
        lockstep.Subscriber(f"/{name}/planner/goal", PoseStamped, self._on_goal)
        lockstep.Subscriber(f"/{name}/planner/cancel", Empty, lambda _: self.planner.cancel())
        if settings.planner.carry > 0.0:
            lockstep.Subscriber(f"/xtdrone/{name}/cmd_vel_enu", Twist, self._on_wanted_velocity)
        if rviz_goal:
            lockstep.Subscriber("/move_base_simple/goal", PoseStamped, self._on_level_goal)
        self._vehicle = VehicleTopics(name, "pose", "velocity", "state", "extended_state")
        lockstep.add_reset_hook(self._restart)
        self._forget()

    def _restart(self) -> None:
        """Begin again, because simulated time was reset."""
        self.planner.restart()
        self._map.restart()
        self._watch.restart()
        if self._swarm is not None:
            self._swarm.restart()
        self._forget()

    def _forget(self) -> None:
        self._streaming_since: float | None = None
        self._requested = self._mapped = -math.inf
        self._published_number = 0
        self._began: float | None = None
        self._has_been_well = False
        self._logged = 0  # level of the state that was logged last
        self._published_state = ""

    # messages

    def _on_goal(self, message: PoseStamped) -> None:
        self._set_goal(message, message.pose.position.z)

    def _on_level_goal(self, message: PoseStamped) -> None:
        if self._vehicle.pose is not None:
            self._set_goal(message, float(self._vehicle.pose[2]))

    def _on_wanted_velocity(self, message: Twist) -> None:
        pose, velocity = self._vehicle.pose, message.linear
        if pose is None:
            return
        ahead = self._settings.planner.carry * np.array([velocity.x, velocity.y, velocity.z])
        try:
            self.planner.move_goal(pose[:3] + ahead)
        except GoalError as error:
            rospy.logwarn_throttle(_WARNINGS, f"{self.name}: velocity command: {error}; the goal is unchanged")

    def _set_goal(self, message: PoseStamped, height: float) -> None:
        if message.header.frame_id.lstrip("/") not in ("", FRAME):
            rospy.logwarn(f"{self.name}: goal: frame {message.header.frame_id!r} is not allowed, {FRAME!r}; ignored")
            return
        place = message.pose.position
        try:
            self.planner.set_goal(np.array([place.x, place.y, height]))
        except GoalError as error:
            rospy.logwarn(f"{self.name}: {error}; ignored")

    # turns

    def step(self) -> None:
        """Advance by a turn; call it at 50 Hz."""
        stamp = rospy.Time.now()
        situation = self._situation(stamp.to_sec())
        if situation is None:
            self._publish_report(stamp, 2, "no position from the autopilot")
            return
        command = self.planner.step(situation)
        for request, accepted, reason in self._services.finished():
            if not accepted:
                rospy.logwarn(f"{self.name}: {request.command} was rejected ({reason or 'no reason given'})")
        if command is None:
            self._streaming_since = None
        else:
            self._publish_setpoint(command, stamp)
            self._request_offboard(situation)
        self._publish_trajectory(stamp)
        self._publish_map(situation, stamp)
        self._publish_report(stamp, *self._assess(situation))

    def _situation(self, now: float) -> Situation | None:
        vehicle = self._vehicle
        pose = vehicle.recent_pose(now, _STALE_POSE)
        if pose is None:
            return None
        return Situation(
            time=now + self._settings.planner.lead,
            position=pose[:3].copy(),
            velocity=vehicle.velocity,
            yaw=yaw_of(pose[3:].tolist()),
            is_flying=vehicle.armed and vehicle.is_in_air,
            is_offboard=vehicle.is_offboard,
            map_count=self._watch.count,
            fault=self._watch.fault(now),
        )

    def _publish_setpoint(self, command: PlannerCommand, stamp: rospy.Time) -> None:
        message = PositionTarget(coordinate_frame=PositionTarget.FRAME_LOCAL_NED)
        message.header.stamp = stamp
        message.type_mask = PositionTarget.IGNORE_YAW_RATE
        message.position = Point(*command.position.tolist())
        message.velocity = Vector3(*command.velocity.tolist())
        message.acceleration_or_force = Vector3(*command.acceleration.tolist())
        message.yaw = command.yaw
        self._setpoint.publish(message)

    def _request_offboard(self, now: Situation) -> None:
        if self._streaming_since is None:
            self._streaming_since = now.time
        if now.is_offboard or not self._settings.planner.offboard:
            return
        if now.time - self._streaming_since >= _STREAM_LEAD and now.time - self._requested >= _REQUEST_SPACING:
            self._requested = now.time
            self._services.submit(CommandRequest("OFFBOARD", None))

    def _publish_trajectory(self, stamp: rospy.Time) -> None:
        planner = self.planner
        if self._swarm is not None:
            self._swarm.publish(stamp)
        if planner.trajectory is None or planner.number == self._published_number:
            return
        self._published_number = planner.number
        radius = self._settings.limits.radius
        if self._swarm is None:
            self._trajectory.publish(
                spline_message(planner.trajectory, self.name, planner.number, radius, stamp, FRAME)
            )
        if self._path.get_num_connections():
            self._path.publish(path_message(planner.trajectory, stamp, FRAME))

    def _publish_map(self, now: Situation, stamp: rospy.Time) -> None:
        if now.time - self._mapped < _MAP_PERIOD:
            return
        self._mapped = now.time
        if self._occupied.get_num_connections():
            self._occupied.publish(cloud_message(self._map.grid.occupied(), stamp, FRAME))
        if self._slice.get_num_connections():
            self._slice.publish(slice_at(self._map.grid, float(now.position[2]), stamp))

    def _assess(self, now: Situation) -> tuple[int, str]:
        level, text = self.planner.state.report(self.planner, now)
        if level == 0 and self._watch.sees_nothing:
            return 1, f"{text}; the sensor sees nothing within its range"
        return level, text

    def _publish_report(self, stamp: rospy.Time, level: int, text: str) -> None:
        state = self.planner.state.name
        if state != self._published_state:
            self._published_state = state
            self._state.publish(String(state))
        self._log(stamp.to_sec(), level, text)
        values = {"state": state, "measurements": str(self._watch.count), "trajectories": str(self.planner.number)}
        self._diagnostics.publish(stamp, level, text, values)

    def _log(self, now: float, level: int, text: str) -> None:
        """Log a state that is worse than the last one, but not what is missing while all nodes start."""
        self._began = now if self._began is None else self._began
        self._has_been_well = self._has_been_well or level == 0
        if not self._has_been_well and now - self._began <= _START_UP:
            return
        if level > self._logged:
            rospy.logwarn(f"{self.name}: planner: {text}")
        self._logged = level

    def close(self) -> None:
        """Cancel pending service calls."""
        self._services.close()


class PlannerNode:
    """Planners of one or several vehicles in one process."""

    def __init__(self, names: Sequence[str], fleet: Sequence[str] = ()) -> None:
        """Declare the topics; goals from rviz go to the first vehicle.

        Raises:
            SettingError: a parameter is not allowed.
        """
        settings = read_settings()
        self._timings = settings.report.timings
        self._planners = [
            VehiclePlanner(name, fleet or names, settings, rviz_goal=n == 0) for n, name in enumerate(names)
        ]

    def step(self) -> None:
        """Run one cycle of every planner."""
        for planner in self._planners:
            planner.step()

    def close(self) -> None:
        """Cancel pending service calls, and write the timings."""
        for planner in self._planners:
            planner.close()
        if self._timings:
            try:
                write_summaries(
                    FilePath(self._timings), {planner.name: planner.stopwatch for planner in self._planners}
                )
            except OSError as error:
                rospy.logwarn(f"planner: timings: {error}")
