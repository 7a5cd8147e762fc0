"""External measurements over MAVLink, up to the sensor record."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from autopilot_fakes import FIRST_ID, FakeAutopilot
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.mavlink.commands.external_sensors_service import VisionService
from xtdrone_autopilot.mavlink.service_base import Vehicle
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_autopilot.state import VISION_BODY, VISION_FRD, VISION_NED
from xtdrone_common import frames
from xtdrone_common.fleet import Vehicle as FleetVehicle

NAN = math.nan
UNKNOWN = [NAN] + [0.0] * 20
LINK = SimpleNamespace()


class World:
    """A vision service and the record that it writes."""

    def __init__(self) -> None:
        self.autopilot = FakeAutopilot()
        commander = Commander(FleetVehicle("iris", 0, FIRST_ID), self.autopilot, Parameters({"MAV_SYS_ID": 1}), 0)
        self.vehicle = Vehicle(commander, self.autopilot, 0)
        self.service = VisionService(self.vehicle)
        self.sensors = self.autopilot.sensors[0]

    def take(self, message) -> None:
        self.service.handlers[message.get_type()](LINK, message)

    def odometry(self, frame: int, child: int, **fields) -> None:
        values = {
            "position": (1.0, 2.0, 3.0), "q": (1.0, 0.0, 0.0, 0.0), "velocity": (4.0, 5.0, 6.0), "pose": UNKNOWN,
            "twist": UNKNOWN, "resets": 0, "kind": 2, "quality": 0, **fields,
        }  # fmt: skip
        self.take(
            mavlink.MAVLink_odometry_message(
                0, frame, child, *values["position"], values["q"], *values["velocity"], 0.0, 0.0, 0.0,
                values["pose"], values["twist"], values["resets"], values["kind"], values["quality"],
            )
        )  # fmt: skip


@pytest.fixture
def world():
    return World()


def triangle(**places):
    names = {"x": 0, "y": 6, "z": 11, "yaw": 20}
    values = [0.0] * 21
    for name, value in places.items():
        values[names[name]] = value
    return values


def test_vision_position_estimate(world):
    covariance = triangle(x=0.1, y=0.2, z=0.3, yaw=0.4)
    world.take(mavlink.MAVLink_vision_position_estimate_message(0, 1.0, 2.0, -3.0, 0.1, -0.2, 0.7, covariance, 5))
    s = world.sensors
    assert (s["vision_fresh"], s["vision_frame"], s["vision_reset_counter"]) == (1, VISION_NED, 5)
    assert s["vision_position"].tolist() == [1.0, 2.0, -3.0]
    assert s["vision_position_variance"] == pytest.approx((0.1, 0.2, 0.3))
    assert s["vision_yaw_variance"] == pytest.approx(0.4)
    assert frames.rpy_from_quaternion(tuple(s["vision_q"])) == pytest.approx((0.1, -0.2, 0.7))
    assert np.isnan(s["vision_velocity"]).all()


def test_unknown_covariance_and_nan(world):
    world.take(mavlink.MAVLink_vision_position_estimate_message(0, NAN, math.inf, 1e9, NAN, 0.0, 0.0, UNKNOWN, 0))
    s = world.sensors
    assert np.isnan(s["vision_position"]).all()
    assert np.isnan(s["vision_q"]).all()
    assert np.isnan(s["vision_position_variance"]).all()


def test_motion_capture(world):
    world.take(mavlink.MAVLink_att_pos_mocap_message(0, [0.0, 0.0, 0.0, 2.0], 1.0, 2.0, -3.0, triangle(x=0.5)))
    assert world.sensors["vision_q"].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert world.sensors["vision_position_variance"][0] == 0.5
    world.take(mavlink.MAVLink_att_pos_mocap_message(0, [0.0, 0.0, 0.0, 0.0], 1.0, 2.0, -3.0, UNKNOWN))
    assert np.isnan(world.sensors["vision_q"]).all()


@pytest.mark.parametrize(
    ("frame", "kind", "position"),
    [
        (1, VISION_NED, (1, 2, 3)),
        (4, VISION_NED, (2, 1, -3)),
        (20, VISION_FRD, (1, 2, 3)),
        (21, VISION_FRD, (1, -2, -3)),
    ],
)
def test_odometry_poses(world, frame, kind, position):
    world.odometry(frame, 12, pose=triangle(x=0.1, y=0.2, z=0.3), resets=3, quality=80)
    s = world.sensors
    assert (s["vision_frame"], s["vision_quality"], s["vision_reset_counter"]) == (kind, 80, 3)
    assert s["vision_position"].tolist() == list(position)
    expected = (0.2, 0.1, 0.3) if frame == 4 else (0.1, 0.2, 0.3)
    assert s["vision_position_variance"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("child", "kind", "velocity"),
    [
        (12, VISION_BODY, (4, 5, 6)),
        (1, VISION_NED, (4, 5, 6)),
        (4, VISION_NED, (5, 4, -6)),
        (21, VISION_FRD, (4, -5, -6)),
    ],
)
def test_odometry_velocities(world, child, kind, velocity):
    world.odometry(20, child, twist=triangle(x=0.1, y=0.1, z=0.1))
    assert world.sensors["vision_velocity_frame"] == kind
    assert world.sensors["vision_velocity"].tolist() == list(velocity)


def test_odometry_without_a_usable_frame_or_of_the_autopilot_itself_is_left(world):
    world.odometry(99, 99)
    assert not world.sensors["vision_fresh"]
    world.odometry(1, 12, kind=8)
    assert not world.sensors["vision_fresh"]
    assert world.vehicle.commander.texts[-1][1] == "ODOMETRY: estimator_type 8 unsupported"


def test_optical_flow(world):
    world.take(mavlink.MAVLink_optical_flow_rad_message(0, 0, 40_000, 0.02, -0.04, 0.004, NAN, 0.0, 0, 200, 0, 1.5))
    s = world.sensors
    assert s["flow_rate"] == pytest.approx((0.5, -1.0))
    assert s["flow_gyro"][0] == pytest.approx(0.1)
    assert math.isnan(s["flow_gyro"][1])
    assert (s["flow_quality"], s["range_fresh"], s["range_distance"]) == (200, 1, 1.5)
    s["flow_fresh"] = 0
    world.take(mavlink.MAVLink_optical_flow_rad_message(0, 0, 0, 0.02, -0.04, 0.0, 0.0, 0.0, 0, 200, 0, -1.0))
    assert not s["flow_fresh"], "no integration time"


@pytest.mark.parametrize(("orientation", "signal", "quality"), [(25, 0, -1), (25, 1, 0), (25, 100, 100), (0, 0, None)])
def test_range_finder(world, orientation, signal, quality):
    message = mavlink.MAVLink_distance_sensor_message(0, 10, 3000, 250, 0, 1, orientation, 255, signal_quality=signal)
    world.take(message)
    s = world.sensors
    if quality is None:
        assert not s["range_fresh"]
        return
    assert (s["range_distance"], s["range_least"], s["range_largest"]) == pytest.approx((2.5, 0.1, 30.0))
    assert s["range_quality"] == quality


def test_samples_wait_for_their_turn(world):
    """Messages from topics take effect after the commands of the same tick."""
    world.vehicle.participant = True
    world.vehicle.hold_setpoints()
    world.odometry(1, 12)
    assert not world.sensors["vision_fresh"]
    world.vehicle.release_setpoints()
    assert world.sensors["vision_fresh"]
