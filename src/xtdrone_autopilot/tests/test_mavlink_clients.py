"""Several MAVLink clients at once on the ports of one vehicle, through real UDP sockets."""

from __future__ import annotations

import contextlib
import gc
import select
import socket
import time
import weakref
from collections import Counter
from itertools import pairwise

import pytest
from autopilot_fakes import FIRST_ID
from pymavlink.dialects.v10 import common as version_1_dialect
from pymavlink.dialects.v20 import common as mavlink
from test_mavlink_server import Client, World, heartbeat, named

from xtdrone_autopilot.autopilot import STEP_US
from xtdrone_autopilot.mavlink.rate_limit import (
    CLIENT_CREDIT,
    MAX_CLIENT_CREDIT,
    MAX_CREDIT,
    STEP_CREDIT,
    VEHICLE_CREDIT,
)
from xtdrone_autopilot.mavlink.receiver import Receiver
from xtdrone_autopilot.mavlink.udp_port_and_clients import CLIENTS, MAX_CLIENTS, VEHICLE_CLIENTS
from xtdrone_autopilot.mavlink.wire.codec import decoder, split
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID, MESSAGES
from xtdrone_autopilot.mavlink.wire.frame_packing import Format, as_version_1
from xtdrone_common.fleet import GCS_REMOTE_PORT

_SYSTEM = FIRST_ID + 1
_REQUEST_POSITION = mavlink.MAVLink_command_long_message(_SYSTEM, 1, 512, 0, 32, 0, 0, 0, 0, 0, 0)


@pytest.fixture
def world():
    world = World()
    yield world
    world.close()


@pytest.fixture
def clients(world):
    """Four ground stations on the ground-station port; the first has the port that receives the heartbeats."""
    port = world.fleet[0].gcs_local_port
    made = [Client(GCS_REMOTE_PORT if i == 0 else 0, port, system=250 + i) for i in range(4)]
    for client in made:
        world.ask(heartbeat(6), client=client)
    yield made
    for client in made:
        client.socket.close()


def listen(world, clients, seconds):
    """Advance time while ``clients`` send a heartbeat each second; return what each of them receives."""
    heard = [[] for _ in clients]
    for client in clients:
        client.receive()
        client.datagrams.clear()
    for _ in range(round(seconds)):
        for client in clients:
            client.send(heartbeat(6))
        world.server.receive(1.0)
        world.run(1.0, 20_000)
        for client, messages in zip(clients, heard, strict=True):
            messages += client.receive()
    return heard


def test_all_hear_the_same_streams_with_sequence_numbers_of_their_own(world, clients):
    heard = listen(world, clients, 2.0)
    counts = [Counter(m.get_type() for m in messages) for messages in heard]
    assert counts[0]["ATTITUDE"] == 100
    assert all(count == counts[0] for count in counts)
    for client in clients:
        sequence = [frame[4] for datagram in client.datagrams for _, _, _, frame in split(datagram)]
        assert len(sequence) > 700
        assert all((after - before) % 256 == 1 for before, after in pairwise(sequence))


def test_intervals_are_a_clients_own(world, clients):
    second = clients[1]
    ask = mavlink.MAVLink_command_long_message(_SYSTEM, 1, 511, 0, 30, 1e6, 0, 0, 0, 0, 0)
    (ack,) = named(world.ask(ask, client=second), "COMMAND_ACK")
    assert (ack.result, ack.target_system) == (0, 251)
    counts = [len(named(messages, "ATTITUDE")) for messages in listen(world, clients, 2.0)]
    assert counts == [100, 2, 100, 100]


def test_replies_go_to_the_sender_and_texts_to_all(world, clients):
    (ack,) = named(world.ask(mavlink.MAVLink_command_long_message(_SYSTEM, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0),
                             client=clients[2]), "COMMAND_ACK")  # fmt: skip
    assert (ack.result, ack.target_system, ack.target_component) == (0, 252, 190)
    others = [clients[0], clients[1], clients[3]]
    assert not any(named(client.receive(), "COMMAND_ACK") for client in others)
    world.run(0.1)
    for client in clients:
        assert [m.text for m in named(client.receive(), "STATUSTEXT")] == ["Armed by external command\t"]


