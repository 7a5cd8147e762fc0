"""MAVLink with one client: its address, its streams, its sequence numbers, the version it speaks."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Protocol

from pymavlink.dialects.v20 import common as mavlink
from xtdrone_native import mavlink_wire

from xtdrone_autopilot.mavlink.streams.stream_schedule import HEARTBEAT, Payloads, Streams
from xtdrone_autopilot.mavlink.streams.telemetry import Source, Telemetry
from xtdrone_autopilot.mavlink.streams.vehicle_state import Values
from xtdrone_autopilot.mavlink.wire.frame_packing import COMPONENT_ID, Format, PackingError, as_version_1

from .rate_limit import CLIENT_CREDIT, MAX_CLIENT_CREDIT, Credit

Address = tuple[str, int]

_SILENCE_US = 5_000_000
_SILENCE_S = 5.0
_BEAT_PERIOD = 1.0  # s of wall time, see keep_alive
_TEXT_SIZE = 50  # STATUSTEXT.text
_NEVER_US = -1


class Endpoint(Protocol):
    """Interface of a link's port; see ``udp_port_and_clients.Port``."""

    system_id: int
    telemetry: Telemetry
    rates: Mapping[str, float]
    data_rate: int
    by_wall: bool

    @property
    def first_version(self) -> int:
        """MAVLink version of the first heartbeat to a client."""

    def version_for(self, spoken: int, before: int) -> int:
        """Return the MAVLink version for a client that speaks version ``spoken``."""

    def streams_changed(self) -> None:
        """Note that the rates of a link have changed."""

    def send(self, frames: mavlink_wire.Outbox, peer: Address, now_us: int) -> int:
        """Send ``frames`` to ``peer``, each in a datagram; return how many the operating system did not accept."""

    def refuses(self, peer: Address) -> bool:
        """Return whether the operating system reported that ``peer`` has no socket."""

    def warn(self, kind: str, text: str, now_us: int, name: str = "") -> None:
        """Log a warning, rate-limited by kind."""


