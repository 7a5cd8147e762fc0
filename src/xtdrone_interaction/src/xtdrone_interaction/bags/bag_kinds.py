"""Bags of any kind as batches of serialised ROS 1 messages: ROS 1 bags, split bags, and ROS 2 bags."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from xtdrone_interaction.bags.decode import HEADER, Layout, LayoutError, MessageError, Rows
from xtdrone_interaction.bags.ros1bag import BagError, BagFile, Batch, Connection, file_size

BATCH = 16 << 20  # bytes of messages handled at once
_UNKNOWN = 1 << 40  # number of unknown connections; the numbers in bags have 32 bits
_ROS2 = (".mcap", ".db3")


class Source(Protocol):
    """A bag, or several.

    Attributes:
        path: of the file or folder.
        size: bytes.
        connections: by number; filled while it is read.
        notes: descriptions of unreadable parts, as sentences; filled while it is read.
        cut: whether the recorder did not finish it; known after reading.
    """

    path: Path
    size: int
    connections: dict[int, Connection]
    notes: list[str]
    cut: bool

    def batches(self) -> Iterator[Batch]:
        """Yield all messages."""
        ...


class Ros2Bag:
    """A ROS 2 bag, its messages converted to ROS 1."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = file_size(path)
        self.connections: dict[int, Connection] = {}
        self.notes: list[str] = []
        self.cut = False

    def batches(self) -> Iterator[Batch]:
        """Yield all messages.

        Raises:
            BagError: it cannot be opened.
        """
        self.notes.clear()
        self.cut = False
        try:
            with AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
                yield from self._batches(reader)
        except BagError:
            raise
        except Exception as error:  # rosbags raises many kinds for a damaged file
            if not self.connections:
                raise BagError(f"bag: {str(self.path)!r} cannot be read: {error}") from error
            self.cut = True
            self.notes.append(f"it cannot be read to the end: {error}")

    def _batches(self, reader: AnyReader) -> Iterator[Batch]:
        store = get_typestore(Stores.EMPTY)
        header = get_typestore(Stores.ROS1_NOETIC).fielddefs[HEADER]
        store.register({**reader.typestore.fielddefs, HEADER: header})
        numbers = {}
        for number, connection in enumerate(reader.connections):
            definition, md5 = store.generate_msgdef(connection.msgtype)
            kind = connection.msgtype.replace("/msg/", "/")
            self.connections[number] = Connection(connection.topic, kind, definition, md5)
            numbers[connection.id, connection.owner] = number
        collected: list[tuple[int, int, bytes]] = []
        size = 0
        for connection, time, raw in reader.messages():
            data = bytes(reader.typestore.cdr_to_ros1(raw, connection.msgtype))
            collected.append((numbers[connection.id, connection.owner], time, data))
            size += len(data)
            if size >= BATCH:
                yield _batch(collected)
                collected, size = [], 0
        if collected:
            yield _batch(collected)


def _batch(messages: list[tuple[int, int, bytes]]) -> Batch:
    length = np.array([len(data) for _, _, data in messages], np.int64)
    return Batch(
        data=np.frombuffer(b"".join(data for _, _, data in messages), np.uint8),
        connection=np.array([number for number, _, _ in messages], np.int64),
        time=np.array([time for _, time, _ in messages], np.int64),
        offset=np.cumsum(length) - length,
        length=length,
    )


def open_source(path: Path) -> Source:
    """Open a ROS 1 bag, or a ROS 2 bag (its folder, or its .mcap or .db3).

    Raises:
        BagError: it cannot be opened.
    """
    if not os.path.exists(path):  # false for a name that the file system rejects, too
        raise BagError(f"bag: {str(path)!r} does not exist")
    if path.suffix in _ROS2 or path.is_dir():
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            raise BagError(f"bag: folder {str(path)!r} has no metadata.yaml, so it is not a ROS 2 bag")
        return Ros2Bag(path)
    return BagFile(path)


class SplitBag:
    """The consecutive bags of one recording, as written by ``rosbag record --split``."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Open all of them.

        Raises:
            BagError: one cannot be read.
        """
        self._parts = [open_source(path) for path in paths]
        self.path = paths[0]
        self.size = sum(part.size for part in self._parts)
        self.connections: dict[int, Connection] = {}
        self.notes: list[str] = []
        self.cut = False

    def batches(self) -> Iterator[Batch]:
        """Yield all messages.

        Raises:
            BagError: one cannot be read.
        """
        self.notes.clear()
        self.cut = False
        # the k-th connection of its kind has the same number in all parts
        known: dict[tuple[Connection, int], int] = {}
        for part in self._parts:
            numbers: dict[int, int] = {}
            kinds: dict[Connection, int] = {}
            for batch in part.batches():
                for number in part.connections.keys() - numbers.keys():
                    connection = part.connections[number]
                    order = kinds[connection] = kinds.get(connection, -1) + 1
                    numbers[number] = known.setdefault((connection, order), len(known))
                    self.connections[numbers[number]] = connection
                local, rows = np.unique(batch.connection, return_inverse=True)
                common = np.array([numbers.get(number, _UNKNOWN) for number in local.tolist()], np.int64)
                yield batch._replace(connection=common[rows])
            self.notes += [f"{part.path.name}: {note}" for note in part.notes]
            self.cut |= part.cut