def test_a_silent_client_is_dropped_and_may_reconnect(world, clients, monkeypatch):
    wall = [0.0]
    monkeypatch.setattr("xtdrone_autopilot.mavlink.client_link.time.monotonic", lambda: wall[0])
    for client in clients:
        world.ask(heartbeat(6), client=client)
    port = world.server.ports[1]
    wall[0] += 6.0
    listen(world, clients[:2], 6.0)
    assert [link.peer[1] for link in port.links] == [c.socket.getsockname()[1] for c in clients[:2]]
    clients[3].receive()
    listen(world, clients[:2], 1.0)
    assert not clients[3].receive()
    world.ask(heartbeat(6), client=clients[3])
    world.run(1.0)
    assert named(clients[3].receive(), "ATTITUDE")


def test_messages_to_a_dropped_client_are_discarded(world, clients):
    link = world.server.ports[1].links[3]
    link.close()
    clients[3].receive()
    for _ in range(1000):
        link.send_text(6, "no client receives this")
    link.flush(world.autopilot.time_us)
    assert link.waiting == 0
    assert not clients[3].receive()


def test_unknown_ports_use_no_slot_of_clients_and_no_memory(world, clients, caplog):
    port = world.server.ports[1]
    strangers = [Client(0, world.fleet[0].gcs_local_port) for _ in range(200)]
    for stranger in strangers:
        stranger.send(heartbeat(6))
        world.server.receive(1.0)
    assert len(port.links) == MAX_CLIENTS
    assert port.refused == 200 - (MAX_CLIENTS - 4)
    assert caplog.text.count("is not served: there are already 16 clients") == 1
    for stranger in strangers:
        stranger.socket.close()
    heard = listen(world, clients, 2.0)
    assert [len(named(messages, "ATTITUDE")) for messages in heard] == [100] * 4


def test_clients_of_all_ports_share_one_room():
    world = World(3)
    ports = world.server.ports
    taken = 0
    for number in range(1000, 1012):
        for port in ports:
            link = port.link_of(("127.0.0.1", number), 0)
            if link is not None:
                link.heard(0, 2)
                taken += 1
    assert taken == CLIENTS + 3 * VEHICLE_CLIENTS
    ports[0].send_due(6_000_000, {})  # the silent clients of one port are dropped
    assert ports[5].link_of(("127.0.0.1", 2000), 6_000_000) is not None
    world.close()


def test_all_ports_recover_while_time_is_paused(monkeypatch):
    """Stations that fill the room of every other port keep a newcomer out for 5 s of wall time at most."""
    wall = [0.0]
    monkeypatch.setattr("xtdrone_autopilot.mavlink.client_link.time.monotonic", lambda: wall[0])
    world = World(3)
    stations = [port for port in world.server.ports if port.by_wall]
    for number in range(1000, 1000 + CLIENTS + 3 * VEHICLE_CLIENTS):
        stations[1 + number % 2].link_of(("127.0.0.1", number), 0).heard(0, 2)
    assert stations[0].link_of(("127.0.0.1", 2000), 0) is None
    wall[0] = 5.5
    assert stations[0].link_of(("127.0.0.1", 2000), 0) is not None
    world.close()


def test_stations_may_connect_and_disconnect_while_time_is_paused(world, monkeypatch):
    wall = [0.0]
    monkeypatch.setattr("xtdrone_autopilot.mavlink.client_link.time.monotonic", lambda: wall[0])
    port = world.server.ports[1]
    now_us = world.autopilot.time_us
    for number in range(1000, 1000 + 10 * MAX_CLIENTS):
        wall[0] += 1.0
        link = port.link_of(("127.0.0.1", number), now_us)
        assert link is not None
        link.heard(now_us, 2)


def test_strangers_that_have_gone_are_not_counted_for_ever(world):
    port = world.server.ports[0]
    for number in range(1000, 2000):
        link = port.link_of(("127.0.0.1", number), world.autopilot.time_us)
        link.heard(world.autopilot.time_us, 2)
        port.sent[number] = 1
        world.autopilot.time_us += 5_100_000
        port.send_due(world.autopilot.time_us, {})
    assert len(port.sent) <= 257
    assert {1999, world.fleet[0].offboard_remote_port} <= set(port.sent)
    assert port.links == [port.default]


