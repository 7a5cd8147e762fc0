"""ROS node for navigation in the plane, with the topics of ROS's move_base.

For a vehicle ``T`` (as ``iris_2d_lidar_0`` or ``ugv_0``); with ``~global_names`` the first seven rows without ``/T``:

====================================  =========================  ======================================================
topic                                 type                       meaning
====================================  =========================  ======================================================
/T/move_base/goal, cancel, status,    move_base_msgs/            an actionlib server, MoveBaseAction
feedback, result                      MoveBaseAction
/T/move_base_simple/goal              geometry_msgs/PoseStamped  in: a goal without an action client
/T/move_base/NavfnROS/plan            nav_msgs/Path              out, while subscribed: the global path
/T/move_base/DWAPlannerROS/           nav_msgs/Path              out, while subscribed: the commanded motion, and the
local_plan, global_plan                                          part of the global path on the local costmap
/T/move_base/global_costmap/costmap,  nav_msgs/OccupancyGrid     out, while subscribed: 100 obstacle, 99 too near to
local_costmap/costmap                                            one, 98 to 0 with the distance, -1 unknown
/T/move_base/current_goal             geometry_msgs/PoseStamped  out: each goal
/T/move_base/make_plan,               nav_msgs/GetPlan,          services, see ``move_base_services``
clear_costmaps                        std_srvs/Empty
/T/SCAN                               sensor_msgs/LaserScan      in, see ``~scan_topic``
MAP                                   nav_msgs/OccupancyGrid     in, see ``~map_topic``
/diagnostics                          DiagnosticArray            out: state and reason, once a second and on change
====================================  =========================  ======================================================

and the topics of ``vehicle_drives``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
import rospy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlanResponse
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan

import xtdrone_lockstep as lockstep
from xtdrone_common.pose_history import PoseHistory
from xtdrone_common.rotation import from_euler, yaw_of
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_control.vehicle_topics import VehicleReport
from xtdrone_planning.mapping.map_messages import FRAME, grid_message
from xtdrone_planning.mapping.sensor_watch import SensorWatch, WatchSettings
from xtdrone_planning.navigation.action_server import ABORTED, SUCCEEDED, ActionTopics
from xtdrone_planning.navigation.level_map import LevelMap, MapError, ScanRays
from xtdrone_planning.navigation.move_base_services import MoveBaseServices
from xtdrone_planning.navigation.navigator import ABORTED as GAVE_UP
from xtdrone_planning.navigation.navigator import PLANNING, Navigator, Turn
from xtdrone_planning.navigation.settings import (
    CostmapSettings,
    NavigationGoalError,
    NavigatorSettings,
    WindowSettings,
    check_reach,
)
from xtdrone_planning.navigation.vehicle_drives import DriveSettings, drive_of
from xtdrone_planning.stopwatch import Stopwatch, write_summaries

Array = NDArray[np.float64]

RATE = 20.0  # Hz, as move_base's controller

_PIECES = 4  # intervals per scan, within which the vehicle's pose is interpolated
_STALE_POSE = 0.5  # s
_LOCAL_PERIOD, _GLOBAL_PERIOD = 0.2, 1.0  # s between two publications of a costmap
_WARNINGS = 5.0  # s between two equal ones
_LEAST_NORM = 0.1  # of a goal's quaternion


@dataclass(frozen=True)
class NavigationSettings(Settings):
    """Topic names and reports of the node."""

    global_names: bool = setting(False, text="publish move_base's topics without the vehicle's name: /move_base/goal")
    timings: str = setting("", text="file for the wall times of scans and plans, JSON; empty: none")


class VehicleNavigation:
    """ROS topics of one vehicle's navigator."""

    def __init__(self, name: str, *, is_robot: bool, rviz_goal: bool) -> None:
        """Declare the topics.

        Args:
            name: Name of the vehicle.
            is_robot: whether it is a ground robot.
            rviz_goal: whether this vehicle subscribes to /move_base_simple/goal.

        Raises:
            SettingError: a parameter is not allowed.
        """
        self.name = name
        self._costs = CostmapSettings.from_parameters(rospy.get_param)
        self._limits = WindowSettings.from_parameters(rospy.get_param)
        names = NavigationSettings.from_parameters(rospy.get_param)
        check_reach(self._costs, self._limits)
        self.level = LevelMap(self._costs)
        self.navigator = Navigator(self.level, NavigatorSettings.from_parameters(rospy.get_param), self._limits)
        self._watch = SensorWatch(WatchSettings.from_parameters(rospy.get_param))
        self.stopwatch = Stopwatch()
        drive = DriveSettings.from_parameters(rospy.get_param)
        self._drive = drive_of(name, drive, self._on_pose, is_robot=is_robot)
        prefix = "" if names.global_names else f"/{name}"
        base = f"{prefix}/move_base"
        self._action = ActionTopics(base, self._begin, self.navigator.cancel)
        self._poses = PoseHistory(seconds=2.0, reach=0.1)
        self._services = MoveBaseServices(
            base, self.level, lambda: self.navigator.clearance, lambda: self._poses.last, self._plan_response
        )
        self._plan = lockstep.Publisher(f"{base}/NavfnROS/plan", Path)
        self._local = lockstep.Publisher(f"{base}/DWAPlannerROS/local_plan", Path)
        self._global = lockstep.Publisher(f"{base}/DWAPlannerROS/global_plan", Path)
        self._costmap = lockstep.Publisher(f"{base}/global_costmap/costmap", OccupancyGrid, latch=True)
        self._local_costmap = lockstep.Publisher(f"{base}/local_costmap/costmap", OccupancyGrid)
        self._current = lockstep.Publisher(f"{base}/current_goal", PoseStamped)
        self._diagnostics = VehicleReport(name, "navigation")
        for topic in sorted({f"{prefix}/move_base_simple/goal"} | ({"/move_base_simple/goal"} if rviz_goal else set())):
            lockstep.Subscriber(topic, PoseStamped, self._action.take)
        if self._costs.scan_topic:
            lockstep.Subscriber(f"/{name}/{self._costs.scan_topic}", LaserScan, self._on_scan, queue_size=1)
        if self._costs.map_topic:
            lockstep.Subscriber(self._costs.map_topic, OccupancyGrid, self._on_map)
        lockstep.add_reset_hook(self._restart)
        self._given: OccupancyGrid | None = None
        self._forget()

    def _restart(self) -> None:
        """Begin again, because simulated time was reset."""
        self.navigator.restart()
        with self._services.lock:
            self.level.restart()
        self._watch.restart()
        self._drive.restart()
        self._action.restart()
        self._poses.clear()
        if self._given is not None:
            self._on_map(self._given)
        self._forget()

    def _forget(self) -> None:
        self._posed = self._local_sent = self._global_sent = -math.inf
        self._last_reason = ""
        self._path: Array = np.empty((0, 2))

    # messages

    def _on_pose(self, stamp: rospy.Time, entry: Array) -> None:
        self._poses.add(stamp.to_nsec(), entry)
        self._posed = stamp.to_sec()

    def _on_map(self, message: OccupancyGrid) -> None:
        info = message.info
        origin = np.array([info.origin.position.x, info.origin.position.y])
        try:
            with self._services.lock:
                self.level.take(_values_of(message), origin, info.resolution)
        except MapError as error:
            rospy.logwarn(f"{self.name}: {error}; the map is ignored")
            return
        self._given = message

    def _on_scan(self, message: LaserScan) -> None:
        with self.stopwatch.measuring("map"), self._services.lock:
            self._enter(message)

    def _enter(self, message: LaserScan) -> None:
        ranges = np.array(message.ranges, float)
        numbers = (message.angle_min, message.angle_increment, message.time_increment, message.range_max)
        if not all(map(math.isfinite, numbers)) or not len(ranges):
            self._watch.rejected("scans without rays, or with angles, times or range_max that are not finite")
            return
        limits = message.range_min, message.range_max
        rays = ScanRays(ranges, *numbers[:3], limits, self._costs.scan_yaw)
        if not self._watch.take(ranges.tobytes(), int(rays.hits.sum())):
            return
        seconds = max(message.time_increment * len(ranges), 1e-3)
        poses = self._poses.during(message.header.stamp.to_nsec(), seconds, _PIECES)
        if poses is None:
            self._watch.rejected("no pose at the time of the scans")
            return
        if not self.level.is_ready:
            if self._costs.map_topic:
                self._watch.rejected(f"no map has been received on {self._costs.map_topic}")
                return  # wait for the given map
            self.level.begin_around(poses[-1])
        self.level.enter(*rays.place(poses, seconds / _PIECES, np.array(self._costs.scan_position), self._costs.slab))
        self.level.update_distance_around(poses[-1])
        self._watch.mapped(rospy.get_time())

    def _begin(self, message: PoseStamped) -> None:
        """Accept a goal.

        Raises:
            NavigationGoalError: it is not allowed.
        """
        if message.header.frame_id.lstrip("/") not in ("", FRAME):
            raise NavigationGoalError(f"goal: frame {message.header.frame_id!r} is not allowed, {FRAME!r}")
        place, q = message.pose.position, message.pose.orientation
        norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
        if not norm >= _LEAST_NORM or not math.isfinite(norm):
            raise NavigationGoalError("goal: a quaternion of length 0 is not allowed, a rotation about z")
        if reason := self._drive.obstacle_to_goals():
            raise NavigationGoalError(f"goal: {reason}")
        yaw = yaw_of((q.w / norm, q.x / norm, q.y / norm, q.z / norm))
        self.navigator.set_goal(np.array([place.x, place.y, yaw]))
        self._drive.begin()
        self._last_reason = ""
        self._current.publish(message)

    # turns

    def step(self) -> None:
        """Advance by a turn; call it at 20 Hz."""
        stamp = rospy.Time.now()
        now = stamp.to_sec()
        if self._drive.is_lost() and self.navigator.goal is not None:
            self.navigator.cancel()
            self._action.goals.end(ABORTED, "the vehicle was taken over, or is on the ground", now)
        pose = self._poses.last
        if pose is None or now - self._posed > _STALE_POSE:
            self._step_without_pose(stamp)
            return
        turn = Turn(now, 1.0 / RATE, self._level_pose(pose), self._fault(now))
        with self.stopwatch.measuring("turn"), self._services.lock:
            motion = self.navigator.step(turn)
        active = self.navigator.goal is not None or self.navigator.is_moving
        self._drive.command(motion, stamp, active=active)
        self._end_goal(now)
        self._action.publish(self._stamped(turn.pose, stamp, float(pose[2])), stamp)
        self._publish_plans(turn, stamp)
        with self._services.lock:
            self._publish_costmaps(turn, stamp)
        self._publish_report(stamp, self._assess(turn))

    def _step_without_pose(self, stamp: rospy.Time) -> None:
        """Stop; clients still get the results of goals that were rejected, cancelled or aborted."""
        self.navigator.pause()
        self._drive.halt()
        self._action.publish(None, stamp)
        self._publish_report(stamp, (2, "no position of the vehicle"))

    def _fault(self, now: float) -> str:
        """Return why the vehicle must brake; empty if it need not."""
        if not self._drive.obeys():
            return "the vehicle is not in OFFBOARD"
        if self._costs.scan_topic and (fault := self._watch.fault(now)):
            return fault
        return "" if self.level.is_ready else "no map has been received"

    def _end_goal(self, now: float) -> None:
        outcome, navigator = self.navigator.outcome, self.navigator
        if not outcome or self._action.goals.present is None:
            return
        self._last_reason = navigator.reason if outcome == GAVE_UP else ""
        text = f"no path or no progress: {navigator.reason}" if outcome == GAVE_UP else "goal reached"
        self._action.goals.end(ABORTED if outcome == GAVE_UP else SUCCEEDED, text, now)

    @staticmethod
    def _level_pose(pose: Array) -> Array:
        w, x, y, z = pose[3:].tolist()
        return np.array([pose[0], pose[1], yaw_of((w, x, y, z))])

    # output

    def _stamped(self, pose: Array, stamp: rospy.Time, height: float) -> PoseStamped:
        message = PoseStamped()
        message.header.stamp, message.header.frame_id = stamp, FRAME
        place, turn = message.pose.position, message.pose.orientation
        place.x, place.y, place.z = float(pose[0]), float(pose[1]), height
        turn.w, turn.x, turn.y, turn.z = from_euler(0.0, 0.0, float(pose[2]))
        return message

    def _path_message(self, poses: Array, stamp: rospy.Time) -> Path:
        height = 0.0 if self._poses.last is None else float(self._poses.last[2])
        path = Path(poses=[self._stamped(pose, stamp, height) for pose in poses])
        path.header.stamp, path.header.frame_id = stamp, FRAME
        return path

    def _plan_response(self, path: Array) -> GetPlanResponse:
        return GetPlanResponse(self._path_message(_with_yaws(path), rospy.Time.now()))

    def _publish_plans(self, turn: Turn, stamp: rospy.Time) -> None:
        path = self.navigator.path
        if path is not self._path:
            self._path = path
            poses = _with_yaws(path)
            if self._plan.get_num_connections():
                self._plan.publish(self._path_message(poses, stamp))
            if self._global.get_num_connections():
                half = 0.5 * self._costs.local_side
                near = np.abs(path - turn.pose[:2]).max(axis=1, initial=0.0) <= half
                self._global.publish(self._path_message(poses[near], stamp))
        if self.navigator.is_moving and self._local.get_num_connections():
            self._local.publish(self._path_message(self.navigator.local_plan(turn), stamp))

    def _publish_costmaps(self, turn: Turn, stamp: rospy.Time) -> None:
        if not self.level.is_ready:
            return
        if turn.time - self._local_sent >= _LOCAL_PERIOD and self._local_costmap.get_num_connections():
            self._local_sent = turn.time
            self._local_costmap.publish(self._grid_message(self.level.local(turn.pose), stamp))
        if turn.time - self._global_sent >= _GLOBAL_PERIOD and self._costmap.get_num_connections():
            self._global_sent = turn.time
            nx, ny, _ = self.level.evidence.shape
            self._costmap.publish(self._grid_message((slice(0, nx), slice(0, ny)), stamp))

    def _grid_message(self, part: tuple[slice, slice], stamp: rospy.Time) -> OccupancyGrid:
        costs = self.level.costs(part, self._limits.radius)
        first = np.array([part[0].start, part[1].start]) + self.level.corner[:2]
        x, y = (first * self.level.cell).tolist()
        return grid_message(costs, (x, y, 0.0), self.level.cell, stamp)

    def _assess(self, turn: Turn) -> tuple[int, str]:
        navigator = self.navigator
        if navigator.goal is None:
            if self._last_reason:
                return 2, f"{navigator.state}; goal aborted: {self._last_reason}"
            return 0, navigator.state
        if turn.fault:
            return 2, f"{navigator.state}; {turn.fault}"
        if navigator.state.startswith("recovering") or navigator.reason:
            return 1, "; ".join(filter(None, [navigator.state, navigator.reason]))
        return (1 if navigator.state == PLANNING else 0), navigator.state

    def _publish_report(self, stamp: rospy.Time, report: tuple[int, str]) -> None:
        (level, text), state = report, self.navigator.state
        values = {"state": state, "scans": str(self._watch.count)}
        has_changed = self._diagnostics.publish(
            stamp, level, text, values, state
        )  # the text counts seconds without a scan
        if level == 2 and has_changed:
            rospy.logwarn_throttle_identical(_WARNINGS, f"{self.name}: navigation: {text}")

    def close(self) -> None:
        """Cancel pending service calls."""
        self._drive.close()


