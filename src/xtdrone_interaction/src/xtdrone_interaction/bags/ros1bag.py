"""Reads ROS 1 bags (format 2.0) sequentially, without their index: also truncated bags, and bags damaged anywhere.

A bag is a sequence of records; messages lie in chunks, compressed or not. The recorder writes the index when it is
closed, so a killed recorder leaves none; :attr:`BagFile.notes` describes what could not be read. A chunk that was being
written when the recorder was killed has no size yet and extends to the end of the file.

The format: wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import bz2
import os
import struct
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from lz4.frame import LZ4FrameDecompressor
from numpy.typing import NDArray

from xtdrone_interaction.bags.scan import CONNECTION, scan_records

MAGIC = b"#ROSBAG V"
_VERSION = b"#ROSBAG V2.0\n"
_PIECE = 4 << 20  # bytes decompressed at once
_FEW = 4096  # compressed bytes
_DAMAGE = (OSError, RuntimeError, EOFError)  # raised by decompressors
_LONGEST_HEADER = 1 << 24  # bytes; message definitions are in the data, not in a header
_USUAL_CHUNK = 1 << 26  # bytes; a smaller chunk may hold more than its header states, because the header may be damaged
_LONGEST_RECORD = 1 << 28  # bytes; a longer one counts as damage, so that no file exhausts memory
_RECORDS = 1 << 16  # scanned at once
_CHUNK_MARK = b"\x04\x00\x00\x00op=\x05"
_BEFORE_MARK = (0, 20, 19)  # bytes of a chunk's header before its op: none, compression=none, compression=lz4 or bz2


class RecordType(IntEnum):
    """The field ``op`` of a record's header."""

    MESSAGE = 2
    BAG_HEADER = 3
    CHUNK = 5
    CONNECTION = 7


class BagError(ValueError):
    """A file that cannot be read as a bag."""


class _ChunkError(Exception):
    """The rest of a chunk cannot be read; the message is a predicate, the chunk its subject."""


@dataclass(frozen=True)
class Connection:
    """One publisher on one topic.

    Attributes:
        topic: name.
        type: of the messages, such as ``geometry_msgs/PoseStamped``.
        definition: text of the message definition, including the types it uses.
        md5: of the definition.
        latching: whether late subscribers receive the last message.
    """

    topic: str
    type: str
    definition: str
    md5: str
    latching: bool = False


class Batch(NamedTuple):
    """Serialised messages.

    Attributes:
        data: bytes, shape (m,).
        connection: number of each message's connection, shape (n,).
        time: when each message was recorded, ns, shape (n,).
        offset: of each message in ``data``, shape (n,).
        length: of each message in bytes, shape (n,).
    """

    data: NDArray[np.uint8]
    connection: NDArray[np.int64]
    time: NDArray[np.int64]
    offset: NDArray[np.int64]
    length: NDArray[np.int64]


class _Extent(NamedTuple):
    """The extent of a chunk's data in the file.

    Attributes:
        begin, end: First byte, and the one after the last.
        is_open: Whether the recorder was still writing it, so that its header states no size.
        has_follower: Whether another chunk begins where its data should be.
        is_short: Whether it ends before its stated end.
    """

    begin: int
    end: int
    is_open: bool
    has_follower: bool
    is_short: bool


