"""The autopilot's MAVLink over real UDP sockets, with pymavlink at the other end."""

from __future__ import annotations

import math
import random
import socket
import struct
import weakref

import numpy as np
import pytest
from autopilot_fakes import FIRST_ID, ORIGIN, FakeAutopilot
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_autopilot.mavlink.udp_port_and_clients import LinkError
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGES
from xtdrone_autopilot.parameters.parameters import NAMES, Parameters
from xtdrone_autopilot.state import TASK_ATTITUDE, TASK_RATES, TASK_TRAJECTORY
from xtdrone_common import modes
from xtdrone_common.fleet import GCS_REMOTE_PORT, Vehicle

_SYSTEM = FIRST_ID + 1
MAVROS_READS = 296  # bytes of a datagram; MAVROS loses the rest
_ALL_BUT_POSITION = 0b110111111000
_ALL_BUT_VELOCITY = 0b110111000111
_ALL_BUT_YAW = 0b101111111111


class Client:
    """A ground station or MAVROS: a socket and pymavlink."""

    def __init__(self, local_port: int, remote_port: int, system: int = 255) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", local_port))
        self.socket.setblocking(False)
        self.remote = ("127.0.0.1", remote_port)
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=190)
        self.datagrams: list[bytes] = []
        self._parsed = 0
        _clients.add(self)

    def send(self, message):
        self.socket.sendto(message.pack(self.mav), self.remote)

    def take_in(self):
        """Empty the socket, which holds less than a second of telemetry; read no more of a datagram than MAVROS."""
        while self.socket.fileno() != -1:
            try:
                self.datagrams.append(self.socket.recv(MAVROS_READS))
            except BlockingIOError:
                return

    def receive(self):
        """Return the messages that have arrived; every frame must parse."""
        self.take_in()
        new, self._parsed = self.datagrams[self._parsed :], len(self.datagrams)
        return [message for datagram in new for message in self.mav.parse_buffer(datagram) or []]


_clients: weakref.WeakSet[Client] = weakref.WeakSet()


class World:
    """A server over a fake autopilot, and a client on the first vehicle's offboard link."""

    def __init__(self, count: int = 1) -> None:
        self.autopilot = FakeAutopilot(count)
        self.fleet = [Vehicle("iris", i, FIRST_ID + i) for i in range(count)]
        self.commanders = [
            Commander(v, self.autopilot, Parameters({"MAV_SYS_ID": v.system_id, "BAT1_N_CELLS": 3}), i)
            for i, v in enumerate(self.fleet)
        ]
        self.server = MavlinkServer(self.fleet, self.autopilot, self.commanders)
        self.commander = self.commanders[0]
        self.setpoint = self.autopilot.setpoint[0]
        vehicle = self.fleet[0]
        self.client = Client(vehicle.offboard_remote_port, vehicle.offboard_local_port)
        self.commander.update()

    def ask(self, *messages, client=None):
        """Send messages, run the server, and return its replies."""
        client = client or self.client
        for message in messages:
            client.send(message)
        self.server.receive(1.0)
        return client.receive()

    def command(self, number, *params, client=None):
        """Send a COMMAND_LONG; return its result and the other replies."""
        values = [*params, *[0.0] * (7 - len(params))]
        message = mavlink.MAVLink_command_long_message(_SYSTEM, 1, number, 0, *values)
        answers = self.ask(message, client=client)
        acks = [m for m in answers if m.get_type() == "COMMAND_ACK"]
        assert [m.command for m in acks] == [number]
        assert (acks[0].target_system, acks[0].target_component) == (255, 190)
        return acks[0].result, [m for m in answers if m.get_type() != "COMMAND_ACK"]

    def take_part(self):
        """Make the client a participant of the lockstep."""
        self.server.reserve({self.fleet[0].offboard_remote_port: ["127.0.0.1"]})

    def run(self, seconds, step_us=4000):
        """Advance time and return the messages to the client."""
        end = self.autopilot.time_us + round(seconds * 1e6)
        found = []
        while self.autopilot.time_us < end:
            self.autopilot.time_us += step_us
            self.server.send_streams(self.autopilot.time_us)
            for client in _clients:
                client.take_in()
            found += self.client.receive()
        return found

    def listen(self, seconds, step_us=4000):
        """Advance time like ``run``, with heartbeats that keep the streams alive."""
        found = []
        while seconds > 0.0:
            self.hear()
            found += self.run(min(seconds, 4.0), step_us)
            seconds -= 4.0
        return found

    def hear(self):
        """Register the client by a message, so that telemetry flows."""
        self.ask(heartbeat())

    def fly_offboard(self, x=1.0, y=2.0, z=-5.0, yaw=0.0):
        self.ask(local_target(x=x, y=y, z=z, mask=_ALL_BUT_POSITION))
        assert self.command(176, 1, 6)[0] == 0
        assert self.command(400, 1)[0] == 0
        self.autopilot.control[0]["landing"]["landed"] = 0
        self.commander.update()  # where it stood is home
        self.autopilot.place(0, x, y, z, yaw)
        self.commander.update()

    def texts(self):
        return [m.text for m in self.run(0.004) if m.get_type() == "STATUSTEXT"]

    def close(self):
        self.server.close()
        self.client.socket.close()


@pytest.fixture
def world():
    world = World()
    yield world
    world.close()


def heartbeat(kind=18):
    return mavlink.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3)