def test_a_removed_client_is_freed_at_once(world, clients, monkeypatch):
    """It neither waits for the garbage collector in a cycle nor remains in a table."""
    wall = [time.monotonic()]
    monkeypatch.setattr("xtdrone_autopilot.mavlink.client_link.time.monotonic", lambda: wall[0])
    links = weakref.WeakSet(world.server.ports[1].links[1:])
    world.run(0.1)
    assert len(links) == 3
    assert all(link.streams.active for link in links)
    wall[0] += 6.0
    world.autopilot.time_us += 5_100_000
    gc.disable()
    try:
        world.run(1.0, 20_000)
        assert not links
    finally:
        gc.enable()


def frames_of(kind, system=_SYSTEM):
    """Return a message of a flood, or bytes that are not MAVLink."""
    messages = {
        "command": mavlink.MAVLink_command_long_message(system, 1, 512, 0, 32, 0, 0, 0, 0, 0, 0),
        "refused command": mavlink.MAVLink_command_long_message(system, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0),
        "setpoint": mavlink.MAVLink_set_position_target_local_ned_message(
            0, system, 1, 1, 0b110111000111, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0
        ),
        "parameter": mavlink.MAVLink_param_set_message(system, 1, b"MPC_XY_P", 0.9, 9),
        "mission item": mavlink.MAVLink_mission_item_int_message(system, 1, 1, 6, 16, 0, 1, 0, 0, 0, 0, 1, 1, 20, 0),
        "file": mavlink.MAVLink_file_transfer_protocol_message(0, system, 1, [1, 0, 0, 3, 1, *[0] * 7, 47, *[0] * 238]),
        "heartbeat": heartbeat(6),
    }
    return messages[kind].pack(mavlink.MAVLink(None, srcSystem=250)) if kind in messages else bytes(range(1, 120))


class Flooder:
    """Sends one datagram many times a step from several sockets, and reads the replies."""

    def __init__(self, own, port, count=1):
        self.sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
        for one in self.sockets:
            one.bind(("127.0.0.1", own))
            one.setblocking(False)
        self.remote = ("127.0.0.1", port)

    def send(self, datagram, count):
        for i in range(count):
            self.sockets[i % len(self.sockets)].sendto(datagram, self.remote)

    def drain(self):
        for one in self.sockets:
            with contextlib.suppress(BlockingIOError):
                while True:
                    one.recv(65535)

    def close(self):
        for one in self.sockets:
            one.close()


@pytest.fixture
def acted(monkeypatch):
    """Return the senders of all handled datagrams."""
    senders = []
    handle_datagram = Receiver.handle_datagram

    def note(self, port, datagram, sender, now_us, **options):
        senders.append(sender)
        handle_datagram(self, port, datagram, sender, now_us, **options)

    monkeypatch.setattr(Receiver, "handle_datagram", note)
    return senders


_STEPS = 200
_FLOOD = 40  # frames a step: 10,000 a second


@pytest.mark.parametrize("kind", ["command", "refused command", "setpoint", "parameter", "mission item", "file",
                                  "heartbeat", "garbage"])  # fmt: skip
@pytest.mark.parametrize(("link", "own", "count"), [
    ("offboard", "offboard_remote_port", 1), ("offboard", "", 1), ("payload", "payload_remote_port", 1),
    ("gcs", "gcs", 1), ("gcs", "", 4),
])  # fmt: skip
def test_frames_handled_in_a_step_are_bounded_for_every_sender(world, acted, kind, link, own, count):
    vehicle = world.fleet[0]
    world.client.socket.close()
    source = GCS_REMOTE_PORT if own == "gcs" else getattr(vehicle, own, 0)
    flooder = Flooder(source, getattr(vehicle, f"{link}_local_port"), count)
    datagram = frames_of(kind)
    for _ in range(_STEPS):
        flooder.send(datagram, _FLOOD)
        world.server.receive()
        world.autopilot.time_us += STEP_US
        world.server.send_streams(world.autopilot.time_us)
        flooder.drain()
    own_credit = count * (MAX_CLIENT_CREDIT + _STEPS * CLIENT_CREDIT)
    assert 0 < len(acted) <= MAX_CREDIT + _STEPS * (STEP_CREDIT + VEHICLE_CREDIT) + own_credit + 2
    flooder.close()


