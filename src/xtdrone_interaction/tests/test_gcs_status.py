"""Status of vehicles in the ground station, and its links."""

from __future__ import annotations

import io
import json
import os
import pty
import selectors
import socket
import threading
import tty
from types import SimpleNamespace

import pytest
from gcs_field import FIRST, Field, LossyLine
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_interaction.gcs import GcsError, Peer, search_for_vehicles
from xtdrone_interaction.gcs.exchanges import exchange
from xtdrone_interaction.gcs.station import GroundStation
from xtdrone_interaction.gcs.udp_tcp_serial import open_connection, split_stream
from xtdrone_interaction.gcs.vehicle_addresses import choose_systems, numbered, parse_address
from xtdrone_interaction.gcs.vehicle_state import VehicleState
from xtdrone_interaction.gcs_commands import status_table as status_command
from xtdrone_interaction.gcs_commands.gcs_cli import main
from xtdrone_interaction.gcs_commands.terminal_output import Screen

PATIENCE = 120.0  # s; only a broken run takes so long


@pytest.fixture(scope="module")
def field():
    field = Field()
    yield field
    field.close()


@pytest.fixture
def lossy(field):
    line = LossyLine(field.ports, 0.3, 3)
    yield line
    line.close()


def words(field):
    return [str(vehicle.id) for vehicle in field.vehicles]


def test_all_vehicles_are_found_with_their_system_ids(field):
    found = {peer.port: peer for peer in search_for_vehicles.find(limit=PATIENCE)}
    assert [found[v.gcs_local_port].system for v in field.vehicles] == [v.system_id for v in field.vehicles]
    assert found[field.vehicles[0].gcs_local_port].name == f"vehicle_{FIRST}"


def test_status_once_while_time_is_paused(field, capsys):
    assert main(["status", "--once", "--vehicle", *words(field)]) == 0
    titles, *rows = capsys.readouterr().out.splitlines()
    assert titles.split()[:4] == ["VEHICLE", "SYS", "TYPE", "ARMED"]
    assert [row.split()[:4] for row in rows] == [
        [f"vehicle_{v.id}", str(v.system_id), "quadrotor", "no"] for v in field.vehicles
    ]


def test_status_as_json(field, capsys):
    assert main(["status", "--once", "--json", "--vehicle", f"{FIRST}-{FIRST + 1}"]) == 0
    first, second = json.loads(capsys.readouterr().out)
    assert (first["system"], second["system"]) == (FIRST + 1, FIRST + 2)
    assert first["autopilot"] == "px4"
    assert first["armed"] is False
    assert first["age"] < PATIENCE


def test_a_silent_vehicle_is_reported_beside_the_others(field, capsys):
    assert main(["status", "--once", "--patience", "3", "--vehicle", str(FIRST), "240"]) == 1
    caught = capsys.readouterr()
    assert f"vehicle_{FIRST} " in caught.out
    assert "no message yet" in caught.out
    assert "vehicle_240: UDP 127.0.0.1:18810: no program listens there" in caught.err


def test_status_over_a_line_that_loses_a_third(field, lossy):
    peers = [Peer(name, 0, "127.0.0.1", port) for name, port in lossy.ports.items()]
    with GroundStation(peers) as ground:
        results = ground.run(dict.fromkeys(peers, exchange.request_state), timeout=0.05, patience=PATIENCE)
        assert set(results.values()) == {None}
        assert [state.system for state in ground.states()] == [v.system_id for v in field.vehicles]


def test_a_station_in_a_separate_thread_reports_changes_and_sends_heartbeats(field):
    heard = threading.Event()
    peers = field.peers()
    before = [commander.health._gcs_us for commander in field.commanders]
    station_ = GroundStation(peers, heartbeat=True, on_change=lambda state: state.mode and heard.set())
    station_.start()
    futures = [station_.submit(peer, exchange.request_state, patience=PATIENCE) for peer in peers]
    assert [future.result(PATIENCE) for future in futures] == [None] * len(peers)
    assert set(station_.run(dict.fromkeys(peers, exchange.request_state), patience=PATIENCE).values()) == {None}
    assert heard.wait(PATIENCE)
    station_.close()
    assert before == [None] * len(peers)
    assert all(commander.health._gcs_us is not None for commander in field.commanders)
    with pytest.raises(GcsError, match="the station is closed"):
        station_.submit(peers[0], exchange.request_state)


