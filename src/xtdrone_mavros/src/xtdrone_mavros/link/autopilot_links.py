"""UDP links to the autopilots and the thread that reads them.

The receiver thread splits datagrams into frames. It handles answers to pending requests (``AutopilotLink.replies``)
itself, because the waiting thread may be the one that holds the simulation; it queues telemetry that plugins need for
the main thread and drops the rest undecoded. While no request is pending and the simulator counts the datagrams of
every link, the main thread reads them itself, and the receiver thread only prevents the sockets' buffers from filling
up.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from pymavlink.dialects.v20 import common as mavlink
from xtdrone_native.mavlink_wire import receive, split

from xtdrone_autopilot.mavlink.wire.codec import frame_error
from xtdrone_common.fleet.fcu_url import AutopilotLinkError, FcuUrl
from xtdrone_mavros.link.ros_values_to_mavlink import pack


class Throttle:
    """Allows each key once in ``interval`` seconds; of wall time, because people read logs."""

    def __init__(self, interval: float = 5.0) -> None:
        """Set the interval in seconds."""
        self._interval = interval
        self._last: dict[str, float] = {}

    def passes(self, key: str) -> bool:
        """Return whether ``key`` may be logged now."""
        now = time.monotonic()
        if now - self._last.get(key, -self._interval) < self._interval:
            return False
        self._last[key] = now
        return True


log = logging.getLogger("rosout.mavros")

_RECEIVE_BUFFER = 1 << 20  # bytes; one vehicle's telemetry in a tick is a few hundred
_LARGEST_DATAGRAM = 65535
_PROBE_PORT = 9  # arbitrary address: nothing is sent to it
_GLANCE_PERIOD = 0.05  # wall s between two reads by the receiver thread while nothing depends on it

RAW = -1
"""Used in place of a message id to request every frame, undecoded."""


def bind_host_for(fcu_host: str, bind_host: str = "") -> str:
    """Return the local address for autopilots at ``fcu_host``, after checking that they are reachable from it.

    Args:
        fcu_host: name or IPv4 address of the host that runs the autopilots.
        bind_host: address of this machine; empty: 127.0.0.1 if the autopilots run here, otherwise 0.0.0.0 (all).

    Raises:
        AutopilotLinkError: the name has no address, the address is unreachable, or ``bind_host`` is not an address
            of this machine.
    """
    try:
        remote = socket.gethostbyname(fcu_host)
    except (OSError, UnicodeError) as error:
        raise AutopilotLinkError(f"fcu_host: {fcu_host!r} has no IPv4 address: {_reason(error)}") from error
    bind_host = bind_host or ("127.0.0.1" if remote.startswith("127.") else "0.0.0.0")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((bind_host, 0))
        except (OSError, UnicodeError) as error:
            reason = _reason(error)
            raise AutopilotLinkError(f"bind_host: {bind_host!r} cannot be bound on this machine: {reason}") from error
        try:
            probe.connect((remote, _PROBE_PORT))  # looks up the route, sends nothing
        except OSError as error:
            raise AutopilotLinkError(
                f"fcu_host: {fcu_host!r} ({remote}) cannot be reached from {bind_host}: {_reason(error)}"
            ) from error
    return bind_host


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


class AutopilotLink:
    """One vehicle's UDP link.

    Attributes:
        name: the vehicle's name, for log messages.
        port: the local port.
        remote: address to which frames are sent.
        source: system and component id used for sending.
        sent: number of datagrams sent.
        sent_bytes: number of bytes sent.
        received: number of datagrams read.
        wanted: ids of the messages that the main thread needs; ``RAW`` for every frame of every sender.
        from_any_sender: the subset of ``wanted`` that is accepted from every sender, not only from the autopilot.
        seen: number of unneeded messages received, by id; the stream manager clears it.
        replies: message id to the function that the receiver thread calls with each of its frames.
        malformed: number of datagrams that were not MAVLink.
    """

    def __init__(
        self,
        name: str,
        url: FcuUrl,
        target: tuple[int, int] = (1, 1),
        source: tuple[int, int] = (1, 240),
    ) -> None:
        """Bind the local port.

        Args:
            name: the vehicle's name, for log messages.
            url: local and remote address.
            target: system and component id of the autopilot; frames of others are ignored.
            source: system and component id used for sending.

        Raises:
            AutopilotLinkError: the local port cannot be bound, or the remote host has no address.
        """
        self.name = name
        self.port = url.bind_port
        self.target = target
        self.source = source
        self.sent = self.sent_bytes = 0
        self.received = 0
        self.malformed = 0
        self.wanted: frozenset[int] = frozenset()
        self.from_any_sender: frozenset[int] = frozenset()
        self.seen: dict[int, int] = {}
        self.replies: dict[int, Callable[[bytes], None]] = {}
        self._queue: deque[tuple[int, int, bytes]] = deque()
        self._packer = mavlink.MAVLink(None, srcSystem=source[0], srcComponent=source[1])
        self._component = source[1]
        self._send_lock = threading.Lock()
        self._read_lock = threading.Lock()
        self._throttle = Throttle()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.remote = (socket.gethostbyname(url.remote_host), url.remote_port)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self.socket.setblocking(False)
            self.socket.bind((url.bind_host, url.bind_port))
        except OSError as error:
            self.socket.close()
            raise AutopilotLinkError(
                f"{name}: UDP port {url.bind_port} cannot be bound for {url.remote_host}:{url.remote_port}: "
                f"{error.strerror or error}; is another mavros or ground station using it?"
            ) from error

    def send(self, message: Any, component: int | None = None) -> None:
        """Send a pymavlink message object; thread-safe.

        Args:
            message: the message.
            component: component id to send as, 0..255; None: that of ``source``.

        Raises:
            FieldError: a value does not fit into its field; nothing is sent.
        """
        with self._send_lock:
            self._packer.srcComponent = self._component if component is None else component
            buffer = pack(message, self._packer)
            self._packer.seq = (self._packer.seq + 1) & 0xFF
            self._send(buffer)

    def send_frame(self, frame: bytes) -> None:
        """Send a frame unchanged; thread-safe."""
        with self._send_lock:
            self._send(frame)

    @property
    def sequence(self) -> int:
        """The sequence number of the next message."""
        return int(self._packer.seq)

    def _send(self, buffer: bytes) -> None:
        try:
            self.socket.sendto(buffer, self.remote)
        except OSError as error:
            if self._throttle.passes("send"):
                host, port = self.remote
                log.warning("%s: cannot send to %s:%d: %s", self.name, host, port, error.strerror or error)
            return
        self.sent += 1
        self.sent_bytes += len(buffer)

    def read(self) -> None:
        """Read every datagram that has arrived; thread-safe."""
        descriptor, more = self.socket.fileno(), True
        with self._read_lock:
            while more:
                try:
                    datagrams, more = receive(descriptor, _LARGEST_DATAGRAM)
                except ConnectionRefusedError:
                    return
                for datagram, _ in datagrams:
                    # Queue the frames before the count announces them.
                    self._handle(datagram, self.received + 1)
                    self.received += 1

    def _handle(self, datagram: bytes, index: int) -> None:
        try:
            self._dispatch(datagram, index)
        except Exception:  # a failing reply handler must not affect other datagrams
            log.exception("%s: receiving MAVLink failed", self.name)

    def drain(self, count: int | None = None) -> list[tuple[int, bytes]]:
        """Return (message id, frame) of needed messages from the first ``count`` datagrams (None: all), in order."""
        queue = self._queue
        frames = []
        while queue and (count is None or queue[0][0] <= count):
            _, number, frame = queue.popleft()
            frames.append((number, frame))
        return frames

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()

    def _dispatch(self, datagram: bytes, index: int) -> None:
        wanted, target, from_any_sender = self.wanted, self.target, self.from_any_sender
        raw = RAW in wanted
        frames, end = split(datagram)
        for number, system, component, frame in frames:
            if raw:
                self._queue.append((index, RAW, frame))
            if number in from_any_sender:
                self._queue.append((index, number, frame))
                continue
            if system != target[0]:
                continue
            reply = self.replies.get(number)
            if reply is not None:
                reply(frame)
            if number in wanted:
                if component == target[1]:
                    self._queue.append((index, number, frame))
            elif reply is None:
                self.seen[number] = self.seen.get(number, 0) + 1
        if end < len(datagram):
            self._note_malformed(datagram, end)

    def _note_malformed(self, datagram: bytes, start: int) -> None:
        self.malformed += 1
        if self._throttle.passes("malformed"):
            error = frame_error(datagram, start)
            log.warning("%s: MAVLink datagram of %d bytes dropped: %s", self.name, len(datagram), error)


class AutopilotReceiver:
    """Thread that reads from all links: on arrival while ``attention`` is held or a link is not counted, else rarely.

    Reading on arrival delays the main thread, because both need the interpreter's lock.
    """

    def __init__(self, links: Iterable[AutopilotLink]) -> None:
        """Prepare the thread; ``start`` runs it."""
        self._links = list(links)
        self._by_port = {link.port: link for link in self._links}
        self._uncounted: dict[int, int] = {}  # datagrams received before the simulator began to count, by port
        self._batches = 0  # number of reads by the thread
        self._arrived = threading.Condition()
        self._attention = 0  # number of contexts that hold it
        self._stopping = False
        self._wake_lock = threading.Lock()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._thread = threading.Thread(target=self._run, name="mavlink receiver", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread and close the links."""
        with self._wake_lock:
            self._stopping = True
            os.eventfd_write(self._wake, 1)
        self._thread.join()
        for link in self._links:
            link.close()
        os.close(self._wake)

    @contextlib.contextmanager
    def attention(self) -> Iterator[None]:
        """Read datagrams on arrival while in this context; may be used in any thread."""
        with self._wake_lock:
            self._attention += 1
            if self._attention == 1 and not self._stopping:
                os.eventfd_write(self._wake, 1)
        try:
            yield
        finally:
            with self._wake_lock:
                self._attention -= 1

    def wait(self, expected: Mapping[int, int], limit: float) -> dict[int, int]:
        """Wait until each port has received the expected number of datagrams.

        Args:
            expected: port to cumulative count; unknown ports are ignored.
            limit: timeout, seconds of wall time.

        Returns:
            Ports with missing datagrams and their number; empty when all have arrived.
        """
        pairs = [(self._by_port[port], count) for port, count in expected.items() if port in self._by_port]

        def complete() -> bool:
            return all(link.received >= count for link, count in pairs)

        # Datagrams sent on this machine are already in the sockets, so there is no need to wait for the thread.
        for link, count in pairs:
            if link.received < count:
                link.read()
        if complete():
            return {}
        with self.attention(), self._arrived:
            self._arrived.wait_for(complete, limit)
        return {link.port: count - link.received for link, count in pairs if link.received < count}

    def wait_counted(self, expected: Mapping[int, int], limit: float) -> dict[int, int]:
        """Wait for the datagrams counted by the simulator, which excludes those sent before this node joined.

        Args:
            expected: port to the simulator's cumulative count.
            limit: timeout, seconds of wall time.

        Returns:
            For each known port of ``expected``: the last datagram of this turn, counted since the port was bound.
        """
        targets = {}
        for port, count in expected.items():
            link = self._by_port.get(port)
            if link is None:
                continue
            if port not in self._uncounted:
                link.read()  # everything sent before the simulator's first count is already in the socket
                self._uncounted[port] = max(0, link.received - count)
            targets[port] = count + self._uncounted[port]
        self.wait(targets, limit)
        return targets

    def counted(self) -> dict[int, int]:
        """Return the number of datagrams read, by port, as the simulator counts them."""
        return {link.port: link.received - self._uncounted.get(link.port, 0) for link in self._links}

    def is_counted(self, port: int) -> bool:
        """Return whether the simulator has reported a count for ``port``."""
        return port in self._uncounted

    def wait_any(self, limit: float) -> None:
        """Wait until the thread has read something, at most ``limit`` seconds of wall time."""
        seen = self._batches
        with self._arrived:
            self._arrived.wait_for(lambda: self._batches != seen, limit)

    def _run(self) -> None:
        by_descriptor = {link.socket.fileno(): link for link in self._links}
        with select.epoll() as wake, select.epoll() as everything:
            wake.register(self._wake, select.EPOLLIN)
            for descriptor in (self._wake, *by_descriptor):
                everything.register(descriptor, select.EPOLLIN)
            while not self._stopping:
                if self._is_calm():
                    wake.poll(_GLANCE_PERIOD)
                    ready = everything.poll(0.0)
                else:
                    ready = everything.poll()
                for descriptor, _ in ready:
                    if descriptor == self._wake:
                        os.eventfd_read(self._wake)
                    else:
                        self._read(by_descriptor[descriptor])
                if ready:
                    with self._arrived:
                        self._batches += 1
                        self._arrived.notify_all()

    def _is_calm(self) -> bool:
        """Return whether the main thread reads every datagram in the turn for which the simulator counts it."""
        return not self._attention and len(self._uncounted) == len(self._links)

    @staticmethod
    def _read(link: AutopilotLink) -> None:
        try:
            link.read()
        except Exception:  # a failing handler must not end the thread that serves all vehicles
            log.exception("%s: receiving MAVLink failed", link.name)
