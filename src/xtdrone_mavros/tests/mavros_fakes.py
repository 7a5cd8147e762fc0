"""Stand-ins for ROS and for an autopilot, for the tests of the MAVROS layer."""

from __future__ import annotations

import contextlib
import copy
import socket
from collections.abc import Callable, Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.lib.plugin_settings import Params
from xtdrone_mavros.link.autopilot_links import AutopilotLink, FcuUrl
from xtdrone_mavros.uas import Plugin, Uas


class FakePublisher:
    """Keeps copies of published messages."""

    def __init__(self) -> None:
        """Begin with no subscriber."""
        self.messages: list[Any] = []
        self.connections = 0

    def publish(self, message: Any) -> None:
        """Keep a copy; the plugins reuse their messages."""
        self.messages.append(copy.deepcopy(message))

    def get_num_connections(self) -> int:
        """Return the number set by the test."""
        return self.connections


class FakeRos:
    """Topics and services as dictionaries."""

    def __init__(self, use_sim_time: bool = True) -> None:
        """Begin at time 0."""
        self.use_sim_time = use_sim_time
        self.time_ns = 0
        self.publishers: dict[str, FakePublisher] = {}
        self.subscribers: dict[str, Callable[[Any], None]] = {}
        self.services: dict[str, Callable[[Any], Any]] = {}
        self.kinds: dict[str, Any] = {}  # of topics and services
        self.params: dict[str, Any] = {}

    @property
    def connection_changes(self) -> int:
        """Return a number that changes with the tests' settings."""
        return hash(tuple(publisher.connections for publisher in self.publishers.values()))

    def now_ns(self) -> int:
        """Return the time set by the test."""
        return self.time_ns

    def publisher(self, topic: str, kind: type, latch: bool) -> FakePublisher:
        """Return the topic's publisher, one per topic as in rospy."""
        self.kinds[topic] = kind
        return self.publishers.setdefault(topic, FakePublisher())

    def subscriber(self, topic: str, kind: type, callback: Callable[[Any], None]) -> None:
        """Keep the callback."""
        self.kinds[topic] = kind
        self.subscribers[topic] = callback

    def service(self, name: str, kind: type, handler: Callable[[Any], Any]) -> None:
        """Keep the handler."""
        self.kinds[name] = kind
        self.services[name] = handler

    def set_param(self, name: str, value: Any) -> None:
        """Keep a parameter, or a tree of them."""
        self.params[name] = value

    def get_param(self, name: str, default: Any) -> Any:
        """Return the value set for that name."""
        return self.params.get(name, default)

    def needs_time(self) -> contextlib.nullcontext[None]:
        """Return an empty context: simulated time always advances."""
        return contextlib.nullcontext()


class Bench:
    """One vehicle's plugins between fake ROS and a UDP socket in the autopilot's place, all in the test's thread.

    Attributes:
        fcu: the autopilot's socket.
        link: MAVROS's end.
        uas: the hub.
        ros: fake ROS.
    """

    def __init__(self, plugins: Sequence[type[Plugin]], params: dict[str, Any] | None = None, **ros: Any) -> None:
        """Open both sockets and make the plugins."""
        self.fcu = udp_socket()
        port = free_udp_port()
        self.link = AutopilotLink("iris_0", FcuUrl("127.0.0.1", port, "127.0.0.1", self.fcu.getsockname()[1]))
        self.ros = FakeRos(**ros)
        self.uas = Uas("iris_0", "/iris_0/mavros", self.link, Params(params or {}), self.ros, plugins)
        self._packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._parser = mavlink.MAVLink(None)

    def close(self) -> None:
        """Close both sockets."""
        self.fcu.close()
        self.link.close()

    def take(self, *topics: str) -> None:
        """Add a subscriber to these topics."""
        for topic in topics:
            self.ros.publishers[f"/iris_0/mavros/{topic}"].connections = 1
        self.uas.refresh()

    def frame(self, message: Any) -> bytes:
        """Return ``message`` as a frame of the autopilot; each frame has the next sequence number."""
        frame = bytes(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) & 0xFF
        return frame

    def send(self, *messages: Any) -> None:
        """Send messages as the autopilot and let the plugins handle them."""
        self.send_raw(b"".join(self.frame(message) for message in messages))

    def send_raw(self, datagram: bytes) -> None:
        """Send a datagram as the autopilot and let the plugins handle it."""
        self.fcu.sendto(datagram, ("127.0.0.1", self.link.port))
        self.link.read()
        self.uas.receive(self.ros.time_ns)

    def published(self, topic: str) -> list[Any]:
        """Return and clear the messages published on a topic."""
        publisher = self.ros.publishers[f"/iris_0/mavros/{topic}"]
        messages, publisher.messages = publisher.messages, []
        return messages

    def call(self, topic: str, message: Any) -> None:
        """Publish to one of the plugins' subscriptions."""
        self.ros.subscribers[f"/iris_0/mavros/{topic}"](message)

    def received(self) -> list[Any]:
        """Return the messages that the autopilot has received."""
        messages = []
        while True:
            try:
                datagram = self.fcu.recv(65535)
            except BlockingIOError:
                return messages
            messages += self._parser.parse_buffer(datagram) or []


def udp_socket() -> socket.socket:
    """Return a non-blocking socket on a free local port."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock


def free_udp_port() -> int:
    """Return a UDP port that was free a moment ago."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])