def open_sources(paths: Sequence[Path]) -> Source:
    """Open one bag, or the consecutive bags of one recording.

    Raises:
        BagError: one cannot be read.
    """
    return open_source(paths[0]) if len(paths) == 1 else SplitBag(paths)


def large_batches(source: Source) -> Iterator[Batch]:
    """Yield the messages in batches of about BATCH bytes, so that the cost per batch and topic is negligible."""
    waiting: list[Batch] = []
    size = 0
    for batch in source.batches():
        waiting.append(batch)
        size += len(batch.data)
        if size >= BATCH:
            yield _joined(waiting)
            waiting, size = [], 0
    if waiting:
        yield _joined(waiting)


def _joined(batches: list[Batch]) -> Batch:
    if len(batches) == 1:
        return batches[0]
    starts = np.cumsum([0, *(len(batch.data) for batch in batches[:-1])])
    return Batch(
        data=np.concatenate([batch.data for batch in batches]),
        connection=np.concatenate([batch.connection for batch in batches]),
        time=np.concatenate([batch.time for batch in batches]),
        offset=np.concatenate([batch.offset + start for batch, start in zip(batches, starts, strict=True)]),
        length=np.concatenate([batch.length for batch in batches]),
    )


def by_connection(batch: Batch) -> Iterator[tuple[int, Batch]]:
    """Yield the messages of each connection in a batch, in order."""
    if not len(batch.connection):
        return
    order = np.argsort(batch.connection, kind="stable")
    numbers = batch.connection[order]
    borders = np.flatnonzero(np.diff(numbers)) + 1
    for rows in np.split(order, borders):
        yield (
            int(batch.connection[rows[0]]),
            Batch(batch.data, batch.connection[rows], batch.time[rows], batch.offset[rows], batch.length[rows]),
        )


class Layouts:
    """Message layouts of a recording, each definition parsed once.

    Attributes:
        failed: errors of invalid definitions, by type.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[str, str], Layout | None] = {}
        self.failed: dict[str, str] = {}

    def of(self, connection: Connection) -> Layout | None:
        """Return the layout of a connection's messages; None if its definition is invalid."""
        key = connection.type, connection.definition
        if key not in self._known:
            try:
                self._known[key] = Layout(*key)
            except LayoutError as error:
                self._known[key] = None
                self.failed[connection.type] = str(error)
        return self._known[key]


def whole_messages(layout: Layout, batch: Batch) -> Rows:
    """Return the valid messages of a connection, as rows of the batch."""
    if layout.traversable:
        return layout.decode(batch.data, batch.offset, batch.length, ()).kept
    return np.array([row for row in range(len(batch.time)) if _fault(layout, batch, row) is None], np.int64)


def _fault(layout: Layout, batch: Batch, row: int) -> str | None:
    """Return the decoding error of a message; None if it is valid."""
    start = int(batch.offset[row])
    try:
        layout.message(batch.data[start : start + int(batch.length[row])].tobytes())
    except MessageError as error:
        return str(error)
    return None


class Losses:
    """Messages that had to be skipped.

    Attributes:
        unknown: number of messages whose connection record is lost.
        failed: errors of invalid definitions, by type.
    """

    def __init__(self) -> None:
        self.unknown = 0
        self.failed: dict[str, str] = {}
        self._damaged: dict[str, tuple[int, str]] = {}  # by topic: their number, and time and reason of the first

    def add(self, connection: Connection, layout: Layout, batch: Batch, kept: Rows) -> None:
        """Register the messages of a connection that are not among ``kept``, rows of the batch."""
        if len(kept) == len(batch.time):
            return
        count, first = self._damaged.get(connection.topic, (0, ""))
        if not count:
            row = int(np.setdiff1d(np.arange(len(batch.time)), kept)[0])
            why = _fault(layout, batch, row) or f"its {batch.length[row]} bytes are more than {connection.type} has"
            first = f"at {batch.time[row] * 1e-9:.3f} s of the recorder's clock: {why}"
        self._damaged[connection.topic] = count + len(batch.time) - len(kept), first

    def notes(self) -> list[str]:
        """Return sentences about the skipped messages."""
        notes = []
        if self.unknown:
            notes.append(f"{self.unknown} messages are of topics whose description is lost; they were skipped")
        for topic, (count, first) in sorted(self._damaged.items()):
            notes.append(f"{count} messages of {topic} do not match their definition; skipped (the first {first})")
        return notes + [f"{text}; its messages were skipped" for text in self.failed.values()]
