"""Conversion of odometry's poses, paths and states to ROS messages."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, Vector3
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rospy import Time
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from xtdrone_common.pose_messages import pose_message, transform_message

from .odometry_health import Estimate, Health, OdometryState

_LEVELS = {
    OdometryState.WAITING: DiagnosticStatus.WARN,
    OdometryState.GOOD: DiagnosticStatus.OK,
    OdometryState.LOST: DiagnosticStatus.ERROR,
}
_UNKNOWN_TURNS = 1e-2  # rad^2/s^2 and m^2/s^2, variances of the velocity

Array = NDArray[np.float64]


class Frames(NamedTuple):
    """Frame names of REP 105."""

    map: str
    odom: str
    body: str


class Reporter(NamedTuple):
    """Identity under which diagnostics are published.

    Attributes:
        vehicle: its name.
        source: name of the odometry, as ``lidar_odometry``.
        noun: name of a measurement, e.g. ``scan``.
    """

    vehicle: str
    source: str
    noun: str


def distance(first: PoseStamped, second: PoseStamped) -> float:
    """Return the distance between two poses, m."""
    a, b = first.pose.position, second.pose.position
    return float(np.hypot(np.hypot(a.x - b.x, a.y - b.y), a.z - b.z))


def odometry(pose: Array, velocity: Array, covariance: Array, stamp: Time, frames: Frames) -> Odometry:
    """Return an odometry message.

    Args:
        pose: (4, 4) body in odom.
        velocity: (3,) m/s, body.
        covariance: (6, 6) of the pose.
        stamp: time of the pose.
        frames: names.
    """
    message = Odometry(header=Header(stamp=stamp, frame_id=frames.odom), child_frame_id=frames.body)
    message.pose.pose = pose_message(pose)
    message.pose.covariance = covariance.ravel().tolist()
    message.twist.twist.linear = Vector3(*velocity.tolist())
    message.twist.covariance = (_UNKNOWN_TURNS * np.eye(6)).ravel().tolist()
    return message


def path(poses: Iterable[PoseStamped], stamp: Time, frame: str) -> Path:
    """Return a path."""
    return Path(Header(stamp=stamp, frame_id=frame), list(poses))


def identity(parent: str, child: str) -> TFMessage:
    """Return the identity transform between two frames."""
    return transform_message(np.eye(4), Time(), parent, child)


def diagnostics(
    reporter: Reporter, health: Health, figures: Estimate | None, dropped: int, stamp: Time
) -> DiagnosticArray:
    """Return the state of a vehicle's odometry.

    Args:
        reporter: identity in the message.
        health: Health of the odometry.
        figures: Figures of the last measurement, None before the first.
        dropped: measurements that were not registered for lack of time.
        stamp: now.
    """
    noun = reporter.noun
    text = health.fault.words(noun) if health.fault is not None else health.state.words(noun)
    level = _LEVELS[health.state]
    if health.state is OdometryState.GOOD and health.fault is not None:
        level = DiagnosticStatus.WARN
    values = [KeyValue("state", health.state.name.lower()), KeyValue("dropped", str(dropped))]
    if figures is not None:
        values += [
            KeyValue("points", str(figures.count)),
            KeyValue("share", f"{figures.share:.3f}"),
            KeyValue("residual", f"{figures.residual:.3f}"),
            KeyValue("weakest", f"{figures.weakest:.4f}"),
            KeyValue("jump", f"{figures.jump:.3f}"),
        ]
    status = DiagnosticStatus(level, f"{reporter.vehicle}: {reporter.source}", text, reporter.vehicle, values)
    return DiagnosticArray(Header(stamp=stamp), [status])
