"""MAVROS's ftp and log_transfer against an autopilot's services, and ftp against a server that stores files."""

from __future__ import annotations

import errno
import random
import struct
import threading
import time
import zlib

import pytest
from mavros_fakes import Bench
from mavros_msgs.srv import (
    FileChecksumRequest,
    FileCloseRequest,
    FileListRequest,
    FileMakeDirRequest,
    FileOpenRequest,
    FileReadRequest,
    FileRemoveDirRequest,
    FileRemoveRequest,
    FileRenameRequest,
    FileTruncateRequest,
    FileWriteRequest,
    LogRequestDataRequest,
    LogRequestEndRequest,
    LogRequestListRequest,
)
from mavros_pair import Pair
from pymavlink.dialects.v20 import common as mavlink
from std_srvs.srv import EmptyRequest, TriggerRequest

from xtdrone_autopilot.logger.log_folder import LogFolder
from xtdrone_mavros.extras.log_transfer import LogTransferPlugin
from xtdrone_mavros.link import ftp_client
from xtdrone_mavros.plugins.ftp import FtpPlugin

_FOLDER = "/fs/microsd/log/2020-01-01"
_CONTENT = random.Random(5).randbytes(3 * ftp_client.LARGEST)  # so that the last part is a whole one


def _logged(pair, folder):
    path = folder / "iris_0" / "2020-01-01" / "00_00_00.ulg"
    path.parent.mkdir(parents=True)
    path.write_bytes(_CONTENT)
    pair.served.autopilot.logs = [LogFolder(folder / "iris_0")]
    return pair


@pytest.fixture
def pair(tmp_path):
    made = _logged(Pair(FtpPlugin), tmp_path)
    yield made
    made.bench.close()


class TestOurAutopilot:
    """ftp/* on the vehicle's logs, which are read-only."""

    def test_list(self, pair):
        answer = pair.call("ftp/list", FileListRequest("/fs/microsd/log"))
        assert (answer.success, answer.r_errno) == (True, 0)
        assert [(entry.name, entry.type, entry.size) for entry in answer.list] == [("2020-01-01", 1, 0)]
        answer = pair.call("ftp/list", FileListRequest(_FOLDER))
        assert [(entry.name, entry.type, entry.size) for entry in answer.list] == [("00_00_00.ulg", 0, len(_CONTENT))]

    @pytest.mark.parametrize("lost", [0, 2])
    def test_read(self, pair, monkeypatch, lost):
        monkeypatch.setattr(ftp_client, "LIMIT", 0.05)
        name = f"{_FOLDER}/00_00_00.ulg"
        pair.lost = lost
        opened = pair.call("ftp/open", FileOpenRequest(name, FileOpenRequest.MODE_READ))
        assert (opened.success, opened.size) == (True, len(_CONTENT))
        pair.lost = lost
        for offset, size in ((0, 10_000), (0, 300), (100, 239), (700, 100), (717, 5)):
            answer = pair.call("ftp/read", FileReadRequest(name, offset, size))
            assert answer.success
            assert answer.data == _CONTENT[offset : offset + size]
        assert pair.call("ftp/close", FileCloseRequest(name)).success
        assert pair.call("ftp/read", FileReadRequest(name, 0, 1)).r_errno == errno.EBADF

    def test_checksum_is_px4s(self, pair):
        answer = pair.call("ftp/checksum", FileChecksumRequest(f"{_FOLDER}/00_00_00.ulg"))
        assert answer.crc32 == zlib.crc32(_CONTENT, 0xFFFFFFFF) ^ 0xFFFFFFFF

    def test_refusals_have_an_errno(self, pair):
        assert pair.call("ftp/list", FileListRequest("/nowhere")).r_errno == errno.ENOENT
        assert pair.call("ftp/mkdir", FileMakeDirRequest("/log/new")).r_errno == errno.EACCES
        assert pair.call("ftp/open", FileOpenRequest("/log", 7)).r_errno == errno.EINVAL
        assert pair.call("ftp/remove", FileRemoveRequest("/" + "x" * 250)).r_errno == errno.ENAMETOOLONG
        assert pair.call("ftp/close", FileCloseRequest("/log")).r_errno == errno.EBADF

    def test_one_file_once_and_reset_closes_it(self, pair):
        request = FileOpenRequest(f"{_FOLDER}/00_00_00.ulg", FileOpenRequest.MODE_READ)
        assert pair.call("ftp/open", request).success
        assert pair.call("ftp/open", request).r_errno == errno.EBUSY
        pair.call("ftp/reset", EmptyRequest())
        assert pair.call("ftp/open", request).success

    def test_an_autopilot_that_is_silent(self, pair, monkeypatch):
        monkeypatch.setattr(ftp_client, "LIMIT", 0.01)
        pair.lost = 1000
        answer = pair.call("ftp/remove", FileRemoveRequest("/log/a"))
        assert (answer.success, answer.r_errno) == (False, errno.ETIMEDOUT)


