"""Pose of a camera on a gimbal, against directions computed by hand."""

from __future__ import annotations

import math

import pytest

from xtdrone_common import frames
from xtdrone_common.cameras.camera_pose import camera_link_pose, mount_orientation, optical_pose


def turned(pose, vector):
    return frames.rotate(pose.orientation, vector)


def attitude(roll, pitch, yaw):
    return frames.quaternion_from_rpy(roll, pitch, yaw)


def test_looking_down_by_sixty_degrees_while_heading_north():
    link = camera_link_pose(
        (1.0, 2.0, 30.0), attitude(0, 0, math.pi / 2), mount_orientation(0, -math.pi / 3, 0), (0.1, 0, -0.2)
    )
    assert link.position == pytest.approx((1.0, 2.1, 29.8))
    assert turned(link, (1, 0, 0)) == pytest.approx((0, 0.5, -math.sqrt(0.75)))  # ahead: north and down
    assert turned(link, (0, 1, 0)) == pytest.approx((-1, 0, 0))  # left: west
    optical = optical_pose(link)
    assert optical.position == link.position
    assert turned(optical, (0, 0, 1)) == pytest.approx((0, 0.5, -math.sqrt(0.75)))
    assert turned(optical, (1, 0, 0)) == pytest.approx((1, 0, 0))  # right in the picture: east
    assert turned(optical, (0, 1, 0)) == pytest.approx((0, -math.sqrt(0.75), -0.5))  # down: south and down


def test_yaw_of_the_gimbal_is_to_the_right_and_tilt_of_the_vehicle_does_not_count():
    tilted = attitude(0.2, -0.1, 0.3)
    link = camera_link_pose((0, 0, 0), tilted, mount_orientation(0, -0.4, 0.5), (0, 0, 0))
    yaw = 0.3 - 0.5
    along = math.cos(0.4)
    assert turned(link, (1, 0, 0)) == pytest.approx((along * math.cos(yaw), along * math.sin(yaw), -math.sin(0.4)))
    assert turned(link, (0, 1, 0))[2] == pytest.approx(0.0)
    # A roll of the gimbal to the right lowers the picture's right side.
    rolled = camera_link_pose((0, 0, 0), tilted, mount_orientation(0.3, 0, 0), (0, 0, 0))
    assert turned(rolled, (0, -1, 0))[2] == pytest.approx(-math.sin(0.3))


def test_the_offset_turns_with_the_vehicle():
    link = camera_link_pose((0, 0, 10), attitude(0, math.pi / 2, 0), mount_orientation(0, 0, 0), (0, 0, -0.3))
    assert link.position == pytest.approx((-0.3, 0, 10))
