"""Default streams: messages and rates of a disarmed PX4 v1.14.3, counted over 20 s."""

from __future__ import annotations

import math
import time
from collections import Counter

import pytest
from autopilot_fakes import FIRST_ID, FakeAutopilot
from pymavlink.dialects.v20 import common as mavlink
from test_mavlink_server import Client, World, heartbeat, local_target, named

from xtdrone_autopilot.autopilot import STEP_US
from xtdrone_autopilot.mavlink.streams.stream_schedule import GCS_RATES, ONBOARD_RATES, SILENT
from xtdrone_autopilot.mavlink.wire.codec import decoder, message_name, split
from xtdrone_autopilot.sensors import update_vibration
from xtdrone_autopilot.state import TASK_GOTO
from xtdrone_common.fleet import GCS_REMOTE_PORT

_SYSTEM = FIRST_ID + 1
_SECONDS = 20

# The autopilot's messages within 20 s, recorded from a PX4 v1.14.3 (SITL with upstream XTDrone's 50 Hz set).
GROUND_STATION = {
    "ALTITUDE": 20,
    "ATTITUDE": 1000,
    "ATTITUDE_QUATERNION": 1000,
    "ATTITUDE_TARGET": 1000,
    "BATTERY_STATUS": 10,
    "ESC_INFO": 20,
    "ESC_STATUS": 20,
    "ESTIMATOR_STATUS": 10,
    "EXTENDED_SYS_STATE": 20,
    "GLOBAL_POSITION_INT": 1000,
    "GPS_RAW_INT": 20,
    "HEARTBEAT": 20,
    "HOME_POSITION": 10,
    "LINK_NODE_STATUS": 20,
    "LOCAL_POSITION_NED": 1000,
    "OPEN_DRONE_ID_LOCATION": 20,
    "OPEN_DRONE_ID_SYSTEM": 20,
    "PING": 2,
    "POSITION_TARGET_LOCAL_NED": 1000,
    "SCALED_PRESSURE": 20,
    "SERVO_OUTPUT_RAW": 1000,
    "SYS_STATUS": 20,
    "TIME_ESTIMATE_TO_TARGET": 20,
    "UTM_GLOBAL_POSITION": 10,
    "VFR_HUD": 80,
    "VIBRATION": 2,
}
ONBOARD = {
    "ALTITUDE": 200,
    "ATTITUDE": 2000,
    "ATTITUDE_QUATERNION": 1000,
    "ATTITUDE_TARGET": 200,
    "BATTERY_STATUS": 10,
    "ESC_INFO": 200,
    "ESC_STATUS": 200,
    "ESTIMATOR_STATUS": 20,
    "EXTENDED_SYS_STATE": 100,
    "GLOBAL_POSITION_INT": 1000,
    "GPS_RAW_INT": 100,
    "HEARTBEAT": 20,
    "HIGHRES_IMU": 1000,
    "HOME_POSITION": 10,
    "LINK_NODE_STATUS": 20,
    "LOCAL_POSITION_NED": 600,
    "ODOMETRY": 600,
    "OPEN_DRONE_ID_LOCATION": 20,
    "OPEN_DRONE_ID_SYSTEM": 20,
    "PING": 20,
    "POSITION_TARGET_LOCAL_NED": 200,
    "SCALED_PRESSURE": 20,
    "SERVO_OUTPUT_RAW": 200,
    "SYSTEM_TIME": 20,
    "SYS_STATUS": 100,
    "TIMESYNC": 200,
    "TIME_ESTIMATE_TO_TARGET": 20,
    "UTM_GLOBAL_POSITION": 20,
    "VFR_HUD": 200,
    "VIBRATION": 10,
}
# Recorded too, but not streams of the autopilot: HEARTBEAT of component 190, the recording ground station's own, which
# PX4 forwards to its other link (there is no forwarding here); CURRENT_EVENT_SEQUENCE, which belongs to the events.
NO_STREAMS = {"CURRENT_EVENT_SEQUENCE"}
ONLY_WITH_A_SOURCE = {  # on by default in PX4 too, but without a source there
    "DISTANCE_SENSOR",
    "GIMBAL_DEVICE_ATTITUDE_STATUS",
    "GIMBAL_MANAGER_STATUS",
    "MOUNT_ORIENTATION",
    "OBSTACLE_DISTANCE",
    "OPTICAL_FLOW_RAD",
    "ORBIT_EXECUTION_STATUS",
    "POSITION_TARGET_GLOBAL_INT",
    "RC_CHANNELS",
}
ON_CHANGE = "GPS_GLOBAL_ORIGIN"


