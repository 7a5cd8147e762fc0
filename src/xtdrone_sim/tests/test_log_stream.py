"""Log streaming over MAVLink to pymavlink clients on real UDP sockets, some of which lose messages."""

from __future__ import annotations

import random
import socket
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink
from pyulog import ULog

from xtdrone_autopilot.logger import mavlink_log_pieces
from xtdrone_autopilot.logger.sampled_topics import TOPICS
from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_autopilot.mavlink.microservices.files_and_logs import log_stream
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.autopilots.builtin_autopilot import BuiltinAutopilot
from xtdrone_sim.simulation import Simulation

START, STOP = mavlink.MAV_CMD_LOGGING_START, mavlink.MAV_CMD_LOGGING_STOP
ACCEPTED, REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
TICK_US = 20_000


class Client:
    """A ground station that stores the streamed log, as a real one does.

    Args:
        port: of the autopilot.
        loss: probability with which a message of the log, or its acknowledgement, is lost.
    """

    def __init__(self, port: int, loss: float = 0.0, *, acknowledges: bool = True, system: int = 255) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self.socket.setblocking(False)
        self.socket.connect(("127.0.0.1", port))
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=190)
        self.parser = mavlink.MAVLink(None)
        self.loss, self.dice = loss, random.Random(7)
        self.acknowledges = acknowledges
        self.beats = True
        self.pieces: dict[int, bytes] = {}
        self.log = bytearray()
        self.lost = 0
        self.results: list[tuple[int, int]] = []
        self.texts: list[str] = []
        self.acked: list[int] = []
        self.unacked: list[int] = []
        self.sizes: list[int] = []

    def send(self, message):
        self.socket.send(message.pack(self.mav))

    def command(self, number, *params):
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *params, *[0.0] * (7 - len(params))))

    def beat(self):
        if self.beats:
            self.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))

    def hear(self) -> bool:
        """Read the datagrams that have arrived; return whether any was acknowledged."""
        answered = False
        while True:
            try:
                datagram = self.socket.recv(2048)
            except BlockingIOError:
                return answered
            for message in self.parser.parse_buffer(datagram) or []:
                answered |= self._take(message)

    def _take(self, m) -> bool:
        kind = m.get_type()
        if kind == "COMMAND_ACK":
            self.results.append((m.command, m.result))
        elif kind == "STATUSTEXT":
            self.texts.append(m.text)
        if not kind.startswith("LOGGING_DATA"):
            return False
        assert (m.target_system, m.target_component) == (self.mav.srcSystem, 190)
        reliable = kind == "LOGGING_DATA_ACKED"
        (self.acked if reliable else self.unacked).append(m.sequence)
        if self.dice.random() < self.loss:
            return False
        self._write(m)
        if not reliable or not self.acknowledges or self.dice.random() < self.loss:
            return False
        self.send(mavlink.MAVLink_logging_ack_message(1, 1, m.sequence))
        return True

    def _write(self, m) -> None:
        """Append a piece; after a loss, drop the truncated message and continue with the next that begins."""
        expected = len(self.pieces) + self.lost
        if m.sequence < expected:
            return  # repeated
        data = bytes(m.data[: m.length])
        self.sizes.append(len(data))
        if m.sequence > expected:
            if m.first_message_offset == mavlink_log_pieces.NO_MESSAGE:
                return
            self.lost += m.sequence - expected
            del self.log[self.whole() :]
            data = data[m.first_message_offset :]
        self.pieces[m.sequence] = data
        self.log += data

    def whole(self) -> int:
        """Return the size of the complete messages in the log."""
        at = 16
        while at + 3 <= len(self.log) and at + 3 + int.from_bytes(self.log[at : at + 2], "little") <= len(self.log):
            at += 3 + int.from_bytes(self.log[at : at + 2], "little")
        return at

    def ulog(self, path: Path) -> ULog:
        """Return the log as pyulog reads it from a file."""
        path.write_bytes(self.log[: self.whole()])
        log = ULog(str(path))
        assert not log.file_corruption
        return log


