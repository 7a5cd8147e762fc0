"""Logs over MAVLink by the log protocol and FTP, with clients on real UDP sockets that also lose messages."""

from __future__ import annotations

import random
import struct
import threading
import time
import zlib

import pytest
from autopilot_fakes import FIRST_ID
from pymavlink import mavftp, mavutil
from pymavlink.dialects.v20 import common as mavlink
from test_mavlink_server import Client, World, heartbeat, named

from xtdrone_autopilot.logger.log_folder import LogFolder
from xtdrone_autopilot.mavlink.microservices.files_and_logs import log_download

_SYSTEM = FIRST_ID + 1
_CHUNK = 90
_NAMES = ("2020-01-01/00_00_00.ulg", "2020-01-01/00_01_30.ulg", "2020-01-02/10_00_05.ulg")
_TIMES = (1_577_836_800, 1_577_836_890, 1_577_959_205)
_SIZES = (5000, 90 * 700, 1)


class Logged(World):
    """A world whose vehicle has logs (files of random bytes), and a ground station that downloads them."""

    def __init__(self, folder, loss=0.0):
        super().__init__()
        self.folder = LogFolder(folder / "iris_0")
        self.autopilot.logs = [self.folder]
        source = random.Random(5)
        self.files = []
        for name, size in zip(_NAMES, _SIZES, strict=True):
            path = folder / "iris_0" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(source.randbytes(size))
            self.files.append(path)
        self.loss, self.lost = loss, source
        self.ask(heartbeat())
        self.client.receive()

    def send(self, *messages):
        for message in messages:
            self.client.send(message)
            self.server.receive(1.0)

    def hear(self, name, seconds=0.5):
        """Advance time; return the messages of that name that were not lost."""
        self.send(heartbeat())
        found = named(self.run(seconds), name)
        return [m for m in found if self.lost.random() >= self.loss]

    def log_list(self, start=0, end=0xFFFF):
        self.send(mavlink.MAVLink_log_request_list_message(_SYSTEM, 1, start, end))
        return [(m.id, m.num_logs, m.last_log_num, m.time_utc, m.size) for m in self.hear("LOG_ENTRY")]

    def download(self, number, size):
        """Return a log as a ground station downloads it: the whole log first, then each missing range."""
        found = {}
        ask = [(0, size)]
        for _ in range(200):
            for offset, count in ask:
                self.send(mavlink.MAVLink_log_request_data_message(_SYSTEM, 1, number, offset, count))
                for m in self.hear("LOG_DATA", 0.1 + 1.2 * count / (_CHUNK * log_download.BURST * 100)):
                    assert m.id == number
                    found[m.ofs] = bytes(m.data[: m.count])
            missing = [at for at in range(0, size, _CHUNK) if at not in found]
            if not missing:
                break
            ask = [(at, _CHUNK) for at in missing]
        self.send(mavlink.MAVLink_log_request_end_message(_SYSTEM, 1))
        return b"".join(found[at] for at in sorted(found))


@pytest.fixture
def world(tmp_path):
    made = Logged(tmp_path)
    yield made
    made.close()


# the log protocol


def test_list(world):
    entries = world.log_list()
    assert entries == [(i, 3, 2, _TIMES[i], _SIZES[i]) for i in range(3)]
    assert world.log_list(1, 1) == [(1, 3, 1, _TIMES[1], _SIZES[1])]
    assert [entry[0] for entry in world.log_list(7, 9)] == [2]  # PX4 limits the range to existing logs


def test_no_logs(world):
    world.autopilot.logs = []
    assert world.log_list() == [(0, 0, 0, 0, 0)]
    world.send(mavlink.MAVLink_log_request_data_message(_SYSTEM, 1, 0, 0, 100))
    assert not world.hear("LOG_DATA")


@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_download_is_the_file(tmp_path, loss):
    world = Logged(tmp_path, loss)
    for number in range(3):
        while not [e for e in world.log_list() if e[0] == number]:
            pass
        assert world.download(number, _SIZES[number]) == world.files[number].read_bytes()
    world.close()