class BagFile:
    """A ROS 1 bag.

    Attributes:
        path: of the file.
        size: bytes.
        connections: by number; filled while the bag is read.
        notes: descriptions of unreadable parts with the reason, as sentences; filled while the bag is read.
        cut: whether the recorder did not finish it; known after reading.
        damaged: whether a part before its end is invalid; known after reading.
    """

    def __init__(self, path: Path) -> None:
        """Check the beginning of a bag.

        Raises:
            BagError: it is not a bag of format 2.0.
        """
        self.path = path
        self.connections: dict[int, Connection] = {}
        self.notes: list[str] = []
        self.cut = self.damaged = False
        self._indexed = True
        try:
            self.size = path.stat().st_size
            with path.open("rb") as file:
                first = file.read(len(_VERSION))
        except OSError as error:
            raise BagError(f"bag: {str(path)!r} cannot be read: {error.strerror}") from error
        if not self.size:
            raise BagError(f"bag: {str(path)!r} is empty")
        if not first.startswith(MAGIC):
            raise BagError(f"bag: {str(path)!r} is not a bag: it begins with {first!r}, not with {MAGIC.decode()!r}")
        if first != _VERSION:
            version = first[len(MAGIC) :].split(b"\n")[0].decode(errors="replace")
            raise BagError(
                f"bag: {str(path)!r} has version {version!r}; only 2.0 can be read; 'rosbag fix' converts older ones"
            )

    @property
    def whole(self) -> bool:
        """Whether everything could be read."""
        return not self.notes

    def batches(self) -> Iterator[Batch]:
        """Yield all messages, in the order of the file.

        Raises:
            BagError: the bag is encrypted.
        """
        self.notes.clear()
        self.cut = self.damaged = False
        with self.path.open("rb") as file:
            file.seek(len(_VERSION))
            while (at := file.tell()) < self.size:
                header = _read_header(file, self.size)
                if header is None:
                    if not self._found_next_chunk(file, at):
                        return
                    continue
                fields, size = header
                kind = fields.get(b"op", b"\0")[0]
                begin = file.tell()
                if kind == RecordType.CHUNK:
                    yield from self._read_chunk(file, fields, begin, size)
                    continue
                if begin + size > self.size:
                    if not self._found_next_chunk(file, at):
                        return
                    continue
                if kind == RecordType.CONNECTION:
                    self._add_connection(fields, file.read(size))
                elif kind == RecordType.BAG_HEADER:
                    self._check_header(fields)
                    self._read_index(file, fields)
                file.seek(begin + size)
        if not self._indexed:
            self.cut = True
            self.notes.append("the recorder did not finish it: there is no index; it was read record by record")

    def _check_header(self, fields: dict[bytes, bytes]) -> None:
        """Check the bag header record.

        Raises:
            BagError: the bag is encrypted.
        """
        if fields.get(b"encryptor"):
            name = fields[b"encryptor"].decode(errors="replace")
            raise BagError(f"bag: {str(self.path)!r} is encrypted ({name}); 'rosbag decrypt' makes it readable")
        self._indexed = any(fields.get(b"index_pos", b""))

    def _read_index(self, file: BinaryIO, fields: dict[bytes, bytes]) -> None:
        """Read the connections repeated in the index; those in a chunk may be damaged."""
        file.seek(min(int.from_bytes(fields.get(b"index_pos", b""), "little"), self.size) or self.size)
        while (header := _read_header(file, self.size)) is not None and header[0][b"op"][0] == RecordType.CONNECTION:
            self._add_connection(header[0], file.read(header[1]))

    def _note_damage(self, text: str) -> None:
        self.damaged = True
        self.notes.append(text)

    def _note_cut(self, at: int) -> None:
        self.cut = True
        self.notes.append(
            f"it is cut off: the record at byte {at} of {self.size} is incomplete; it was read up to there"
        )

    def _found_next_chunk(self, file: BinaryIO, at: int) -> bool:
        """Record that the record at ``at`` is invalid, and find the next chunk; return False if there is none."""
        place = self._next_chunk(file, at)
        if place is None:
            self._note_cut(at)
            return False
        self._note_damage(f"bytes {at} to {place} of {self.size} are damaged and were skipped")
        file.seek(place)
        return True

    def _next_chunk(self, file: BinaryIO, at: int) -> int | None:
        """Return the offset of the next chunk after ``at``; None if there is none."""
        begin = at + 1
        while begin < self.size:
            file.seek(begin)
            part = file.read(_PIECE)
            for mark in _places(part, _CHUNK_MARK):
                for before in _BEFORE_MARK:
                    place = begin + mark - before - 4
                    file.seek(max(place, 0))
                    if place > at and (found := _read_header(file, self.size)) and found[0].get(b"op") == b"\x05":
                        return place
            if len(part) < _PIECE:
                break
            begin += _PIECE - len(_CHUNK_MARK)
        return None

    def _read_chunk(self, file: BinaryIO, fields: dict[bytes, bytes], begin: int, size: int) -> Iterator[Batch]:
        """Yield the messages of a chunk, note what is wrong with it, and seek its end."""
        extent = self._measure_chunk(file, fields, begin, size)
        file.seek(begin)
        left, damage = 0, ""
        try:
            left = yield from self._read_pieces(_unpacked_chunk(file, fields, extent))
        except _ChunkError as error:
            damage = str(error)
        self._note_chunk(extent, left, damage)
        file.seek(extent.end)

    def _measure_chunk(self, file: BinaryIO, fields: dict[bytes, bytes], begin: int, size: int) -> _Extent:
        """Return the extent of a chunk's data, whose size its header may not state, or state wrongly."""
        is_open = size == 0 and fields.get(b"size", b"\0" * 4) == b"\0" * 4  # the size is written when it is full
        stated_end = self.size if is_open else begin + size
        following = self._next_chunk(file, begin) if is_open or stated_end > self.size else None
        end = following or min(stated_end, self.size)
        return _Extent(begin, end, is_open, following is not None, end < stated_end)

    def _read_pieces(self, pieces: Iterator[bytes]) -> Generator[Batch, None, int]:
        """Yield the messages in the decompressed pieces of a chunk; return the number of bytes after the last record.

        Raises:
            _ChunkError: the rest of the chunk cannot be read.
        """
        rest = b""
        for piece in pieces:
            data = np.frombuffer(rest + piece if rest else piece, np.uint8)
            at, more = 0, True
            while more:
                batch, at, more = self._records(data, at)
                if len(batch.connection):
                    yield batch
            rest = data[at:].tobytes()
            if len(rest) > _LONGEST_RECORD:
                raise _ChunkError(f"has a record of more than {_LONGEST_RECORD >> 20} MB")
        return len(rest)

    def _note_chunk(self, chunk: _Extent, left: int, damage: str) -> None:
        """Note what is wrong with a chunk that was read; ``left``: number of bytes after its last record."""
        if chunk.has_follower:
            self._note_damage(f"the chunk at byte {chunk.begin} states a wrong size; it was read as far as it is valid")
        elif chunk.is_open or (chunk.is_short and (left or damage)):
            self.cut = True
            self.notes.append(
                f"it is cut off in the chunk at byte {chunk.begin} of {self.size}: the messages up to there were read"
            )
        elif chunk.is_short:
            self._note_cut(chunk.begin)
        elif damage:
            self._note_damage(
                f"the chunk at byte {chunk.begin} {damage}; its messages before that and the rest were read"
            )
        elif left:
            self._note_damage(f"the chunk at byte {chunk.begin} ends with {left} bytes that are no record; skipped")

    def _records(self, data: NDArray[np.uint8], at: int) -> tuple[Batch, int, bool]:
        """Return the messages from ``at`` on, their end, and whether more may follow."""
        connection, time, offset, length = (np.empty(_RECORDS, np.int64) for _ in range(4))
        count, at = scan_records(data, at, connection, time, offset, length)
        connection, time, offset, length = connection[:count], time[:count], offset[:count], length[:count]
        for i in np.flatnonzero(connection == CONNECTION).tolist():
            record = data[offset[i] : offset[i] + length[i]].tobytes()
            header_size = int.from_bytes(record[:4], "little")
            self._add_connection(_fields(record[4 : 4 + header_size]) or {}, record[8 + header_size :])
        known = connection >= 0
        if not known.all():
            connection, time, offset, length = connection[known], time[known], offset[known], length[known]
        return Batch(data, connection, time, offset, length), at, count == _RECORDS

    def _add_connection(self, fields: dict[bytes, bytes], data: bytes) -> None:
        number = fields.get(b"conn", b"")
        more = _fields(data)
        if len(number) != 4 or more is None or b"type" not in more:
            return  # readers of topics report its messages as unknown
        topic = "/" + "/".join(part for part in fields.get(b"topic", b"").decode(errors="replace").split("/") if part)
        self.connections.setdefault(
            int.from_bytes(number, "little"),
            Connection(
                topic=topic,
                type=more[b"type"].decode(errors="replace"),
                definition=more.get(b"message_definition", b"").decode(errors="replace"),
                md5=more.get(b"md5sum", b"").decode(errors="replace"),
                latching=more.get(b"latching") == b"1",
            ),
        )