class World:
    """One vehicle, its MAVLink, and clients."""

    def __init__(self, logs: Path | None = None) -> None:
        self.fleet = parse_fleet("iris:1")
        self.simulation = Simulation(self.fleet, seed=3, autopilots=partial(BuiltinAutopilot, logs=logs))
        self.server = MavlinkServer(self.fleet, self.simulation.autopilot, self.simulation.commanders)
        self.clients: list[Client] = []
        self.rows: list[bytes] = []

    @property
    def commander(self):
        return self.simulation.commanders[0]

    def client(self, loss=0.0, *, port=None, **settings) -> Client:
        self.clients.append(Client(port or self.fleet[0].gcs_local_port, loss, **settings))
        return self.clients[-1]

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e6 / TICK_US)):
            for client in self.clients:
                client.beat()
            self.server.receive(0.5)
            until = self.simulation.time_us + TICK_US
            while self.simulation.time_us < until:
                self.simulation.step()
                self.server.send_streams(self.simulation.time_us)
            while any([client.hear() for client in self.clients]):
                self.server.receive(0.5)
            self.rows.append(self.simulation.world.plant[0].tobytes())

    def ask(self, client: Client, number: int, *params: float) -> int:
        client.results.clear()
        client.command(number, *params)
        self.run(0.04)
        ((command, result),) = client.results
        assert command == number
        return result

    def fly(self) -> None:
        assert self.commander.request(modes.AUTO_TAKEOFF) == 0
        assert self.commander.arm_disarm(True) == 0
        self.run(4.0)
        self.commander.parameters.set("MPC_XY_CRUISE", 4.0)
        self.run(2.0)

    def close(self) -> None:
        self.server.close()
        for client in self.clients:
            client.socket.close()
        self.simulation.close()


@pytest.fixture
def world():
    made = World()
    yield made
    made.close()


def stream_flight(world: World, client: Client) -> None:
    world.run(1.0)
    assert world.ask(client, START) == ACCEPTED
    world.run(1.0 if client.loss == 0.0 else 30.0)
    world.fly()
    assert world.ask(client, STOP) == ACCEPTED


def sampled(log: ULog) -> dict[str, dict[str, np.ndarray]]:
    names = {topic.name for topic in TOPICS}
    return {data.name: data.data for data in log.data_list if data.name in names}


def test_a_stream_is_the_file_of_the_same_time(tmp_path):
    world = World(tmp_path / "logs")
    client = world.client()
    stream_flight(world, client)
    world.close()
    log = client.ulog(tmp_path / "streamed.ulg")
    (path,) = (tmp_path / "logs").rglob("*.ulg")
    file = ULog(str(path))

    assert client.lost == 0
    assert sorted(client.pieces) == list(range(len(client.pieces)))
    assert (log.msg_info_dict, log.initial_parameters) == (file.msg_info_dict, file.initial_parameters)
    assert [(name, value) for _, name, value in log.changed_parameters] == [("MPC_XY_CRUISE", 4.0)]
    assert "Armed by external command" in [text.message for text in log.logged_messages]
    received, written = sampled(log), sampled(file)
    assert {"sensor_combined", "vehicle_local_position", "actuator_motors"} <= received.keys()
    for name, found in received.items():
        first, last = found["timestamp"][[0, -1]]
        rows = (written[name]["timestamp"] >= first) & (written[name]["timestamp"] <= last)
        for field, values in found.items():
            np.testing.assert_array_equal(values, written[name][field][rows], err_msg=f"{name}.{field}")
    assert log.start_timestamp > file.start_timestamp
    duration = (log.last_timestamp - log.start_timestamp) * 1e-6
    assert 5.0 < duration < 7.5
    assert {data.name for data in log.data_list} >= {"vehicle_status", "battery_status", "home_position"}
    backends = {int(b) for data in log.data_list if data.name == "logger_status" for b in data.data["backend"]}
    assert backends == {2}


def streamed(loss: float = 0.0) -> tuple[Client, list[bytes]]:
    """Return the client of a streamed flight, and the plant's states in it."""
    world = World()
    client = world.client(loss)
    stream_flight(world, client)
    assert world.commander.on_text is not None
    world.run(0.2)
    assert world.commander.on_text is None, "nothing is logged any more"
    world.close()
    return client, world.rows


def test_a_stream_needs_no_files_and_does_not_change_the_flight(tmp_path):
    client, rows = streamed()
    log = client.ulog(tmp_path / "streamed.ulg")
    assert {"sensor_combined", "vehicle_local_position", "vehicle_status"} <= {data.name for data in log.data_list}

    alone = World()
    alone.client()
    alone.run(2.04)
    alone.fly()
    alone.close()
    assert alone.simulation.autopilots._logger is None, "without a stream there is no logger"
    assert alone.rows == rows[: len(alone.rows)]
    assert streamed()[0].log == client.log