def local_target(
    x=0.0,
    y=0.0,
    z=0.0,
    vx=0.0,
    vy=0.0,
    vz=0.0,
    ax=0.0,
    ay=0.0,
    az=0.0,
    yaw=0.0,
    yaw_rate=0.0,
    mask=0,
    frame=1,
    system=_SYSTEM,
):
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, system, 1, frame, mask, x, y, z, vx, vy, vz, ax, ay, az, yaw, yaw_rate
    )


def named(messages, name):
    return [m for m in messages if m.get_type() == name]


# streams


def test_a_first_client_gets_the_streams_without_a_request_and_without_timeout(world):
    messages = world.run(20.0, 20_000)
    kinds = {m.get_type() for m in messages}
    assert len(kinds) >= 27
    assert abs(len(named(messages, "ATTITUDE")) - 1000) <= 60  # from the first heartbeat, at 50 ticks a second
    assert not [port.remote_port for port in world.server.ports[1:3] if port.default.streams.active]  # no socket there
    beat = named(messages, "HEARTBEAT")[0]
    assert (beat.type, beat.autopilot, beat.base_mode, beat.custom_mode, beat.system_status) == (2, 12, 29, 50593792, 3)
    assert beat.get_srcSystem() == _SYSTEM
    assert beat.get_srcComponent() == 1


def test_a_first_client_without_a_socket_gets_heartbeats_until_it_has_one(world):
    port = world.server.ports[1]
    world.run(3.0)
    assert port.sent == {GCS_REMOTE_PORT: 4}  # at 1 s, at once, and 2, 3 and 4 s
    station = Client(GCS_REMOTE_PORT, world.fleet[0].gcs_local_port)
    world.run(1.5)
    assert named(station.receive(), "ATTITUDE")
    station.socket.close()
    world.run(0.1)
    before = port.sent[GCS_REMOTE_PORT]
    world.run(3.0)
    assert port.sent[GCS_REMOTE_PORT] - before == 3
    assert port.lost == 0


def test_a_rejected_client_does_not_affect_the_others(world):
    port = world.server.ports[0]
    gone = Client(0, world.fleet[0].offboard_local_port)
    world.hear()
    world.ask(heartbeat(), client=gone)
    link = port.links[1]
    gone.socket.close()
    messages = world.run(1.0)
    assert len(named(messages, "ATTITUDE")) == 100
    assert port.lost == 0
    assert not link.streams.active


def test_a_participant_gets_the_streams_from_its_join(world):
    world.client.socket.close()
    world.take_part()
    port = world.server.ports[0]
    assert port.default.streams.active
    world.client = Client(0, world.fleet[0].offboard_local_port)
    world.run(2.0, 20_000)
    assert port.default.streams.active, "though no socket is there yet"
    world.server.reserve({})
    world.run(0.1, 20_000)
    assert not port.default.streams.active


def test_ground_station_rates(world):
    gcs = Client(0, world.fleet[0].gcs_local_port)
    world.ask(heartbeat(6), client=gcs)
    world.run(2.0)
    messages = gcs.receive()
    assert len(named(messages, "ATTITUDE")) == 100
    assert len(named(messages, "SERVO_OUTPUT_RAW")) == 100
    assert not named(messages, "HIGHRES_IMU")
    gcs.socket.close()


def test_one_message_a_datagram_and_counters(world):
    """Each datagram has one message, as from PX4, since real MAVROS reads only 296 bytes of it."""
    world.hear()
    world.run(1.0, step_us=20_000)
    datagrams = world.client.datagrams
    assert len(datagrams) == world.server.sent[world.fleet[0].offboard_remote_port] > 300
    assert max(map(len, datagrams)) <= 280
    assert all(len(datagram) == datagram[1] + 12 for datagram in datagrams), "a MAVLink 2 frame each"
    assert world.server.received[world.fleet[0].offboard_local_port] == 1


def test_highres_imu_flags_the_sensors_sampled_since_the_last_one_on_the_link(world):
    world.hear()
    sensors = world.autopilot.sensors[0]
    (first,) = named(world.run(0.02), "HIGHRES_IMU")
    assert first.fields_updated == 0x1FFF
    (same,) = named(world.run(0.02), "HIGHRES_IMU")
    assert same.fields_updated == 0x3F
    sensors["mag"][0] += 0.01
    (mag,) = named(world.run(0.02), "HIGHRES_IMU")
    assert mag.fields_updated == 0x1FF
    sensors["baro_pressure"] += 1.0
    sensors["mag"][0] += 0.01
    other = Client(0, world.fleet[0].offboard_local_port)
    world.ask(heartbeat(), client=other)
    (baro,) = named(world.run(0.02), "HIGHRES_IMU")
    assert baro.fields_updated == 0x1FFF
    assert named(other.receive(), "HIGHRES_IMU")[0].fields_updated == 0x1FFF
    other.socket.close()


def test_streams_of_all_vehicles_fall_on_the_same_ticks():
    world = World(2)
    other = Client(world.fleet[1].offboard_remote_port, world.fleet[1].offboard_local_port)
    world.hear()
    world.run(0.013)
    world.ask(heartbeat(), client=other)
    other.mav.srcSystem = 254
    mine = named(world.run(1.0), "LOCAL_POSITION_NED")
    theirs = named(other.receive(), "LOCAL_POSITION_NED")
    assert [m.time_boot_ms for m in mine] == [m.time_boot_ms for m in theirs]
    assert theirs[0].get_srcSystem() == _SYSTEM + 1
    other.socket.close()
    world.close()