@pytest.fixture
def world():
    world = World()
    yield world
    world.close()


@pytest.fixture
def station(world):
    client = Client(GCS_REMOTE_PORT, world.fleet[0].gcs_local_port)
    yield client
    client.socket.close()


def frames(client):
    """Yield and clear (name, frame) of everything sent to a client."""
    for datagram in client.datagrams:
        for number, _, _, frame in split(datagram):
            yield message_name(number), frame
    client.datagrams.clear()


def latest(client):
    """Return the last message of each kind, decoded by our own codec, which includes those missing in pymavlink."""
    return {name: decoder(name)(frame) for name, frame in frames(client)}


def test_the_default_streams_have_px4s_rates(world, station, monkeypatch):
    now = time.monotonic()
    monkeypatch.setattr(
        "xtdrone_autopilot.mavlink.client_link.time.monotonic", lambda: now
    )  # heartbeats are sent by wall time too
    world.run(1.0)
    for client in (world.client, station):
        world.ask(heartbeat(6), client=client)
        client.datagrams.clear()
    counts: dict[Client, Counter[str]] = {world.client: Counter(), station: Counter()}
    for _ in range(_SECONDS):
        for client in counts:
            client.send(heartbeat(6))
        world.server.receive(1.0)
        world.run(1.0)
        station.receive()
        for client, counter in counts.items():
            counter.update(name for name, _ in frames(client))
    for client, expected in ((station, GROUND_STATION), (world.client, ONBOARD)):
        found = {name: count for name, count in counts[client].items() if name not in NO_STREAMS}
        assert found.pop(ON_CHANGE, 0) == (client is station), "once; the onboard client got it in its first second"
        assert found.keys() == expected.keys()
        for name, count in expected.items():
            assert found[name] == pytest.approx(count, rel=0.02, abs=0.5), name


def test_no_stream_is_on_by_default_that_the_recorded_px4_does_not_have():
    for rates, recorded in ((GCS_RATES, GROUND_STATION), (ONBOARD_RATES, ONBOARD)):
        assert set(rates) - set(recorded) == {ON_CHANGE, *ONLY_WITH_A_SOURCE}


def test_the_origin_is_sent_once_and_again_on_change(world):
    """As PX4 v1.14's MavlinkStreamGpsGlobalOrigin, at most once a second onboard."""

    def origins(seconds):
        world.listen(seconds, 20_000)
        return [decoder(name)(frame).altitude for name, frame in frames(world.client) if name == ON_CHANGE]

    assert origins(5.0) == [488_000]
    assert origins(12.0) == []
    world.autopilot.estimator[0]["origin"]["alt"] = 400.0
    assert origins(1.1) == [400_000]
    assert origins(5.0) == []


def test_the_seldom_messages_content(world):
    a = world.autopilot
    a.place(0, 30.0, 40.0, -20.0)
    a.estimator[0]["vibration"]["metrics"] = (1e-6, 0.02, 0.3)
    a.estimator[0]["P"][6, 6] = 0.04
    a.sensors[0]["gps_lat"], a.sensors[0]["gps_lon"], a.sensors[0]["gps_alt"] = 47.4, 8.6, 500.4
    a.sensors[0]["gps_vel"] = (0.0, -2.0, 0.5)
    a.sensors[0]["gps_eph"], a.sensors[0]["gps_epv"], a.sensors[0]["gps_speed_accuracy"] = 0.9, 1.5, 0.25
    world.commander.update()
    world.listen(10.0, 20_000)
    got = latest(world.client)
    now_us = a.time_us
    assert (got["TIMESYNC"].tc1, got["TIMESYNC"].ts1) == (0, now_us * 1000)
    vibration = got["VIBRATION"]
    assert (vibration.vibration_y, vibration.vibration_z) == pytest.approx((0.02, 0.3))
    utm = got["UTM_GLOBAL_POSITION"]
    assert utm.time - now_us == pytest.approx(1577836800000000, abs=1_000_000)
    assert (utm.alt, utm.h_acc, utm.flags, utm.flight_state) == (508_000, 200, 109, 1)
    assert utm.lat == got["GLOBAL_POSITION_INT"].lat
    odid = got["OPEN_DRONE_ID_LOCATION"]
    assert (odid.latitude, odid.altitude_geodetic, odid.direction) == (474_000_000, 500.0, 27_000)
    assert (odid.speed_horizontal, odid.speed_vertical, odid.status) == (200, -50, 2)
    assert (odid.horizontal_accuracy, odid.vertical_accuracy, odid.speed_accuracy) == (12, 5, 4)
    assert got["OPEN_DRONE_ID_SYSTEM"].operator_altitude_geo == pytest.approx(488.0)
    assert got["OPEN_DRONE_ID_SYSTEM"].timestamp == 365 * 86400 + now_us // 1_000_000
    # 10 m up to 30 m at 3 m/s, 50 m at 5 m/s, 20 m down at 1.5 m/s, 10 m at 0.7 m/s; times 1.1, plus 100 s
    assert got["TIME_ESTIMATE_TO_TARGET"].safe_return == round(1.1 * (10 / 3 + 10 + 20 / 1.5 + 10 / 0.7) + 100)
    assert got["TIME_ESTIMATE_TO_TARGET"].land == -1


