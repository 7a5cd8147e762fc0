"""The gimbal's setpoint, its control authority, its MAVLink, and MAVROS's mount_control."""

from __future__ import annotations

import math
import threading

import pytest
from autopilot_fakes import ORIGIN, Flight
from geometry_msgs.msg import Quaternion
from mavros_fakes import Bench
from mavros_msgs.msg import MountControl
from mavros_msgs.srv import MountConfigureRequest
from pymavlink.dialects.v20 import common as mavlink
from service_fakes import SYSTEM, Served

from xtdrone_autopilot.navigator.gimbal_manager import NEUTRAL, YAW_LOCK, GimbalManager
from xtdrone_common import frames
from xtdrone_mavros.plugins import PLUGINS

NAN = math.nan
DOWN = math.radians(-60.0)
GCS = (255, 190)


@pytest.fixture
def flight():
    return Flight()


@pytest.fixture
def gimbal(flight):
    return flight.commander.navigator.payload.gimbal_manager


@pytest.fixture
def served():
    """A vehicle with a gimbal."""
    served = Served()
    served.commander.navigator.payload.gimbal_attitude = (0.0, 0.0, 0.0)
    return served


def approx(*values):
    return pytest.approx(values, abs=1e-6)


# the setpoint


def test_yaw_follows_the_vehicle_unless_it_is_locked(flight, gimbal):
    assert all(map(math.isnan, gimbal.angles))
    gimbal.look((0.1, DOWN, 0.5))
    flight.place(0.0, 0.0, -10.0, yaw=1.0)
    assert gimbal.angles == approx(0.1, DOWN, 0.5)
    gimbal.look((0.0, DOWN, 0.5), YAW_LOCK)
    assert gimbal.angles == approx(0.0, DOWN, -0.5)
    flight.place(0.0, 0.0, -10.0, yaw=-2.0)
    assert gimbal.angles == approx(0.0, DOWN, 2.5)
    gimbal.look((NAN, NAN, NAN))  # from now on it turns with the vehicle
    flight.place(0.0, 0.0, -10.0, yaw=0.0)
    assert gimbal.angles == approx(0.0, DOWN, 2.5)
    gimbal.look((1.0, 1.0, 1.0), NEUTRAL)
    assert gimbal.angles == (0.0, 0.0, 0.0)


def test_rates_turn_it_until_it_looks_straight_down(flight, gimbal):
    gimbal.look((0.0, -0.5, 0.0), rates=(-0.25, 0.5))
    flight.autopilot.time_us += 2_000_000
    assert gimbal.angles == approx(0.0, -1.0, 1.0)
    flight.autopilot.time_us += 10_000_000
    assert gimbal.angles == approx(0.0, -math.pi / 2, math.remainder(6.0, 2.0 * math.pi))


def test_a_place_is_looked_at_wherever_the_vehicle_is(flight, gimbal):
    flight.place(0.0, 0.0, -10.0)
    gimbal.look_at((0.0, 10.0, 0.0))
    assert gimbal.angles == approx(0.0, -math.pi / 4, math.pi / 2)
    flight.place(0.0, 20.0, -10.0, yaw=1.0)
    behind = -math.pi / 2 - 1.0
    assert gimbal.angles == approx(0.0, -math.pi / 4, behind)
    gimbal.look_at(None)
    flight.place(0.0, 0.0, -10.0)
    assert gimbal.angles == approx(0.0, -math.pi / 4, behind)


def test_non_finite_commands_do_not_move_it(gimbal):
    gimbal.look((0.0, DOWN, 0.0))
    gimbal.look((math.inf, -math.inf, NAN), rates=(math.inf, NAN))
    gimbal.look_at((0.0, NAN, 0.0))
    gimbal.pitch_yaw((NAN, NAN, NAN, NAN, NAN))
    assert gimbal.angles == approx(0.0, DOWN, 0.0)


# MAVLink


def test_without_a_gimbal_commands_and_telemetry_are_absent():
    served = Served()
    for command in (204, 205, 1000, 1001):
        assert served.command(command) == (None, [])
    for message in (265, 280, 281, 283, 285):
        assert served.command(512, message)[0] == 2
    assert served.ask(set_pitch_yaw(0.1)) == []