def test_a_modest_client_is_answered_at_once_during_a_flood(world, clients):
    flooders = [Flooder(0, port, 3) for port in (world.fleet[0].gcs_local_port, world.fleet[0].offboard_local_port)]
    world.server.receive()
    for step in range(_STEPS):
        for flooder in flooders:
            flooder.send(frames_of("command"), _FLOOD)
        asks = step % 20 == 19
        if asks:
            clients[2].receive()
            clients[2].send(_REQUEST_POSITION)
        world.server.receive()
        assert len(named(clients[2].receive(), "COMMAND_ACK")) == asks
        world.autopilot.time_us += STEP_US
        for flooder in flooders:
            flooder.drain()
    assert world.server.ports[1].dropped > 0
    for flooder in flooders:
        flooder.close()


def test_a_transfer_in_small_steps_loses_nothing_at_full_speed(world):
    """No piece is lost when each simulated step takes as long as the server's reply to a request."""
    station = Client(0, world.fleet[0].gcs_local_port)
    read = mavlink.MAVLink_param_request_read_message(_SYSTEM, 1, b"MPC_XY_P", -1)
    for _ in range(1000):
        assert named(world.ask(read, client=station), "PARAM_VALUE")
        world.autopilot.time_us += STEP_US
    assert world.server.ports[1].dropped == 0
    station.socket.close()


def test_excess_requests_are_answered_later(world, clients, caplog):
    flooder, stranger = clients[1], Client(0, world.fleet[0].gcs_local_port)
    for client in (flooder, stranger):
        for _ in range(150):  # a socket's buffer holds only some hundred messages
            client.send(_REQUEST_POSITION)
    clients[2].send(_REQUEST_POSITION)
    world.server.receive(1.0)
    assert len(named(clients[2].receive(), "LOCAL_POSITION_NED")) == 1
    answered = len(named(flooder.receive(), "COMMAND_ACK"))
    assert 10 < answered < 150
    assert "unknown senders send more than can be served" in caplog.text
    assert world.server.backlog
    while world.server.backlog:
        world.server.receive()
        answered += len(named(flooder.receive(), "COMMAND_ACK"))
    assert answered == 150
    stranger.socket.close()


