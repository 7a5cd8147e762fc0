"""Reading of topic connections in the participant's own thread, over socket pairs; no ROS master."""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from io import BytesIO
from types import SimpleNamespace

import pytest

pytest.importorskip("rospy", reason="needs rospy")

from xtdrone_lockstep.transport.inbox import Inbox, TopicFeed
from xtdrone_lockstep.transport.topic_reader import Reader


def framed(*messages: bytes) -> bytes:
    return b"".join(struct.pack("<I", len(message)) + message for message in messages)


class Connection(SimpleNamespace):
    """The part of rospy's transport used by a feed."""

    def __init__(self, sock: socket.socket, head: bytes = b"") -> None:
        buffer = BytesIO()
        buffer.write(head)
        super().__init__(socket=sock, read_buff=buffer, protocol=SimpleNamespace(buff_size=4096))
        self.stat_bytes = self.stat_num_msg = 0
        self.closed = 0

    def close(self) -> None:
        self.closed += 1
        self.socket.close()


class Line:
    """A publisher's socket, and the feed at the other end."""

    def __init__(self, head: bytes = b"", counted: bool = True) -> None:
        self.sender, receiver = socket.socketpair()
        self.connection = Connection(receiver, head)
        self.inbox = Inbox("/publisher")
        if counted:
            self.inbox.target = 0
        self.feed = TopicFeed(self.connection, self.inbox)

    def expect(self, count: int) -> Line:
        self.inbox.target = count
        return self

    def close(self) -> None:
        self.sender.close()
        self.connection.socket.close()


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    line.inbox.feed = line.feed
    yield line
    line.close()


@pytest.fixture
def reader() -> Reader:
    reader = Reader()
    reader.activate()
    return reader


def test_messages_are_the_same_for_any_fragmentation(line: Line) -> None:
    messages = [b"", b"a", b"x" * 5000, b"yz", b"", b"z" * 70_000]
    data = framed(*messages)
    for size in (1, 3, 4096, len(data)):
        line.inbox.messages.clear()
        for start in range(0, len(data), size) if size > 1 else range(200):
            line.sender.sendall(data[start : start + size])
            while line.feed.pull():
                pass
        if size == 1:  # the rest in one piece
            line.sender.sendall(data[200:])
            while line.feed.pull():
                pass
        assert list(line.inbox.messages) == messages
    assert line.inbox.received == line.connection.stat_num_msg == 4 * len(messages)
    assert line.connection.stat_bytes == 4 * len(data)


def test_data_received_with_the_header_comes_first() -> None:
    line = Line(head=framed(b"first", b"second")[:-3])
    assert list(line.inbox.messages) == [b"first"]
    line.sender.sendall(b"ond" + framed(b"third"))
    assert line.feed.pull()
    assert list(line.inbox.messages) == [b"first", b"second", b"third"]
    line.close()


def test_fetch_reads_only_the_messages_due(line: Line) -> None:
    line.sender.sendall(framed(b"1"))
    assert line.inbox.fetch()
    assert not line.inbox.messages
    assert line.expect(1).inbox.fetch()
    assert list(line.inbox.messages) == [b"1"]
    assert not line.expect(2).inbox.fetch()
    assert not line.inbox.closed


def test_messages_sent_before_the_publisher_ended_are_read(line: Line) -> None:
    line.sender.sendall(framed(b"1", b"2"))
    line.sender.close()
    assert line.expect(3).inbox.fetch() is False
    assert list(line.inbox.messages) == [b"1", b"2"]
    assert line.inbox.closed
    assert line.connection.closed == 1


def test_close_in_another_thread_keeps_received_messages(line: Line) -> None:
    line.sender.sendall(framed(b"1", b"2"))
    thread = threading.Thread(target=lambda: line.connection.close())
    thread.start()
    thread.join()
    assert list(line.inbox.messages) == [b"1", b"2"]
    assert line.inbox.closed
    assert line.expect(2).inbox.fetch()
    assert not line.expect(3).inbox.fetch()


def test_newest_messages_of_a_foreign_publisher_are_kept() -> None:
    line = Line(counted=False)
    line.inbox.most_kept = 3
    line.sender.sendall(framed(b"1", b"2", b"3", b"4", b"5"))
    assert line.feed.pull()
    assert list(line.inbox.messages) == [b"3", b"4", b"5"]
    assert line.inbox.dropped == 2
    line.inbox.decode = lambda data: None if data == b"4" else data.decode()
    assert list(line.inbox.take(10)) == ["3", "5"]
    line.close()


def test_foreign_connection_is_read_while_waiting_and_a_counted_one_is_not(reader: Reader) -> None:
    foreign, counted = Line(counted=False), Line()
    for line in (foreign, counted):
        reader.hand_over(line.feed)
    reader.wait(5.0)
    for line in (foreign, counted):
        line.sender.sendall(framed(b"1"))
    reader.wait(5.0)
    assert list(foreign.inbox.messages) == [b"1"]
    reader.wait(0.0)
    assert not counted.inbox.messages
    reader.count(foreign.inbox)
    foreign.sender.sendall(framed(b"2"))
    reader.wait(0.0)
    assert list(foreign.inbox.messages) == [b"1"]
    # A close is noticed at once on either.
    for line in (foreign, counted):
        line.sender.close()
    while not (foreign.inbox.closed and counted.inbox.closed):
        reader.wait(5.0)
    assert list(foreign.inbox.messages) == [b"1", b"2"]
    assert list(counted.inbox.messages) == [b"1"]


def test_wait_ends_with_the_last_counted_message(reader: Reader) -> None:
    here, late, ended, unconnected = Line(), Line(), Line(), Line()
    for line in (here, late, ended):
        reader.hand_over(line.feed)
    reader.wait(5.0)
    here.sender.sendall(framed(b"1"))
    ended.sender.close()
    inboxes = [line.expect(1).inbox for line in (here, late, ended, unconnected)]
    go = threading.Event()

    def send() -> None:
        go.wait()
        late.sender.sendall(framed(b"1")[:2])
        late.sender.sendall(framed(b"1")[2:])
        unconnected.sender.sendall(framed(b"1"))
        reader.hand_over(unconnected.feed)

    thread = threading.Thread(target=send)
    thread.start()
    assert set(reader.await_messages(inboxes, time.monotonic() + 0.01)) == {late.inbox, unconnected.inbox}
    go.set()
    assert reader.await_messages(inboxes, time.monotonic() + 20.0) == []
    thread.join()
    assert ended.inbox.closed
    assert [len(line.inbox.messages) for line in (here, late, ended, unconnected)] == [1, 1, 0, 1]


def test_watched_descriptors_are_served_while_waiting_for_messages(reader: Reader) -> None:
    line = Line()
    reader.hand_over(line.feed)
    reader.wait(5.0)
    source, sink = os.pipe()

    def serve() -> None:
        os.read(source, 10)
        line.sender.sendall(framed(b"1"))

    reader.watch(source, serve)
    os.write(sink, b"x")
    assert reader.await_messages([line.expect(1).inbox], time.monotonic() + 20.0) == []
    for descriptor in (source, sink):
        os.close(descriptor)
    line.close()


def test_connection_closed_before_the_handover_is_ignored(reader: Reader) -> None:
    line = Line()
    line.sender.sendall(framed(b"1"))
    reader.hand_over(line.feed)
    line.connection.close()
    reader.wait(5.0)
    assert line.expect(2).inbox.fetch() is False
    assert list(line.inbox.messages) == [b"1"]
