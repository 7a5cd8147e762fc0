"""Effect of a reset and of slow time on MAVLink, the MAVROS layer, XTDrone's commands and the lockstep's server."""

from __future__ import annotations

import pytest
from autopilot_fakes import FIRST_ID, FakeAutopilot
from mavros_fakes import Bench
from pymavlink.dialects.v20 import common as mavlink
from test_lockstep_server import FakeParticipant, Running, joined
from test_mavlink_server import Client, World, heartbeat

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.mavlink import client_link as link_module
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_control.communication.commands import MultirotorCore
from xtdrone_lockstep.server import LockstepServer
from xtdrone_lockstep.transport.inbox import Inbox
from xtdrone_mavros.plugins import PLUGINS

GCS_REMOTE_PORT = 14550
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def types(messages):
    return [message.get_type() for message in messages]


# ---- the autopilots' MAVLink


@pytest.fixture
def world():
    world = World()
    yield world
    world.close()


@pytest.fixture
def clock(monkeypatch):
    """Wall time, set by the test."""

    class Clock:
        now = 1000.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(link_module, "time", clock)
    monkeypatch.setattr("xtdrone_autopilot.mavlink.mavlink_server.time", clock)
    return clock


@pytest.fixture
def station(world):
    """A ground station on the vehicle's other link."""
    client = Client(GCS_REMOTE_PORT, world.fleet[0].gcs_local_port)
    yield client
    client.socket.close()


def test_heartbeats_continue_at_1_hz_while_time_is_paused(world, station, clock):
    station.receive()
    for _ in range(100):  # 10 s of wall time
        clock.now += 0.1
        world.server.keep_alive()
    assert types(station.receive()) == ["HEARTBEAT"] * 10
    assert world.client.receive() == []  # datagrams on the offboard link are counted, and the same in every run


def test_no_heartbeat_by_wall_time_goes_where_a_participant_counts(world, station, clock):
    station.receive()
    for _ in range(30):
        clock.now += 0.1
        world.server.keep_alive(lambda: {GCS_REMOTE_PORT})
    assert station.receive() == []
    clock.now += 0.1
    world.server.keep_alive(lambda: {24540})
    assert types(station.receive()) == ["HEARTBEAT"]


def test_a_heartbeat_by_simulated_time_is_enough(world, station, clock):
    world.server.keep_alive()
    station.receive()
    for _ in range(100):
        clock.now += 0.0996  # a little faster than real time
        world.autopilot.time_us += 100_000
        world.server.send_streams(world.autopilot.time_us)
        world.server.keep_alive()
        station.take_in()
    assert types(station.receive()).count("HEARTBEAT") == 11  # at 1.1 s, at 2 s, ... at 11 s


def test_telemetry_survives_every_pause(world, clock):
    world.hear()
    world.run(1.0)
    clock.now += 3600.0
    found = types(world.run(0.1))
    assert "LOCAL_POSITION_NED" in found


def test_after_a_reboot_streams_begin_anew(world):
    world.hear()
    world.command(511, 32, 1e6)  # LOCAL_POSITION_NED once a second
    assert "LOCAL_POSITION_NED" in types(world.run(2.0))
    sent, received = dict(world.server.sent), world.server.received
    autopilot = FakeAutopilot(1)
    autopilot.time_us = 0
    autopilot.estimator["initialised"] = 0
    world.autopilot = autopilot
    world.server.reboot(autopilot, [Commander(world.fleet[0], autopilot, Parameters({"MAV_SYS_ID": FIRST_ID + 1}), 0)])
    found = world.run(2.0)
    assert types(found).count("HEARTBEAT") == 3  # at 4 ms, 1 s, 2 s
    assert "ATTITUDE" not in types(found)  # its estimator has none yet
    assert found[0].system_status == mavlink.MAV_STATE_UNINIT
    port = world.fleet[0].offboard_remote_port
    assert world.server.sent[port] == sent[port] + len(found)
    assert world.server.received == received
    autopilot.estimator["initialised"] = 1
    world.hear()
    positions = [m for m in world.run(1.0) if m.get_type() == "LOCAL_POSITION_NED"]
    assert len(positions) == 30  # the default again
    assert positions[0].time_boot_ms < 2100


# ---- MAVROS


@pytest.fixture
def bench():
    made = Bench(PLUGINS)
    yield made
    made.close()


def beat(status=mavlink.MAV_STATE_STANDBY, base_mode=0x51):
    return mavlink.MAVLink_heartbeat_message(2, 12, base_mode, 4 << 16 | 3 << 24, status, 3)


def position(time_ms):
    return mavlink.MAVLink_local_position_ned_message(time_ms, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0)