def test_interval_can_be_set_stopped_and_reset(world):
    world.hear()
    assert world.command(511, 32, 100_000)[0] == 0
    assert len(named(world.run(2.0), "LOCAL_POSITION_NED")) == 20
    assert world.command(511, 32, -1)[0] == 0
    assert not named(world.run(1.0), "LOCAL_POSITION_NED")
    assert world.command(510, 32)[1][0].interval_us == -1
    assert world.command(511, 32, 0)[0] == 0
    assert len(named(world.run(1.0), "LOCAL_POSITION_NED")) == 30
    assert world.command(510, 32)[1][0].interval_us == 33333
    assert world.command(511, 26, 100_000)[0] == 0, "SCALED_IMU is off by default"
    assert len(named(world.run(1.0), "SCALED_IMU")) == 10


@pytest.mark.parametrize("params", [(0, 0), (0, 100_000), (9999, 1000), (math.nan, 0), (-1, 0)])
def test_bad_intervals_fail(world, params):
    assert world.command(511, *params)[0] == 4
    assert len(named(world.run(2.0), "HEARTBEAT")) >= 2


@pytest.mark.parametrize(("asked", "found"), [(math.inf, -1), (math.nan, 33333)])
def test_an_interval_that_is_no_number_is_never_or_the_default(world, asked, found):
    assert world.command(511, 32, asked)[0] == 0
    assert world.command(510, 32)[1][0].interval_us == found


def test_links_have_intervals_of_their_own(world):
    gcs = Client(0, world.fleet[0].gcs_local_port)
    world.ask(heartbeat(6), client=gcs)
    world.hear()
    assert world.command(511, 30, -1)[0] == 0
    assert not named(world.run(0.5), "ATTITUDE")
    assert named(gcs.receive(), "ATTITUDE")
    gcs.socket.close()


def test_a_further_ground_station_is_forgotten_when_it_is_silent_by_both_clocks(world, monkeypatch):
    station = Client(0, world.fleet[0].gcs_local_port)
    wall = [0.0]
    monkeypatch.setattr("xtdrone_autopilot.mavlink.client_link.time.monotonic", lambda: wall[0])
    world.ask(heartbeat(6), client=station)
    world.run(5.5, 100_000)
    station.receive()
    world.run(1.0, 100_000)
    assert named(station.receive(), "ATTITUDE"), "fast simulation: no wall time has gone by"
    wall[0] = 6.0
    world.run(3.0, 100_000)
    assert not station.receive()
    world.ask(heartbeat(6), client=station)
    world.run(1.0, 100_000)
    assert named(station.receive(), "ATTITUDE")
    station.socket.close()


@pytest.mark.parametrize("wall_s", [0.0, 100.0])
def test_a_further_client_of_the_offboard_link_is_forgotten_by_simulated_time_alone(world, monkeypatch, wall_s):
    wall = [0.0]
    monkeypatch.setattr("xtdrone_autopilot.mavlink.client_link.time.monotonic", lambda: wall[0])
    client = Client(0, world.fleet[0].offboard_local_port)
    world.ask(heartbeat(), client=client)
    wall[0] = wall_s
    world.run(4.9, 100_000)
    assert named(client.receive(), "ATTITUDE")
    world.run(0.2, 100_000)
    client.receive()
    world.run(3.0, 100_000)
    assert not client.receive()
    client.socket.close()


def test_receiving_reads_all_that_is_there(world):
    for _ in range(600):
        world.client.send(heartbeat())
    assert world.server.receive() == 600
    assert world.server.receive() == 0


def test_links_are_pointed_at_another_machine_when_the_peer_is_gone(world):
    vehicle = world.fleet[0]
    port = world.server.ports[0]
    world.hear()
    world.server.direct([vehicle.offboard_remote_port], "10.0.0.2", override=False)
    assert port.default.peer == ("127.0.0.1", vehicle.offboard_remote_port)
    world.server.direct([vehicle.offboard_remote_port], "10.0.0.2", override=True)
    assert port.default.peer == ("10.0.0.2", vehicle.offboard_remote_port)