def test_escs(world):
    world.hear()
    world.autopilot.control[0]["actuators"][:4] = (0.0, 0.5, 1.0, math.nan)
    world.autopilot.sensors[0]["esc_rpm"] = (1000.4, 2000.0, 3000.0, 4000.0, 9.0, 9.0, 9.0, 9.0)
    world.autopilot.sensors[0]["esc_current"][:4] = (1.0, 2.0, 3.0, 4.0)
    world.run(0.2)
    got = latest(world.client)
    status, info = got["ESC_STATUS"], got["ESC_INFO"]
    assert tuple(status.rpm) == (1000, 2000, 3000, 4000)
    assert tuple(status.current) == (1.0, 2.0, 3.0, 4.0)
    assert (info.count, info.info, tuple(info.temperature)) == (4, 15, (2000, 4000, 6000, 2000))


# SYS_STATUS of the recorded PX4: present, enabled, health; disarmed, ready, without a radio
RECORDED_SENSORS = (35684397, 35749933, 840990783)


def test_sensors_as_px4_reports_them(world):
    world.hear()
    a = world.autopilot
    a.estimator[0]["mag_good"] = a.estimator[0]["baro_good"] = 1
    world.commander.update()

    def sensors():
        m = named(world.run(0.3), "SYS_STATUS")[-1]
        names = ("present", "enabled", "health")
        return tuple(getattr(m, f"onboard_control_sensors_{name}") for name in names)

    assert sensors() == RECORDED_SENSORS
    a.sensors[0]["gps_fix"] = 0
    a.estimator[0]["mag_good"] = 0
    assert sensors()[2] == RECORDED_SENSORS[2] & ~0b100100


def test_the_pilots_input(world):
    world.hear()
    assert world.command(511, 69, 100_000)[0] == 0
    names = ("RC_CHANNELS", "MANUAL_CONTROL")
    assert not any(named(world.run(0.3), name) for name in names)
    world.commander.parameters.set("COM_RC_IN_MODE", 2)
    world.ask(mavlink.MAVLink_manual_control_message(_SYSTEM, 100, -200, 500, 300, 0))
    world.commander.update()
    sticks = named(world.run(0.1), "MANUAL_CONTROL")[-1]
    assert (sticks.x, sticks.y, sticks.z, sticks.r) == (100, -200, 500, 300)
    world.commander.parameters.set("COM_RC_IN_MODE", 0)
    for axis, channel in (("ROLL", 1), ("PITCH", 2), ("THROTTLE", 3), ("YAW", 4)):
        world.commander.parameters.set(f"RC_MAP_{axis}", channel)
    pulses = [1500, 1600, 1400, 1500, 2000, 65535, 65535, 65535]
    world.ask(mavlink.MAVLink_rc_channels_override_message(_SYSTEM, 1, *pulses))
    world.commander.update()
    radio = named(world.run(0.1), "RC_CHANNELS")[-1]
    assert (radio.chan1_raw, radio.chan2_raw, radio.chan5_raw, radio.chan6_raw) == (1500, 1600, 2000, 65535)
    assert radio.chancount == 5


def test_more_than_four_escs_need_two_messages():
    world = World()
    world.server.close()
    world.autopilot.rotors[:] = 6
    world.server = type(world.server)(world.fleet, world.autopilot, world.commanders)
    world.hear()
    world.run(0.1)
    indices = [decoder(name)(frame).index for name, frame in frames(world.client) if name == "ESC_STATUS"]
    assert indices == [0, 4]
    world.close()