def attitude(time_ms):
    return mavlink.MAVLink_attitude_quaternion_message(time_ms, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def fly(bench, seconds, begin=0.0):
    """Advance time with telemetry at 10 Hz; return the MAVLink that MAVROS has sent, as (time s, type)."""
    sent = []
    for k in range(1, round(10 * seconds) + 1):
        now = begin + 0.1 * k
        bench.ros.time_ns = round(now * 1e9)
        if k % 10 == 1:
            bench.send(beat())
        bench.send(attitude(round(now * 1000)), position(round(now * 1000)))
        bench.uas.step(bench.ros.time_ns)
        sent += [(round(now, 1), m.get_type()) for m in bench.received()]
    return sent


def test_mavros_begins_anew_when_time_goes_back(bench):
    bench.take("local_position/pose")
    bench.send(beat(mavlink.MAV_STATE_UNINIT))
    first = fly(bench, 5.0)
    assert len(bench.published("local_position/pose")) == 50
    # the messages of the last ticks are still in the socket
    leftover = bench.frame(position(5_100))
    bench.fcu.sendto(leftover + bench.frame(beat(base_mode=0xD1)), ("127.0.0.1", bench.link.port))
    bench.published("state")
    bench.ros.time_ns = 0
    bench.uas.on_time_reset(0)
    assert [state.connected for state in bench.published("state")] == [False]
    bench.send(beat(mavlink.MAV_STATE_UNINIT))
    assert [(s.connected, s.armed) for s in bench.published("state")] == [(True, False)]
    assert bench.published("local_position/pose") == []
    assert fly(bench, 5.0) == first  # heartbeats and stream requests at the same times as in the first flight
    poses = bench.published("local_position/pose")
    assert [pose.header.stamp.to_sec() for pose in poses] == pytest.approx([0.1 * k for k in range(1, 51)])


def test_mavros_repeats_its_requests_after_a_reboot(bench):
    bench.take("local_position/pose")
    bench.send(beat(mavlink.MAV_STATE_UNINIT))
    fly(bench, 3.0)
    bench.published("local_position/pose")
    bench.ros.time_ns += 20_000_000
    bench.send(beat(mavlink.MAV_STATE_UNINIT))  # time goes on
    assert bench.published("state")[-1].connected
    bench.send(position(3_040))
    assert bench.published("local_position/pose") == []  # the attitude is older than the reset
    asked = [m for m in bench.received() if m.get_type() == "COMMAND_LONG"]
    assert mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED in [int(m.param1) for m in asked]


# ---- XTDrone's commands


class Quiet:
    def info(self, text):
        pass

    warning = stream_warning = info


def test_communication_holds_again_after_a_restart():
    core = MultirotorCore("iris_0", Quiet(), cmd_timeout=1.0)
    initial = core.setpoint
    core.on_target_velocity("t", (1.0, 0.0, 0.0), 0.0, 500.0, body=False)
    request = core.on_command("OFFBOARD", 500.0)
    core.on_result(request, True, "", 500.0)
    core.restart()
    assert core.tick(0.1) == initial
    core.on_pose((1.0, 2.0, 0.0), IDENTITY)
    assert core.tick(0.2).position == (1.0, 2.0, 0.0)  # the setpoint follows the vehicle, as before any input
    assert core.on_command("OFFBOARD", 0.3) is not None  # not treated as a repetition
    core.on_target_velocity("t", (1.0, 0.0, 0.0), 0.0, 1.0, body=False)
    assert not core.hovering
    core.tick(2.1)
    assert core.hovering  # the timeout counts in the new time


# ---- lockstep


def test_participants_are_due_as_at_a_start_when_time_is_set_back():
    server = LockstepServer()
    try:
        player = FakeParticipant(server, "/a", rate=10.0)
        joined(server, player)
        times = []
        for now in (100_000, 200_000, 100_000, 200_000):
            if len(times) == 2:
                server.reset_time(0)
            assert server.next_due_us(now - 4000) == now
            with Running(server, now):
                tick = player.tick()
                player.done(tick)
            times.append((tick.tick, tick.time_us))
        assert times == [(1, 100_000), (2, 200_000), (3, 100_000), (4, 200_000)]
    finally:
        server.close()


def test_messages_in_flight_are_void_after_a_time_reset():
    server = LockstepServer()
    try:
        writer = FakeParticipant(server, "/w", rate=10.0, publications=[["/t", "std_msgs/String"]])
        reader = FakeParticipant(server, "/r", rate=5.0, subscriptions=[["/t", "std_msgs/String"]])
        writer.made(1, "/t", "/r", count=0)
        joined(server, writer, reader)
        for k, now in enumerate((0, 100_000), 1):
            with Running(server, now):
                if now == 0:
                    reader.done(reader.tick())
                writer.done(writer.tick(), {1: k})
        server.reset_time(0)
        with Running(server, 0):
            writer.done(writer.tick(), {1: 3})
            tick = reader.tick()
            reader.done(tick)
        ((channel, *_),) = reader.peers[0]["made"]
        assert reader.peers[-1]["void"] == [[channel, 2]]
        assert tick.channels == {channel: 2}
        with Running(server, 200_000):
            writer.done(writer.tick())
            tick = reader.tick()
            reader.done(tick)
        assert tick.channels == {channel: 3}
        assert reader.peers[-1]["void"] == [[channel, 2]]  # reported once
    finally:
        server.close()


def test_void_messages_are_dropped_but_latched_ones():
    for latched, left in ((False, ["new"]), (True, ["old", "old", "new"])):
        inbox = Inbox("/w")
        inbox.latched = latched
        inbox.messages.extend(["dispatched", "old", "old", "new"])
        inbox.received, inbox.target = 4, 1
        assert list(inbox.take(10)) == ["dispatched"]
        inbox.target = 4
        inbox.discard(3)
        assert list(inbox.take(10)) == left


def test_the_heartbeat_of_a_station_is_noted(world, station):
    """The link of a ground station serves commands while time is paused."""
    answers = world.ask(
        heartbeat(6), mavlink.MAVLink_param_request_read_message(FIRST_ID + 1, 1, b"MPC_XY_P", -1), client=station
    )
    assert [m.param_id for m in answers if m.get_type() == "PARAM_VALUE"] == ["MPC_XY_P"]
