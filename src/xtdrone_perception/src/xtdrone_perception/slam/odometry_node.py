"""ROS node for odometry of one vehicle ``T``, independent of the sensor.

=========================================  ================================  =========================================
topic                                      type                              meaning
=========================================  ================================  =========================================
/T/mavros/imu/data                         sensor_msgs/Imu                   in: attitude, for deskewing and prediction
/T/mavros/local_position/velocity_local    geometry_msgs/TwistStamped        in: velocity, for deskewing and prediction
/T/mavros/extended_state                   mavros_msgs/ExtendedState         in: whether it stands on the ground, where
                                                                             identical images are no fault
/T/SOURCE/odometry                         nav_msgs/Odometry                 out: T/odom to T/base_link
/T/SOURCE/path                             nav_msgs/Path                     out, latched: ``~path_rate``
/T/mavros/vision_pose/pose                 geometry_msgs/PoseStamped         out: to the autopilot, while it is good
/diagnostics                               diagnostic_msgs/DiagnosticArray   out: at every change, and 1 Hz
/tf, /tf_static                            tf2_msgs/TFMessage                out with ``~tf``: map, T/odom, T/base_link
=========================================  ================================  =========================================

The result of a measurement (a scan, an image) is published ``~latency`` of simulated time after its arrival, however
long the computation takes; the flight continues meanwhile. Poses for the autopilot, which assumes them to be of the
time of arrival, are extrapolated to that time. An unreliable measurement (``odometry_health``) is not published.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from tf2_msgs.msg import TFMessage

import xtdrone_lockstep as lockstep
from xtdrone_common.frames import to_xyzw
from xtdrone_common.pose_history import PoseHistory
from xtdrone_common.pose_matrices import pose_of, predicted_pose, rotation_of, turned_about_z, yaw_of
from xtdrone_common.pose_messages import stamped_pose, transform_message
from xtdrone_common.settings import Settings, setting
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_lockstep.deferred_work import Deferred

from . import odometry_messages as messages
from .deskewing import ScanMotion, motion_of
from .odometry_health import Estimate, Fault, Health, HealthLimits, OdometryState, fault_of

RATE = 50.0  # Hz
_MOST_WAITING = 3  # measurements; further ones, which occur only on a real vehicle, are dropped
_LEAST_STEP = 0.05  # m between two poses of the path
_MOST_PATH = 20_000  # poses
_REPORT_NS = 1_000_000_000
_KNOTS = 6  # attitudes in a scan

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OdometryOptions(Settings):
    """Private parameters of every node for odometry."""

    start: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-1e5, high=1e5, unit="m", text="position of base_link at the first measurement, in map"
    )
    heading: float | None = setting(
        None, low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad",
        text="yaw of base_link at the first measurement, ENU; none: the autopilot's",
    )  # fmt: skip
    level: bool = setting(
        True, text="assume base_link to be level at the first measurement; false: use the autopilot's roll and pitch"
    )
    latency: float = setting(0.04, low=0.0, high=1.0, unit="s", text="simulated time from a measurement to its result")
    feed: bool = setting(True, text="send poses to the autopilot")
    tf: bool = setting(False, text="publish T/odom to T/base_link")
    tf_map: bool = setting(True, text="publish map to T/odom, the identity; false: loop closure does")
    path_rate: float = setting(2.0, low=0.0, high=10.0, unit="Hz", text="publishing rate of the path; 0: off")


class Core(Protocol):
    """Interface of an odometry without ROS to the node.

    Attributes:
        pose: (4, 4) body to map, at the last measurement.
    """

    pose: Array

    def accept(self, found: Any) -> None:
        """Move to the pose of a measurement and add it to the map."""

    def move(self, pose: Array) -> None:
        """Move to a predicted pose."""


class OdometrySource(NamedTuple):
    """Properties of a kind of odometry.

    Attributes:
        name: Name of the node and its topics, e.g. ``lidar_odometry``.
        noun: name of a measurement, e.g. ``scan``.
        least_points: minimum for a measurement.
    """

    name: str
    noun: str
    least_points: int


class Job(NamedTuple):
    """A measurement to be registered; all times in ns."""

    payload: Any
    turn: Rotation  # of the body since the last measurement
    velocity: Array | None  # m/s, map; None: unknown
    attitude: Rotation  # of the autopilot at the time
    end_ns: int
    same: int


class _Outcome(NamedTuple):
    """A registered measurement and its fault."""

    found: Estimate
    velocity: Array
    fault: Fault | None


class AutopilotMotion:
    """The autopilot's attitudes and velocities of the last seconds."""

    def __init__(self, name: str) -> None:
        """Subscribe to the topics of a vehicle."""
        self._attitudes, self._velocities = PoseHistory(scalar_last=True), PoseHistory()
        lockstep.Subscriber(f"/{name}/mavros/imu/data", Imu, self._on_imu)
        lockstep.Subscriber(f"/{name}/mavros/local_position/velocity_local", TwistStamped, self._on_velocity)

    def clear(self) -> None:
        """Forget everything."""
        self._attitudes.clear()
        self._velocities.clear()

    def attitude(self, time_ns: int) -> Rotation | None:
        """Return the attitude at a time, body to map, None if it is unknown."""
        entry = self._attitudes.at(time_ns)
        return None if entry is None else Rotation.from_quat(to_xyzw(entry.tolist()))

    def velocity(self, time_ns: int) -> Array | None:
        """Return the velocity at a time, (3,) m/s, map, None if it is unknown."""
        entry = self._velocities.at(time_ns)
        return None if entry is None else entry[:3]

    def during(self, begin_ns: int, seconds: float) -> tuple[ScanMotion, Rotation] | None:
        """Return the motion during a scan and the attitude at its end, body to map; None if an attitude is unknown."""
        times = np.linspace(0.0, seconds, _KNOTS)
        found = [self.attitude(begin_ns + round(t * 1e9)) for t in times.tolist()]
        known = [attitude for attitude in found if attitude is not None]
        if len(known) < _KNOTS:
            return None
        velocity = self.velocity(begin_ns + round(seconds * 1e9))
        return motion_of(times, Rotation.concatenate(known), np.zeros(3) if velocity is None else velocity), known[-1]

    def _on_imu(self, message: Imu) -> None:
        q = message.orientation
        entry = np.array([q.w, q.x, q.y, q.z])
        if np.isfinite(entry).all() and abs(np.linalg.norm(entry) - 1.0) < 0.1:
            self._attitudes.add(message.header.stamp.to_nsec(), entry)

    def _on_velocity(self, message: TwistStamped) -> None:
        v = message.twist.linear
        entry = np.array([v.x, v.y, v.z, 1.0, 0.0, 0.0, 0.0])
        if np.isfinite(entry).all():
            self._velocities.add(message.header.stamp.to_nsec(), entry)