def _values_of(message: OccupancyGrid) -> NDArray[np.int8]:
    """Return the cells (nx, ny) of a map.

    Raises:
        MapError: the number of cells does not match the map's size, or its axes are rotated relative to its frame.
    """
    info, turn = message.info, message.info.origin.orientation
    values = np.array(message.data, np.int8)
    if len(values) != info.width * info.height:
        raise MapError(f"map: {len(values)} cells are not allowed, width * height: {info.width} * {info.height}")
    if not abs(turn.x) + abs(turn.y) + abs(turn.z) <= 1e-6:
        raise MapError(f"map: origin turned by ({turn.x:g}, {turn.y:g}, {turn.z:g}) is not allowed, (0, 0, 0)")
    return values.reshape(info.height, info.width).T


def _with_yaws(path: Array) -> Array:
    """Return the poses (n, 3) along a path (n, 2), each facing the next point; the last keeps the previous heading."""
    if len(path) < 2:
        return np.column_stack([path, np.zeros(len(path))])
    steps = np.diff(path, axis=0)
    yaws = np.arctan2(steps[:, 1], steps[:, 0])
    return np.column_stack([path, np.append(yaws, yaws[-1])])


class NavigationNode:
    """The navigation of one or several vehicles in one process."""

    def __init__(self, names: Sequence[str], *, are_robots: bool) -> None:
        """Declare the topics; goals from rviz go to the first vehicle.

        Args:
            names: Names of the vehicles.
            are_robots: whether they are ground robots.

        Raises:
            SettingError: a parameter is not allowed.
        """
        settings = NavigationSettings.from_parameters(rospy.get_param)
        if settings.global_names and len(names) > 1:
            raise SettingError("global_names", True, f"false for {len(names)} vehicles: their topics would be the same")
        self._timings = settings.timings
        self._vehicles = [
            VehicleNavigation(name, is_robot=are_robots, rviz_goal=n == 0) for n, name in enumerate(names)
        ]

    def step(self) -> None:
        """Run one cycle of every vehicle."""
        for vehicle in self._vehicles:
            vehicle.step()

    def close(self) -> None:
        """Cancel pending service calls, and write the timings."""
        for vehicle in self._vehicles:
            vehicle.close()
        if self._timings:
            try:
                write_summaries(FilePath(self._timings), {one.name: one.stopwatch for one in self._vehicles})
            except OSError as error:
                rospy.logwarn(f"navigation: timings: {error}")
