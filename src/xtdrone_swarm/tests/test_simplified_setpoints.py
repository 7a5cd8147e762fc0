"""MAVROS's setpoints for simplified vehicles."""

from __future__ import annotations

import math

import pytest

from xtdrone_control.communication.setpoint import Setpoint, acceleration_setpoint, pose_setpoint, velocity_setpoint
from xtdrone_swarm.simplified.setpoints import FORCE, SetpointError, Start, wanted
from xtdrone_swarm.swarm_vehicles import ACCELERATION, POSITION, VELOCITY

NORTH = math.pi / 2
HERE = Start((10.0, 20.0, 5.0), NORTH)
VECTOR = (1.0, 2.0, 3.0)
ZERO = (0.0, 0.0, 0.0)


def test_the_local_frame_is_enu() -> None:
    assert wanted(pose_setpoint(VECTOR, 0.5, body=False), HERE, NORTH) == (POSITION, VECTOR, 0.0, 0.5)
    kind, vector, rate, yaw = wanted(velocity_setpoint(VECTOR, 0.3, body=False), HERE, NORTH)
    assert (kind, vector, rate) == (VELOCITY, VECTOR, 0.3)
    assert math.isnan(yaw)
    assert wanted(acceleration_setpoint(VECTOR, 0.0, body=False), HERE, NORTH)[:2] == (ACCELERATION, VECTOR)


def test_body_frames_are_turned_by_the_heading() -> None:
    """Forward is north, left is west."""
    assert wanted(velocity_setpoint(VECTOR, 0.0, body=True), HERE, NORTH).vector == pytest.approx((-2.0, 1.0, 3.0))
    assert wanted(acceleration_setpoint(VECTOR, 0.0, body=True), HERE, NORTH).vector == pytest.approx((-2.0, 1.0, 3.0))
    target = wanted(pose_setpoint(VECTOR, 2.0, body=True), HERE, NORTH)
    assert target.vector == pytest.approx((8.0, 21.0, 8.0))
    assert target.yaw == pytest.approx(NORTH + 2.0 - math.tau)


def test_without_yaw_and_yaw_rate_the_heading_is_kept() -> None:
    target = wanted(Setpoint(1, 0b110111000111, velocity=VECTOR, yaw=1.0, yaw_rate=1.0), HERE, NORTH)
    assert target.yaw_rate == 0.0
    assert math.isnan(target.yaw)


@pytest.mark.parametrize(
    ("setpoint", "word"),
    [
        (Setpoint(7, 0b110111111000, position=VECTOR), "coordinate_frame 7"),
        (Setpoint(8, 0b110111111000, position=VECTOR), "BODY_NED"),
        (Setpoint(1, 0b110111000000, position=VECTOR), "position and velocity"),
        (Setpoint(1, 0b110111111111), "nothing"),
        (Setpoint(1, 0b110111011111, velocity=VECTOR), "a part of velocity"),
        (Setpoint(1, FORCE | 0b110000111111, acceleration=VECTOR), "force"),
        (Setpoint(1, 0b110111000111, velocity=(0.0, math.nan, 0.0)), "velocity.y is nan"),
        (Setpoint(1, 0b100111111000, position=ZERO, yaw=math.inf), "yaw is inf"),
        (Setpoint(1, 0b010111000111, velocity=ZERO, yaw_rate=math.nan), "yaw_rate is nan"),
    ],
)
def test_unsupported_setpoints_are_reported(setpoint: Setpoint, word: str) -> None:
    with pytest.raises(SetpointError, match=word):
        wanted(setpoint, HERE, NORTH)


def test_masked_fields_may_have_any_value() -> None:
    mixed = Setpoint(1, 0b110111000111, position=(math.nan, 0.0, 0.0), velocity=VECTOR, yaw=math.nan)
    assert wanted(mixed, HERE, NORTH).vector == VECTOR
