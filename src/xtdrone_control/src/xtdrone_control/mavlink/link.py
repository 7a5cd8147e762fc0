"""One UDP link of one vehicle: its socket, its peer, its streams."""

from __future__ import annotations

import errno
import logging
import socket
import time
from collections import deque
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.fleet import Vehicle

from .packing import Format, PackingError
from .streams import HEARTBEAT, Streams
from .telemetry import Telemetry, Values

Address = tuple[str, int]

COMPONENT_ID = 1  # MAV_COMP_ID_AUTOPILOT1
LOOPBACK = "127.0.0.1"
_MAX_DATAGRAM = 1400  # bytes; below the MTU of what a datagram may cross
_RECEIVE_BUFFER = 1 << 20
_SILENCE_US = 5_000_000
_SILENCE_S = 5.0
_WARNING_INTERVAL_US = 1_000_000
_BEAT_PERIOD = 1.0  # s of wall time, see keep_alive
_TEXT_SIZE = 50  # STATUSTEXT.text

_log = logging.getLogger("rosout.mavlink")


class LinkError(OSError):
    """A link whose port cannot be bound."""


class Link:
    """One end of MAVLink over UDP.

    Attributes:
        name: vehicle and kind of link, for messages.
        system_id: the vehicle's MAVLink system id.
        local_port: bound port.
        remote_port: where frames go to until somebody speaks.
        peer: where frames go to: whoever spoke last.
        sender: MAVLink system and component id of the message that is handled; answers are addressed to it.
        streams: what is sent by itself.
        received: datagrams read.
        sent: datagrams sent by remote port.
        lost: datagrams that the operating system did not take.
        malformed: datagrams that were not, or not wholly, MAVLink.
        foreign: messages for other systems.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        kind: str,
        local_port: int,
        remote_port: int,
        telemetry: Telemetry,
        rates: dict[str, float],
        host: str = LOOPBACK,
        *,
        by_wall: bool = False,
    ) -> None:
        """Bind the port.

        Args:
            vehicle: whose link this is.
            kind: what the link is called in messages.
            local_port: port to bind.
            remote_port: port on this machine to which frames go until somebody speaks, or ``direct`` names another.
            telemetry: what the vehicle tells.
            rates: default rates of the streams, message name to Hz.
            host: address to bind; "0.0.0.0" for every network.
            by_wall: the peer lives by wall time, as a ground station does: it is silent only if it is so by both
                clocks. Else simulated time alone counts, so that the streams are the same at any speed.

        Raises:
            LinkError: the port cannot be bound, or there is no such address here.
        """
        self.name = f"{vehicle.name} {kind} link"
        self.system_id = vehicle.system_id
        self.local_port = local_port
        self.remote_port = remote_port
        self.peer: Address = (LOOPBACK, remote_port)
        self.sender = (0, 0)
        self.telemetry = telemetry
        self.streams = Streams(telemetry, rates)
        self._rates = rates
        self._by_wall = by_wall
        self.received = 0
        self.sent: dict[int, int] = {}
        self.lost = 0
        self.malformed = 0
        self.foreign = 0
        self._mav = mavlink.MAVLink(None, srcSystem=vehicle.system_id, srcComponent=COMPONENT_ID)
        self._frames: deque[bytes] = deque()
        self._heard_us = -1
        self._heard_wall = 0.0
        self._beat_wall = 0.0
        self._text_id = 0
        self._warned_us: dict[str, int] = {}
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self.socket.setblocking(False)
            self.socket.bind((host, local_port))
        except OSError as error:
            self.socket.close()
            advice = "it must be an address of this machine"
            if error.errno == errno.EADDRINUSE:
                advice = "is another simulator, PX4 or ground station using it?"
            raise LinkError(
                error.errno,
                f"{self.name}: UDP port {local_port} cannot be bound on {host}: {error.strerror or error}; {advice}",
            ) from error

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()

    def reboot(self, telemetry: Telemetry, now_us: int) -> None:
        """Start anew for an autopilot that has been rebooted: streams begin again; socket, peer and counters stay.

        Args:
            telemetry: what the rebooted vehicle tells.
            now_us: simulated time, microseconds; it may have gone back.
        """
        self._heard_us = min(self._heard_us, now_us)
        self._text_id = 0
        self.telemetry = telemetry
        self.streams = Streams(telemetry, self._rates)
        self._frames.clear()
        self._warned_us.clear()

    def read(self) -> tuple[bytes, Address] | None:
        """Return the next datagram and its sender, None when there is none."""
        try:
            datagram, sender = self.socket.recvfrom(65535)
        except (BlockingIOError, ConnectionRefusedError):
            return None
        self.received += 1
        return datagram, sender

    def direct(self, host: str, *, override: bool = False) -> None:
        """Send to ``host`` from now on, unless somebody has spoken; with ``override`` also then, for he is gone."""
        if override or self._heard_us < 0:
            self.peer = (host, self.remote_port)

    def heard(self, sender: Address, now_us: int) -> None:
        """Note a valid frame from ``sender``: answers and streams go there from now on."""
        self.peer = sender
        self._heard_us = now_us
        self._heard_wall = time.monotonic()
        self.streams.start(now_us)

    def send_message(self, message: Any) -> None:
        """Queue a pymavlink message object; ``flush`` sends it."""
        self._frames.append(message.pack(self._mav))
        self._mav.seq = self._mav.seq + 1 & 0xFF

    def send_values(self, message: Format, values: Values, now_us: int) -> None:
        """Queue a message given by its values in wire order; ``flush`` sends it."""
        try:
            frame = message.frame(values, self._mav.seq, self.system_id, COMPONENT_ID)
        except PackingError as error:
            self.warn("packing", f"not sent: {error}", now_us)
            return
        self._frames.append(frame)
        self._mav.seq = self._mav.seq + 1 & 0xFF

    def send_text(self, severity: int, text: str) -> None:
        """Queue a STATUSTEXT, in numbered pieces when it is longer than one holds."""
        data = text.encode("ascii", "replace")
        pieces = [data[i : i + _TEXT_SIZE] for i in range(0, len(data), _TEXT_SIZE)]
        number = 0
        if len(pieces) > 1:
            number = self._text_id = self._text_id % 0xFFFF + 1
        for i, piece in enumerate(pieces):
            self.send_message(mavlink.MAVLink_statustext_message(severity, piece, number, i))

    def send_due(self, now_us: int) -> None:
        """Send the telemetry that is due, and what is queued."""
        if now_us >= self.streams.next_due_us:
            self._queue_due(now_us)
        if self._frames:
            self.flush(now_us)

    def _queue_due(self, now_us: int) -> None:
        if now_us - self._heard_us > _SILENCE_US and not (self._by_wall and self._heard_lately()):
            self.streams.stop()
        self.telemetry.refresh(now_us)
        for message, values in self.streams.due(now_us, lambda text: self.warn("packing", text, now_us)):
            if message is HEARTBEAT:
                self._beat_wall = time.monotonic()
            self.send_values(message, values, now_us)

    def _heard_lately(self) -> bool:
        """Say whether somebody spoke within the last seconds of wall time; simulated time may run fast."""
        return time.monotonic() - self._heard_wall <= _SILENCE_S

    def keep_alive(self, now_us: int) -> None:
        """Send a HEARTBEAT when the last one is older than a second of wall time.

        Simulated time may stand still or go slowly; a ground station, which lives by wall time, takes silence for a
        lost link. Not for links whose datagrams are part of a flight that must be the same each time.
        """
        wall = time.monotonic()
        if wall - self._beat_wall < _BEAT_PERIOD:
            return
        self._beat_wall = wall
        self.telemetry.refresh(now_us)
        found = self.streams.values(HEARTBEAT.number, lambda text: self.warn("packing", text, now_us))
        if found is not None:
            self.send_values(*found, now_us)
        self.flush(now_us)

    def flush(self, now_us: int) -> None:
        """Send what is queued, in as few datagrams as possible."""
        frames = self._frames
        while frames:
            size, parts = 0, []
            while frames and size + len(frames[0]) <= _MAX_DATAGRAM:
                size += len(frames[0])
                parts.append(frames.popleft())
            try:
                self.socket.sendto(b"".join(parts), self.peer)
            except OSError as error:
                self.lost += 1
                self.warn("send", f"cannot send to {self.peer[0]}:{self.peer[1]}: {error.strerror}", now_us)
                continue
            port = self.peer[1]
            self.sent[port] = self.sent.get(port, 0) + 1

    def warn(self, kind: str, text: str, now_us: int) -> None:
        """Log a warning, at most one of each ``kind`` a simulated second."""
        last = self._warned_us.get(kind)
        if last is None or now_us - last >= _WARNING_INTERVAL_US:
            self._warned_us[kind] = now_us
            _log.warning("%s: %s", self.name, text)
