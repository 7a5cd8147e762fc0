"""ROS node that forwards poses of third-party odometry and SLAM to the autopilot. For vehicle ``T``

===============================  ===============================  ====================================================
topic                            type                             meaning
===============================  ===============================  ====================================================
the source's                     Odometry, PoseStamped or /tf     in: see ``SOURCES``; of /tf, with /tf_static
/T/DISTANCE                      sensor_msgs/LaserScan            in, see ``~distance``, for programs that work in the
                                                                  plane: the height
/T/mavros/vision_pose/pose       geometry_msgs/PoseStamped        out: base_link in map, once for each pose
/T/pose_transfer/odometry        nav_msgs/Odometry                out, while subscribed: the same, without a velocity,
                                                                  for the drift by ``./xtdrone analyse``
/T/vins_estimator/odometry       nav_msgs/Odometry                in, for multi_vins: the pose of the IMU
/T/odometry                      nav_msgs/Odometry                out, for multi_vins: the same in map
/diagnostics                     diagnostic_msgs/DiagnosticArray  out: once a second, and on change
===============================  ===============================  ====================================================

If the source or range finder falls silent, the autopilot's failsafe takes over: no pose is sent twice, or with an old
height.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Pose, PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

import xtdrone_lockstep as lockstep
from xtdrone_common.pose_messages import pose_message, stamped_pose
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_control.vehicle_topics import VehicleReport
from xtdrone_perception.slam.transfer.foreign_pose import (
    STATIC,
    ChainWatch,
    ForeignFrame,
    PlaceSettings,
    TransformChain,
    pose_from,
)

RATE = 60.0  # Hz

_MAP = "map"
_SILENCE = 1.0  # s
_OLD_HEIGHT = 0.5  # s after which a range is too old to use
_UNKNOWN = -1.0  # first element of a covariance that is not known

Array = NDArray[np.float64]


class ForeignSource(NamedTuple):
    """Output of a third-party program.

    Attributes:
        kind: ``odometry``, ``pose`` or ``tf``.
        topic: its topic (of a tf: parent and child frame, with a space between), unless ``~topic`` is set; {} is the
            vehicle's name.
        optical: whether the pose is that of a camera's optical frame.
        plane: whether it works in the plane, so that the height comes from the range finder.
        odometry: topic of a further odometry, which is published in map on /T/odometry; empty: none.
    """

    kind: str
    topic: str
    optical: bool = False
    plane: bool = False
    odometry: str = ""


SOURCES = {
    "vins": ForeignSource("odometry", "/vins_estimator/camera_pose", optical=True),
    "multi_vins": ForeignSource(
        "odometry", "/{}/vins_estimator/camera_pose", optical=True, odometry="/{}/vins_estimator/odometry"
    ),
    "hector": ForeignSource("pose", "/{}/pose", plane=True),
    "cartographer": ForeignSource("tf", "map base_link", plane=True),
    "aloam": ForeignSource("tf", "camera_init aft_mapped"),
    "fastlio": ForeignSource("odometry", "/Odometry"),
    "odometry": ForeignSource("odometry", "/{}/odometry"),
}
"""Sources by name; ``odometry`` is any nav_msgs/Odometry of a sensor with the axes of base_link."""

LASERS = ("hector", "cartographer", "aloam", "fastlio", "odometry")
"""The sources of ``laser_transfer.py``."""


@dataclass(frozen=True)
class ForeignOptions(Settings):
    """Topics of the node."""

    topic: str = setting(
        "", text="topic of the source, or parent and child frames of its tf; empty: the program's default"
    )
    distance: str = setting(
        "distance", text="topic of the downward range finder below /VEHICLE/, for sources in the plane"
    )
    distance_below: float = setting(
        0.0, low=-2.0, high=2.0, unit="m", text="height of base_link above that range finder"
    )


def transfer_of(vehicle: str, source: str) -> PoseTransfer:
    """Return the topics of a vehicle, with the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    get = rospy.get_param
    return PoseTransfer(
        vehicle, SOURCES[source], ForeignOptions.from_parameters(get), PlaceSettings.from_parameters(get)
    )


def _frames_of(topic: str) -> tuple[str, str]:
    """Return parent and child frame of a source on /tf.

    Raises:
        SettingError: they are not two names with a space between.
    """
    names = topic.split()
    if len(names) != 2:
        raise SettingError("topic", topic, "parent and child frame with a space between, as 'map base_link'")
    return names[0], names[1]