def test_queued_jobs_can_be_cancelled_and_running_ones_end_with_the_station(field):
    def endless(beat):
        while True:
            yield []

    def broken(beat):
        yield []
        raise ZeroDivisionError

    with GroundStation(field.peers()) as ground:
        first, second = ground.peers[:2]
        running = ground.submit(first, endless, patience=PATIENCE)
        waiting = ground.submit(first, exchange.request_state)
        flawed = ground.submit(second, broken)
        fine = ground.submit(second, exchange.request_state, patience=PATIENCE)
        ground.poll(0.0)
        assert waiting.cancel()
        while not fine.done():
            ground.poll(0.1)
    assert isinstance(flawed.exception(), ZeroDivisionError)
    with pytest.raises(GcsError, match="the station is closed"):
        running.result(0.0)


def test_a_failing_watcher_is_logged_and_the_station_continues(field, caplog):
    def fail(state):
        raise ZeroDivisionError("a fault of the caller's")

    peers = field.peers()
    with GroundStation(peers, on_change=fail) as ground:
        ground.start()
        futures = [ground.submit(peer, exchange.request_state, patience=PATIENCE) for peer in peers]
        assert [future.result(PATIENCE) for future in futures] == [None] * len(peers)
    assert "typhoon_h480_0: on_change of the ground station has failed" in caplog.text
    with GroundStation(peers, on_change=fail) as ground, pytest.raises(ZeroDivisionError):  # the caller's own thread
        ground.run({peers[0]: exchange.request_state}, patience=PATIENCE)


class Cable:
    """A pseudo-terminal as the serial line to a vehicle's UDP port."""

    def __init__(self, port):
        self._vehicle, self._device = pty.openpty()
        tty.setraw(self._device)
        self.device = os.ttyname(self._device)
        self._rest = b""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        with selectors.DefaultSelector() as selector:
            for source in (self._vehicle, self._socket):
                selector.register(source, selectors.EVENT_READ)
            while not self._ended.is_set():
                for key, _ in selector.select(0.01):
                    if key.fileobj is self._socket:
                        os.write(self._vehicle, self._socket.recv(65535))
                        continue
                    frames, self._rest = split_stream(self._rest + os.read(self._vehicle, 4096))
                    for frame in frames:
                        self._socket.send(frame)

    def pull(self):
        """Remove the device."""
        self._ended.set()
        self._thread.join()
        os.close(self._device)
        os.close(self._vehicle)
        self._socket.close()


def test_a_serial_line_that_is_pulled_in_the_end(field, capsys):
    cable = Cable(field.vehicles[1].gcs_local_port)
    address = f"serial:{cable.device}:57600"
    try:
        wanted = ["--connect", address, "--vehicle", str(FIRST + 2)]
        assert main(["status", "--once", *wanted]) == 0
        assert f"system_{FIRST + 2}  {FIRST + 2}" in capsys.readouterr().out
        assert main(["params", "get", "MAV_SYS_ID", *wanted]) == 0
        assert capsys.readouterr().out.split() == [f"system_{FIRST + 2}", "MAV_SYS_ID", str(FIRST + 2)]
        peer = Peer("radio", FIRST + 2, cable.device, 57600, "serial")
        with GroundStation([peer]) as ground:
            assert str(GroundStation([peer]).errors["radio"]).startswith(
                f"radio: {cable.device} at 57600 baud cannot be"
            )
            ground.run({peer: exchange.request_state}, patience=PATIENCE)
            future = ground.submit(peer, exchange.request_state)
            cable.pull()
            while not future.done():
                ground.poll(1.0)
            assert ground.states() == []
        with pytest.raises(GcsError, match=rf"radio: {cable.device} at 57600 baud: the device"):
            future.result()
    finally:
        if not cable._ended.is_set():
            cable.pull()
    assert main(["status", "--once", *wanted]) == 1
    assert f"{cable.device} at 57600 baud cannot be opened: No such file" in capsys.readouterr().err


