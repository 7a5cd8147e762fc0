"""The frames exchanged by the simulator (server) and its participants (clients), and the schedule of their turns.

A frame is ``u32 length`` (of what follows), ``u8 type``, payload; everything little-endian. Hot frames are packed:

=========  ==================  =========================================================================
frame      direction           payload
=========  ==================  =========================================================================
TICK       server to client    u64 tick, i64 time_us, u32 n, u32 m, n + m pairs (u32 id, u64 count)
DONE       client to server    the same; time_us repeats that of the TICK
ALIVE      client to server    empty; or u8 1: the node is waiting for an event that needs time to advance
=========  ==================  =========================================================================

The first n pairs are channels: a *channel* is one topic connection from one publisher to one subscriber; its count is
the number of messages sent over it since it was made. In DONE the ids are assigned by the publisher, in TICK by the
server. The other m pairs are UDP ports and the number of datagrams sent to them. Only counts that changed are sent.

All other frames carry a JSON object:

=========  ==================  =========================================================================
RESERVE    client to server    version, name, pid, host; answered like JOIN, which must follow on this connection
JOIN       client to server    version, name, rate (Hz), pid, host, publications [[topic, type]], subscriptions
                               [[topic, type]], udp_ports [port]
WELCOME    server to client    version, base_step_us, digest (bool: DIGEST is requested)
REFUSED    server to client    code, reason; the server closes the connection
PEER       client to server    made [[id, topic, subscriber, subscriber's TCP port, count]], lost [id]
PEER       server to client    made [[id, topic, publisher, subscriber's TCP port]], lost [id]; the
                               client's own connections whose subscriber has become (counted [id]) or is no longer
                               (uncounted [id]) a participant; after a reset of simulation time, reset (true) and
                               void [[id, count]]: the first count messages of a channel predate the reset;
                               missing [topic]: subscribed topics without some connection that the simulation waits
                               for, so that the client is to ask the master again
DECLARE    client to server    publications, subscriptions (as in JOIN: the complete current lists)
DIGEST     client to server    time_us, topics {topic: [messages, bytes, crc]}; see `Digest`
LEAVE      client to server    reason, failed (bool)
LEAVE      server to client    reason, failed (bool): the simulation has ended, normally or because of a failure
=========  ==================  =========================================================================

``host`` identifies the machine and process namespace in which ``pid`` is valid (see :func:`process_namespace`), so that
the server can distinguish a dead process from a silent one; empty if unknown.

:mod:`.server.frames` defines the types and ranges of the fields that clients send, and the longest frame of each type.
"""

from __future__ import annotations

import enum
import json
import os
import socket
import struct
import zlib
from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any, NamedTuple

from xtdrone_native import lockstep_io

VERSION = 2
BASE_STEP_US = 4000
MAX_FRAME = 1 << 24
"""Longest frame in bytes; longer ones are rejected."""

_HEAD = struct.Struct("<IB")
_DIGEST_HEAD = struct.Struct("<qI")


class ProtocolError(Exception):
    """The peer does not speak this protocol."""


def printable(text: str, most: int = 200) -> str:
    """Return a peer's text as one line for a log: unprintable characters are escaped, long text is truncated.

    Args:
        text: Any text; may contain line feeds, terminal control codes and lone surrogates.
        most: Maximum length of the result in characters.
    """
    letters = (letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text[:most])
    line = "".join(letters)
    return line if len(text) <= most and len(line) <= most else line[: most - 3] + "..."


def quote(value: object, most: int = 60) -> str:
    """Return a value received as JSON in about ``most`` printable characters or fewer, for an error message."""
    if isinstance(value, list | dict):
        return f"{'a list' if isinstance(value, list) else 'an object'} of {len(value)}"
    return f"'{printable(value, most)}'" if isinstance(value, str) else printable(repr(value), most)


class Kind(enum.IntEnum):
    """Frame types."""

    JOIN = 1
    WELCOME = 2
    REFUSED = 3
    PEER = 4
    DECLARE = 5
    LEAVE = 6
    TICK = 7
    DONE = 8
    ALIVE = 9
    RESERVE = 10
    DIGEST = 11