def test_parts_and_missing_entries(world):
    world.log_list()
    whole = world.files[0].read_bytes()
    for offset, count, sizes in ((4950, 90, [50]), (4950, 5000, [50]), (100, 200, [90, 90, 20]), (5000, 90, [0])):
        world.send(mavlink.MAVLink_log_request_data_message(_SYSTEM, 1, 0, offset, count))
        found = world.hear("LOG_DATA")
        assert [m.count for m in found] == sizes
        assert b"".join(bytes(m.data[: m.count]) for m in found) == whole[offset : offset + sum(sizes)]
    world.send(mavlink.MAVLink_log_request_data_message(_SYSTEM, 1, 3, 0, 90))
    assert not world.hear("LOG_DATA")


def test_pace_is_simulated_times(world):
    world.log_list()
    world.send(mavlink.MAVLink_log_request_data_message(_SYSTEM, 1, 1, 0, _SIZES[1]))
    first = len(world.hear("LOG_DATA", 0.1))
    assert first == pytest.approx(10 * log_download.BURST, abs=log_download.BURST)
    world.send(mavlink.MAVLink_log_request_end_message(_SYSTEM, 1))
    assert not world.hear("LOG_DATA", 0.1)
    assert world.server.next_due_us > world.autopilot.time_us


def test_two_clients_have_transfers_of_their_own(world):
    other = Client(0, world.fleet[0].gcs_local_port, system=250)
    world.ask(heartbeat(6), client=other)
    world.log_list()
    world.send(mavlink.MAVLink_log_request_data_message(_SYSTEM, 1, 0, 0, 5000))
    world.ask(mavlink.MAVLink_log_request_data_message(_SYSTEM, 1, 1, 0, 900), client=other)
    mine = world.hear("LOG_DATA")
    theirs = named(other.receive(), "LOG_DATA")
    assert b"".join(bytes(m.data[: m.count]) for m in mine) == world.files[0].read_bytes()
    assert b"".join(bytes(m.data[: m.count]) for m in theirs) == world.files[1].read_bytes()[:900]
    other.socket.close()


def test_erase_leaves_the_log_that_is_written(world):
    world.folder.current = world.files[1]
    world.send(mavlink.MAVLink_log_erase_message(_SYSTEM, 1))
    assert [path.exists() for path in world.files] == [False, True, False]
    assert [entry[4] for entry in world.log_list()] == [_SIZES[1]]


def test_a_log_that_vanishes_ends_its_transfer(world):
    world.log_list()
    world.files[0].unlink()
    world.send(mavlink.MAVLink_log_request_data_message(_SYSTEM, 1, 0, 0, 5000))
    assert [m.count for m in world.hear("LOG_DATA")] == [0]


# FTP


class Ftp:
    """An FTP client on a world's socket."""

    def __init__(self, world):
        self.world, self.sequence = world, 0

    def ask(self, opcode, data=b"", session=0, offset=0, size=None, seconds=0.0):
        """Send a request; return (kind, data) of the replies."""
        payload = struct.pack(
            "<HBBBBBBI", self.sequence, session, opcode, len(data) if size is None else size, 0, 0, 0, offset
        )
        self.sequence += 2
        message = mavlink.MAVLink_file_transfer_protocol_message(0, _SYSTEM, 1, (payload + data).ljust(251, b"\0"))
        answers = self.world.ask(message)
        if seconds:
            answers += self.world.run(seconds)
        found = []
        for m in named(answers, "FILE_TRANSFER_PROTOCOL"):
            assert (m.target_system, m.target_component) == (255, 190)
            head = struct.unpack_from("<HBBBBBBI", bytes(m.payload))
            assert head[4] == opcode
            found.append((head[2], bytes(m.payload[12 : 12 + head[3]]), head[7], head[0]))
        return found

    def one(self, *arguments, **options):
        ((kind, data, _, sequence),) = self.ask(*arguments, **options)
        assert sequence == self.sequence - 1
        return kind, data


@pytest.fixture
def client(world):
    return Ftp(world)


_ACK, _NAK = 128, 129
_LOGS = b"/fs/microsd/log"


