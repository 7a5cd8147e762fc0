"""Validation of the frames that clients send: each function decodes a payload into a typed record.

All types and ranges are checked here, so that the rest of the server may rely on them: a name is a resolved ROS name, a
count fits its field, and every table is bounded. Invalid payloads raise ``ProtocolError``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from ..protocol import (
    ALIVE_FRAME,
    BASE_STEP_US,
    MAX_FRAME,
    NEEDS_TIME,
    NEEDS_TIME_FRAME,
    VERSION,
    Barrier,
    Kind,
    ProtocolError,
    Schedule,
    printable,
    quote,
    unpack_barrier,
    unpack_object,
)

LONGEST_RESERVE = 1 << 12
"""Bytes; a RESERVE usually has about 200."""
LONGEST_JOIN = 1 << 24
"""Bytes; the MAVROS layer of 1000 vehicles sends 7 million for 95000 topics, with all plugins 11 million."""
LONGEST_LEAVE = 1 << 16
MOST_TOPICS = 1 << 18
"""Publications and subscriptions of a participant."""
MOST_CHANNELS = 1 << 17
"""Connections of a participant as publisher; 250 vehicles that exchange their poses need 62500."""
MOST_PORTS = 4096
"""UDP ports of a participant."""
LONGEST_NAME = 256
LONGEST_REASON = 500

_U32 = (1 << 32) - 1
_U64 = (1 << 64) - 1
_I64 = (1 << 63) - 1
_HIGHEST_PID = (1 << 31) - 1
_HIGHEST_PORT = 65535
_NAME = re.compile(r"(?:/[A-Za-z0-9_]+)+")
_TYPE = re.compile(r"\*|[A-Za-z]\w*(?:/\w+)?", re.ASCII)

BEFORE_JOIN: dict[int, int] = {Kind.RESERVE: LONGEST_RESERVE, Kind.JOIN: LONGEST_JOIN}
"""Frame types accepted before JOIN, with their maximum lengths (see ``protocol.FrameReader``)."""
AFTER_JOIN: dict[int, int] = {
    Kind.DONE: len(ALIVE_FRAME) + 24 + 12 * (MOST_CHANNELS + MOST_PORTS),
    Kind.ALIVE: len(NEEDS_TIME_FRAME) - 4,
    Kind.PEER: MAX_FRAME,
    Kind.DECLARE: LONGEST_JOIN,
    Kind.DIGEST: LONGEST_JOIN,
    Kind.LEAVE: LONGEST_LEAVE,
}
"""Frame types accepted from a participant."""


class RefusalError(ProtocolError):
    """A well-formed RESERVE or JOIN that the server rejects.

    Attributes:
        code: Code of the REFUSED frame.
    """

    def __init__(self, code: str, reason: str) -> None:
        super().__init__(reason)
        self.code = code


class Reservation(NamedTuple):
    """Content of a RESERVE, and part of a JOIN.

    Attributes:
        name: Resolved ROS name.
        pid: Process id, 0 if unknown.
        host: Namespace of the process id (see ``protocol.process_namespace``); empty if unknown.
    """

    name: str
    pid: int
    host: str


class Declaration(NamedTuple):
    """All topics of a participant with their types; "*" for any type."""

    publications: dict[str, str]
    subscriptions: dict[str, str]


class Join(NamedTuple):
    """Content of a JOIN.

    Attributes:
        node: Name and process of the node.
        rate: Turns per second of simulation time in Hz.
        schedule: Times of its turns.
        udp_ports: Local ports on which it receives the simulator's datagrams.
        topics: Its publications and subscriptions.
    """

    node: Reservation
    rate: float
    schedule: Schedule
    udp_ports: tuple[int, ...]
    topics: Declaration


class Made(NamedTuple):
    """A topic connection reported by its publisher.

    Attributes:
        number: Number assigned by the publisher.
        topic: Resolved topic name.
        subscriber: Resolved name of the subscribing node; empty if its name is not a valid ROS name.
        port: The subscriber's TCP port, 0 within one process.
        sent: Messages sent over it so far.
    """

    number: int
    topic: str
    subscriber: str
    port: int
    sent: int


class Peers(NamedTuple):
    """Content of a PEER: connections made, and the numbers of connections lost."""

    made: list[Made]
    lost: list[int]


class DigestReport(NamedTuple):
    """Content of a DIGEST: simulation time in microseconds; messages, bytes and checksum by topic."""

    time_us: int
    topics: dict[str, list[int]]


class Leave(NamedTuple):
    """Content of a LEAVE; the reason is one printable line."""

    reason: str
    failed: bool


def reservation(payload: bytes) -> Reservation:
    """Decode a RESERVE payload.

    Raises:
        RefusalError: The protocol version differs, or the name is not a valid ROS name.
        ProtocolError: The payload is malformed.
    """
    return _reservation(_Fields("RESERVE", unpack_object(payload)))


def join(payload: bytes, base_step_us: int = BASE_STEP_US) -> Join:
    """Decode a JOIN payload.

    Args:
        payload: Payload of the frame.
        base_step_us: The simulator's step in microseconds.

    Raises:
        RefusalError: The protocol version differs, the name is not a valid ROS name, or the rate is out of range.
        ProtocolError: The payload is malformed.
    """
    fields = _Fields("JOIN", unpack_object(payload))
    node = _reservation(fields)
    rate = fields.get("rate")
    try:
        schedule = Schedule(rate, base_step_us)
    except ValueError as error:
        raise RefusalError("rate", f"{node.name}: {error}") from error
    ports = fields.items("udp_ports", MOST_PORTS)
    checked = dict.fromkeys(_integer("JOIN: UDP port", port, 1, _HIGHEST_PORT) for port in ports)
    return Join(node, float(rate), schedule, tuple(checked), _declaration(fields))


def declaration(payload: bytes) -> Declaration:
    """Decode a DECLARE payload.

    Raises:
        ProtocolError: The payload is malformed.
    """
    return _declaration(_Fields("DECLARE", unpack_object(payload)))


def peers(payload: bytes) -> Peers:
    """Decode a PEER payload.

    Raises:
        ProtocolError: The payload is malformed.
    """
    fields = _Fields("PEER", unpack_object(payload))
    made = [_check_made(entry) for entry in fields.items("made", MOST_CHANNELS)]
    lost = [_integer("PEER: number", number, 0, _U32) for number in fields.items("lost", MOST_CHANNELS)]
    return Peers(made, lost)


def digest(payload: bytes) -> DigestReport:
    """Decode a DIGEST payload.

    Raises:
        ProtocolError: The payload is malformed.
    """
    fields = _Fields("DIGEST", unpack_object(payload))
    topics = fields.get("topics")
    if not isinstance(topics, dict) or len(topics) > MOST_TOPICS:
        raise ProtocolError(f"DIGEST: topics {quote(topics)}: must be an object of at most {MOST_TOPICS}")
    time_us = _integer("DIGEST: time_us", fields.get("time_us"), 0, _I64)
    return DigestReport(time_us, {_name("DIGEST: topic", topic): _state(state) for topic, state in topics.items()})


def leave(payload: bytes) -> Leave:
    """Decode a LEAVE payload.

    Raises:
        ProtocolError: The payload is malformed.
    """
    fields = _Fields("LEAVE", unpack_object(payload))
    reason, failed = fields.get("reason", ""), fields.get("failed", False)
    if not isinstance(reason, str) or not isinstance(failed, bool):
        raise ProtocolError(f"LEAVE: reason {quote(reason)}, failed {quote(failed)}: must be a string and a boolean")
    return Leave(printable(reason, LONGEST_REASON), failed)


def done(payload: bytes) -> Barrier:
    """Decode a DONE payload.

    Raises:
        ProtocolError: The length does not match the number of pairs.
    """
    return unpack_barrier(payload)


def needs_time(payload: bytes) -> bool:
    """Decode an ALIVE payload; return whether the node is waiting for an event that needs time to advance.

    Raises:
        ProtocolError: The payload is malformed.
    """
    if payload not in (b"", NEEDS_TIME):
        raise ProtocolError(f"ALIVE: {payload!r}: must be empty or {NEEDS_TIME!r}")
    return bool(payload)


class _Fields:
    """The JSON object of a frame, accessed by key."""

    def __init__(self, frame: str, content: Mapping[str, Any]) -> None:
        self.frame = frame
        self._content = content

    def get(self, key: str, default: Any = None) -> Any:
        return self._content.get(key, default)

    def items(self, key: str, most: int) -> list[Any]:
        """Return the list at ``key``, empty if absent.

        Raises:
            ProtocolError: The value is not a list, or longer than ``most``.
        """
        value = self._content.get(key, [])
        if not isinstance(value, list) or len(value) > most:
            raise ProtocolError(f"{self.frame}: {key} {quote(value)}: must be a list of at most {most}")
        return value


def _reservation(fields: _Fields) -> Reservation:
    name, version = fields.get("name"), fields.get("version")
    if version != VERSION or isinstance(version, bool):
        node = printable(name, LONGEST_NAME) if isinstance(name, str) else quote(name)
        raise RefusalError("version", f"{node} uses lockstep version {quote(version)}, the simulator {VERSION}")
    if not isinstance(name, str) or len(name) > LONGEST_NAME or not _NAME.fullmatch(name):
        allowed = f"must be a resolved ROS name, such as /follower_1, of at most {LONGEST_NAME} characters"
        raise RefusalError("name", f"name {quote(name)}: {allowed}")
    host = fields.get("host", "")
    if not isinstance(host, str) or len(host) > LONGEST_NAME:
        raise ProtocolError(
            f"{fields.frame}: host {quote(host)}: must be a string of at most {LONGEST_NAME} characters"
        )
    return Reservation(name, _integer(f"{fields.frame}: pid", fields.get("pid", 0), 0, _HIGHEST_PID), host)


def _declaration(fields: _Fields) -> Declaration:
    publications = _topics(fields, "publications")
    subscriptions = _topics(fields, "subscriptions")
    if len(publications) + len(subscriptions) > MOST_TOPICS:
        count = len(publications) + len(subscriptions)
        raise ProtocolError(f"{fields.frame}: {count} topics, at most {MOST_TOPICS} are allowed")
    return Declaration(publications, subscriptions)


def _topics(fields: _Fields, key: str) -> dict[str, str]:
    what = f"{fields.frame}: {key}"
    topics = {}
    for entry in fields.items(key, MOST_TOPICS):
        topic, kind = _row(what, entry, 2, "[topic, type]")
        if not isinstance(kind, str) or len(kind) > LONGEST_NAME or not _TYPE.fullmatch(kind):
            raise ProtocolError(f"{what}: type {quote(kind)}: must be a ROS type, such as std_msgs/String, or *")
        topics[_name(what, topic)] = kind
    return topics


def _check_made(entry: object) -> Made:
    number, topic, subscriber, port, count = _row("PEER: made", entry, 5, "[id, topic, subscriber, port, count]")
    if not isinstance(subscriber, str):
        raise ProtocolError(f"PEER: subscriber {quote(subscriber)}: must be a string")
    # A foreign subscriber may use any name; that is not the publisher's fault.
    known = len(subscriber) <= LONGEST_NAME and _NAME.fullmatch(subscriber)
    return Made(
        _integer("PEER: number", number, 0, _U32),
        _name("PEER", topic),
        subscriber if known else "",
        _integer("PEER: TCP port", port, 0, _HIGHEST_PORT),
        _integer("PEER: count", count, 0, _U64),
    )


def _state(state: object) -> list[int]:
    limits = (_U64, _U64, _U32)
    row = _row("DIGEST", state, len(limits), "[messages, bytes, crc]")
    return [_integer("DIGEST: number", value, 0, most) for value, most in zip(row, limits, strict=True)]


def _row(what: str, entry: object, length: int, columns: str) -> list[Any]:
    if not isinstance(entry, list) or len(entry) != length:
        raise ProtocolError(f"{what}: {quote(entry)}: must be {columns}")
    return entry


def _name(what: str, value: object) -> str:
    if not isinstance(value, str) or len(value) > LONGEST_NAME or not _NAME.fullmatch(value):
        allowed = f"must be a resolved ROS name, such as /iris_0/cmd, of at most {LONGEST_NAME} characters"
        raise ProtocolError(f"{what}: topic {quote(value)}: {allowed}")
    return value


def _integer(what: str, value: object, low: int, high: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise ProtocolError(f"{what} {quote(value)}: must be an integer from {low} to {high}")
    return value
