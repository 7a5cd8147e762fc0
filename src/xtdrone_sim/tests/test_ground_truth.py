"""The time-stamped twist of a ground truth is in the axes of the body."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("rospy")

from geometry_msgs.msg import Pose, Quaternion, Twist, Vector3

from xtdrone_sim.sensors.ground_truth import in_body


def test_a_body_that_looks_north_flies_north_ahead() -> None:
    half = math.sqrt(0.5)
    pose = Pose(orientation=Quaternion(0.0, 0.0, half, half))
    found = in_body(pose, Twist(Vector3(0.5, 2.0, 1.0), Vector3(0.0, 0.1, 0.3)))
    assert (found.linear.x, found.linear.y, found.linear.z) == pytest.approx((2.0, -0.5, 1.0))
    assert (found.angular.x, found.angular.y, found.angular.z) == pytest.approx((0.1, 0.0, 0.3))
