"""The shared origin of PX4s' local frames, against an autopilot that replies as PX4 v1.14 does."""

from __future__ import annotations

import logging

import pytest
from mavros_fakes import Bench
from mavros_msgs.srv import CommandBoolRequest
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.plugins.command import CommandPlugin
from xtdrone_mavros.plugins.shared_origin import MOST_TRIES, PARAMETER, PERIOD, SharedOriginPlugin, parse_origin
from xtdrone_mavros.plugins.sys_status import SysStatusPlugin

HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 0x91, 6 << 16, 4, 3)
WORLD = {"latitude": 47.397742, "longitude": 8.545594, "altitude": 488.0}
SHARED = (473977420, 85455940, 488000)
SPAWN = (473977420, 85456338, 488120)  # 3 m east of it


class Px4:
    """A fake PX4 whose estimator moves the origin after the reply.

    Attributes:
        bench: the MAVROS layer.
        origin: 1e-7 deg, 1e-7 deg, mm AMSL; None while there is no position.
        set: how often SET_GPS_GLOBAL_ORIGIN came.
        in_air: the estimator ignores a new origin.
    """

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.origin: tuple[int, int, int] | None = None
        self.set = 0
        self.in_air = False

    def pass_time(self) -> None:
        """Run a turn of the MAVROS layer, and send the autopilot's replies."""
        self.bench.ros.time_ns += round(PERIOD * 1e9)
        self.bench.uas.step(self.bench.ros.time_ns)
        for message in self.bench.received():
            self._take(message)

    def _take(self, message) -> None:
        kind = message.get_type()
        asks = kind == "COMMAND_LONG" and (message.command, message.param1) == (mavlink.MAV_CMD_REQUEST_MESSAGE, 49.0)
        if asks or kind == "SET_GPS_GLOBAL_ORIGIN":
            self._tell()
        if kind == "SET_GPS_GLOBAL_ORIGIN":
            assert (message.target_system, message.latitude, message.longitude, message.altitude) == (1, *SHARED)
            self.set += 1
            self.origin = self.origin if self.in_air else SHARED

    def _tell(self) -> None:
        if self.origin is not None:
            self.bench.send(mavlink.MAVLink_gps_global_origin_message(*self.origin, 0))


@pytest.fixture
def px4():
    bench = Bench((SysStatusPlugin, CommandPlugin, SharedOriginPlugin))
    bench.ros.params[PARAMETER] = WORLD
    bench.send(HEARTBEAT)
    yield Px4(bench)
    bench.close()


def arm(px4):
    """Request arming. The test's autopilot sends no ack, so only a withheld request is answered at once."""
    return px4.bench.ros.services["/iris_0/mavros/cmd/arming"](CommandBoolRequest(value=True))


def test_the_origin_is_set_once_there_is_a_position(px4, caplog):
    caplog.set_level(logging.INFO, "rosout.mavros")
    for _ in range(5):
        px4.pass_time()
    assert px4.set == 0
    px4.origin = SPAWN
    px4.pass_time()
    assert arm(px4).result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert "47.3977420 deg, 8.5456338 deg, 488.120 m AMSL, and has to be 47.3977420 deg, 8.5455940" in caplog.text
    for _ in range(5):
        px4.pass_time()
    assert (px4.origin, px4.set) == (SHARED, 2)  # the reply to the first has the old origin
    assert px4.bench.uas.arming_held == ""
    assert "iris_0: the local frame begins at the shared origin" in caplog.text
    px4.origin = (SHARED[0] + 1, SHARED[1] - 1, SHARED[2] + 10)  # rounded
    px4.bench.send(mavlink.MAVLink_gps_global_origin_message(*px4.origin, 0))
    px4.pass_time()
    assert px4.set == 2


def test_an_origin_that_another_px4_begins_with_is_moved_too(px4):
    px4.origin = SPAWN
    for _ in range(4):
        px4.pass_time()
    px4.origin = SPAWN  # restarted before the connection times out
    px4.bench.send(mavlink.MAVLink_gps_global_origin_message(*SPAWN, 0))
    px4.pass_time()
    assert px4.origin == SHARED


def test_a_vehicle_that_rejects_the_origin_is_reported_and_skipped(px4, caplog):
    px4.origin, px4.in_air = SPAWN, True
    for _ in range(MOST_TRIES + 10):
        px4.pass_time()
    assert px4.set == MOST_TRIES
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warnings) == 1
    assert warnings[0].startswith(
        "iris_0: the local frame begins at 47.3977420 deg, 8.5456338 deg, 488.120 m AMSL, not"
    )
    assert px4.bench.uas.arming_held == ""
    px4.in_air = False
    px4.bench.uas.set_connected(False)
    px4.bench.send(HEARTBEAT)
    for _ in range(4):
        px4.pass_time()
    assert px4.origin == SHARED


@pytest.mark.parametrize("value", [{}, None])
def test_nothing_is_sent_without_the_parameter(px4, value):
    px4.bench.ros.params[PARAMETER] = value
    px4.bench.uas.set_connected(False)
    px4.bench.received()
    px4.origin = SPAWN
    px4.bench.send(HEARTBEAT, mavlink.MAVLink_gps_global_origin_message(*SPAWN, 0))
    px4.bench.ros.time_ns += round(PERIOD * 1e9)
    px4.bench.uas.step(px4.bench.ros.time_ns)
    assert {message.get_type() for message in px4.bench.received()} <= {"HEARTBEAT"}
    assert px4.bench.uas.arming_held == ""


def test_a_parameter_that_is_not_a_position_is_rejected():
    assert parse_origin(WORLD) == SHARED
    for bad in ({"latitude": 47.0}, {**WORLD, "latitude": 91.0}, {**WORLD, "altitude": "high"}, "47, 8, 488", [1, 2]):
        with pytest.raises(ValueError, match=r"/xtdrone/shared_origin: .* is not allowed"):
            parse_origin(bad)