class TestParticipants:
    """Clients whose datagrams the lockstep counts."""

    def exhaust(self, world, flooder):
        """Use up all credit by a flood in the middle of a tick, until only participants wake the server."""
        world.server.receive()
        world.server.hold_setpoints()
        world.server.keep_alive()
        for _ in range(30):
            flooder.send(frames_of("command"), _FLOOD)
            world.server.receive()
            flooder.drain()
        flooder.send(frames_of("command"), _FLOOD)
        assert not select.select([world.server], [], [], 0.0)[0]

    @pytest.fixture
    def flooder(self, world):
        made = Flooder(0, world.fleet[0].offboard_local_port)
        yield made
        made.close()

    def test_all_that_they_send_in_a_flood_is_acted_on_at_once(self, world, flooder, acted):
        participant = world.client.socket.getsockname()
        world.server.reserve({participant[1]: {"127.0.0.1", "10.0.0.2"}})
        self.exhaust(world, flooder)
        for _ in range(300):
            world.client.send(_REQUEST_POSITION)
        assert select.select([world.server], [], [], 0.0)[0]
        acted.clear()
        assert world.server.receive() == 300
        assert acted.count(participant) == 300
        world.server.release_setpoints()
        assert select.select([world.server], [], [], 0.0)[0], "after the tick all clients are served"

    def test_a_full_buffer_of_one_client_leaves_the_others_theirs(self, world, flooder, acted):
        participant = world.client.socket.getsockname()
        world.server.reserve({participant[1]: {"127.0.0.1"}})
        flooder.send(bytes(1000), 5000)
        world.client.send(_REQUEST_POSITION)
        assert world.server.receive() < 5000
        assert acted.count(participant) == 1

    def test_earlier_and_later_messages_keep_their_order(self, world):
        numbers = []
        port = world.client.socket.getsockname()[1]
        vehicle = world.server._vehicles[0]
        vehicle.receiver.handle_datagram = lambda port, datagram, *_, **__: numbers.append(datagram[0])
        for number, peers in enumerate([{}, {port: {"127.0.0.1"}}, {port: {"127.0.0.1"}}, {}, {}]):
            world.client.socket.sendto(bytes([number]), world.client.remote)
            world.server.reserve(peers)
        world.server.receive()
        assert numbers == [0, 1, 2, 3, 4]
        assert world.server.received[vehicle.ports[0].local_port] == 5

    def test_the_port_is_not_shared_with_other_programs(self, world):
        port = world.server.ports[0]
        world.server.reserve({port.remote_port: {"127.0.0.1"}})
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with pytest.raises(OSError, match="in use"):
                other.bind(("127.0.0.1", port.local_port))

    def test_other_clients_are_served_in_a_long_tick(self, world, flooder, acted, monkeypatch):
        self.exhaust(world, flooder)
        wall = time.monotonic() + 1.0
        monkeypatch.setattr("xtdrone_autopilot.mavlink.mavlink_server.time.monotonic", lambda: wall)
        acted.clear()
        world.server.keep_alive()
        world.server.receive()
        assert 0 < len(acted) < _FLOOD


def test_the_payload_link_keeps_to_its_bandwidth(world):
    vehicle = world.fleet[0]
    payload = Client(vehicle.payload_remote_port, vehicle.payload_local_port)
    world.run(0.1)
    world.ask(heartbeat(18), client=payload)
    (messages,) = listen(world, [payload], 20.0)
    assert len(named(messages, "HEARTBEAT")) == 20
    assert 0.5 * 80_000 < sum(map(len, payload.datagrams)) < 80_000
    payload.socket.close()


# of the messages below
_EXTENSIONS = {
    "thrust_body", "buttons2", "enabled_extensions", "s", "t", "aux1", "aux2", "aux3", "aux4", "aux5", "aux6",
}  # fmt: skip


