"""A paused simulation serves its clients: parameter lists, logs and files continue at a constant simulated time."""

from __future__ import annotations

import json
import struct

import pytest
from pymavlink.dialects.v20 import common as mavlink
from test_mavlink_server import Client, World, heartbeat

from xtdrone_autopilot.logger.log_folder import LogFolder
from xtdrone_autopilot.parameters.parameters import NAMES
from xtdrone_common.fleet import GCS_REMOTE_PORT

_PERIOD = 0.02


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
    monkeypatch.setattr("xtdrone_autopilot.mavlink.client_link.time", clock)
    monkeypatch.setattr("xtdrone_autopilot.mavlink.mavlink_server.time", clock)
    return clock


@pytest.fixture
def station(world):
    client = Client(0, world.fleet[0].gcs_local_port)
    world.ask(heartbeat(6), client=client)
    yield client
    client.socket.close()


def wait(world, clock, client, seconds, counted=()):
    """Wait in wall time while simulated time is paused; return the client's messages, without heartbeats."""
    heard = []
    for _ in range(round(seconds / _PERIOD)):
        clock.now += _PERIOD
        world.server.receive(0.0)
        world.server.keep_alive(lambda: counted)
        heard += [m for m in client.receive() if m.get_type() != "HEARTBEAT"]
    return heard


def test_the_parameter_list(world, clock, station):
    system = world.fleet[0].system_id
    station.send(mavlink.MAVLink_param_request_list_message(system, 1))
    heard = wait(world, clock, station, 2.0)
    names = [m.param_id for m in heard if m.get_type() == "PARAM_VALUE"]
    assert names == ["_HASH_CHECK", *NAMES, "_HASH_CHECK"]
    world.autopilot.time_us += 1_000_000
    world.server.send_streams(world.autopilot.time_us)
    assert "PARAM_VALUE" not in [m.get_type() for m in station.receive()]


def test_a_transfer_interrupted_by_a_pause_continues(world, clock, station):
    station.send(mavlink.MAVLink_param_request_list_message(world.fleet[0].system_id, 1))
    world.server.receive(1.0)
    world.run(0.05)
    heard = [m for m in station.receive() if m.get_type() == "PARAM_VALUE"]
    heard += wait(world, clock, station, 0.16)
    assert len(heard) < len(NAMES)
    world.run(1.0)
    heard += [m for m in station.receive() if m.get_type() == "PARAM_VALUE"]
    assert [m.param_id for m in heard if m.param_id != "_HASH_CHECK"] == list(NAMES)


def test_time_that_is_slow_does_not_stand(world, clock, station):
    station.send(mavlink.MAVLink_param_request_list_message(world.fleet[0].system_id, 1))
    heard = []
    for _ in range(50):
        world.autopilot.time_us += 4000
        heard += wait(world, clock, station, 0.04)
    assert [m.param_id for m in heard if m.get_type() == "PARAM_VALUE"] == ["_HASH_CHECK"]


def test_counted_nodes_wait_for_simulated_time(world, clock, station):
    """A lockstep participant receives the same messages in every run."""
    port = station.socket.getsockname()[1]
    station.send(mavlink.MAVLink_param_request_list_message(world.fleet[0].system_id, 1))
    assert len(wait(world, clock, station, 1.0, {port})) == 1
    assert world.server.keep_alive_delay == pytest.approx(_PERIOD)
    world.run(1.0)
    assert len([m for m in station.receive() if m.get_type() == "PARAM_VALUE"]) == len(NAMES) + 1
    assert world.server.keep_alive_delay > _PERIOD


