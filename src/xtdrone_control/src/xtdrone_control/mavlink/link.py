"""MAVLink with one client: its address, its streams, its sequence numbers, the version it speaks."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Any, Protocol

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.mavlink.streams.streams import HEARTBEAT, Payloads, Streams
from xtdrone_control.mavlink.streams.telemetry import Telemetry, Values
from xtdrone_control.mavlink.wire.packing import COMPONENT_ID, Format, PackingError, as_version_1

from .turns import OWN_EARNINGS, OWN_SAVINGS, Purse

Address = tuple[str, int]

_SILENCE_US = 5_000_000
_SILENCE_S = 5.0
_BEAT_PERIOD = 1.0  # s of wall time, see keep_alive
_TEXT_SIZE = 50  # STATUSTEXT.text
_NEVER_US = -1


class Endpoint(Protocol):
    """The port of a link, as the link uses it; see ``port.Port``."""

    system_id: int
    telemetry: Telemetry
    rates: Mapping[str, float]
    by_wall: bool

    @property
    def first_version(self) -> int:
        """MAVLink version of the first heartbeat to a client."""

    def version_for(self, spoken: int, before: int) -> int:
        """Return the MAVLink version for a client that speaks version ``spoken``."""

    def streams_changed(self) -> None:
        """Note that the rates of a link have changed."""

    def send(self, datagram: bytes, peer: Address, now_us: int) -> bool:
        """Send a datagram and return whether the operating system accepted it."""

    def refuses(self, peer: Address) -> bool:
        """Return whether the operating system reported that ``peer`` has no socket."""

    def warn(self, kind: str, text: str, now_us: int, name: str = "") -> None:
        """Log a warning, rate-limited by kind."""


class Link:
    """One client of one port of one vehicle.

    Several clients may speak on a port at once; each has a link, so that intervals, sequence numbers, time-outs and
    answers are its own.

    A client that has spoken gets the streams until it is silent. A port's first client gets them unasked and for ever,
    as PX4's default partner does; on this machine only while a socket is there to take them, which costs a heartbeat a
    second to find out.

    Attributes:
        name: vehicle and kind of link, for messages.
        system_id: the vehicle's MAVLink system id.
        peer: the client's address.
        sender: MAVLink system and component id of the message that is handled; answers are addressed to it.
        version: of MAVLink, 1 or 2: what is sent.
        streams: what is sent by itself.
        telemetry: what the vehicle tells.
        received: messages of this client that were acted on.
        sent: messages sent to it.
        received_bytes: of its datagrams.
        sent_bytes: of the frames sent to it.
        malformed: datagrams of this client that were not, or not wholly, MAVLink.
        dropped: datagrams of this client that were not looked at, see ``turns``.
        lost: datagrams to it that the operating system did not take.
        constant: this is the port's first client.
        participant: the client takes part in the lockstep: it is there whatever the network says.
        open: whether the client is still one of the port's; what is sent over a link that is not goes nowhere.
        purse: what the client may ask for when the others have used up what is common, see ``turns``.
    """

    def __init__(self, port: Endpoint, peer: Address, name: str) -> None:
        """Serve ``peer`` over ``port``; nothing but the heartbeat is sent before a client is known to be there."""
        self._port = port
        self.name = name
        self.system_id = port.system_id
        self.peer = peer
        self.sender = (0, 0)
        self.version = port.first_version
        self.telemetry: Telemetry = port.telemetry
        self.streams = self._new_streams()
        self.received = 0
        self.sent = 0
        self.received_bytes = 0
        self.sent_bytes = 0
        self.malformed = self.dropped = self.lost = 0
        self.constant = False
        self.participant = False
        self.open = True
        self.purse = Purse(OWN_EARNINGS, OWN_SAVINGS)
        self._mav = mavlink.MAVLink(None, srcSystem=self.system_id, srcComponent=COMPONENT_ID)
        self._frames: deque[bytes] = deque()
        self._heard_us = _NEVER_US
        self._heard_wall = 0.0
        self._beat_wall = 0.0
        self._text_id = 0
        self._pings = 0
        self._measured = (0, 0, 0)  # time, sent and received bytes at the last LINK_NODE_STATUS
        self._sampled: tuple[bytes, float] | None = None  # magnetometer and barometer in the last HIGHRES_IMU

    def _new_streams(self) -> Streams:
        own = {"PING": self._ping, "LINK_NODE_STATUS": self._node_status, "HIGHRES_IMU": self._highres_imu}
        return Streams(self.telemetry, self._port.rates, own, self._port.streams_changed)

    @property
    def has_spoken(self) -> bool:
        """Whether the client has said something."""
        return self._heard_us != _NEVER_US

    @property
    def waiting(self) -> int:
        """How many frames are queued."""
        return len(self._frames)

    def reboot(self, telemetry: Telemetry, now_us: int) -> None:
        """Start anew for an autopilot that has been rebooted: streams begin again; address and counters stay.

        Args:
            telemetry: what the rebooted vehicle tells.
            now_us: simulated time, microseconds; it may have gone back.
        """
        self._heard_us = min(self._heard_us, now_us)
        self._text_id = 0
        self._measured = (now_us, self.sent_bytes, self.received_bytes)
        self.telemetry = telemetry
        self.streams = self._new_streams()
        self._frames.clear()
        if self.participant:
            self.streams.start(now_us)

    def take_part(self, participant: bool, now_us: int) -> None:
        """Note whether the client takes part in the lockstep: its streams begin with that, in each run alike."""
        self.participant = participant
        if participant:
            self.streams.start(now_us)

    def refused(self) -> None:
        """Note that no socket takes what is sent to the client: streams stop until one does, or until it speaks."""
        if not self.participant:
            self.streams.stop()

    def close(self) -> None:
        """Forget the client. A service that still answers it does so in vain."""
        self.open = False
        self._frames.clear()

    def heard(self, now_us: int, version: int) -> None:
        """Note a valid frame of MAVLink ``version`` from the client: streams begin, unless they have."""
        self.received += 1
        self._heard_us = now_us
        self._heard_wall = time.monotonic()
        self.version = self._port.version_for(version, self.version if self.received > 1 else 0)
        self.streams.start(now_us)

    def silent(self, now_us: int) -> bool:
        """Say whether the client has not spoken for 5 s, as the port's clock counts them."""
        if now_us - self._heard_us <= _SILENCE_US and self.has_spoken:
            return False
        return self.silent_by_wall or not self._port.by_wall

    @property
    def silent_by_wall(self) -> bool:
        """Whether the client has not spoken for 5 s of wall time."""
        return time.monotonic() - self._heard_wall > _SILENCE_S

    def send_message(self, message: Any) -> None:
        """Queue a pymavlink message object; ``flush`` sends it."""
        self._queue(message.pack(self._mav))

    def send_values(self, message: Format, values: Values | list[Values], now_us: int) -> None:
        """Queue a message given by its values in wire order, or several; ``flush`` sends them."""
        try:
            for one in values if isinstance(values, list) else [values]:
                self.send_payload(message, message.payload(one))
        except PackingError as error:
            self.warn("packing", f"not sent: {error}", now_us)

    def send_payload(self, message: Format, payload: bytes) -> None:
        """Queue a message given by its payload (``Format.payload``); ``flush`` sends it."""
        self._queue(message.frame(payload, self._mav.seq, self.system_id, COMPONENT_ID))

    def _queue(self, frame: bytes) -> None:
        """Queue a MAVLink 2 frame in the client's version; one that has no MAVLink 1 form is not sent in that."""
        if self.version == 1:
            converted = as_version_1(frame)
            if converted is None:
                return
            frame = converted
        if self.open:
            self._frames.append(frame)
            self._mav.seq = self._mav.seq + 1 & 0xFF
            self.sent += 1
            self.sent_bytes += len(frame)

    def send_text(self, severity: int, text: str) -> None:
        """Queue a STATUSTEXT, in numbered pieces when it is longer than one holds."""
        data = text.encode("ascii", "replace")
        pieces, number = [data], 0
        if len(data) > _TEXT_SIZE:  # the last piece is not full, by which it is known
            pieces = [data[i : i + _TEXT_SIZE] for i in range(0, len(data) + 1, _TEXT_SIZE)]
            number = self._text_id = self._text_id % 0xFFFF + 1
        for i, piece in enumerate(pieces):
            self.send_message(mavlink.MAVLink_statustext_message(severity, piece, number, i))

    def send_due(self, now_us: int, shared: Payloads) -> None:
        """Send the telemetry that is due, and what is queued; for ``shared`` see ``Streams.due``."""
        if now_us >= self.streams.next_due_us:
            self._queue_due(now_us, shared)
        if self._frames:
            self.flush(now_us)

    def _queue_due(self, now_us: int, shared: Payloads) -> None:
        self.telemetry.refresh(now_us)
        for message, payloads in self.streams.due(now_us, shared, lambda text: self.warn("packing", text, now_us)):
            if message is HEARTBEAT:
                self._beat_wall = time.monotonic()
            for payload in payloads:
                self.send_payload(message, payload)

    def _ping(self) -> Values:
        """PING as PX4 sends it to find out how long the way is; the answer is not used."""
        self._pings += 1
        return self.telemetry.time_us, self._pings & 0xFFFFFFFF, 0, 0

    def _node_status(self) -> Values:
        """What has gone over this link; rates since the last time, bytes a second."""
        now_us = self.telemetry.time_us
        since, sent, received = self._measured
        self._measured = (now_us, self.sent_bytes, self.received_bytes)
        span = max(now_us - since, 1) * 1e-6
        rates = [round((now - then) / span) & 0xFFFFFFFF
                 for now, then in ((self.sent_bytes, sent), (self.received_bytes, received))]  # fmt: skip
        return (
            now_us,
            *rates,
            self.sent & 0xFFFFFFFF,
            self.received & 0xFFFFFFFF,
            0,
            self.malformed & 0xFFFF,
            self.lost & 0xFFFF,
            self.dropped & 0xFFFF,
            0,
            0,
        )

    def _highres_imu(self) -> Values:
        """HIGHRES_IMU with the bits of what has been sampled since the last one on this link."""
        s = self.telemetry.sensors
        mag, baro = s["mag"].tobytes(), float(s["baro_pressure"])
        before, self._sampled = self._sampled, (mag, baro)
        return self.telemetry.highres_imu(
            mag=before is None or before[0] != mag, baro=before is None or before[1] != baro
        )

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
        """Send what is queued, a datagram each: real MAVROS reads no more than 296 bytes of one."""
        frames = self._frames
        probing = self.constant and not self.streams.active and bool(frames)
        while frames:
            if not self._port.send(frames.popleft(), self.peer, now_us):
                self.lost += 1
        if probing and not self._port.refuses(self.peer):
            self.streams.start(now_us)

    def warn(self, kind: str, text: str, now_us: int) -> None:
        """Log a warning, at most one of each ``kind`` a simulated second, a wall second and port."""
        self._port.warn(kind, text, now_us, self.name)