def test_content(world):
    a = world.autopilot
    a.place(0, 10.0, -20.0, -30.0, yaw=math.radians(-90.0))
    a.estimator[0]["velocity"] = (1.0, 2.0, -0.5)
    a.estimator[0]["rates"] = (0.1, 0.2, 0.3)
    a.estimator[0]["P"] = 0.04 * np.eye(len(a.estimator[0]["P"]))
    a.estimator[0]["epv"] = 0.2
    a.sensors[0]["gps_vel"] = (0.0, -2.0, 0.0)
    a.sensors[0]["gps_eph"] = 0.9
    a.sensors[0]["baro_pressure"] = 95598.0
    a.control[0]["sp_position"] = (1.0, math.nan, 3.0)
    got = {m.get_type(): m for m in world.listen(10.0, 10_000)}
    lpos, att, gpos = got["LOCAL_POSITION_NED"], got["ATTITUDE"], got["GLOBAL_POSITION_INT"]
    assert (lpos.x, lpos.y, lpos.z) == (10.0, -20.0, -30.0)
    assert att.yaw == pytest.approx(-math.pi / 2)
    assert (att.rollspeed, att.yawspeed) == pytest.approx((0.1, 0.3))
    assert gpos.lat == round((ORIGIN[0] + math.degrees(10 / 6371000)) * 1e7)
    assert gpos.lon == pytest.approx(85453280, abs=300)
    assert (gpos.alt, gpos.relative_alt, gpos.vx, gpos.vz, gpos.hdg) == (518000, 30000, 100, -50, 27000)
    odom = got["ODOMETRY"]
    assert (odom.vx, odom.vy, odom.vz) == pytest.approx((1.0, 2.0, -0.5))
    assert odom.pose_covariance[0] == pytest.approx(0.04)
    assert odom.pose_covariance[1] == 0.0
    assert (odom.frame_id, odom.child_frame_id) == (1, 1)  # PX4 v1.14 sends LOCAL_NED for both
    gps = got["GPS_RAW_INT"]
    assert (gps.fix_type, gps.vel, gps.cog, gps.h_acc, gps.eph) == (3, 200, 27000, 900, 65535)
    assert got["SCALED_PRESSURE"].press_abs == pytest.approx(955.98)
    assert got["VFR_HUD"].groundspeed == pytest.approx(math.sqrt(5))
    assert got["VFR_HUD"].heading == 270
    assert got["ALTITUDE"].altitude_amsl == pytest.approx(518.0)
    target = got["POSITION_TARGET_LOCAL_NED"]
    assert (target.x, target.type_mask) == (1.0, 0b10)
    assert math.isnan(target.y)
    assert got["ESTIMATOR_STATUS"].flags == 831
    assert got["ESTIMATOR_STATUS"].pos_vert_accuracy == pytest.approx(0.2)
    assert got["SERVO_OUTPUT_RAW"].servo1_raw == 900
    assert got["BATTERY_STATUS"].voltages[0] == 16200
    assert got["SYS_STATUS"].voltage_battery == 16200
    assert got["HOME_POSITION"].altitude == 488000
    assert got["GPS_GLOBAL_ORIGIN"].latitude == 473977420
    assert got["EXTENDED_SYS_STATE"].landed_state == 2
    time = got["SYSTEM_TIME"]
    assert time.time_unix_usec - time.time_boot_ms * 1000 == 1577836800000000


def test_motors_are_pulses_when_armed(world):
    world.hear()
    world.command(400, 1)
    world.autopilot.control[0]["actuators"][:4] = (0.0, 0.5, 1.0, math.nan)
    servo = named(world.run(0.2), "SERVO_OUTPUT_RAW")[-1]
    assert (servo.servo1_raw, servo.servo2_raw, servo.servo3_raw, servo.servo4_raw) == (1000, 1500, 2000, 1000)


@pytest.mark.parametrize(
    ("field", "value", "lost"),
    [
        ("position", (1e300, 0.0, 0.0), "LOCAL_POSITION_NED"),
        ("position", (math.nan, 0.0, math.nan), "GLOBAL_POSITION_INT"),
        ("position", (math.inf, 0.0, 0.0), "GLOBAL_POSITION_INT"),
        ("q", (math.nan, 0.0, 0.0, 0.0), "VFR_HUD"),
        ("P", math.nan, ""),
        ("velocity", (math.inf, math.nan, 0.0), ""),
        ("rates", (math.inf, math.nan, 0.0), ""),
    ],
)
def test_a_diverged_estimate_does_not_stop_the_rest(world, caplog, field, value, lost):
    world.autopilot.estimator[0][field] = value
    world.hear()
    messages = world.run(1.0)
    assert named(messages, "EXTENDED_SYS_STATE")
    assert not lost or not named(messages, lost)
    assert not lost or "iris_0 offboard link: not sent" in caplog.text


# commands


def test_arm_disarm_and_texts(world):
    world.hear()
    assert world.command(400, 1)[0] == 0
    assert world.texts() == ["Armed by external command\t"]
    world.autopilot.place(0, 0.0, 0.0, -5.0)
    assert world.command(400, 0)[0] == 1
    assert world.texts() == ["Disarming denied! Not landed\t"]
    assert world.command(400, 0, 21196)[0] == 0
    assert not world.ask(mavlink.MAVLink_command_long_message(_SYSTEM, 1, 400, 0, 2, 0, 0, 0, 0, 0, 0))
    assert world.texts()[-1] == "Unsupported ARM_DISARM param: 2.000"


@pytest.mark.parametrize("rest", ["rest", ""])
def test_long_texts_are_sent_in_chunks_with_a_short_last_one(world, rest):
    world.hear()
    world.commander.say(2, "x" * 100 + rest)
    pieces = named(world.run(0.004), "STATUSTEXT")
    assert [(m.text, m.chunk_seq) for m in pieces] == [("x" * 50, 0), ("x" * 50, 1), (rest, 2)]
    assert pieces[0].id == pieces[1].id == pieces[2].id > 0


def test_mode_commands(world):
    world.hear()
    assert world.command(176, 1, 4, 5)[0] == 0
    assert world.commander.mode is modes.AUTO_RTL
    assert world.command(176, 1, 4, 1)[0] == 1
    assert world.command(176, 1, 99)[0] == 0, "an unknown main mode, as PX4"
    assert world.command(176, 1, 1)[0] == 0
    assert world.commander.mode is modes.MANUAL
    assert world.command(176, math.nan, 4, 5)[0] == 0, "PX4 casts NaN to no bits, which select no mode"
    assert world.command(176, 1, 300)[0] == 0, "and 300 to the byte 44"
    assert world.commander.mode is modes.MANUAL