class OdometryNode:
    """Topics and state of one vehicle; a subclass adds the sensor and the registration."""

    def __init__(self, name: str, source: OdometrySource, options: OdometryOptions, limits: HealthLimits) -> None:
        """Declare the topics.

        Args:
            name: Name of the vehicle.
            source: Source of the odometry.
            options: Options of the node.
            limits: Limits of the supervision.
        """
        self._name, self._source, self._options, self._limits = name, source, options, limits
        self._frames = messages.Frames("map", f"{name}/odom", f"{name}/base_link")
        self._deferred = Deferred(1, wait=lockstep.is_active())
        base = f"/{name}/{source.name}"
        self._odometry = lockstep.Publisher(f"{base}/odometry", Odometry)
        self._path = lockstep.Publisher(f"{base}/path", Path, latch=True)
        self._vision = lockstep.Publisher(f"/{name}/mavros/vision_pose/pose", PoseStamped)
        self._diagnostics = lockstep.Publisher("/diagnostics", DiagnosticArray)
        self._tf = lockstep.Publisher("/tf", TFMessage)
        self._tf_static = lockstep.Publisher("/tf_static", TFMessage, latch=True)
        self._motion = AutopilotMotion(name)
        self._vehicle = VehicleTopics(name, "extended_state")
        self._clear()
        lockstep.add_reset_hook(self._restart)
        if options.tf and options.tf_map:
            self._tf_static.publish(messages.identity(self._frames.map, self._frames.odom))

    # of the subclass

    def _new_core(self, start: Array) -> Core:
        """Return the odometry, at a pose (4, 4) of the body in the map."""
        raise NotImplementedError

    def _register(self, core: Any, job: Job, predicted: Array) -> Estimate:
        """Register a measurement from a predicted pose (4, 4); called by the worker."""
        raise NotImplementedError

    def _publish_more(self, found: Any, stamp: rospy.Time) -> None:
        """Publish additional topics of this source, after the odometry."""

    def _clear(self) -> None:
        """Discard all state, e.g. after a reset of time."""
        self._motion.clear()
        self._core: Core | None = None
        self._health = Health(self._limits)
        self._told: tuple[OdometryState, Fault | None] | None = None
        self._velocity = np.zeros(3)  # of the worker's last measurement, map; used by the worker only
        self._last_end_ns: int | None = None
        self._last_attitude: Rotation | None = None
        self._digest, self._same, self._dropped = -1, 0, 0
        self._figures: Estimate | None = None
        self._poses: deque[PoseStamped] = deque(maxlen=_MOST_PATH)
        self._next_path_ns = self._next_report_ns = 0

    def _restart(self) -> None:
        self._deferred.clear()
        self._deferred.close()
        self._deferred = Deferred(1, wait=lockstep.is_active())
        self._clear()

    # measurements

    def _is_late(self) -> bool:
        """Return whether a new measurement must be dropped, and record it."""
        if len(self._deferred) < _MOST_WAITING:
            return False
        self._dropped += 1
        self._health.on_scan(rospy.get_time(), Fault.LATE)
        return True

    def _submit(self, payload: Any, digest: int, end_ns: int) -> None:
        """Start the registration of a measurement.

        Args:
            payload: Payload for ``_register``.
            digest: Digest of the raw data; two measurements of a working sensor in flight differ.
            end_ns: its time.
        """
        is_same = (
            digest == self._digest and not self._vehicle.is_on_ground
        )  # a simulated camera that stands still has no noise
        self._same = self._same + 1 if is_same else 0
        self._digest = digest
        attitude = self._motion.attitude(end_ns)
        if attitude is None:
            self._warn_of_attitude()
            return
        last = self._last_attitude or attitude
        self._last_attitude = attitude
        job = Job(payload, last.inv() * attitude, self._motion.velocity(end_ns), attitude, end_ns, self._same)
        due_us = (rospy.Time.now().to_nsec() + round(self._options.latency * 1e9)) // 1000
        self._deferred.put(job, due_us, self._register_and_move, job, self._start_core(job))

    def _warn_of_attitude(self) -> None:
        rospy.logwarn_throttle(
            10.0, f"{self._name}: no odometry: no attitude on mavros/imu/data at the {self._source.noun}'s time"
        )

    def _start_core(self, job: Job) -> Core:
        """Return the odometry, created at the first measurement."""
        if self._core is None:
            options = self._options
            own = yaw_of(pose_of((0.0, 0.0, 0.0), job.attitude))
            heading = own if options.heading is None else options.heading
            tilt = Rotation.identity() if options.level else turned_about_z(-own) * job.attitude
            self._core = self._new_core(pose_of(options.start, turned_about_z(heading) * tilt))
        return self._core

    # registration, by the worker

    def _register_and_move(self, job: Job, core: Core) -> _Outcome:
        """Register a measurement and move the odometry."""
        seconds = 0.0 if self._last_end_ns is None else (job.end_ns - self._last_end_ns) * 1e-9
        self._last_end_ns = job.end_ns
        velocity = self._velocity if job.velocity is None else job.velocity
        before = core.pose
        predicted = predicted_pose(before, job.turn, velocity, seconds)
        found = self._register(core, job, predicted)
        fault = fault_of(found, job.same, self._source.least_points, self._limits)
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

    def _finish(self, job: Job, outcome: _Outcome, now: rospy.Time) -> None:
        trusted = self._health.on_scan(now.to_sec(), outcome.fault)
        self._figures = outcome.found
        if not trusted:
            return
        pose = outcome.found.pose
        end = rospy.Time(0, 0) + rospy.Duration(0, job.end_ns)
        self._publish(pose, outcome, end)
        if self._options.feed:
            self._vision.publish(stamped_pose(self._carry_forward(pose, outcome, job, now), now, self._frames.map))
        self._publish_path(pose, end)
        self._publish_more(outcome.found, end)

    def _publish(self, pose: Array, outcome: _Outcome, stamp: rospy.Time) -> None:
        body_velocity = rotation_of(pose).inv().apply(outcome.velocity)
        self._odometry.publish(messages.odometry(pose, body_velocity, outcome.found.covariance, stamp, self._frames))
        if self._options.tf:
            self._tf.publish(transform_message(pose, stamp, self._frames.odom, self._frames.body))

    def _carry_forward(self, pose: Array, outcome: _Outcome, job: Job, now: rospy.Time) -> Array:
        """Extrapolate a pose from the time of its measurement to now."""
        attitude = self._motion.attitude(now.to_nsec())
        turn = Rotation.identity() if attitude is None else job.attitude.inv() * attitude
        return predicted_pose(pose, turn, outcome.velocity, (now.to_nsec() - job.end_ns) * 1e-9)

    def _publish_path(self, pose: Array, stamp: rospy.Time) -> None:
        """Publish the path, if it is due."""
        entry = stamped_pose(pose, stamp, self._frames.odom)
        if not self._poses or messages.distance(self._poses[-1], entry) >= _LEAST_STEP:
            self._poses.append(entry)
        if self._options.path_rate and stamp.to_nsec() >= self._next_path_ns:
            self._next_path_ns = stamp.to_nsec() + round(1e9 / self._options.path_rate)
            self._path.publish(messages.path(self._poses, stamp, self._frames.odom))

    def _report(self, now: rospy.Time) -> None:
        """Publish the state at each change, and once a second."""
        state = self._health.state, self._health.fault
        if state == self._told and now.to_nsec() < self._next_report_ns:
            return
        if state != self._told:
            self._log(*state)
        self._told = state
        self._next_report_ns = now.to_nsec() + _REPORT_NS
        source = messages.Reporter(self._name, self._source.name, self._source.noun)
        self._diagnostics.publish(messages.diagnostics(source, self._health, self._figures, self._dropped, now))

    def _log(self, state: OdometryState, fault: Fault | None) -> None:
        if state is OdometryState.LOST and fault is not None:
            words = fault.words(self._source.noun)
            rospy.logwarn(f"{self._name}: odometry is lost, the autopilot receives no poses: {words}")
        elif state is OdometryState.GOOD and self._told is not None and self._told[0] is OdometryState.LOST:
            rospy.loginfo(f"{self._name}: odometry is good again")