def test_ftp_lists_the_tree(client):
    assert client.one(3, b"/") == (_ACK, b"Detc\0Dfs\0Dlog\0")
    assert client.one(3, b"") == (_ACK, b"Detc\0Dfs\0Dlog\0")
    assert client.one(3, b"/fs/microsd/") == (_ACK, b"Dlog\0")
    assert client.one(3, _LOGS) == (_ACK, b"D2020-01-01\0D2020-01-02\0")
    assert client.one(3, _LOGS + b"/2020-01-01") == (_ACK, b"F00_00_00.ulg\t5000\0F00_01_30.ulg\t63000\0")
    assert client.one(3, b"log/2020-01-01", offset=1) == (_ACK, b"F00_01_30.ulg\t63000\0")
    assert client.one(3, _LOGS, offset=2) == (_NAK, bytes([6]))


def test_ftp_lists_entries_that_fit(client, world):
    for minute in range(60):
        (world.folder.root / f"2020-01-02/11_{minute:02d}_00.ulg").write_bytes(b"x" * minute)
    names, offset = [], 0
    while True:
        kind, data = client.one(3, _LOGS + b"/2020-01-02", offset=offset)
        if kind == _NAK:
            break
        entries = data.rstrip(b"\0").split(b"\0")
        names += entries
        offset += len(entries)
    assert names == [b"F10_00_05.ulg\t1", *(f"F11_{m:02d}_00.ulg\t{m}".encode() for m in range(60))]


def test_ftp_reads(client, world):
    whole = world.files[0].read_bytes()
    path = f"/log/{_NAMES[0]}".encode()
    assert client.one(4, path) == (_ACK, struct.pack("<I", 5000))
    assert client.one(4, path) == (_NAK, bytes([5]))  # one session a client
    assert client.one(5, offset=10, size=100) == (_ACK, whole[10:110])
    assert client.one(5, offset=4990, size=100) == (_ACK, whole[4990:])
    assert client.one(5, offset=5000, size=100) == (_NAK, bytes([6]))
    assert client.one(5, offset=0, size=100, session=1) == (_NAK, bytes([4]))
    assert client.one(1) == (_ACK, b"")
    assert client.one(1) == (_NAK, bytes([4]))
    assert client.one(5, offset=0, size=100) == (_NAK, bytes([4]))


def test_ftp_burst(client, world):
    whole = world.files[1].read_bytes()
    client.one(4, f"/log/{_NAMES[1]}".encode())
    answers = client.ask(15, offset=1000, size=239, seconds=0.5)
    *parts, (kind, data, _, _) = answers
    assert (kind, data) == (_NAK, bytes([6]))
    assert b"".join(data for _, data, _, _ in parts) == whole[1000:]
    assert [offset for _, _, offset, _ in parts] == list(range(1000, len(whole), 239))
    sequences = [sequence for _, _, _, sequence in answers]
    assert sequences == list(range(client.sequence - 1, client.sequence - 1 + len(answers)))
    assert client.ask(15, offset=0, size=80, seconds=0.011)
    assert client.one(2)[0] == _ACK  # reset ends the burst
    assert not named(world.run(0.1), "FILE_TRANSFER_PROTOCOL")


def test_ftp_checksum(client, world):
    crc = 0
    for byte in world.files[1].read_bytes():  # PX4's crc32part, bit by bit
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    assert client.one(14, f"/log/{_NAMES[1]}".encode()) == (_ACK, struct.pack("<I", crc))
    assert crc != zlib.crc32(world.files[1].read_bytes())


def test_ftp_answers_a_repeated_request_again(client):
    path = f"/log/{_NAMES[0]}".encode()
    first = client.one(4, path)
    client.sequence -= 2
    assert client.one(4, path) == first
    client.one(2)


