"""Trajectories as messages."""

from __future__ import annotations

import math

import numpy as np
import rospy
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Path
from xtdrone_msgs.msg import SplineTrajectory

from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline

_LEAST_POINTS, _MOST_POINTS = 4, 10_000
_FARTHEST = 1e6  # m
_LONGEST = 3600.0  # s; checks of trajectories step through all of their time
_LATEST = 60.0  # s from now until the start, for the same reason
_SPACING = 0.1  # s between the poses of a path


class TrajectoryError(ValueError):
    """A message that is not a valid trajectory; the text names the field, its value and what is allowed."""


def spline_message(
    spline: UniformSpline, vehicle: str, number: int, radius: float, stamp: rospy.Time, frame: str
) -> SplineTrajectory:
    """Return a trajectory as a message.

    Args:
        spline: the trajectory.
        vehicle: name, as ``iris_0``.
        number: counts the vehicle's trajectories.
        radius: Radius of the vehicle, m.
        stamp: time of planning.
        frame: Frame of the points.
    """
    message = SplineTrajectory(vehicle=vehicle, id=number, interval=spline.interval, radius=radius)
    message.header.stamp, message.header.frame_id = stamp, frame
    message.start = rospy.Time.from_sec(spline.start)
    message.control_points = [Point(*point) for point in spline.points.tolist()]
    return message


def spline_of(message: SplineTrajectory, now: float) -> UniformSpline:
    """Return the trajectory of a message that is received now, s of ROS time.

    Raises:
        TrajectoryError: too few or too many points, a number that is not finite or too large, an interval or radius
            that is not positive, a trajectory that is too long, or one that begins too late.
    """
    count = len(message.control_points)
    if not _LEAST_POINTS <= count <= _MOST_POINTS:
        raise TrajectoryError(f"control_points: {count} are not allowed, {_LEAST_POINTS} to {_MOST_POINTS}")
    longest = _LONGEST / (count - 3)
    if not 0.0 < message.interval <= longest:
        raise TrajectoryError(f"interval: {message.interval:g} is not allowed, above 0 and at most {longest:g} s")
    if not 0.0 < message.radius < math.inf:
        raise TrajectoryError(f"radius: {message.radius:g} is not allowed, above 0 m and finite")
    ahead = message.start.to_sec() - now
    if ahead > _LATEST:
        raise TrajectoryError(f"start: {ahead:g} s from now is not allowed, at most {_LATEST:g} s")
    points = np.array([(point.x, point.y, point.z) for point in message.control_points])
    if not (np.abs(points) <= _FARTHEST).all():  # refuses NaN, too
        raise TrajectoryError(f"control_points: numbers beyond +-{_FARTHEST:g} m, or not finite, are not allowed")
    return UniformSpline(message.start.to_sec(), float(message.interval), points)


def path_message(spline: UniformSpline, stamp: rospy.Time, frame: str) -> Path:
    """Return the positions of a trajectory every 0.1 s, for rviz."""
    message = Path()
    message.header.stamp, message.header.frame_id = stamp, frame
    times = spline.start + np.arange(0.0, spline.duration + _SPACING, _SPACING)
    for position in spline.positions(times).tolist():
        pose = PoseStamped(header=message.header)
        pose.pose.position = Point(*position)
        pose.pose.orientation.w = 1.0
        message.poses.append(pose)
    return message
