"""Schedule of the telemetry messages on a link.

Due times are multiples of a stream's interval, so that the telemetry of all vehicles falls on the same ticks and every
run is the same. Default rates are those of PX4 v1.14's onboard and normal (ground station) modes, the latter with
upstream XTDrone's streams at 50 Hz. GPS_GLOBAL_ORIGIN is sent on change, at most once in its interval.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from xtdrone_native import mavlink_wire

from xtdrone_autopilot.mavlink.streams.telemetry import Source, Telemetry, silent
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_autopilot.mavlink.wire.frame_packing import Format
from xtdrone_autopilot.tables.reader import Converter, one_of, read_table

_NEVER_US = 1 << 62
_LEAST_INTERVAL_US = 4000  # the autopilot's step
_LARGEST_INTERVAL_US = (1 << 31) - 1  # largest value of MESSAGE_INTERVAL
_FALLBACK_RATE = 1.0  # Hz, default requested for a message that has none

Payloads = dict[int, bytes | list[bytes] | None]
Convert = Callable[[mavlink_wire.Format, bytes], None]


class _Row(NamedTuple):
    """Row of ``tables/streams.csv``.

    Attributes:
        message: MAVLink name.
        source: "vehicle" for the same content on all links, "link" for that of the link; "gimbal", "orbit" and
            "obstacles" while a gimbal is fitted, in ORBIT, and while collision prevention is in use; "none" for streams
            of PX4 v1.14 of what is not simulated: their intervals can be set, nothing is sent.
        onboard, ground_station: default rates of links in the two modes, Hz; None: only on request.
    """

    message: str
    source: str
    onboard: float | None
    ground_station: float | None


def _rate(text: str) -> float | None:
    return float(text) if text else None


_SOURCES = one_of("vehicle", "link", "gimbal", "orbit", "obstacles", "none")
_COLUMNS: dict[str, Converter] = {"message": str, "source": _SOURCES, "onboard": _rate, "ground_station": _rate}
_ROWS = [_Row(*row) for row in read_table("streams", _COLUMNS)]
ONBOARD_RATES = {row.message: row.onboard for row in _ROWS if row.onboard is not None}
GCS_RATES = {row.message: row.ground_station for row in _ROWS if row.ground_station is not None}
SILENT = frozenset(row.message for row in _ROWS if row.source == "none")
LINK_MESSAGES = frozenset(row.message for row in _ROWS if row.source == "link")
FORMATS = {f.number: f for f in (Format(row.message) for row in _ROWS)}
HEARTBEAT = FORMATS[MESSAGE_ID["HEARTBEAT"]]
_PAYLOAD_BYTES = 4000.0  # in a second: "mavlink start -r 4000" of PX4's payload link
_FRAME_OVERHEAD = 12  # bytes of a MAVLink 2 frame without its payload


def _scale(rates: dict[str, float], limit: float) -> dict[str, float]:
    """Return ``rates`` scaled by one factor to a load of at most ``limit`` bytes/s; HEARTBEAT keeps its rate."""
    load = {name: rate * (FORMATS[MESSAGE_ID[name]].size + _FRAME_OVERHEAD) for name, rate in rates.items()}
    beat = load["HEARTBEAT"]
    factor = min((limit - beat) / (sum(load.values()) - beat), 1.0)
    return {name: rate if name == "HEARTBEAT" else rate * factor for name, rate in rates.items()}


PAYLOAD_RATES = _scale(  # without the messages that are sent at times: they would change the scale
    {row.message: row.onboard for row in _ROWS if row.onboard is not None and row.source in ("vehicle", "link")},
    _PAYLOAD_BYTES,
)


def _limit(interval_us: float) -> int:
    return round(min(max(interval_us, _LEAST_INTERVAL_US), _LARGEST_INTERVAL_US))


class _Stream:
    """One message of a link."""

    __slots__ = ("format", "interval_us", "wire")

    def __init__(self, message: Format, values: Source, shared: bool) -> None:
        self.format = message
        number = message.number if shared else -1  # shared: the same for every client
        self.wire = mavlink_wire.Stream(message.name, message.wire, values, message.general_payload, number)
        self.interval_us = _NEVER_US


def _next_multiple(interval_us: int, now_us: int) -> int:
    """Return the first multiple of ``interval_us`` after ``now_us``."""
    return (now_us // interval_us + 1) * interval_us


class Streams:
    """The streams of one link of one vehicle.

    Attributes:
        active: whether all streams are sent, not only the heartbeat.
    """

    def __init__(
        self,
        telemetry: Telemetry,
        rates: Mapping[str, float],
        own: Mapping[str, Source] | None = None,
        changed: Callable[[], None] = silent,
    ) -> None:
        """Schedule the heartbeat; the other streams begin with ``start``.

        Args:
            telemetry: source of the values.
            rates: default rates, message name to Hz.
            own: sources of the ``LINK_MESSAGES``; those without one are not sent.
            changed: called when ``next_due_us`` has changed, except by ``send_due``.
        """
        self._defaults = rates
        self._changed = changed
        self.active = False
        own = own or {}
        self._streams = {
            number: _Stream(f, own.get(f.name, silent) if f.name in LINK_MESSAGES else telemetry.source(f.name),
                            f.name not in LINK_MESSAGES)
            for number, f in FORMATS.items()
        }  # fmt: skip
        for name, rate in rates.items():
            self._streams[MESSAGE_ID[name]].interval_us = round(1e6 / rate)
        self._schedule = mavlink_wire.Schedule()
        self._add_beat(_next_multiple(self._beat.interval_us, -1))

    @property
    def _beat(self) -> _Stream:
        return self._streams[HEARTBEAT.number]

    def _add_beat(self, due_us: int) -> None:
        self._schedule.add(self._beat.interval_us, due_us, [self._beat.wire])

    @property
    def next_due_us(self) -> int:
        """Simulated time of the next message, microseconds."""
        return self._schedule.next_due_us

    def start(self, now_us: int) -> None:
        """Start all streams."""
        if not self.active:
            self.active = True
            self._rebuild(now_us)

    def stop(self) -> None:
        """Stop all streams except the heartbeat."""
        if self.active:
            self.active = False
            self._rebuild(0)

    def end(self) -> None:
        """Stop the streams for good and release them, so that the link of a removed client is freed at once.

        The sources of the ``LINK_MESSAGES`` refer to the link: as a cycle it would wait for Python's collection of the
        oldest garbage, which is delayed until a quarter of all objects is new.
        """
        self._changed = silent
        self.stop()
        self._streams = {HEARTBEAT.number: self._beat}

    def interval(self, number: int) -> int | None:
        """Return the interval of message ``number``, us; -1 if it is off, None if it is not a stream."""
        stream = self._streams.get(number)
        if stream is None:
            return None
        return -1 if stream.interval_us == _NEVER_US else stream.interval_us

    def set_interval(self, number: int, interval_us: float, now_us: int) -> bool:
        """Set the interval of a message as MAV_CMD_SET_MESSAGE_INTERVAL does.

        Args:
            number: message id.
            interval_us: microseconds, clamped to the possible range; negative: off; 0: the default.
            now_us: simulated time, microseconds.

        Returns:
            False if the message is not a stream, or is the heartbeat, which cannot be changed.
        """
        stream = self._streams.get(number)
        if stream is None or number == HEARTBEAT.number:
            return False
        if interval_us == 0:
            interval_us = round(1e6 / self._defaults.get(stream.format.name, _FALLBACK_RATE))
        stream.interval_us = _NEVER_US if interval_us < 0 else _limit(interval_us)
        self._rebuild(now_us)
        return True

    def _rebuild(self, now_us: int) -> None:
        """Group the streams by interval, keeping overdue ones due."""
        (_, beat_due_us), *others = self._schedule.due_times
        known = dict(others)
        groups: dict[int, list[mavlink_wire.Stream]] = {}
        for stream in self._streams.values() if self.active else ():
            if stream.interval_us != _NEVER_US and stream is not self._beat:
                groups.setdefault(stream.interval_us, []).append(stream.wire)
        self._schedule.clear()
        self._add_beat(beat_due_us)
        for interval in sorted(groups):
            due_us = min(known.get(interval, _NEVER_US), _next_multiple(interval, now_us))
            self._schedule.add(interval, due_us, groups[interval])
        self._changed()

    @property
    def beat_due_us(self) -> int:
        """Simulated time of the next heartbeat, microseconds."""
        return self._schedule.first_due_us

    def send_due(
        self,
        now_us: int,
        shared: Payloads,
        outbox: mavlink_wire.Outbox,
        convert: Convert | None,
        report: Callable[[str], None],
    ) -> None:
        """Queue the messages due by ``now_us`` and schedule the next ones. Missed messages are not sent later.

        Args:
            now_us: simulated time, microseconds.
            shared: payloads packed at this time for other clients of the vehicle, by message id; extended here.
            outbox: receives the messages as MAVLink 2 frames.
            convert: receives format and payload of the messages instead, if not None.
            report: receives the error text of a message that cannot be packed from the current estimate.
        """
        self._schedule.send_due(now_us, shared, outbox, convert, report)

    def send_once(self, number: int, send: Callable[[Format, bytes], None], report: Callable[[str], None]) -> bool:
        """Send message ``number`` with its current content, and return whether it has any.

        Args:
            number: message id.
            send: receives the format and the payload of each message, of which there is usually one.
            report: as in ``send_due``.
        """
        stream = self._streams.get(number)
        payloads = None if stream is None else stream.wire.payloads({}, report)
        if stream is None or payloads is None:
            return False
        for payload in payloads if isinstance(payloads, list) else [payloads]:
            send(stream.format, payload)
        return True