class PoseTransfer:
    """Topics of one vehicle."""

    def __init__(self, vehicle: str, source: ForeignSource, options: ForeignOptions, place: PlaceSettings) -> None:
        """Declare the topics.

        Raises:
            SettingError: ``topic`` does not name two frames, for a source on /tf.
        """
        self._vehicle, self._source = vehicle, source
        self._frame = ForeignFrame(place, source.optical)
        self._tf = TransformChain()
        self._publisher = lockstep.Publisher(f"/{vehicle}/mavros/vision_pose/pose", PoseStamped)
        self._poses = lockstep.Publisher(f"/{vehicle}/pose_transfer/odometry", Odometry)
        self._diagnostics = VehicleReport(vehicle, "pose transfer")
        topic = options.topic or source.topic.format(vehicle)
        if source.kind == "tf":
            self._parent, self._child = _frames_of(topic)
            lockstep.Subscriber("/tf", TFMessage, self._on_tf)
            lockstep.Subscriber("/tf_static", TFMessage, self._on_static_tf)
        elif source.kind == "pose":
            lockstep.Subscriber(topic, PoseStamped, lambda message: self._enter(message.header, message.pose))
        else:
            lockstep.Subscriber(topic, Odometry, lambda message: self._enter(message.header, message.pose.pose))
        if source.odometry:
            self._body = ForeignFrame(replace(place, sensor_position=(0.0, 0.0, 0.0)), optical=False)
            self._odometry = lockstep.Publisher(f"/{vehicle}/odometry", Odometry)
            lockstep.Subscriber(source.odometry.format(vehicle), Odometry, self._on_odometry)
        if source.plane:
            self._below = options.distance_below
            lockstep.Subscriber(f"/{vehicle}/{options.distance}", LaserScan, self._on_distance)
        lockstep.add_reset_hook(self._forget)
        self._forget()

    def _forget(self) -> None:
        """Begin again, because simulated time was reset."""
        self._tf.clear()
        self._watch = ChainWatch()
        self._new: PoseStamped | None = None
        self._last_height, self._measured = 0.0, -math.inf
        self._last_ns = -1
        self._heard = -math.inf
        self._count = self._rejected = 0

    def _on_distance(self, message: LaserScan) -> None:
        ranges = [r for r in message.ranges if math.isfinite(r) and message.range_min <= r <= message.range_max]
        if ranges:
            self._last_height, self._measured = min(ranges) + self._below, rospy.get_time()

    def _height(self) -> float | None:
        """Return the height of base_link, m; None if the range finder has no recent measurement."""
        return self._last_height if rospy.get_time() - self._measured <= _OLD_HEIGHT else None

    def _on_odometry(self, message: Odometry) -> None:
        p, q = message.pose.pose.position, message.pose.pose.orientation
        found = self._body.vehicle(np.array([p.x, p.y, p.z]), np.array([q.w, q.x, q.y, q.z]))
        if found is None:
            return
        out = Odometry(header=Header(stamp=message.header.stamp, frame_id=_MAP), child_frame_id=message.child_frame_id)
        out.pose.pose, out.pose.covariance = pose_message(found), message.pose.covariance
        out.twist = message.twist
        self._odometry.publish(out)

    def _on_tf(self, message: TFMessage) -> None:
        for entry in message.transforms:
            self._add_transform(entry, entry.header.stamp.to_nsec())
        found = self._tf.pose(self._parent, self._child)
        if found is not None and self._watch.is_new(found):
            self._enter(Header(stamp=rospy.Time(*divmod(found[0], 10**9))), pose_message(found[1]))

    def _on_static_tf(self, message: TFMessage) -> None:
        for entry in message.transforms:
            self._add_transform(entry, STATIC)

    def _add_transform(self, entry: TransformStamped, stamp_ns: int) -> None:
        t, q = entry.transform.translation, entry.transform.rotation
        pose = pose_from(np.array([t.x, t.y, t.z]), np.array([q.w, q.x, q.y, q.z]))
        if pose is not None:
            self._tf.add(entry.header.frame_id, entry.child_frame_id, stamp_ns, pose)

    def _enter(self, header: Header, pose: Pose) -> None:
        """Store the vehicle's pose until the next turn."""
        p, q = pose.position, pose.orientation
        height = self._height() if self._source.plane else None
        if self._source.plane and height is None:
            return
        found = self._frame.vehicle(np.array([p.x, p.y, p.z]), np.array([q.w, q.x, q.y, q.z]), height)
        if found is None:
            self._rejected += 1
            rospy.logwarn_throttle(5.0, f"{self._vehicle}: pose dropped: not finite, or not a rotation")
            return
        if header.stamp.to_nsec() == self._last_ns and self._last_ns > 0:
            return  # a source that repeats a pose has not measured a new one
        self._last_ns = header.stamp.to_nsec()
        self._new = stamped_pose(found, header.stamp, _MAP)

    def step(self) -> None:
        """Send new poses, and report."""
        stamp = rospy.Time.now()
        pose, self._new = self._new, None
        if pose is not None:
            if not pose.header.stamp.to_nsec():
                pose.header.stamp = stamp
            self._publisher.publish(pose)
            self._publish_odometry(pose)
            self._heard = stamp.to_sec()
            self._count += 1
        self._publish_report(stamp)

    def _publish_odometry(self, pose: PoseStamped) -> None:
        if self._poses.get_num_connections():
            message = Odometry(header=pose.header, child_frame_id=f"{self._vehicle}/base_link")
            message.pose.pose = pose.pose
            message.pose.covariance[0] = message.twist.covariance[0] = _UNKNOWN
            self._poses.publish(message)

    def _assess(self, now: float) -> tuple[int, str]:
        """Return level and text for the diagnostics."""
        has_no_height = self._source.plane and self._height() is None
        if not self._count:
            return DiagnosticStatus.WARN, f"{'no distance from the range finder' if has_no_height else 'no poses'} yet"
        if now - self._heard > _SILENCE:
            missing = "distance from the range finder" if has_no_height else "new poses"
            return DiagnosticStatus.ERROR, f"no {missing} for {_SILENCE:g} s"
        return DiagnosticStatus.OK, "poses are sent"

    def _publish_report(self, stamp: rospy.Time) -> None:
        level, text = self._assess(stamp.to_sec())
        values = {"poses": str(self._count), "rejected": str(self._rejected)}
        if self._diagnostics.publish(stamp, level, text, values, text) and level == DiagnosticStatus.ERROR:
            rospy.logwarn(f"{self._vehicle}: {text}; the autopilot's failsafe will act")