def test_set_mode_message_is_acknowledged_as_a_command(world):
    answers = world.ask(mavlink.MAVLink_set_mode_message(_SYSTEM, 1, modes.AUTO_LAND.custom_mode))
    assert [(m.command, m.result) for m in answers] == [(176, 0)]
    assert world.commander.mode is modes.AUTO_LAND


@pytest.mark.parametrize(
    ("number", "result"),
    [
        (16, 3), (20, 0), (21, 0), (22, 0), (24, 3), (31, 3), (177, 3), (178, 0), (192, 3), (193, 3), (245, 0),
        (300, 2), (401, 0), (410, 0), (510, 0), (511, 4), (512, 0), (520, 0), (521, 3), (2000, 3),
        (31010, 3), (65535, 3),
    ],
)  # fmt: skip
def test_zero_parameters_disarmed_as_px4(world, number, result):
    assert world.command(number)[0] == result
    assert not world.commander.armed


def test_request_message(world):
    _, (version,) = world.command(512, 148)
    assert version.flight_sw_version == 0x010E03FF
    assert version.uid == _SYSTEM
    _, (home,) = world.command(512, 242)
    assert home.latitude == 473977420
    assert world.command(512, 259)[0] == 2
    _, (beat,) = world.command(512, math.nan)
    assert beat.get_type() == "HEARTBEAT", "(uint16_t)NaN is 0"


def test_takeoff_command(world):
    assert world.command(22, 0, 0, 0, math.nan, math.nan, math.nan, ORIGIN[2] + 9.0)[0] == 0
    world.command(400, 1)
    assert world.setpoint["goal_position"].tolist() == pytest.approx([0.0, 0.0, -9.0])
    assert math.isnan(world.setpoint["goal_yaw"])


def test_command_int_has_integer_places_and_no_frame(world):
    """Altitudes are AMSL in every frame, as with PX4 v1.14's MavlinkReceiver::handle_message_command_int."""
    world.fly_offboard(0.0, 0.0, -5.0)
    place = [round(v * 1e7) for v in world.commander.view.to_global((10.0, 20.0, 0.0))[:2]]
    unset = 0x7FFFFFFF

    def ask(frame, *position):
        message = mavlink.MAVLink_command_int_message(_SYSTEM, 1, frame, 192, 0, 0, -1, 1, 0, math.nan, *position)
        assert world.ask(message)[0].result == 0
        return world.setpoint["goal_position"].tolist()

    for frame in range(22):
        height = 15.0 + frame
        assert ask(frame, *place, ORIGIN[2] + height) == pytest.approx([10.0, 20.0, -height], abs=0.02)
    goal = ask(6, unset, unset, ORIGIN[2] + 8.0)
    assert goal == pytest.approx([10.0, 20.0, -8.0], abs=0.02), "the goal's place stays"


def test_set_home(world):
    assert world.command(179, 0, 0, 0, 0, 47.5, 8.6, 500.0)[0] == 0
    assert world.commander.home.latitude == pytest.approx(47.5, abs=1e-5)
    assert world.command(179, 0, 0, 0, 0, 247.5, 8.6, 500.0)[0] == 2
    assert world.command(179, 1)[0] == 0
    assert world.commander.home.latitude == pytest.approx(ORIGIN[0])


def test_messages_for_other_systems_are_ignored(world, caplog):
    answers = world.ask(mavlink.MAVLink_command_long_message(_SYSTEM + 1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))
    assert not answers
    assert not world.commander.armed
    assert world.server.ports[0].foreign == 1
    assert str(_SYSTEM + 1) in caplog.text


def test_messages_for_other_systems_do_not_draw_the_telemetry_away(world):
    world.hear()
    stranger = Client(0, world.fleet[0].offboard_local_port)
    world.ask(mavlink.MAVLink_command_long_message(_SYSTEM + 1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0), client=stranger)
    assert named(world.run(1.0), "LOCAL_POSITION_NED")
    assert not stranger.receive()
    stranger.socket.close()


def test_commands_for_other_components_are_ignored(world):
    assert not world.ask(mavlink.MAVLink_command_long_message(_SYSTEM, 100, 400, 0, 1, 0, 0, 0, 0, 0, 0))
    assert not world.commander.armed


def test_broadcast_setpoints_and_discovery_requests_are_accepted_other_commands_are_not(world):
    assert not world.ask(mavlink.MAVLink_command_long_message(0, 0, 400, 0, 1, 0, 0, 0, 0, 0, 0))
    assert not world.commander.armed
    answers = world.ask(mavlink.MAVLink_command_long_message(0, 0, 520, 0, 1, 0, 0, 0, 0, 0, 0))
    assert {m.get_type() for m in answers} == {"AUTOPILOT_VERSION", "COMMAND_ACK"}
    everywhere = local_target(x=1.0, mask=_ALL_BUT_POSITION)
    everywhere.target_system = 0
    world.ask(everywhere)
    assert world.command(176, 1, 6)[0] == 0
    assert world.command(400, 1)[0] == 0, "OFFBOARD can be armed by the setpoint's grace"


# setpoints


def test_position_target(world):
    world.fly_offboard()
    world.ask(local_target(x=4.0, y=5.0, z=-6.0, yaw=1.0, mask=0b100111111000))
    s = world.setpoint
    assert s["task"] == TASK_TRAJECTORY
    assert s["position"].tolist() == [4.0, 5.0, -6.0]
    assert all(map(math.isnan, s["velocity"].tolist() + s["acceleration"].tolist()))
    assert s["yaw"] == 1.0
    assert math.isnan(s["yaw_rate"])