class TestVersion1:
    def client(self, world):
        client = Client(0, world.fleet[0].gcs_local_port)
        send = client.socket.sendto
        client.send = lambda m: send(m.pack(client.mav, force_mavlink1=True), client.remote)
        return client

    def test_is_answered_in_version_1(self, world):
        client = self.client(world)
        world.ask(heartbeat(6), client=client)
        answers = world.ask(_REQUEST_POSITION, client=client)
        assert [m.get_type() for m in answers] == ["LOCAL_POSITION_NED", "COMMAND_ACK"]
        world.run(1.0)
        client.receive()
        assert {datagram[0] for datagram in client.datagrams} == {0xFE}
        client.socket.close()

    def test_a_client_that_turns_to_version_2_is_answered_in_it(self, world):
        client = self.client(world)
        world.ask(heartbeat(6), client=client)
        del client.send  # the instance attribute; the class's method sends version 2
        world.ask(_REQUEST_POSITION, client=client)
        assert {datagram[0] for datagram in client.datagrams} == {0xFD}
        client.socket.close()

    def test_others_are_answered_in_version_2(self, world, clients):
        client = self.client(world)
        world.ask(heartbeat(6), client=client)
        listen(world, [client, *clients], 1.0)
        assert {datagram[0] for datagram in client.datagrams} == {0xFE}
        assert {datagram[0] for datagram in clients[0].datagrams} == {0xFD}
        client.socket.close()

    @pytest.mark.parametrize(("setting", "first", "answer"), [(0, 0xFE, 0xFD), (1, 0xFE, 0xFE), (2, 0xFD, 0xFD)])
    def test_mav_proto_ver(self, setting, first, answer):
        world = World()
        world.commander.parameters.set("MAV_PROTO_VER", setting)
        world.server.close()
        world.server = type(world.server)(world.fleet, world.autopilot, world.commanders)
        world.run(1.0)
        assert {datagram[0] for datagram in world.client.datagrams} == {first}
        world.hear()
        world.client.datagrams.clear()
        world.run(1.0)
        assert {datagram[0] for datagram in world.client.datagrams} == {answer}
        world.close()

    @pytest.mark.parametrize("name", ["SET_ATTITUDE_TARGET", "MANUAL_CONTROL"])
    def test_extension_fields_of_received_frames_are_zero(self, name):
        cls = MESSAGES[MESSAGE_ID[name]]
        size = version_1_dialect.mavlink_map[cls.id].unpacker.size
        frame = as_version_1(Format(name).frame(bytes(range(1, size + 1)), 0, 7, 8))
        message = decoder(name)(frame)
        for field in cls.fieldnames:
            value = getattr(message, field)
            assert (value in (0, 0.0, [0.0] * 3, (0.0,) * 3)) == (field in _EXTENSIONS), field

    def test_extension_fields_and_large_ids_are_omitted(self):
        parser = mavlink.MAVLink(None)
        values = (-1, -1, 0, *[7] * 10, -1, 0, 1, 1, 100, 0, 1, 9, 9, 9, 9, 3, 5)
        status = Format("BATTERY_STATUS")
        frame = as_version_1(status.frame(status.payload(values), 3, 1, 1))
        assert (frame[0], frame[1], len(frame)) == (0xFE, 36, 44)
        message = parser.decode(bytearray(frame))
        assert (message.voltages[9], message.battery_remaining, message.voltages_ext[0]) == (7, 100, 0)
        origin = Format("UTM_GLOBAL_POSITION")
        assert as_version_1(origin.frame(b"\0", 0, 1, 1)) is None


def test_a_signed_frame_is_accepted_like_an_unsigned_one(world):
    client = Client(0, world.fleet[0].gcs_local_port)
    client.mav.signing.secret_key = b"k" * 32
    client.mav.signing.sign_outgoing = True
    client.send(_REQUEST_POSITION)
    client.mav.signing.secret_key = None
    world.server.receive(1.0)
    assert named(client.receive(), "LOCAL_POSITION_NED")
    assert not any(datagram[2] & 1 for datagram in client.datagrams), "answers are not signed"
    client.socket.close()


def test_no_socket_remains_open(world):
    ports = [port.local_port for port in world.server.ports]
    world.server.close()
    for number in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", number))


def test_a_key_for_signing_is_rejected_with_one_text(world):
    setup = mavlink.MAVLink_setup_signing_message(_SYSTEM, 1, list(range(32)), 7)
    world.ask(setup)
    world.ask(setup)
    texts = [m.text for m in named(world.run(0.1), "STATUSTEXT")]
    assert texts == ["MAVLink signing is not supported"]


def test_a_vehicle_that_leaves_frees_ports_and_clients_and_counts_go_on(world):
    vehicle = world.fleet[0]
    others = [Client(0, vehicle.gcs_local_port, system=200 + i) for i in range(2)]
    for other in others:
        world.ask(heartbeat(6), client=other)
    world.run(1.0, 20_000)
    before, free = dict(world.server.sent), world.server._limit.left
    received = world.server.received[vehicle.gcs_local_port]
    assert received == 2
    world.server.remove_vehicle(0)
    assert world.server.sent == before
    assert vehicle.gcs_local_port not in world.server.received
    assert world.server._limit.left == free + 2 - VEHICLE_CLIENTS
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", vehicle.gcs_local_port))
    world.run(1.0, 20_000)
    assert world.server.sent == before
    world.server.add_vehicle(0, vehicle, {vehicle.gcs_local_port: 9})
    assert world.server.received[vehicle.gcs_local_port] == 9
    world.ask(heartbeat(6), client=others[0])
    world.run(1.0, 20_000)
    assert world.server.received[vehicle.gcs_local_port] == 10
    assert all(world.server.sent[port] >= count for port, count in before.items())
    assert world.server.sent != before
    for other in others:
        other.socket.close()