def test_several_vehicles_over_one_line(field):
    """The station separates the frames of all vehicles at one port, as from a router."""
    mav = [mavlink.MAVLink(None, srcSystem=system, srcComponent=1) for system in (3, 7)]
    beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1 | 128, 5, 4, 3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    ended = threading.Event()

    def fly():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as router:
            while not ended.wait(0.02):
                for each in mav:
                    router.sendto(beat.pack(each), ("127.0.0.1", port))

    thread = threading.Thread(target=fly)
    thread.start()
    try:
        peers = search_for_vehicles.listen(("udpin", "127.0.0.1", port), 2.0)
        assert [peer.system for peer in peers] == [3, 7]
        with GroundStation(peers) as ground:
            greeted = ground.run({peer: exchange.await_heartbeat(peer.system) for peer in peers}, patience=PATIENCE)
            assert [beat.system for beat in greeted.values()] == [3, 7]
            refused = ground.run(dict.fromkeys(peers, exchange.request_state), patience=PATIENCE)
            states = ground.states()
    finally:
        ended.set()
        thread.join()
    assert [(state.mode, state.armed, state.autopilot) for state in states] == [("mode 5", True, "ardupilotmega")] * 2
    assert {str(result) for result in refused.values()} == {
        f"system_{system}: autopilot: ardupilotmega is not supported, only PX4" for system in (3, 7)
    }


def test_a_tcp_line_that_ends(field):
    with socket.create_server(("127.0.0.1", 0)) as server:
        peer = Peer("a", 1, "127.0.0.1", server.getsockname()[1], "tcp")
        with GroundStation([peer]) as ground:
            future = ground.submit(peer, exchange.request_state)
            connection, _ = server.accept()
            ground.poll(0.0)
            connection.close()
            while not future.done():
                ground.poll(1.0)
        with pytest.raises(GcsError, match=r"the other end has closed the connection|is broken"):
            future.result()
    with pytest.raises(GcsError, match="cannot be reached"):
        open_connection(*peer.address)


# ---- status of a vehicle


def message(text, part=0, number=0):
    return SimpleNamespace(severity=3, text=text, id=number, chunk_seq=part)


def test_texts_in_parts_are_put_together_and_made_fit_to_show():
    state = VehicleState("a")
    for part in (message("Preflight Fail: ", 0, 5), message("no GPS\t", 1, 5), message("\x1b[2Jother")):
        state.update("STATUSTEXT", part, 1.0)
    assert [text for _, text in state.texts] == ["Preflight Fail:no GPS", "?[2Jother"]


def test_places_have_the_digits_of_the_wire():
    state = VehicleState("a", 1)
    place = {"lat": 473977419, "lon": -85455941, "alt": 488123, "relative_alt": -1}
    state.update("GLOBAL_POSITION_INT", SimpleNamespace(**place, vx=30, vy=40, vz=-5, hdg=65535), 1.0)
    state.update("LOCAL_POSITION_NED", SimpleNamespace(x=1.23449, y=-0.1 - 0.2, z=-4.0, vx=0.0, vy=0.0, vz=0.0), 1.0)
    told = json.dumps(state.as_json(1.0))
    for text in ('"latitude": 47.3977419', '"longitude": -8.5455941', '"altitude": 488.123', '"height": -0.001',
                 '"local": [-0.3, 1.234, 4.0]', '"speed": 0.5', '"climb": 0.05', '"heading": null'):  # fmt: skip
        assert f"{text}," in told


def test_a_screen_draws_in_place_and_truncates_long_lines(monkeypatch):
    monkeypatch.setenv("COLUMNS", "10")
    monkeypatch.setenv("LINES", "4")
    written = io.StringIO()
    screen = Screen(written)
    screen.draw(["x" * 30])
    screen.draw(["a", "b", "c", "d"])
    assert written.getvalue() == (
        "\x1b[2K" + "x" * 9 + "\n\x1b[J" + "\x1b[1A\x1b[2Ka\n\x1b[2Kb\n\x1b[2K... and 2\n\x1b[J"
    )
    monkeypatch.setenv("COLUMNS", "8")
    screen.draw(["a"])
    assert written.getvalue().endswith("\x1b[2J\x1b[H\x1b[2Ka\n\x1b[J")