@pytest.mark.parametrize(
    ("frame", "expected"),
    [(1, (1.0, 2.0, 3.0)), (8, (-2.0, 1.0, 3.0)), (9, (-2.0, 1.0, 3.0))],
)
def test_velocity_frames(world, frame, expected):
    world.fly_offboard(yaw=math.pi / 2)
    world.ask(local_target(vx=1.0, vy=2.0, vz=3.0, ax=1.0, ay=2.0, az=3.0, mask=0b010000000111, frame=frame))
    assert world.setpoint["velocity"].tolist() == pytest.approx(expected)
    assert world.setpoint["acceleration"].tolist() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("frame", "position", "yaw"),
    [
        (1, (1.0, 2.0, 3.0), 0.5),
        (9, (8.0, 21.0, -27.0), 0.5 + math.pi / 2),
    ],
)
def test_position_frames(world, frame, position, yaw):
    world.fly_offboard(10.0, 20.0, -30.0, yaw=math.pi / 2)
    world.ask(local_target(x=1.0, y=2.0, z=3.0, yaw=0.5, mask=0b100111111000, frame=frame))
    assert world.setpoint["position"].tolist() == pytest.approx(position)
    assert world.setpoint["yaw"] == pytest.approx(yaw)


@pytest.mark.parametrize(
    "message",
    [
        local_target(mask=_ALL_BUT_YAW),
        local_target(mask=0b001000111111),
        local_target(frame=20, mask=_ALL_BUT_POSITION),
        local_target(frame=8, x=1.0, mask=_ALL_BUT_POSITION),
    ],
)
def test_bad_setpoints_are_rejected_with_a_text(world, message):
    world.fly_offboard()
    world.texts()
    before = str(world.setpoint)
    for _ in range(3):
        world.ask(message)
    assert str(world.setpoint) == before
    assert "".join(world.texts()).count("SET_POSITION_TARGET_LOCAL_NED") == 1
    world.run(1.1, 100_000)
    world.ask(message)
    world.commander.update()
    assert world.commander.system_status == 5, "a rejected setpoint does not feed the watchdog"


def test_global_target(world):
    world.fly_offboard()
    lat, lon, _ = world.commander.view.to_global((100.0, -50.0, 0.0))
    values = (0, 0, 0, 0, 0, 0, 0, 0)
    for frame, alt in ((5, ORIGIN[2] + 12.0), (6, 12.0)):
        world.ask(
            mavlink.MAVLink_set_position_target_global_int_message(
                0, _SYSTEM, 1, frame, _ALL_BUT_POSITION, round(lat * 1e7), round(lon * 1e7), alt, *values
            )
        )
        assert world.setpoint["position"].tolist() == pytest.approx([100.0, -50.0, -12.0], abs=0.02)


def test_attitude_target(world):
    world.fly_offboard()
    half = math.sqrt(0.5)
    world.ask(mavlink.MAVLink_set_attitude_target_message(0, _SYSTEM, 1, 0b11, [half, half, 0, 0], 9, 9, 0.3, 0.6))
    s = world.setpoint
    assert s["task"] == TASK_ATTITUDE
    assert s["attitude_q"].tolist() == pytest.approx([half, half, 0.0, 0.0])
    assert s["rates"].tolist() == pytest.approx([0.0, 0.0, 0.3])
    assert s["thrust"] == pytest.approx(0.6)
    world.ask(mavlink.MAVLink_set_attitude_target_message(0, _SYSTEM, 1, 128, [1, 0, 0, 0], 0.1, 0.2, 0.3, 0.5))
    assert s["task"] == TASK_RATES
    assert s["rates"].tolist() == pytest.approx([0.1, 0.2, 0.3])


def test_manual_control(world):
    world.fly_offboard()
    world.ask(mavlink.MAVLink_manual_control_message(_SYSTEM, 0, 0, 500, 0, 0))
    world.commander.update()
    world.command(176, 1, 3)
    world.ask(mavlink.MAVLink_manual_control_message(_SYSTEM, 1000, -1000, 500, 0, 0))
    s = world.setpoint
    assert (s["stick_x"], s["stick_y"], s["stick_z"]) == (1.0, -1.0, 0.0)
    world.ask(mavlink.MAVLink_manual_control_message(_SYSTEM, 32767, 0, 1000, 0, 0))
    assert (s["stick_x"], s["stick_z"]) == (0.0, 1.0)


# parameters


def decode(m):
    kind = "<i" if m.param_type == 6 else "<f"
    return struct.unpack(kind, struct.pack("<f", m.param_value))[0]


def test_parameter_list(world):
    assert [m.param_id for m in world.ask(mavlink.MAVLink_param_request_list_message(_SYSTEM, 1))] == ["_HASH_CHECK"]
    answers = [m for m in world.run(1.0) if m.get_type() == "PARAM_VALUE"]
    assert [m.param_id for m in answers] == [*NAMES, "_HASH_CHECK"]
    assert [m.param_index for m in answers[:-1]] == list(range(len(NAMES)))
    values = {m.param_id: decode(m) for m in answers[:-1]}
    assert values["MAV_SYS_ID"] == _SYSTEM
    assert values["EKF2_NOAID_TOUT"] == 5_000_000
    assert values["MPC_TKO_SPEED"] == pytest.approx(1.5)
    (code,) = struct.unpack("<I", struct.pack("<f", answers[-1].param_value))
    assert code == world.commander.parameters.hash()


