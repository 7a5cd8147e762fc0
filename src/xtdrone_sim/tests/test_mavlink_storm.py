"""MAVLink input of any content and amount: no exception, constant memory, and the flight continues.

The form with a million frames is marked ``long`` and runs only on request: ``pytest -m long``.
"""

from __future__ import annotations

import math
import random
import socket
import struct
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_autopilot.mavlink.udp_port_and_clients import MAX_CLIENTS
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID, MESSAGES
from xtdrone_common.fleet import Vehicle
from xtdrone_sim.simulation import Simulation

SYSTEM = 1
STEP_US = 4000
BATCH = 40  # frames a step: 10,000 a simulated second
_STRANGE_VALUES = [struct.pack("<f", value) for value in (math.nan, math.inf, -1.0, 1e30, 1.0, 0.0, -0.0)]
_LIKELY = {  # values that get past the first checks
    "target_system": [SYSTEM, SYSTEM, 0],
    "target": [SYSTEM],
    "target_component": [1, 0],
    "command": [16, 20, 21, 22, 176, 178, 179, 186, 192, 223, 224, 241, 245, 246, 300, 400, 420, 510, 511, 512, 519],
    "frame": [0, 2, 3, 5, 6, 10],
    "coordinate_frame": [1, 5, 6, 7, 8, 9, 12],
    "param_id": [b"MPC_XY_P", b"NAV_DLL_ACT", b"_HASH_CHECK", b"\xff\xfe", b"MIS_TAKEOFF_ALT"],
    "param_type": [6, 9],
    "mission_type": [0, 1, 2, 255],
    "seq": [0, 1, 2, 65535],
    "count": [0, 1, 3, 65535],
}  # fmt: skip


def checksum(data: bytes, extra: int) -> bytes:
    return struct.pack("<H", mavlink.x25crc(data + bytes([extra])).crc)


def version_2(cls: Any, payload: bytes, sequence: int, flags: int = 0) -> bytes:
    header = struct.pack(
        "<BBBBBBBHB", 0xFD, len(payload), flags, 0, sequence & 255, 255, 190, cls.id & 0xFFFF, cls.id >> 16
    )
    return header + payload + checksum(header[1:] + payload, cls.crc_extra) + (b"s" * 13 if flags & 1 else b"")


def version_1(cls: Any, payload: bytes, sequence: int) -> bytes:
    header = struct.pack("<BBBBBB", 0xFE, len(payload), sequence & 255, 255, 190, cls.id)
    return header + payload + checksum(header[1:] + payload, cls.crc_extra)