def test_metadata_by_ftp_bursts(world, clock, station):
    system = world.fleet[0].system_id
    sequence = 0

    def ask(opcode, data=b"", offset=0, size=None):
        nonlocal sequence
        sequence += 2
        size = len(data) if size is None else size
        payload = struct.pack("<HBBBBBBI", sequence, 0, opcode, size, 0, 0, 0, offset) + data
        station.send(mavlink.MAVLink_file_transfer_protocol_message(0, system, 1, list(payload.ljust(251, b"\0"))))

    ask(4, b"/etc/extras/parameters.json")
    (opened,) = wait(world, clock, station, _PERIOD)
    (size,) = struct.unpack_from("<I", bytes(opened.payload), 12)
    ask(15, size=239)
    parts = {}
    for message in wait(world, clock, station, 2.0):
        payload = bytes(message.payload)
        if payload[3] == 128:
            parts[struct.unpack_from("<I", payload, 8)[0]] = payload[12 : 12 + payload[4]]
    content = b"".join(parts[offset] for offset in sorted(parts))
    assert len(content) == size
    assert [entry["name"] for entry in json.loads(content)["parameters"]] == list(NAMES)


def test_a_log_is_downloaded(world, clock, station, tmp_path):
    folder = tmp_path / "iris_0"
    (folder / "2020-01-01").mkdir(parents=True)
    log = bytes(range(256)) * 40
    (folder / "2020-01-01" / "00_00_00.ulg").write_bytes(log)
    world.autopilot.logs = [LogFolder(folder)]
    system = world.fleet[0].system_id
    station.send(mavlink.MAVLink_log_request_list_message(system, 1, 0, 0xFFFF))
    entries = [m for m in wait(world, clock, station, 0.2) if m.get_type() == "LOG_ENTRY"]
    assert [m.size for m in entries] == [len(log)]
    station.send(mavlink.MAVLink_log_request_data_message(system, 1, 0, 0, len(log)))
    parts = [m for m in wait(world, clock, station, 1.0) if m.get_type() == "LOG_DATA"]
    assert b"".join(bytes(m.data[: m.count]) for m in parts) == log


def test_immediate_requests_are_answered_immediately(world, clock, station):
    """A mission transfer is a series of requests and replies, and needs no simulated time."""
    system = world.fleet[0].system_id
    station.send(mavlink.MAVLink_mission_count_message(system, 1, 1, 0))
    (wanted,) = wait(world, clock, station, _PERIOD)
    assert wanted.get_type() in ("MISSION_REQUEST", "MISSION_REQUEST_INT")
    item = mavlink.MAVLink_mission_item_int_message(
        system, 1, 0, 3, 22, 0, 1, 0, 0, 0, 0, int(47.397 * 1e7), int(8.5455 * 1e7), 10.0, 0
    )
    station.send(item)
    (ack,) = wait(world, clock, station, _PERIOD)
    assert (ack.get_type(), ack.type) == ("MISSION_ACK", 0)
    assert len(world.commander.navigator.plans.mission) == 1


def test_the_first_clients_port_is_no_exception(world, clock):
    """A ground station at 14550 is the first client, and runs by wall time like the others."""
    station = Client(GCS_REMOTE_PORT, world.fleet[0].gcs_local_port)
    try:
        station.send(mavlink.MAVLink_param_request_list_message(world.fleet[0].system_id, 1))
        heard = wait(world, clock, station, 2.0)
        assert len([m for m in heard if m.get_type() == "PARAM_VALUE"]) == len(NAMES) + 2
    finally:
        station.socket.close()


def datagrams_of_a_run(paused, clock):
    """Return a counted client's datagrams in a flight with or without a ground station's requests in a pause."""
    world = World()
    station = Client(0, world.fleet[0].gcs_local_port)
    try:
        world.hear()
        world.run(1.0)
        if paused:
            station.send(mavlink.MAVLink_param_request_list_message(world.fleet[0].system_id, 1))
            assert len(wait(world, clock, station, 2.0, {world.fleet[0].offboard_remote_port})) > len(NAMES)
        world.run(2.0)
        return world.client.datagrams
    finally:
        station.socket.close()
        world.close()


def test_a_pause_with_a_visitor_leaves_no_trace(clock):
    assert datagrams_of_a_run(True, clock) == datagrams_of_a_run(False, clock)