def test_mount_control_of_the_first_version(served):
    payload = served.commander.navigator.payload
    assert served.command(204, 2)[0] == 0
    assert served.command(205, -60.0, 5.0, 10.0, 0.0, 0.0, 0.0, 2.0)[0] == 0
    assert payload.gimbal == approx(math.radians(5.0), DOWN, math.radians(10.0))
    assert served.command(205, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0)[0] == 0
    assert payload.gimbal == (0.0, 0.0, 0.0)
    assert served.command(205, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 3.0)[0] == 3  # from the radio control
    north = served.commander.view.to_global((100.0, 0.0, 100.0))
    assert served.command(205, 0.0, 0.0, 0.0, north[2], north[0], north[1], 4.0)[0] == 0
    assert payload.gimbal[1] == pytest.approx(-math.pi / 4, abs=1e-3)  # a float resolves a position to a metre


def set_pitch_yaw(pitch, flags=0):
    return mavlink.MAVLink_gimbal_manager_set_pitchyaw_message(SYSTEM, 1, flags, 0, pitch, 0.2, NAN, NAN)


def test_only_the_client_in_control_steers(served):
    payload = served.commander.navigator.payload
    assert served.command(1000, -30.0, 10.0, NAN, NAN)[0] == 2
    served.ask(set_pitch_yaw(-0.3))
    assert math.isnan(payload.gimbal[1])
    assert served.command(1001, -2, -2, -1, -1)[0] == 0  # the sender takes control
    assert payload.gimbal_manager.primary == GCS
    assert served.command(1000, -30.0, 10.0, NAN, NAN)[0] == 0
    assert payload.gimbal == approx(0.0, math.radians(-30.0), math.radians(10.0))
    served.ask(set_pitch_yaw(-0.3))
    assert payload.gimbal == approx(0.0, -0.3, 0.2)
    q = frames.quaternion_from_rpy(0.1, -0.4, 0.3)
    served.ask(mavlink.MAVLink_gimbal_manager_set_attitude_message(SYSTEM, 1, 0, 1, q, NAN, NAN, NAN))
    assert payload.gimbal == approx(0.1, -0.4, 0.3)
    other = mavlink.MAVLink(None, srcSystem=9, srcComponent=1)
    served.other.client = other
    assert served.command(1001, -3, -3, -1, -1, link=served.other)[0] == 0  # it has no control to release
    assert served.command(1000, 0.0, 0.0, link=served.other)[0] == 2
    assert served.command(1001, -3, -3, -1, -1)[0] == 0
    assert served.command(1001, 9, 1, 255, 190)[0] == 0
    assert served.command(1000, 0.0, 0.0, link=served.other)[0] == 0
    assert payload.gimbal_manager.secondary == GCS


@pytest.mark.parametrize("wrong", [(300.0, 1.0), (NAN, 1.0), (0.0, 0.0), (1.0, -5.0), (1e30, 1e30)])
def test_an_invalid_request_does_not_change_control(wrong):
    gimbal = GimbalManager(Flight().commander.view)
    gimbal.configure(GCS, (-2.0, 0.0, *wrong))
    assert (gimbal.primary, gimbal.secondary) == (GCS, (0, 0))