def test_downward_sensors(world):
    world.hear()
    a = world.autopilot
    a.sensors[0]["range_distance"], a.sensors[0]["range_largest"], a.sensors[0]["range_quality"] = 4.2, 30.0, 80
    a.sensors[0]["flow_rate"], a.sensors[0]["flow_gyro"], a.sensors[0]["flow_quality"] = (0.5, -1.0), (0.1, 0.2), 200
    a.estimator[0]["terrain_valid"], a.estimator[0]["terrain"] = 1, 1.0
    a.sensors[0]["gps_hdop"] = 0.7
    names = ("DISTANCE_SENSOR", "OPTICAL_FLOW_RAD")
    assert not any(named(world.run(0.3), name) for name in names)
    a.estimator[0]["time_range_us"] = a.estimator[0]["time_flow_us"] = a.time_us
    got = {m.get_type(): m for m in world.run(0.3)}
    distance, flow = (got[name] for name in names)
    assert (distance.current_distance, distance.max_distance, distance.orientation) == (420, 3000, 25)
    assert distance.signal_quality == 80
    assert (flow.integrated_x, flow.integrated_y) == pytest.approx((0.01, -0.02))
    assert (flow.integrated_ygyro, flow.distance, flow.quality) == pytest.approx((0.004, 4.2, 200))
    assert got["ALTITUDE"].bottom_clearance == pytest.approx(1.0)
    assert got["ALTITUDE"].altitude_terrain == pytest.approx(487.0)
    assert got["GPS_RAW_INT"].eph == 70
    assert not any(named(world.run(0.6)[-50:], name) for name in names), "samples do not come any more"


def test_the_place_that_an_automatic_mode_flies_to(world):
    world.hear()
    assert not named(world.run(1.0), "POSITION_TARGET_GLOBAL_INT")
    world.fly_offboard()
    assert not named(world.run(1.0), "POSITION_TARGET_GLOBAL_INT")
    world.setpoint["task"] = TASK_GOTO
    world.setpoint["goal_position"] = (0.0, 0.0, -7.0)
    target = named(world.run(0.1), "POSITION_TARGET_GLOBAL_INT")[-1]
    assert (target.lat_int, target.lon_int, target.alt) == (473977420, 85455940, 495.0)
    assert target.coordinate_frame == 5
    world.hear()
    utm = named(world.run(1.0), "UTM_GLOBAL_POSITION")[-1]
    assert (utm.next_lat, utm.next_alt, utm.flags & 128, utm.flight_state) == (473977420, 495_000, 128, 3)


def test_a_link_reports_its_status(world, station):
    world.ask(local_target(system=_SYSTEM), client=station)
    world.ask(heartbeat(6), client=station)
    world.run(1.0)
    station.receive()
    first = latest(station)
    world.ask(heartbeat(6), client=station)
    world.run(1.0)
    station.receive()
    second = latest(station)["LINK_NODE_STATUS"]
    before = first["LINK_NODE_STATUS"]
    assert (before.messages_received, second.messages_received) == (2, 3)
    assert second.messages_sent - before.messages_sent == pytest.approx(370, abs=20)
    assert second.tx_rate == pytest.approx(10_000, rel=0.3)
    assert second.rx_rate == 21


def test_streams_without_a_source_may_be_requested_and_send_nothing(world):
    world.hear()
    for name in SILENT:
        number = next(n for n, cls in mavlink.mavlink_map.items() if cls.msgname == name)
        assert world.command(511, number, 100_000)[0] == 0
    assert not {m.get_type() for m in world.run(1.0)} & set(SILENT)


def test_vibration_metrics_of_alternating_samples():
    autopilot = FakeAutopilot()
    for k in range(2000):
        sign = 1.0 if k % 2 else -1.0
        autopilot.sensors[0]["gyro"] = (0.1 * sign, 0.0, 0.0)
        autopilot.sensors[0]["accel"] = (0.0, 0.3 * sign, -9.8)
        update_vibration(autopilot.estimator[0]["vibration"], autopilot.sensors[0], STEP_US * 1e-6)
    assert autopilot.estimator[0]["vibration"]["metrics"].tolist() == pytest.approx([0.0, 0.2, 0.6], rel=1e-3)