class Barrier(NamedTuple):
    """Content of a TICK or a DONE.

    Attributes:
        tick: Number of the tick, from 1.
        time_us: Simulation time in microseconds.
        channels: Cumulative number of messages by channel id; only channels whose count changed.
        datagrams: Cumulative number of datagrams by UDP port; only ports whose count changed.
    """

    tick: int
    time_us: int
    channels: dict[int, int]
    datagrams: dict[int, int]


def pack_barrier(kind: Kind, tick: int, time_us: int, channels: dict[int, int], datagrams: dict[int, int]) -> bytes:
    """Return a complete TICK or DONE frame.

    Args:
        kind: ``Kind.TICK`` or ``Kind.DONE``.
        tick: Number of the tick.
        time_us: Simulation time in microseconds.
        channels: Cumulative number of messages by channel id.
        datagrams: Cumulative number of datagrams by UDP port.
    """
    return lockstep_io.pack_barrier(kind, tick, time_us, channels, datagrams)


def unpack_barrier(payload: bytes) -> Barrier:
    """Decode the payload of a TICK or DONE frame.

    Raises:
        ProtocolError: The length does not match the number of pairs.
    """
    content = lockstep_io.unpack_barrier(payload)
    if content is None:
        raise ProtocolError(f"barrier frame of {len(payload)} bytes: the length does not match the number of pairs")
    return Barrier._make(content)


def pack_object(kind: Kind, content: Mapping[str, Any]) -> bytes:
    """Return a complete frame that carries a JSON object."""
    payload = json.dumps(content, separators=(",", ":")).encode()
    return _HEAD.pack(1 + len(payload), kind) + payload


def unpack_object(payload: bytes) -> dict[str, Any]:
    """Decode the JSON object of a frame.

    Raises:
        ProtocolError: The payload is not a JSON object.
    """
    try:
        content = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"not JSON: {payload[:40]!r}") from error
    if not isinstance(content, dict):
        raise ProtocolError(f"not a JSON object: {payload[:40]!r}")
    return content


ALIVE_FRAME = _HEAD.pack(1, Kind.ALIVE)
NEEDS_TIME = b"\x01"
NEEDS_TIME_FRAME = _HEAD.pack(2, Kind.ALIVE) + NEEDS_TIME


ANY_FRAME: Mapping[int, int] = dict.fromkeys(Kind, MAX_FRAME)
"""Default maximum frame lengths by type, in bytes without the length field."""


class FrameReader:
    """Splits a byte stream into frames.

    Attributes:
        longest: Accepted frame types with their maximum lengths in bytes, without the length field. It is checked as
            soon as a frame's header has arrived, before its payload.
    """

    def __init__(self, longest: Mapping[int, int] = ANY_FRAME) -> None:
        self.longest = longest
        self._buffer = bytearray()

    def __len__(self) -> int:
        """Return the number of bytes received that do not form a complete frame yet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Append received bytes."""
        self._buffer += data

    def frames(self) -> Iterator[tuple[int, bytes]]:
        """Yield (type, payload) of each complete frame and remove it.

        Raises:
            ProtocolError: A length is 0 or exceeds ``longest``, or the type is not accepted.
        """
        while len(self._buffer) >= _HEAD.size:
            length, kind = _HEAD.unpack_from(self._buffer)
            if not 0 < length <= self.longest.get(kind, 0):
                raise ProtocolError(self._fault(kind, length))
            end = 4 + length
            if len(self._buffer) < end:
                return
            payload = bytes(self._buffer[_HEAD.size : end])
            del self._buffer[:end]
            yield kind, payload

    def _fault(self, kind: int, length: int) -> str:
        if kind in self.longest:
            return f"{Kind(kind).name} of {length} bytes, allowed are 1 to {self.longest[kind]}"
        names = ", ".join(Kind(allowed).name for allowed in self.longest)
        return f"frame of type {kind}, allowed are {names}"

    def has_frame(self) -> bool:
        """Return whether ``frames`` would yield a frame or raise an error."""
        if len(self._buffer) < _HEAD.size:
            return False
        length, _ = _HEAD.unpack_from(self._buffer)
        return length == 0 or length > MAX_FRAME or len(self._buffer) >= 4 + length