class Link:
    """One client of one port of one vehicle.

    Each client of a port has a separate link with its stream intervals, sequence numbers, timeouts and replies.

    A client gets the streams from its first message until it falls silent. The first client of a port gets them
    permanently and without a request, as PX4's default partner does. On this machine it gets them only while a socket
    is bound at its address, which a heartbeat each second probes.

    Attributes:
        name: vehicle and kind of link, for log messages.
        system_id: the vehicle's MAVLink system id.
        peer: the client's address.
        sender: MAVLink system and component id of the message being handled; replies are addressed to it.
        version: MAVLink version of sent frames, 1 or 2.
        streams: periodic messages to the client.
        telemetry: source of the vehicle's telemetry messages.
        received: number of messages handled from this client.
        received_bytes: bytes of its datagrams.
        malformed: datagrams of this client with bytes that are not valid MAVLink.
        dropped: datagrams of this client dropped by ``rate_limit``.
        lost: datagrams to this client that the operating system did not accept.
        is_first: whether this is the first client of the port.
        participant: whether the client is a lockstep participant: its streams ignore errors of the network.
        open: False once the port has removed the client; frames sent over the link are then discarded.
        credit: credit of this client beside the shared one, see ``rate_limit``.
    """

    def __init__(self, port: Endpoint, peer: Address, name: str) -> None:
        """Serve ``peer`` over ``port``; only the heartbeat is sent until the client is known to be present."""
        self._port = port
        self.name = name
        self.system_id = port.system_id
        self.peer = peer
        self.sender = (0, 0)
        self.version = port.first_version
        self.telemetry: Telemetry = port.telemetry
        self.streams = self._new_streams()
        self.received = 0
        self.received_bytes = 0
        self.malformed = self.dropped = self.lost = 0
        self.is_first = False
        self.participant = False
        self.open = True
        self.credit = Credit(CLIENT_CREDIT, MAX_CLIENT_CREDIT)
        self._mav = mavlink.MAVLink(None, srcSystem=self.system_id, srcComponent=COMPONENT_ID)
        self._frames = mavlink_wire.Outbox(*peer, self.system_id, COMPONENT_ID)
        self._heard_us = _NEVER_US
        self._heard_wall = 0.0
        self._beat_wall = 0.0
        self._text_id = 0
        self._pings = 0
        self._measured = (0, 0, 0)  # time, sent and received bytes at the last LINK_NODE_STATUS
        self._samples = mavlink_wire.Samples()

    def _new_streams(self) -> Streams:
        self._origin: Values | None = None  # sent last
        own: dict[str, Source] = {
            "GPS_GLOBAL_ORIGIN": self._changed_origin,
            "PING": self._ping,
            "LINK_NODE_STATUS": self._node_status,
            "HIGHRES_IMU": self._highres_imu,
        }
        return Streams(self.telemetry, self._port.rates, own, self._port.streams_changed)

    @property
    def sent(self) -> int:
        """Number of messages sent to the client."""
        return self._frames.queued

    @property
    def sent_bytes(self) -> int:
        """Bytes of the frames sent to the client."""
        return self._frames.queued_bytes

    @property
    def data_rate(self) -> int:
        """Nominal capacity of the link, bytes/s."""
        return self._port.data_rate

    @property
    def has_spoken(self) -> bool:
        """Whether a valid message of the client has been received."""
        return self._heard_us != _NEVER_US

    @property
    def waiting(self) -> int:
        """Number of queued frames."""
        return len(self._frames)

    def reboot(self, telemetry: Telemetry, now_us: int) -> None:
        """Restart the streams for a rebooted autopilot; address and counters are kept.

        Args:
            telemetry: telemetry of the rebooted vehicle.
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

    def set_participant(self, participant: bool, now_us: int) -> None:
        """Set whether the client is a lockstep participant; its streams start then, at the same time in every run."""
        self.participant = participant
        if participant:
            self.streams.start(now_us)

    def refused(self) -> None:
        """Stop the streams because the client has no socket, until it has one or sends a message."""
        if not self.participant:
            self.streams.stop()

    def close(self) -> None:
        """Close the link; later replies of services to the client are discarded."""
        self.open = False
        self._frames.clear()
        self.streams.end()

    def heard(self, now_us: int, version: int) -> None:
        """Record a valid frame of MAVLink ``version`` from the client, and start its streams."""
        self.received += 1
        self._heard_us = now_us
        self._heard_wall = time.monotonic()
        self.version = self._port.version_for(version, self.version if self.received > 1 else 0)
        self.streams.start(now_us)

    def silent(self, now_us: int) -> bool:
        """Return whether the client has been silent for 5 s by the clocks of the port."""
        if now_us - self._heard_us <= _SILENCE_US and self.has_spoken:
            return False
        return self.silent_by_wall or not self._port.by_wall

    @property
    def silent_by_wall(self) -> bool:
        """Whether the client has been silent for 5 s of wall time."""
        return time.monotonic() - self._heard_wall > _SILENCE_S

    def send_message(self, message: Any) -> None:
        """Queue a pymavlink message object; ``flush`` sends it."""
        self._mav.seq = self._frames.sequence
        self._queue(bytes(message.pack(self._mav)))

    def send_values(self, message: Format, values: Values, now_us: int) -> None:
        """Queue a message given by its values in wire order; ``flush`` sends it."""
        try:
            self.send_payload(message, message.payload(values))
        except PackingError as error:
            self.warn("packing", f"not sent: {error}", now_us)

    def send_payload(self, message: Format, payload: bytes) -> None:
        """Queue a message given by its payload (``Format.payload``); ``flush`` sends it."""
        if self.version == 2 and self.open:
            self._frames.put(message.wire, payload)
        else:
            self._put_version_1(message.wire, payload)

    def _put_version_1(self, message: mavlink_wire.Format, payload: bytes) -> None:
        self._queue(message.frame(payload, self._frames.sequence, self.system_id, COMPONENT_ID))

    def _queue(self, frame: bytes) -> None:
        """Queue a MAVLink 2 frame in the client's version; for version 1, drop frames that MAVLink 1 lacks."""
        converted = as_version_1(frame) if self.version == 1 else frame
        if self.open and converted is not None:
            self._frames.put_frame(converted)

    def send_text(self, severity: int, text: str) -> None:
        """Queue a STATUSTEXT, split into numbered pieces if it is longer than one message holds."""
        data = text.encode("ascii", "replace")
        pieces, number = [data], 0
        if len(data) > _TEXT_SIZE:  # a piece that is not full marks the end
            pieces = [data[i : i + _TEXT_SIZE] for i in range(0, len(data) + 1, _TEXT_SIZE)]
            number = self._text_id = self._text_id % 0xFFFF + 1
        for i, piece in enumerate(pieces):
            self.send_message(mavlink.MAVLink_statustext_message(severity, piece, number, i))

    def send_due(self, now_us: int, shared: Payloads) -> None:
        """Send due telemetry and queued frames; for ``shared`` see ``Streams.send_due``."""
        if now_us >= self.streams.next_due_us:
            self._queue_due(now_us, shared)
        if self._frames:
            self.flush(now_us)

    def _queue_due(self, now_us: int, shared: Payloads) -> None:
        self.telemetry.refresh(now_us)
        if self.streams.beat_due_us <= now_us:
            self._beat_wall = time.monotonic()
        convert = self._put_version_1 if self.version == 1 else None
        self.streams.send_due(now_us, shared, self._frames, convert, self._report)

    def _report(self, text: str) -> None:
        self.warn("packing", text, self.telemetry.vehicle.time_us)

    def _ping(self) -> Values:
        """Return PING, which PX4 sends to measure the round-trip time; the reply is ignored."""
        self._pings += 1
        return self.telemetry.vehicle.time_us, self._pings & 0xFFFFFFFF, 0, 0

    def _node_status(self) -> Values:
        """Return LINK_NODE_STATUS: counters of this link, and rates since the last message, bytes/s."""
        now_us = self.telemetry.vehicle.time_us
        since, sent, received = self._measured
        self._measured = (now_us, self.sent_bytes, self.received_bytes)
        span = max(now_us - since, 1) * 1e-6
        bytes_since = self.sent_bytes - sent, self.received_bytes - received
        rates = [round(count / span) & 0xFFFFFFFF for count in bytes_since]
        counts = [count & 0xFFFFFFFF for count in (self.sent, self.received)]
        errors = [count & 0xFFFF for count in (self.malformed, self.lost, self.dropped)]
        return now_us, *rates, *counts, 0, *errors, 0, 0

    def _changed_origin(self) -> Values | None:
        """Return GPS_GLOBAL_ORIGIN if this client does not have it yet, as PX4's stream does."""
        values = self.telemetry.flight.gps_global_origin()
        if values is None or values[:3] == self._origin:
            return None
        self._origin = values[:3]
        return values

    def _highres_imu(self) -> bytes:
        """Return HIGHRES_IMU, flagging the sensors with a new sample since the last message on this link."""
        return self.telemetry.vehicle.records.highres_imu(self._samples)

    def keep_alive(self, now_us: int) -> None:
        """Send a HEARTBEAT if the last one is older than a second of wall time.

        A ground station runs on wall time and reports a lost link while simulated time stands still or runs slowly.
        Do not call it for lockstep participants, whose datagrams must be the same in every run.
        """
        wall = time.monotonic()
        if wall - self._beat_wall < _BEAT_PERIOD:
            return
        self._beat_wall = wall
        self.telemetry.refresh(now_us)
        self.streams.send_once(HEARTBEAT.number, self.send_payload, self._report)
        self.flush(now_us)

    def flush(self, now_us: int) -> None:
        """Send queued frames, one in a datagram: real MAVROS reads at most 296 bytes of a datagram."""
        frames = self._frames
        if not frames:
            return
        probing = self.is_first and not self.streams.active
        self.lost += self._port.send(frames, self.peer, now_us)
        if probing and not self._port.refuses(self.peer):
            self.streams.start(now_us)

    def warn(self, kind: str, text: str, now_us: int) -> None:
        """Log a warning, at most one of each ``kind`` and port in a simulated second and a wall second."""
        self._port.warn(kind, text, now_us, self.name)