def test_a_client_that_loses_a_third_has_all_definitions_and_whole_messages(tmp_path):
    client, _ = streamed(0.3)
    log = client.ulog(tmp_path / "streamed.ulg")
    definitions = max(client.acked) + 1
    assert set(range(definitions)) <= client.pieces.keys()
    assert len(client.acked) > 1.5 * definitions, "they were repeated"
    assert client.lost > 0.2 * len(client.unacked)
    whole = streamed()[0].ulog(tmp_path / "whole.ulg")
    assert log.initial_parameters == whole.initial_parameters
    assert set(sampled(log)) == set(sampled(whole))
    gyro = log.get_dataset("sensor_combined").data
    assert np.abs(gyro["gyro_rad[0]"]).max() < 10.0
    assert (np.diff(gyro["timestamp"].astype(np.int64)) > 0).all()


def test_a_client_that_never_acknowledges_gets_the_first_piece_for_two_and_a_half_seconds(world):
    client = world.client(acknowledges=False)
    world.run(0.5)
    assert world.ask(client, START) == ACCEPTED
    world.run(2.0)
    assert world.ask(client, START) == REJECTED
    world.run(3.0)
    assert client.acked == [0] * log_stream.MAX_TRIES
    assert not client.unacked
    client.acknowledges = True
    assert world.ask(client, START) == ACCEPTED
    world.run(1.5)
    assert client.unacked


def test_the_rate_is_bounded(world):
    client = world.client()
    assert world.ask(client, START) == ACCEPTED
    world.run(1.5)
    counts = []
    for _ in range(5):
        before = len(client.unacked)
        world.run(0.1)
        counts.append(len(client.unacked) - before)
    assert max(counts) <= 0.1e6 / log_stream.PERIOD_US * log_stream.BURST
    assert set(client.sizes[max(client.acked) + 1 :]) == {mavlink_log_pieces.PIECE_SIZE}


def test_answers(world):
    client, other = world.client(), world.client(system=254)
    slow = world.client(port=world.fleet[0].payload_local_port, system=253)
    world.run(0.5)
    assert world.ask(client, STOP) == ACCEPTED, "nothing to stop"
    assert world.ask(client, START, 1.0) == UNSUPPORTED
    assert world.ask(slow, START) == DENIED
    assert slow.texts == ["Not enough bandwidth to enable log streaming"]
    assert not client.acked
    assert world.ask(client, START) == ACCEPTED
    assert world.ask(client, START) == REJECTED
    assert world.ask(other, START) == REJECTED
    world.run(1.0)
    assert client.unacked
    assert not other.acked
    assert world.ask(other, STOP) == ACCEPTED, "any client may"
    count = len(client.unacked)
    world.run(1.0)
    assert len(client.unacked) == count
    assert world.ask(other, START) == ACCEPTED


def ended(world: World, client: Client) -> bool:
    world.run(0.2)
    count = len(client.unacked)
    world.run(2.0)
    return len(client.unacked) == count


def test_a_silent_client_receives_nothing_more(world):
    client, other = world.client(port=world.fleet[0].offboard_local_port), world.client(system=254)
    assert world.ask(client, START) == ACCEPTED
    world.run(1.5)
    assert not ended(world, client)
    client.beats = False
    world.run(5.0)
    assert ended(world, client)
    assert world.ask(other, START) == ACCEPTED


def test_a_reboot_and_a_reset_end_a_stream(world):
    client = world.client()
    assert world.ask(client, START) == ACCEPTED
    world.run(1.5)
    assert world.ask(client, mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0) == ACCEPTED
    assert ended(world, client)
    client.pieces.clear()
    client.log.clear()
    assert world.ask(client, START) == ACCEPTED
    world.run(1.5)
    assert not ended(world, client)
    world.simulation.restart()
    world.server.reboot(world.simulation.autopilot, world.simulation.commanders)
    assert ended(world, client)


def test_pieces_name_where_messages_begin_and_the_oldest_are_dropped():
    def message(size):
        return (size - 3).to_bytes(2, "little") + b"D" + bytes(size - 3)

    log = mavlink_log_pieces.LogStream()
    log.write(bytes(16) + message(100) + message(300))
    log.finish_definitions()
    assert [(p.sequence, p.first_message, len(p.data)) for p in log.definitions] == [(0, 0, 249), (1, 255, 167)]
    log.write(message(249) + message(200) + message(48) + message(3))
    assert [(p.sequence, p.first_message, len(p.data)) for p in log.data] == [(2, 0, 249), (3, 0, 249)]
    log.write(message(248))
    assert log.data[-1].first_message == 2
    for _ in range(70_000):
        log.write(message(249))
    assert len(log.data) == mavlink_log_pieces.CAPACITY
    assert (log.data[-1].sequence - log.data[0].sequence) % 65_536 == mavlink_log_pieces.CAPACITY - 1
    log.close()
    log.write(message(249))
    assert not log.data