def test_parameter_read_and_set(world):
    def read(name, index=-1):
        return world.ask(mavlink.MAVLink_param_request_read_message(_SYSTEM, 1, name.encode(), index))

    def write(name, value, kind):
        return world.ask(mavlink.MAVLink_param_set_message(_SYSTEM, 1, name.encode(), value, kind))

    assert decode(read("MPC_XY_CRUISE")[0]) == 5.0
    assert read("", 0)[0].param_id == NAMES[0]
    assert not read("", len(NAMES))
    assert not read("NO_SUCH")
    assert decode(write("MPC_XY_CRUISE", 4.0, 9)[0]) == 4.0
    assert world.autopilot.params["mpc_xy_cruise"][0] == 4.0
    bits = struct.unpack("<f", struct.pack("<i", 3))[0]
    assert decode(write("NAV_DLL_ACT", bits, 6)[0]) == 3
    assert not write("MPC_XY_CRUISE", bits, 6), "wrong type"
    assert not write("MPC_XY_CRUISE", math.nan, 9)
    assert not write("NO_SUCH", 1.0, 9)
    assert world.commander.parameters.get("MPC_XY_CRUISE") == 4.0


# the rest of the protocol


def test_empty_mission(world):
    assert world.ask(mavlink.MAVLink_mission_request_list_message(_SYSTEM, 1, 0))[0].count == 0
    world.ask(mavlink.MAVLink_mission_ack_message(_SYSTEM, 1, 0, 0))
    assert world.ask(mavlink.MAVLink_mission_count_message(_SYSTEM, 1, 0, 2))[0].type == 0
    assert world.ask(mavlink.MAVLink_mission_clear_all_message(_SYSTEM, 1, 1))[0].mission_type == 1


def test_time_and_ping(world):
    answer = world.ask(mavlink.MAVLink_timesync_message(0, 77))[0]
    assert (answer.tc1, answer.ts1) == (world.autopilot.time_us * 1000, 77)
    assert not world.ask(mavlink.MAVLink_timesync_message(5, 77)), "an answer is not answered"
    answer = world.ask(mavlink.MAVLink_ping_message(123, 4, 0, 0))[0]
    assert (answer.time_usec, answer.seq, answer.target_system) == (123, 4, 255)


def test_origin_is_set_on_the_ground(world):
    """The first origin fixes the local position globally; a second keeps the global and moves the local position."""
    estimator = world.autopilot.estimator[0]
    estimator["origin"]["set"] = 0
    estimator["position"] = (3.0, 4.0, -1.0)
    origin = mavlink.MAVLink_set_gps_global_origin_message(_SYSTEM, 475000000, 86000000, 500000)
    assert world.ask(origin)[0].latitude == 475000000
    assert estimator["origin"]["alt"] == 500.0
    assert estimator["position"].tolist() == [3.0, 4.0, -1.0]
    before = world.commander.view.to_global(world.commander.view.position)
    moved = mavlink.MAVLink_set_gps_global_origin_message(_SYSTEM, 475010000, 86000000, 510000)
    assert world.ask(moved)[0].latitude == 475010000
    assert estimator["position"] == pytest.approx((3.0 - 6371000.0 * math.radians(1e-3), 4.0, 9.0), abs=1e-3)
    assert world.commander.view.to_global(world.commander.view.position) == pytest.approx(before, abs=1e-9)
    assert (estimator["resets"]["xy"], estimator["resets"]["z"]) == (1, 1)
    assert estimator["shifts"]["z"] == pytest.approx(10.0)


def test_origin_is_not_moved_in_the_air_nor_to_no_place(world):
    world.autopilot.place(0, 0.0, 0.0, -5.0)
    elsewhere = mavlink.MAVLink_set_gps_global_origin_message(_SYSTEM, 10, 20, 30)
    assert world.ask(elsewhere)[0].latitude == round(ORIGIN[0] * 1e7)
    world.autopilot.place(0, 0.0, 0.0, 0.0)
    beyond = mavlink.MAVLink_set_gps_global_origin_message(_SYSTEM, 910000000, 20, 30)
    assert world.ask(beyond)[0].latitude == round(ORIGIN[0] * 1e7)


def test_replies_go_to_the_sender(world):
    other = Client(0, world.fleet[0].offboard_local_port)
    world.hear()
    assert world.command(401, client=other)[0] == 0
    assert not world.client.receive()
    other.socket.close()


def test_ground_station_is_noted(world):
    world.fly_offboard()
    world.ask(heartbeat(6))
    world.autopilot.time_us += 10_100_000
    world.commander.update()
    assert "Connection to ground station lost\t" in [text for _, text in world.commander.texts]


# bad input


def test_occupied_port_is_reported():
    vehicle = Vehicle("iris", 3, FIRST_ID)
    blocker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    blocker.bind(("127.0.0.1", vehicle.gcs_local_port))
    autopilot = FakeAutopilot()
    commander = Commander(vehicle, autopilot, Parameters({"MAV_SYS_ID": 1, "BAT1_N_CELLS": 3}), 0)
    with pytest.raises(LinkError, match=rf"iris_3 ground-station link: UDP port {vehicle.gcs_local_port}"):
        MavlinkServer([vehicle], autopilot, [commander])
    blocker.close()
    MavlinkServer([vehicle], autopilot, [commander]).close()  # the other port was released