class Px4Files:
    """An FTP server after PX4: it keeps its last reply, and repeats it for the same sequence number of any client."""

    def __init__(self) -> None:
        self.files: dict[str, bytearray] = {}
        self.open: str | None = None
        self.last = 0, b""  # number and payload of the last answer
        self.done: list[int] = []  # opcodes carried out

    def answer(self, payload: bytes) -> bytes:
        number, session, opcode, size, _, _, _, offset = struct.unpack_from("<HBBBBBBI", payload)
        if self.last[1] and self.last[0] == number + 1:
            return self.last[1]
        self.done.append(opcode)
        kind, data = self._do(opcode, offset, payload[12 : 12 + size])
        head = struct.pack("<HBBBBBBI", number + 1, session, kind, len(data), opcode, 0, 0, offset)
        self.last = number + 1, (head + data).ljust(251, b"\0")
        return self.last[1]

    def _do(self, opcode: int, offset: int, data: bytes) -> tuple[int, bytes]:
        path, _, new = data.partition(b"\0")
        name, file = path.decode("latin-1"), self.files.get(self.open or "", bytearray())
        if opcode == 6:
            self.open, self.files[name] = name, bytearray()
            return 128, struct.pack("<I", 0)
        if opcode == 7:
            file[offset : offset + len(data)] = data
            return 128, struct.pack("<I", len(data))
        if opcode == 1:
            self.open = None
            return 128, b""
        if name not in self.files:
            return 129, bytes([2, errno.ENOENT])
        if opcode == 13:
            self.files[new.decode()] = self.files.pop(name)
        elif opcode == 12:
            del self.files[name][offset:]
        elif opcode == 8:
            del self.files[name]
        else:
            return 129, bytes([7])
        return 128, b""


class Px4:
    """The plugin connected to such a server."""

    def __init__(self) -> None:
        self.bench = Bench([FtpPlugin])
        self.server = Px4Files()
        self.lost = 0

    def call(self, service, request):
        results = []
        handler = self.bench.ros.services[f"/iris_0/mavros/ftp/{service}"]
        thread = threading.Thread(target=lambda: results.append(handler(request)), daemon=True)
        thread.start()
        end = time.monotonic() + 120.0
        while thread.is_alive():
            assert time.monotonic() < end, "the service hangs"
            for message in self.bench.received():
                answer = self.server.answer(bytes(message.payload))
                if self.lost:
                    self.lost -= 1
                else:
                    self.bench.send(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 240, list(answer)))
            thread.join(0.001)
        return results[0]


@pytest.fixture
def px4(monkeypatch):
    monkeypatch.setattr(ftp_client, "LIMIT", 0.05)
    made = Px4()
    yield made
    made.bench.close()


class TestPx4:
    """ftp/* on an autopilot that stores files."""

    def test_a_file_is_written_once_though_answers_get_lost(self, px4):
        px4.lost = 1
        assert px4.call("open", FileOpenRequest("/a", FileOpenRequest.MODE_CREATE)).success
        px4.lost = 2
        assert px4.call("write", FileWriteRequest("/a", 0, _CONTENT)).success
        assert px4.call("close", FileCloseRequest("/a")).success
        assert px4.server.files == {"/a": _CONTENT}
        assert px4.server.done == [6, 7, 7, 7, 1]

    def test_rename_truncate_remove(self, px4):
        px4.server.files["/a"] = bytearray(_CONTENT)
        assert px4.call("rename", FileRenameRequest("/a", "/b")).success
        assert px4.call("truncate", FileTruncateRequest("/b", 5)).success
        assert px4.server.files == {"/b": _CONTENT[:5]}
        assert px4.call("remove", FileRemoveRequest("/b")).success
        assert px4.call("remove", FileRemoveRequest("/b")).r_errno == errno.ENOENT, "the autopilot's own errno"
        px4.server.files["/c"] = bytearray()
        assert px4.call("rmdir", FileRemoveDirRequest("/c")).r_errno == errno.ENOSYS
        assert px4.call("truncate", FileTruncateRequest("/c", 1 << 32)).r_errno == errno.EFBIG

    def test_an_answer_to_an_earlier_client_is_ignored(self, px4):
        px4.server.files["/a"] = bytearray(_CONTENT)
        px4.server.last = 1, struct.pack("<HBBBBBBI", 1, 0, 129, 1, 4, 0, 0, 0).ljust(251, b"\x0a")
        assert px4.call("remove", FileRemoveRequest("/a")).success
        assert px4.server.files == {}


class TestLogTransfer:
    """log_transfer/raw/*."""

    @pytest.fixture
    def pair(self, tmp_path):
        made = _logged(Pair(LogTransferPlugin), tmp_path)
        yield made
        made.bench.close()

    def test_a_log_is_fetched(self, pair):
        raw = "log_transfer/raw"
        assert pair.call(f"{raw}/log_request_list", LogRequestListRequest(0, 0xFFFF)).success
        pair.turn()
        [entry] = pair.bench.published(f"{raw}/log_entry")
        assert (entry.id, entry.num_logs, entry.last_log_num, entry.size) == (0, 1, 0, len(_CONTENT))
        assert entry.time_utc.to_sec() == 1_577_836_800
        assert pair.call(f"{raw}/log_request_data", LogRequestDataRequest(0, 0, 0xFFFFFFFF)).success
        pair.turn()
        parts = pair.bench.published(f"{raw}/log_data")
        assert [part.offset for part in parts] == list(range(0, len(_CONTENT), 90))
        assert b"".join(part.data for part in parts) == _CONTENT
        assert pair.call(f"{raw}/log_request_end", LogRequestEndRequest()).success

    def test_erase(self, pair):
        assert pair.call("log_transfer/raw/log_request_erase", TriggerRequest()).success
        pair.turn()
        assert pair.served.autopilot.logs[0].entries() == []