def _places(data: bytes, mark: bytes) -> Iterator[int]:
    at = data.find(mark)
    while at >= 0:
        yield at
        at = data.find(mark, at + 1)


def _read_header(file: BinaryIO, end: int) -> tuple[dict[bytes, bytes], int] | None:
    """Return a record's header and the length of its data; None if it is cut off or invalid."""
    raw = file.read(4)
    if len(raw) < 4:
        return None
    size = int.from_bytes(raw, "little")
    if size > min(_LONGEST_HEADER, end - file.tell()):
        return None
    fields = _fields(file.read(size))
    raw = file.read(4)
    if fields is None or b"op" not in fields or len(fields[b"op"]) != 1 or len(raw) < 4:
        return None
    return fields, struct.unpack("<I", raw)[0]


def _fields(data: bytes) -> dict[bytes, bytes] | None:
    """Return the fields of a header by name; None if they are invalid."""
    fields = {}
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        name, sign, value = data[at + 4 : at + 4 + size].partition(b"=")
        at += 4 + size
        if not sign or at > len(data):
            return None
        fields[name] = value
    return fields


def _unpacked_chunk(file: BinaryIO, fields: dict[bytes, bytes], extent: _Extent) -> Iterator[bytes]:
    """Yield the data of a chunk decompressed, in pieces.

    Raises:
        _ChunkError: they are damaged, packed in an unknown way, or longer than stated.
    """
    packing = fields.get(b"compression", b"none")
    pieces = _unpacked(file, packing, extent.end - extent.begin)
    if packing != b"none" and not extent.is_open:
        pieces = _limited(pieces, max(int.from_bytes(fields.get(b"size", b""), "little"), _USUAL_CHUNK))
    try:
        yield from pieces
    except (*_DAMAGE, ValueError) as error:
        raise _ChunkError(f"cannot be decompressed further ({error})") from error