@pytest.mark.parametrize(
    "path",
    [
        "/..", "../../../../etc/passwd", "/log/../../iris_1/2020-01-01/00_00_00.ulg", "/etc/passwd",
        "log/2020-01-01/..", "/fs/microsd/log/2020-01-01/../../secret", "/log//secret",
        "/log/2020-01-01/link.ulg", "/log/linked",
        "/log/linked/00_00_00.ulg", "/log/2020-01-01/00_00_00.ulg/", "/log/2020-01-01\\00_00_00.ulg", "/log/\xff",
        "/log/2020-01-01/00_00_00.ulg\x00/../x", "@PARAM/param.pck", "~", "/log/2020-01-01/notes.txt",
    ],
)  # fmt: skip
def test_no_path_leads_out(client, world, tmp_path, path):
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "iris_1/2020-01-01").mkdir(parents=True)
    (tmp_path / "iris_1/2020-01-01/00_00_00.ulg").write_text("secret")
    (world.folder.root / "2020-01-01/link.ulg").symlink_to(tmp_path / "secret")
    (world.folder.root / "2020-01-01/notes.txt").write_text("secret")
    (world.folder.root / "linked").symlink_to(tmp_path / "iris_1/2020-01-01")
    (world.folder.root / "2020-03-03").symlink_to(tmp_path / "iris_1/2020-01-01")
    data = path.encode("latin-1")
    for opcode in (4, 14):
        kind, found = client.one(opcode, data)
        if path.startswith("/log/2020-01-01/00_00_00.ulg"):  # an additional slash, or characters after a zero
            assert kind == _ACK
            client.one(2)
        else:
            assert (kind, found) == (_NAK, bytes([10]))
    kind, listed = client.one(3, data)
    assert kind == _NAK
    assert listed in (bytes([10]), bytes([6]))
    assert b"2020-03-03" not in client.one(3, b"/log")[1]


def test_ftp_writes_nothing(client, world):
    before = sorted(str(p) for p in world.folder.root.rglob("*"))
    for opcode in (6, 7, 8, 9, 10, 11, 12, 13):
        assert client.one(opcode, b"/log/2020-01-01/00_00_00.ulg") == (_NAK, bytes([9]))
    assert client.one(99, b"") == (_NAK, bytes([7]))
    assert client.one(5, size=240) == (_NAK, bytes([3]))
    assert sorted(str(p) for p in world.folder.root.rglob("*")) == before


def test_ftp_handles_any_request(client, world):
    source = random.Random(1)
    for _ in range(500):
        payload = source.randbytes(251)
        if source.random() < 0.7:
            payload = payload[:3] + bytes([source.randrange(16), source.randrange(240)]) + payload[5:]
        world.send(mavlink.MAVLink_file_transfer_protocol_message(0, _SYSTEM, 1, payload))
        world.run(0.004)
    client.one(2)
    assert client.one(3, b"/") == (_ACK, b"Detc\0Dfs\0Dlog\0")
    assert all(path.exists() for path in world.files)


def test_pymavlinks_ftp_client(world, tmp_path):
    """pymavlink's FTP client lists and downloads logs while simulated time advances."""
    done = threading.Event()

    def fly():
        while not done.is_set():
            world.autopilot.time_us += 4000
            world.server.receive(0.0)
            world.server.send_streams(world.autopilot.time_us)
            done.wait(0.001)

    port = world.fleet[0].gcs_local_port
    flying = threading.Thread(target=fly)
    flying.start()
    try:
        link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=250)
        link.mav.send(heartbeat(6))
        assert link.wait_heartbeat(timeout=20) is not None
        station = mavftp.MAVFTP(link, target_system=_SYSTEM, target_component=1)
        assert station.cmd_list(["/fs/microsd/log/2020-01-01"]).error_code == 0
        names = [(entry.name, entry.size_b) for entry in station.list_result]
        assert names == [("00_00_00.ulg", 5000), ("00_01_30.ulg", 63000)]
        target = tmp_path / "got.ulg"
        station.cmd_get([f"/log/{_NAMES[1]}", str(target)])
        assert station.process_ftp_reply("OpenFileRO", timeout=30).error_code == 0
        end = time.monotonic() + 20.0
        while not target.exists() and time.monotonic() < end:
            done.wait(0.01)
        assert target.read_bytes() == world.files[1].read_bytes()
        link.close()
    finally:
        done.set()
        flying.join()


def test_version_has_the_ftp_capability(world):
    world.client.receive()
    _, answers = world.command(520, 1)
    (version,) = named(answers, "AUTOPILOT_VERSION")
    assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_FTP


def test_commands_are_passed_to_the_logger(world):
    told = []
    world.commander.on_command = lambda *what: told.append(what)
    world.client.receive()
    assert world.command(511, 30, 1e6)[0] == 0
    ((number, params, sender, result),) = told
    assert (number, params[:2], sender, result) == (511, (30.0, 1e6), (255, 190), 0)