class Digest:
    """Running checksum of the messages published on one topic; two flights are equal if all their digests are.

    Each message contributes, in order: i64 time_us and u32 length, little-endian, then the serialised message without
    its length prefix. ``time_us`` is the simulation time of publication. The checksum is zlib's CRC-32 of the
    concatenation.

    Attributes:
        messages: Number of messages.
        bytes: Their total length in bytes.
        crc: The checksum.
    """

    __slots__ = ("bytes", "crc", "messages")

    def __init__(self) -> None:
        self.messages = 0
        self.bytes = 0
        self.crc = 0

    def add(self, time_us: int, message: bytes | memoryview) -> None:
        """Add one serialised message published at ``time_us``."""
        size = len(message)
        self.messages += 1
        self.bytes += size
        self.crc = zlib.crc32(message, zlib.crc32(_DIGEST_HEAD.pack(time_us, size), self.crc))

    def state(self) -> list[int]:
        """Return messages, bytes and crc in the order of the DIGEST frame."""
        return [self.messages, self.bytes, self.crc]


DIGEST_PERIOD_US = 1_000_000
"""Simulation time between digests in microseconds. A participant sends DIGEST, with all its topics, before the DONE of
its first turn in each period, and once more before it leaves."""


def process_namespace() -> str:
    """Return an identifier shared by all processes that see the same process ids; empty where unknown.

    It combines the kernel's boot id with the pid namespace and is available on Linux only.
    """
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:
            return f"{file.read().strip()} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def same_machine(first: str, second: str) -> bool:
    """Return whether the IP addresses of a connection's two ends belong to the same machine."""
    return first == second or (first.startswith("127.") and second.startswith("127."))


_UNANSWERED_MS = 15_000
_KEEPALIVE = ((socket.TCP_KEEPIDLE, 3), (socket.TCP_KEEPINTVL, 3), (socket.TCP_KEEPCNT, 4))


def tune(sock: socket.socket) -> None:
    """Set the TCP options of a lockstep connection: send without delay and detect an unreachable machine.

    A machine's kernel answers even while the process hangs; after 15 s without an answer the connection breaks.
    """
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        sock.setsockopt(socket.IPPROTO_TCP, option, value)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNANSWERED_MS)


class Schedule:
    """The times at which a participant is due: the first base step at or after k / rate seconds, k = 0, 1, 2, ...

    The rate is converted to a fraction and all computation is in integers, so that rounding errors do not accumulate.
    """

    def __init__(self, rate: float, base_step_us: int = BASE_STEP_US) -> None:
        """Compute the grid of turns.

        Args:
            rate: Turns per second of simulation time in Hz, above 0 and at most one per base step.
            base_step_us: The simulator's step in microseconds.

        Raises:
            ValueError: The rate is out of range.
        """
        fastest = 1_000_000 / base_step_us
        if isinstance(rate, bool) or not (isinstance(rate, int | float) and 0.0 < rate <= fastest):
            raise ValueError(f"rate {quote(rate)}: must be above 0 and at most {fastest:g} Hz")
        fraction = Fraction(rate).limit_denominator(1_000_000) or Fraction(rate)
        steps = Fraction(1_000_000, base_step_us) / fraction
        self._base_step_us = base_step_us
        self._numerator, self._denominator = steps.numerator, steps.denominator

    def due_us(self, index: int) -> int:
        """Return the time of turn ``index`` in microseconds."""
        return -(-index * self._numerator // self._denominator) * self._base_step_us

    def after_us(self, now_us: int) -> int:
        """Return the earliest due time later than ``now_us``, in microseconds."""
        index = (now_us // self._base_step_us) * self._denominator // self._numerator + 1
        return self.due_us(index)