def _limited(pieces: Iterator[bytes], size: int) -> Iterator[bytes]:
    """Yield ``pieces`` up to ``size`` bytes.

    Raises:
        ValueError: there are more.
    """
    for piece in pieces:
        yield piece[:size]
        size -= len(piece)
        if size < 0:
            raise ValueError("it holds more than its stated size")


def _unpacked(file: BinaryIO, packing: bytes, size: int) -> Iterator[bytes]:
    """Yield the next ``size`` bytes of the file decompressed, in pieces, up to any damage.

    Raises:
        OSError, RuntimeError, EOFError: they are damaged.
        ValueError: the compression is unknown.
    """
    begin, given = file.tell(), 0
    try:
        for piece in _unpacked_by(file, packing, size):
            given += len(piece)
            yield piece
    except _DAMAGE:
        # the failed step yielded nothing: repeat in small steps, skipping the bytes already yielded
        file.seek(begin)
        for piece in _unpacked_by(file, packing, size, careful=True):
            if len(piece) > given:
                yield piece[given:]
            given = max(0, given - len(piece))


def _unpacked_by(file: BinaryIO, packing: bytes, size: int, *, careful: bool = False) -> Iterator[bytes]:
    """Yield the next ``size`` bytes of the file decompressed; if ``careful``, in small steps and the last byte by byte.

    Raises:
        OSError, RuntimeError, EOFError, ValueError: as of :func:`_unpacked`.
    """
    if packing == b"none":
        while size > 0 and (piece := file.read(min(size, _PIECE))):
            size -= len(piece)
            yield piece
        return
    if packing not in (b"lz4", b"bz2"):
        raise ValueError(f"packing {packing.decode(errors='replace')!r}; there are none, lz4, bz2")
    unpacker: Any = LZ4FrameDecompressor() if packing == b"lz4" else bz2.BZ2Decompressor()
    while size > 0 and not unpacker.eof:
        packed = file.read((_FEW if size > _FEW else 1) if careful else min(size, _PIECE))
        if not packed:
            return
        size -= len(packed)
        piece = unpacker.decompress(packed, _PIECE)
        while piece:
            yield piece
            piece = b"" if unpacker.eof or unpacker.needs_input else unpacker.decompress(b"", _PIECE)


def file_size(path: Path) -> int:
    """Return the size of a file, or of all files in a folder, in bytes."""
    if path.is_dir():
        return sum(os.path.getsize(part) for part in path.rglob("*") if part.is_file())
    return path.stat().st_size