def test_the_gimbals_telemetry(served):
    served.autopilot.place(0, 0.0, 0.0, -10.0, yaw=1.0)
    payload = served.commander.navigator.payload
    payload.gimbal_attitude = (0.0, DOWN, 0.5)
    assert served.command(512, 265)[0] == 0
    mount = dict(served.link.sent)["MOUNT_ORIENTATION"]
    assert (mount.roll, mount.pitch, mount.yaw) == approx(0.0, -60.0, math.degrees(0.5))
    assert mount.yaw_absolute == pytest.approx(math.degrees(1.5))
    served.command(512, 285)
    status = dict(served.link.sent)["GIMBAL_DEVICE_ATTITUDE_STATUS"]
    assert tuple(status.q) == approx(*frames.quaternion_from_rpy(0.0, DOWN, 0.5))
    assert status.flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
    payload.gimbal_manager.look((0.0, DOWN, 1.5), YAW_LOCK)
    served.command(512, 285)
    status = dict(served.link.sent)["GIMBAL_DEVICE_ATTITUDE_STATUS"]
    assert tuple(status.q) == approx(*frames.quaternion_from_rpy(0.0, DOWN, 1.5))
    assert status.flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
    served.command(1001, -2, -2, -1, -1)
    served.command(512, 281)
    manager = dict(served.link.sent)["GIMBAL_MANAGER_STATUS"]
    assert (manager.primary_control_sysid, manager.primary_control_compid) == GCS
    served.command(512, 280)
    assert dict(served.link.sent)["GIMBAL_MANAGER_INFORMATION"].gimbal_device_id == 1
    served.command(512, 283)
    assert dict(served.link.sent)["GIMBAL_DEVICE_INFORMATION"].vendor_name == "XTDrone"


def test_a_region_of_interest_is_looked_at_by_the_gimbal_too(served):
    latitude, longitude, _ = served.commander.view.to_global((100.0, 0.0, 0.0))
    served.autopilot.place(0, 0.0, 0.0, -100.0)
    message = mavlink.MAVLink_command_int_message(
        SYSTEM, 1, 6, 195, 0, 0, 0.0, 0.0, 0.0, 0.0, round(latitude * 1e7), round(longitude * 1e7), ORIGIN[2]
    )
    assert served.ask(message)[0].result == 0
    payload = served.commander.navigator.payload
    assert payload.gimbal == pytest.approx((0.0, -math.pi / 4, 0.0), abs=1e-3)
    assert served.command(197)[0] == 0
    served.autopilot.place(0, 0.0, 50.0, -10.0)
    assert payload.gimbal == pytest.approx((0.0, -math.pi / 4, 0.0), abs=1e-3)


# MAVROS


@pytest.fixture
def bench():
    made = Bench(PLUGINS)
    yield made
    made.close()


def test_mavros_sends_the_command(bench):
    bench.call("mount_control/command", MountControl(mode=2, pitch=-60.0, roll=1.0, yaw=5.0, altitude=10.0))
    [sent] = bench.received()
    assert (sent.command, sent.target_system) == (205, 1)
    assert (sent.param1, sent.param2, sent.param3, sent.param4, sent.param7) == (-60.0, 1.0, 5.0, 10.0, 2.0)
    bench.call("mount_control/command", MountControl(mode=2, pitch=NAN))
    assert bench.received() == []


def test_mavros_publishes_the_orientation(bench):
    bench.uas.set_connected(True)
    bench.received()
    bench.take("mount_control/orientation")
    asked = [(m.param1, m.param2) for m in bench.received() if m.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL]
    assert (mavlink.MAVLINK_MSG_ID_MOUNT_ORIENTATION, 20_000.0) in asked  # needed to project pictures onto the ground
    bench.send(mavlink.MAVLink_mount_orientation_message(1000, 10.0, -60.0, 30.0, 90.0))
    [found] = bench.published("mount_control/orientation")
    assert type(found) is Quaternion
    wanted = frames.quaternion_from_rpy(*map(math.radians, (10.0, -60.0, 30.0)))
    assert (found.w, found.x, found.y, found.z) == approx(*wanted)


@pytest.mark.parametrize(("result", "success"), [(0, True), (3, False)])
def test_mavros_configures_the_mount(bench, result, success):
    answers = []
    service = bench.ros.services["/iris_0/mavros/mount_control/configure"]
    request = MountConfigureRequest(mode=2, stabilize_pitch=True, yaw_input=1)
    thread = threading.Thread(target=lambda: answers.append(service(request)))
    thread.start()
    bench.fcu.setblocking(True)
    (sent,) = bench._parser.parse_buffer(bench.fcu.recv(65535))
    assert (sent.command, sent.param1, sent.param3, sent.param7) == (204, 2.0, 1.0, 1.0)
    bench.send(mavlink.MAVLink_command_ack_message(204, result))
    thread.join()
    assert (answers[0].success, answers[0].result) == (success, result)