def test_malformed_bytes_are_counted_and_the_link_lives_on(world, caplog):
    good = heartbeat().pack(world.client.mav)
    wrong_crc = good[:-1] + bytes([good[-1] ^ 1])
    for datagram in (b"", b"\xfd", b"hello", good[:-3], wrong_crc, b"\xfd\x09\xff" + good[3:], good + b"junk"):
        world.client.socket.sendto(datagram, world.client.remote)
    world.server.receive(1.0)
    assert world.server.ports[0].malformed == 6
    assert caplog.text.count("bad MAVLink ignored") == 1
    assert world.command(401)[0] == 0


def test_random_payloads_with_a_right_checksum_do_no_harm(world):
    """Frames with a valid checksum and any payload raise nothing, and all outputs can still be sent."""
    rng = random.Random(1)
    names = world.server.messages
    classes = [c for c in MESSAGES.values() if c.msgname in names]
    assert len(classes) == len(names)
    specials = [struct.pack("<f", v) for v in (math.nan, math.inf, -1.0, 1e30, 400.0, 511.0, 1.0)]
    likely = {  # values that pass the first checks
        "target_system": [_SYSTEM],
        "target": [_SYSTEM],
        "target_component": [1],
        "command": [20, 21, 22, 176, 178, 179, 186, 192, 245, 246, 300, 400, 410, 510, 511, 512, 520],
        "param1": [0.0, 1.0, 30.0, 32.0, 148.0, math.nan],
        "coordinate_frame": [1, 5, 6, 7, 8, 9, 12],
        "param_id": [b"MPC_XY_P", b"NAV_DLL_ACT", b"_HASH_CHECK", b"\xff\xfe"],
        "param_type": [6, 9],
    }
    for i in range(8000):
        cls = rng.choice(classes)
        size = cls.unpacker.size
        payload = bytearray(rng.randbytes(size))
        for at in range(0, size - 4, 4):
            if rng.random() < 0.5:
                payload[at : at + 4] = rng.choice(specials)
        if rng.random() < 0.8:
            values = list(cls.unpacker.unpack(payload))
            for place, field in enumerate(cls.ordered_fieldnames):
                if field in likely:  # only text arrays precede these, and text is one value
                    values[sum(cls.lengths[:place])] = rng.choice(likely[field])
            payload = bytearray(cls.unpacker.pack(*values))
        payload = bytes(payload[: rng.randint(1, size)]) if rng.random() < 0.2 else bytes(payload)
        header = struct.pack("<BBBBBBBHB", 0xFD, len(payload), 0, 0, i & 255, 255, 190, cls.id & 0xFFFF, cls.id >> 16)
        crc = mavlink.x25crc(header[1:] + payload + bytes([cls.crc_extra])).crc
        world.client.socket.sendto(header + payload + struct.pack("<H", crc), world.client.remote)
        world.server.receive(1.0)
        if i % 50 == 0:
            world.run(0.1, 20_000)
            world.commander.update()
    world.client.receive()
    assert named(world.run(1.1), "HEARTBEAT")
    assert world.command(401)[0] == 0


def test_held_setpoints_follow_the_commands_of_the_tick_in_any_order_of_arrival(world):
    steer = local_target(x=9.0, y=2.0, z=-5.0, mask=_ALL_BUT_POSITION)
    loiter = mavlink.MAVLink_command_long_message(_SYSTEM, 1, 176, 0, 1, 4, 3, 0, 0, 0, 0)
    outcomes = []
    for messages in [(steer, loiter), (loiter, steer)]:
        world.fly_offboard(x=1.0)
        world.take_part()
        world.server.hold_setpoints()
        answers = world.ask(*messages)
        assert [m.result for m in answers if m.get_type() == "COMMAND_ACK"] == [0]
        assert world.setpoint["position"][0] != 9.0
        world.server.release_setpoints()
        world.commander.update()
        outcomes.append(world.setpoint.tobytes())
    assert outcomes[0] == outcomes[1]
    world.ask(steer)
    assert world.command(176, 1, 6)[0] == 0
    world.commander.update()
    assert world.setpoint["position"][0] == 9.0  # no datagram is stored any more


def test_a_held_home_position_comes_after_the_commands_of_the_tick(world):
    topic = mavlink.MAVLink_set_home_position_message(
        _SYSTEM, 475_000_000, 86_000_000, 500_000, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
    )
    world.take_part()
    world.server.hold_setpoints()
    world.ask(topic)
    assert world.commander.home.latitude == pytest.approx(ORIGIN[0])
    assert world.command(179, 0, 0, 0, 0, 46.0, 8.0, 400.0)[0] == 0
    assert world.commander.home.latitude == pytest.approx(46.0, abs=1e-5)
    world.server.release_setpoints()
    assert world.commander.home.latitude == pytest.approx(47.5, abs=1e-5)


def test_a_free_clients_setpoint_counts_for_the_offboard_command_that_follows_it(world):
    """MAVSDK's ``offboard.start()`` sends one setpoint, then the command."""
    vehicle = world.fleet[0]
    station = Client(0, vehicle.offboard_local_port)
    world.ask(heartbeat())
    world.autopilot.place(0, 0.0, 0.0, -5.0)
    assert world.command(400, 1)[0] == 0
    world.take_part()
    world.server.hold_setpoints()
    steer, offboard = local_target(x=9.0, y=2.0, z=-5.0, mask=_ALL_BUT_POSITION), (176, 1, 6)
    world.ask(steer, client=station)
    assert world.command(*offboard, client=station)[0] == 0
    assert world.setpoint["position"][0] == 9.0
    world.server.release_setpoints()
    station.socket.close()