def test_a_narrow_table_omits_the_least_important_columns_and_no_text():
    states = [VehicleState(f"iris_{i}", i + 1, heard=9.0, kind="quadrotor", mode="AUTO.LOITER") for i in range(2)]
    states[1].texts = [(4, "Disarming denied! Not landed")]
    assert status_command.table(states, 10.0)[2].split() == [
        *("iris_1", "2", "quadrotor", "-", "AUTO.LOITER", "-", "-", "-", "-", "-", "-"),
        *("Disarming", "denied!", "Not", "landed"),
    ]
    wide = status_command.table(states, 10.0, 79)
    assert wide[0].split() == ["VEHICLE", "ARMED", "MODE", "X", "Y", "Z", "HEIGHT", "SPEED", "BATTERY"]
    narrow = status_command.table(states, 10.0, 39)
    assert [line.split() for line in narrow[:3]] == [
        ["VEHICLE", "ARMED", "MODE", "HEIGHT"], ["iris_0", "-", "AUTO.LOITER", "-"], ["iris_1", "-", "AUTO.LOITER", "-"]
    ]  # fmt: skip
    for lines in (wide, narrow):
        assert lines[3:] == ["iris_1: Disarming denied! Not landed"]
        assert max(map(len, lines[:3])) <= 39 + 40 * (lines is wide)


# ---- words and lines


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--vehicle", "5-2"], "'5-2' is not allowed, the lower number first"),
        (["--vehicle", "250"], "250 is not allowed, 0 to 249"),
        (["--vehicle", "3", "--fleet", "iris:3"], "3 is not allowed, 0 to 2"),
        (["--connect", "udp:1:2"], "'udp:1:2' is not allowed, udpout, udpin or tcp with host and port"),
        (["--connect", "serial:/dev/ttyACM0"], "or serial:DEVICE:BAUD"),
        (["--connect", "tcp:host:0"], "'tcp:host:0' is not allowed"),
    ],
)
def test_vehicles_that_lead_nowhere(arguments, message, capsys):
    assert main(["status", "--once", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_an_invalid_host(capsys):
    assert main(["status", "--once", "--host", "a..b"]) == 1
    assert capsys.readouterr().err.startswith("xtdrone gcs: a..b: no such machine: ")
    assert main(["status", "--once", "--connect", "udpout:a..b:14550"]) == 1
    assert "UDP a..b:14550 cannot be reached" in capsys.readouterr().err


def test_numbers_and_systems():
    assert numbered(4, "iris:3,solo:2").name == "solo_1"
    assert parse_address("tcp:localhost:5760") == ("tcp", "localhost", 5760)
    assert parse_address("serial:/dev/ttyUSB0:921600") == ("serial", "/dev/ttyUSB0", 921600)
    found = [Peer(f"system_{system}", system, "h", 1) for system in (1, 2, 5)]
    assert choose_systems(["1-2", "system_5", "1"], found) == found
    with pytest.raises(GcsError, match="of the systems on this connection: 1, 2, 5"):
        choose_systems(["3"], found)


FRAMES = [
    mavlink.MAVLink_heartbeat_message(2, 12, 0, custom, 4, 3).pack(mavlink.MAVLink(None, srcSystem=1))
    for custom in range(4)
]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from(FRAMES)), st.lists(st.integers(1, 30), min_size=1), st.binary(max_size=5))
def test_a_stream_is_split_into_frames_at_any_chunk_size(frames, sizes, noise):
    stream = bytes(set(noise) - {0xFD, 0xFE}) + b"".join(frames)
    found, rest = [], b""
    while stream:
        size = sizes[len(found) % len(sizes)]
        part, stream = stream[:size], stream[size:]
        new, rest = split_stream(rest + part)
        found += new
    assert found == frames
    assert rest == b""