class Storm:
    """Seeded frames of every kind expected from a broken, old, new or hostile client."""

    def __init__(self, seed: int, names: tuple[str, ...]) -> None:
        self.rng = random.Random(seed)
        self.classes = [MESSAGES[MESSAGE_ID[name]] for name in names]
        self.sequence = 0

    def payload(self, cls: Any) -> bytes:
        """Return random content for a message, with values that are likely to pass the first checks."""
        rng, size = self.rng, cls.unpacker.size
        data = bytearray(rng.randbytes(size))
        for at in range(0, size - 4, 4):
            if rng.random() < 0.5:
                data[at : at + 4] = rng.choice(_STRANGE_VALUES)
        if rng.random() < 0.8:
            values = list(cls.unpacker.unpack(data))
            for place, field in enumerate(cls.ordered_fieldnames):
                if field in _LIKELY and cls.lengths[place] == 1:
                    self._put(cls, values, place, rng.choice(_LIKELY[field]))
            data = bytearray(cls.unpacker.pack(*values))
        return bytes(data)

    @staticmethod
    def _put(cls: Any, values: list[Any], place: int, value: Any) -> None:
        at = sum(cls.lengths[:place])
        limit = {"b": 127, "B": 255, "h": 32767, "H": 65535}.get(cls.unpacker.format.strip("<")[-1], 65535)
        if isinstance(values[at], bytes) == isinstance(value, bytes):
            values[at] = value if isinstance(value, bytes) else min(value, limit, 255 if values[at] < 256 else 65535)

    def valid(self) -> bytes:
        """Return a frame with a valid checksum and any content."""
        rng = self.rng
        self.sequence += 1
        cls = rng.choice(self.classes)
        payload = self.payload(cls)
        if cls.id < 256 and rng.random() < 0.2:
            return version_1(cls, payload[: rng.randint(1, len(payload))], self.sequence)
        if rng.random() < 0.2:
            payload = payload[: rng.randint(1, len(payload))]
        elif rng.random() < 0.1:
            payload = (payload + rng.randbytes(20))[:255]
        return version_2(cls, payload, self.sequence, 1 if rng.random() < 0.1 else 0)

    def broken(self) -> bytes:
        """Return bytes that form a valid frame only by accident."""
        rng = self.rng
        frame = bytearray(self.valid())
        kind = rng.randrange(7)
        if kind == 0:
            for _ in range(rng.randint(1, 3)):
                frame[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del frame[rng.randrange(len(frame)) :]
        elif kind == 2:
            frame[1] = rng.randrange(256)
        elif kind == 3:
            frame = bytearray(rng.randbytes(rng.randrange(300)))
        elif kind == 4:
            frame = bytearray(rng.choice((b"\xfd", b"\xfe")) + rng.randbytes(rng.randrange(300)))
        elif kind == 5:
            end = frame[1] + (10 if frame[0] == 0xFD else 6)  # of the payload
            frame[end + 1] ^= 0x5A
        else:
            frame += frame[: rng.randrange(len(frame))] + rng.randbytes(3)
        return bytes(frame)


class Elsewhere(Vehicle):
    """The first vehicle, on ports far from those of a running simulation."""

    offboard_local_port = 34800
    offboard_remote_port = 24800
    gcs_local_port = 18800
    payload_local_port = 14510
    payload_remote_port = 14270


class World:
    """A simulated vehicle behind its MAVLink server; ``clock`` steps both."""

    def __init__(self) -> None:
        self.vehicle = Elsewhere("iris", 0, 0)
        self.simulation = Simulation((self.vehicle,), seed=3)
        self.simulation.commanders[0].parameters.set("MPC_TKO_RAMP_T", 1.0)  # soon in the air
        self.server = MavlinkServer((self.vehicle,), self.simulation.autopilot, self.simulation.commanders)
        self.client = Speaker(self.vehicle.offboard_remote_port, self.vehicle.offboard_local_port)

    def step(self) -> None:
        self.server.receive()
        self.simulation.step()
        self.server.send_streams(self.simulation.time_us)

    def close(self) -> None:
        self.client.close()
        self.server.close()
        self.simulation.close()


class Speaker:
    """A socket that sends to one of the vehicle's ports."""

    def __init__(self, own: int, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", own))
        self.socket.setblocking(False)
        self.remote = ("127.0.0.1", port)
        self.mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)

    def send(self, message: Any) -> None:
        self.send_bytes(message.pack(self.mav))
        self.mav.seq = self.mav.seq + 1 & 255

    def send_bytes(self, data: bytes) -> None:
        self.socket.sendto(data, self.remote)

    def receive(self) -> list[bytes]:
        found = []
        while True:
            try:
                found.append(self.socket.recv(65535))
            except BlockingIOError:
                return found

    def close(self) -> None:
        self.socket.close()


def resident() -> int:
    """Return the resident memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.fixture
def world():
    world = World()
    yield world
    world.close()


def rage(world: World, count: int, seed: int) -> None:
    """Send ``count`` frames to both ports while the vehicle flies on, and check its state and the memory."""
    storm = Storm(seed, world.server.messages)
    speakers = [
        world.client,
        *(Speaker(0, world.vehicle.gcs_local_port) for _ in range(5)),
    ]
    before = 0
    for sent in range(0, count, BATCH):
        for i in range(BATCH):
            frame = storm.valid() if storm.rng.random() < 0.5 else storm.broken()
            speakers[(sent + i) % len(speakers)].send_bytes(frame)
        world.step()
        while world.server.backlog:  # time is paused, so all messages are handled
            world.server.receive()
        for speaker in speakers:
            speaker.receive()
        if sent == count // 4 // BATCH * BATCH:
            before = resident()
    assert resident() - before < 30e6
    ports = world.server.ports
    assert sum(port.malformed for port in ports) > 0.3 * count * (1 - sum(port.dropped for port in ports) / count)
    assert sum(link.received for port in ports for link in port.links) > 0.1 * count
    world.client.send(mavlink.MAVLink_ping_message(4711, 1, 0, 0))
    for _ in range(300):
        world.step()
    answers = b"".join(world.client.receive())
    assert struct.pack("<Q", 4711)[:2] in answers
    for speaker in speakers[1:]:
        speaker.close()


def test_a_storm_of_frames_does_no_harm(world):
    rage(world, 40_000, seed=1)


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_a_storm_of_a_million_frames_does_no_harm(world):
    rage(world, 1_000_000, seed=2)


# floods in flight


def target(world: World, t: float) -> Any:
    """Return the velocity setpoint of a circle flown in OFFBOARD."""
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, SYSTEM, 1, 1, 0b110111000111, 0, 0, 0, 2.0 * math.cos(t), 2.0 * math.sin(t), -0.5 if t < 6.0 else 0.0,
        0, 0, 0, 0, 0,
    )  # fmt: skip


def command(number: int, *params: float) -> Any:
    values = [*params, *[0.0] * (7 - len(params))]
    return mavlink.MAVLink_command_long_message(SYSTEM, 1, number, 0, *values)


def harmless(rng: random.Random) -> Any:
    """Return a message that requests much and changes nothing."""
    return rng.choice(
        [
            mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3),
            mavlink.MAVLink_ping_message(1, 2, 0, 0),
            mavlink.MAVLink_timesync_message(0, 1),
            mavlink.MAVLink_param_request_read_message(SYSTEM, 1, b"MPC_XY_P", -1),
            mavlink.MAVLink_param_request_list_message(SYSTEM, 1),
            mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, 0),
            command(512, 32),
            command(511, 30, 4000),
        ]
    )


def fly(flood: int, ports: tuple[str, ...] = ()) -> tuple[bytes, list[bytes], World]:
    """Fly a circle by OFFBOARD for 10 s while strangers send ``flood`` frames a step to each of ``ports``.

    Returns:
        The truth at every step, the messages sent to the client, and the closed world with its counters.
    """
    world, rng = World(), random.Random(5)
    strangers = [Speaker(0, getattr(world.vehicle, port)) for port in ports for _ in range(MAX_CLIENTS + 10)]
    mav = mavlink.MAVLink(None, srcSystem=254, srcComponent=1)
    truth, heard = [], []
    for _ in range(500):  # until the estimator is ready
        world.step()
    for k in range(2500):
        if k % 12 == 0:
            world.client.send(target(world, k * 0.004))
        if k == 250:
            world.client.send(command(176, 1, 6))
            world.client.send(command(400, 1))
        for i in range(flood * len(ports)):
            frame = harmless(rng).pack(mav)
            if rng.random() < 0.3:
                frame = frame[:-1] + bytes([frame[-1] ^ 1])
            # one stranger sends much, the others a little
            strangers[0 if i % 4 else rng.randrange(len(strangers))].send_bytes(frame)
        world.step()
        truth.append(world.simulation.world.plant.tobytes())
        heard += world.client.receive()
        for stranger in strangers:
            stranger.receive()
    for stranger in strangers:
        stranger.close()
    world.close()
    return b"".join(truth), heard, world


@pytest.fixture(scope="module")
def quiet() -> tuple[bytes, list[bytes]]:
    truth, heard, world = fly(0)
    assert world.simulation.commanders[0].armed
    assert world.simulation.autopilot.estimator[0]["position"][2] < -0.5
    return truth, heard


@pytest.mark.parametrize("ports", [("offboard_local_port",), ("gcs_local_port",)])
def test_a_flood_of_10000_frames_a_second_changes_nothing_for_the_client(quiet, ports):
    truth, heard, world = fly(BATCH, ports)
    assert truth == quiet[0]
    assert heard == quiet[1]
    port = next(port for port in world.server.ports if port.local_port == getattr(world.vehicle, ports[0]))
    assert port.received >= 2500 * BATCH
    assert len(port.links) <= MAX_CLIENTS
