"""Lidar odometry of one vehicle ``T`` as a ROS node.

=========================================  ================================  =========================================
topic                                      type                              meaning
=========================================  ================================  =========================================
/T/velodyne_points (``~cloud``)            sensor_msgs/PointCloud2           in: with the points' times
/T/mavros/imu/data                         sensor_msgs/Imu                   in: attitude, for skew and prediction
/T/mavros/local_position/velocity_local    geometry_msgs/TwistStamped        in: velocity, for skew and prediction
/T/lidar_odometry/odometry                 nav_msgs/Odometry                 out: T/odom to T/base_link
/T/lidar_odometry/path                     nav_msgs/Path                     out, latched: ``~path_rate``
/T/lidar_odometry/cloud                    sensor_msgs/PointCloud2           out: the scan without skew, T/base_link
/T/lidar_odometry/local_map                sensor_msgs/PointCloud2           out, latched: ``~map_rate``, T/odom
/T/mavros/vision_pose/pose                 geometry_msgs/PoseStamped         out: to the autopilot, while good
/diagnostics                               diagnostic_msgs/DiagnosticArray   out: at every change, and 1 Hz
/tf, /tf_static                            tf2_msgs/TFMessage                out with ``~tf``: map, T/odom, T/base_link
=========================================  ================================  =========================================

The result of a scan is published ``~latency`` of simulated time after its arrival, whatever the registration takes; the
flight continues meanwhile. A pose for the autopilot, which takes it for one of the time of its arrival, is carried
forward to this time. A scan that may not be trusted (``odometry_health``) is not passed on.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu, PointCloud2
from tf2_msgs.msg import TFMessage

from xtdrone_control import lockstep
from xtdrone_control.lockstep.deferred_work import Deferred
from xtdrone_control.settings import Settings, setting
from xtdrone_perception.tracking.pose_history import PoseHistory

from . import odometry_messages as messages
from .deskewing import ScanMotion, motion_of
from .lidar_odometry import LidarOdometry, Registration, RegistrationOptions, predicted_pose
from .odometry_health import Fault, Health, HealthLimits, ScanFigures, State, fault_of
from .poses import pose_of, rotation_of, turned_about_z, yaw_of
from .scan_points import PointScan, read_cloud

RATE = 50.0  # Hz
_KNOTS = 6  # attitudes in a scan
_MOST_WAITING = 3  # scans; on a real vehicle further ones are dropped
_STILL = 0.05  # s without motion for a cloud without times
_LEAST_STEP = 0.05  # m between two poses of the path
_MOST_PATH = 20_000  # poses
_REPORT_NS = 1_000_000_000

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LidarOdometryOptions(Settings):
    """Private parameters of the node."""

    cloud: str = setting("velodyne_points", text="topic of the clouds below the vehicle's namespace")
    lidar_position: tuple[float, float, float] = setting((0.0, 0.0, 0.06), unit="m", text="of the lidar in base_link")
    lidar_rpy: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad", text="roll, pitch, yaw in base_link"
    )
    start: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-1e5, high=1e5, unit="m", text="where base_link is at the first scan, in map"
    )
    heading: float | None = setting(
        None, low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad", text="its yaw then, ENU; none: the autopilot's"
    )
    level: bool = setting(True, text="take base_link for level then; false: its roll and pitch are the autopilot's")
    latency: float = setting(0.04, low=0.0, high=1.0, unit="s", text="simulated time from a scan to its result")
    feed: bool = setting(True, text="send poses to the autopilot")
    tf: bool = setting(False, text="publish T/odom to T/base_link")
    tf_map: bool = setting(True, text="publish map to T/odom, the identity; false: loop closure does")
    map_rate: float = setting(1.0, low=0.0, high=10.0, unit="Hz", text="of the local map; 0: none")
    map_radius: float = setting(40.0, low=1.0, high=1000.0, unit="m", text="of the local map")
    path_rate: float = setting(2.0, low=0.0, high=10.0, unit="Hz", text="of the path; 0: none")


class _Job(NamedTuple):
    """A scan to be registered; all times in ns."""

    scan: PointScan
    motion: ScanMotion
    turn: Rotation  # of the body since the end of the last scan
    velocity: Array | None  # m/s, map; None: unknown
    attitude: Rotation  # of the autopilot at the end
    end_ns: int
    same: int


class _Outcome(NamedTuple):
    """A registered scan and its fault."""

    registration: Registration
    velocity: Array
    fault: Fault | None


class VehicleOdometry:
    """Topics and state of one vehicle."""

    def __init__(
        self, name: str, settings: LidarOdometryOptions, odometry: RegistrationOptions, limits: HealthLimits
    ) -> None:
        """Declare the topics.

        Args:
            name: of the vehicle.
            settings: of the node.
            odometry: of the registration.
            limits: of the supervision.
        """
        self._name, self._settings, self._registration, self._limits = name, settings, odometry, limits
        self._lidar = pose_of(settings.lidar_position, Rotation.from_euler("xyz", settings.lidar_rpy))
        self._frames = messages.Frames("map", f"{name}/odom", f"{name}/base_link")
        self._deferred = Deferred(1, wait=lockstep.is_active())
        self._clear()
        base = f"/{name}/lidar_odometry"
        self._odometry = lockstep.Publisher(f"{base}/odometry", Odometry)
        self._path = lockstep.Publisher(f"{base}/path", Path, latch=True)
        self._cloud = lockstep.Publisher(f"{base}/cloud", PointCloud2)
        self._map = lockstep.Publisher(f"{base}/local_map", PointCloud2, latch=True)
        self._vision = lockstep.Publisher(f"/{name}/mavros/vision_pose/pose", PoseStamped)
        self._diagnostics = lockstep.Publisher("/diagnostics", DiagnosticArray)
        self._tf = lockstep.Publisher("/tf", TFMessage)
        self._tf_static = lockstep.Publisher("/tf_static", TFMessage, latch=True)
        lockstep.Subscriber(f"/{name}/mavros/imu/data", Imu, self._on_imu)
        lockstep.Subscriber(f"/{name}/mavros/local_position/velocity_local", TwistStamped, self._on_velocity)
        lockstep.Subscriber(f"/{name}/{settings.cloud}", PointCloud2, self._on_cloud, queue_size=4, buff_size=2**24)
        lockstep.add_reset_hook(self._restart)
        if settings.tf and settings.tf_map:
            self._tf_static.publish(messages.identity(self._frames.map, self._frames.odom))

    def _clear(self) -> None:
        self._attitudes, self._velocities = PoseHistory(), PoseHistory()
        self._core: LidarOdometry | None = None
        self._health = Health(self._limits)
        self._told: tuple[State, Fault | None] | None = None
        self._velocity = np.zeros(3)  # of the worker's last scan, map; used by the worker only
        self._last_end_ns: int | None = None
        self._last_attitude: Rotation | None = None
        self._digest, self._same, self._dropped = -1, 0, 0
        self._way = 0.0
        self._figures: Registration | None = None
        self._poses: deque[PoseStamped] = deque(maxlen=_MOST_PATH)
        self._next_map_ns = self._next_path_ns = self._next_report_ns = 0

    def _restart(self) -> None:
        self._deferred.clear()
        self._deferred.close()
        self._deferred = Deferred(1, wait=lockstep.is_active())
        self._clear()

    # messages

    def _on_imu(self, message: Imu) -> None:
        q = message.orientation
        entry = np.array([q.x, q.y, q.z, q.w])
        if np.isfinite(entry).all() and abs(np.linalg.norm(entry) - 1.0) < 0.1:
            self._attitudes.add(message.header.stamp.to_nsec(), entry)

    def _on_velocity(self, message: TwistStamped) -> None:
        v = message.twist.linear
        entry = np.array([v.x, v.y, v.z, 0.0, 0.0, 0.0, 1.0])
        if np.isfinite(entry).all():
            self._velocities.add(message.header.stamp.to_nsec(), entry)

    def _on_cloud(self, message: PointCloud2) -> None:
        try:
            scan = read_cloud(message)
        except ValueError as error:
            rospy.logwarn_throttle(10.0, f"{self._name}: ignored a cloud: {error}")
            return
        if len(self._deferred) >= _MOST_WAITING:
            self._dropped += 1
            self._health.on_scan(rospy.get_time(), Fault.LATE)
            return
        self._same = self._same + 1 if scan.digest == self._digest else 0
        self._digest = scan.digest
        job = self._job(scan, message.header.stamp.to_nsec())
        if job is not None:
            due_us = (rospy.Time.now().to_nsec() + round(self._settings.latency * 1e9)) // 1000
            self._deferred.put(job, due_us, self._registered, job, self._started(job))

    def _job(self, scan: PointScan, begin_ns: int) -> _Job | None:
        """Return what the registration needs to know of a scan; None if the attitude is unknown."""
        duration = max(scan.duration, _STILL)
        times = np.linspace(0.0, duration, _KNOTS)
        found = [self._attitudes.at(begin_ns + round(t * 1e9)) for t in times.tolist()]
        if any(entry is None for entry in found):
            rospy.logwarn_throttle(
                10.0, f"{self._name}: no odometry: no attitude on mavros/imu/data at the scan's time"
            )
            return None
        attitudes = Rotation.from_quat(np.array(found))
        end_ns = begin_ns + round(duration * 1e9)
        entry = self._velocities.at(end_ns)
        velocity = None if entry is None else entry[:3]
        last = self._last_attitude or attitudes[-1]
        motion = motion_of(times, attitudes, np.zeros(3) if velocity is None else velocity)
        self._last_attitude = attitudes[-1]
        return _Job(scan, motion, last.inv() * attitudes[-1], velocity, attitudes[-1], end_ns, self._same)

    def _started(self, job: _Job) -> LidarOdometry:
        """Return the odometry, which starts with the first scan."""
        if self._core is None:
            settings = self._settings
            own = yaw_of(pose_of((0.0, 0.0, 0.0), job.attitude))
            heading = own if settings.heading is None else settings.heading
            tilt = Rotation.identity() if settings.level else turned_about_z(-own) * job.attitude
            start = pose_of(settings.start, turned_about_z(heading) * tilt)
            self._core = LidarOdometry(self._registration, self._lidar, start)
        return self._core

    # registration, by the worker

    def _registered(self, job: _Job, core: LidarOdometry) -> _Outcome:
        """Register a scan and move the odometry."""
        seconds = 0.0 if self._last_end_ns is None else (job.end_ns - self._last_end_ns) * 1e-9
        self._last_end_ns = job.end_ns
        velocity = self._velocity if job.velocity is None else job.velocity
        before = core.pose
        predicted = predicted_pose(before, job.turn, velocity, seconds)
        found = core.register(core.points_of(job.scan, job.motion), predicted)
        figures = ScanFigures(
            found.count, found.share, found.residual, found.weakest, found.jump, found.turn, job.same,
            self._registration.least_points, found.is_first,
        )  # fmt: skip
        fault = fault_of(figures, self._limits)
        if fault is None:
            core.accept(found)
        else:
            core.move(predicted)
        if seconds > 0.0:
            self._velocity = (core.pose[:3, 3] - before[:3, 3]) / seconds
        return _Outcome(found, self._velocity.copy(), fault)

    # turns

    def step(self) -> None:
        """Publish the results that are due, and the state."""
        now = rospy.Time.now()
        for job, outcome in self._deferred.ready(now.to_nsec() // 1000):
            self._finish(job, outcome, now)
        self._health.on_time(now.to_sec())
        self._report(now)

    def close(self) -> None:
        """End the worker."""
        self._deferred.close()

    def _finish(self, job: _Job, outcome: _Outcome, now: rospy.Time) -> None:
        trusted = self._health.on_scan(now.to_sec(), outcome.fault)
        self._figures = outcome.registration
        if not trusted:
            return
        pose = outcome.registration.pose
        end = rospy.Time(0, 0) + rospy.Duration(0, job.end_ns)
        self._publish(pose, outcome, end)
        if self._settings.feed:
            self._vision.publish(messages.stamped(self._carried(pose, outcome, job, now), now, self._frames.map))
        if self._cloud.get_num_connections():
            self._cloud.publish(messages.cloud(outcome.registration.points, end, self._frames.body))
        self._publish_slowly(pose, end)

    def _publish(self, pose: Array, outcome: _Outcome, stamp: rospy.Time) -> None:
        body_velocity = rotation_of(pose).inv().apply(outcome.velocity)
        covariance = outcome.registration.covariance
        self._odometry.publish(messages.odometry(pose, body_velocity, covariance, stamp, self._frames))
        if self._settings.tf:
            self._tf.publish(messages.transform(pose, stamp, self._frames.odom, self._frames.body))

    def _carried(self, pose: Array, outcome: _Outcome, job: _Job, now: rospy.Time) -> Array:
        """Return a pose carried forward from the end of its scan to now."""
        entry = self._attitudes.at(now.to_nsec())
        turn = Rotation.identity() if entry is None else job.attitude.inv() * Rotation.from_quat(entry)
        return predicted_pose(pose, turn, outcome.velocity, (now.to_nsec() - job.end_ns) * 1e-9)

    def _publish_slowly(self, pose: Array, stamp: rospy.Time) -> None:
        """Publish path and local map, if they are due."""
        now_ns = stamp.to_nsec()
        entry = messages.stamped(pose, stamp, self._frames.odom)
        if not self._poses or messages.distance(self._poses[-1], entry) >= _LEAST_STEP:
            self._poses.append(entry)
        if self._settings.path_rate and now_ns >= self._next_path_ns:
            self._next_path_ns = now_ns + round(1e9 / self._settings.path_rate)
            self._path.publish(messages.path(self._poses, stamp, self._frames.odom))
        if self._settings.map_rate and now_ns >= self._next_map_ns and self._map.get_num_connections():
            self._next_map_ns = now_ns + round(1e9 / self._settings.map_rate)
            points = self._core.local_map(self._settings.map_radius) if self._core is not None else np.empty((0, 3))
            self._map.publish(messages.cloud(points, stamp, self._frames.odom))

    def _report(self, now: rospy.Time) -> None:
        """Publish the state at each change, and once a second."""
        state = self._health.state, self._health.fault
        if state == self._told and now.to_nsec() < self._next_report_ns:
            return
        if state != self._told:
            self._log(*state)
        self._told = state
        self._next_report_ns = now.to_nsec() + _REPORT_NS
        self._diagnostics.publish(messages.diagnostics(self._name, self._health, self._figures, self._dropped, now))

    def _log(self, state: State, fault: Fault | None) -> None:
        if state is State.LOST and fault is not None:
            rospy.logwarn(f"{self._name}: odometry is lost, the autopilot gets no poses: {fault.value}")
        elif state is State.GOOD and self._told is not None and self._told[0] is State.LOST:
            rospy.loginfo(f"{self._name}: odometry is good again")


def read_settings() -> tuple[LidarOdometryOptions, RegistrationOptions, HealthLimits]:
    """Read the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    get: Any = rospy.get_param
    return (
        LidarOdometryOptions.from_parameters(get),
        RegistrationOptions.from_parameters(get),
        HealthLimits.from_parameters(get),
    )
