"""Events interface: events are broadcast and can be requested again (https://mavlink.io/en/services/events.html).

As in PX4, sequence numbers start shortly before they wrap around, the last 20 events can be requested, and each client
gets the latest sequence number every 3 s, from which it detects missed events.
"""

from __future__ import annotations

from collections import deque
from typing import Any, ClassVar

from xtdrone_autopilot.events.event_catalogue import MAX_ARGUMENTS
from xtdrone_autopilot.events.events import Event
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.service_base import Service, Vehicle
from xtdrone_autopilot.mavlink.wire.frame_packing import Format

_EVENT, _CURRENT, _ERROR = (Format(name) for name in ("EVENT", "CURRENT_EVENT_SEQUENCE", "RESPONSE_EVENT_ERROR"))
_FIRST_SEQUENCE = 0xFFFF - 10
_KEPT = 20
_UPDATE_INTERVAL_US = 100_000
_SEQUENCE_INTERVAL_US = 3_000_000
_ARGUMENTS = 40
_RESET = 1  # MAV_EVENT_CURRENT_SEQUENCE_FLAGS_RESET: no event has been sent yet
_UNAVAILABLE = 0  # MAV_EVENT_ERROR_REASON
_BROADCAST = 0

assert MAX_ARGUMENTS <= _ARGUMENTS


class EventService(Service):
    """Sends the commander's events."""

    MESSAGES: ClassVar[dict[str, str]] = {"REQUEST_EVENT": "_request_event"}

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._sequence = _FIRST_SEQUENCE
        self._kept: deque[tuple[int, Event]] = deque(maxlen=_KEPT)
        self._sequence_sent_us: dict[Link, int] = {}  # time of the last CURRENT_EVENT_SEQUENCE to each client
        self.due_us = 0

    def update(self, now_us: int) -> None:
        """Broadcast new events, and send the latest sequence number to the clients for which it is due."""
        self.due_us = (now_us // _UPDATE_INTERVAL_US + 1) * _UPDATE_INTERVAL_US
        links = self.vehicle.clients()
        self._sequence_sent_us = {
            link: self._sequence_sent_us[link] for link in links if link in self._sequence_sent_us
        }
        for link in links:
            if now_us - self._sequence_sent_us.get(link, -_SEQUENCE_INTERVAL_US) >= _SEQUENCE_INTERVAL_US:
                self._sequence_sent_us[link] = now_us
                flags = 0 if self._kept else _RESET
                link.send_values(_CURRENT, (self._sequence, flags), now_us)
        events = self.vehicle.commander.events
        while events:
            self._sequence = self._sequence + 1 & 0xFFFF
            self._kept.append((self._sequence, events.popleft()))
            for link in links:
                self._send(link, *self._kept[-1])

    def _send(self, link: Link, sequence: int, event: Event) -> None:
        arguments = event.arguments.ljust(_ARGUMENTS, b"\0")
        time_ms = event.time_us // 1000
        values = (event.number, time_ms, sequence, _BROADCAST, _BROADCAST, event.log_levels, *arguments)
        link.send_values(_EVENT, values, self.vehicle.now_us)

    def _request_event(self, link: Link, m: Any) -> None:
        """Send events ``first_sequence`` to ``last_sequence`` again, and an error for each that is not kept.

        In a range longer than the number of kept events, the older ones get a single error.
        """
        first, count = m.first_sequence, (m.last_sequence - m.first_sequence & 0xFFFF) + 1
        if count > _KEPT:
            self._send_error(link, first)
            first, count = m.last_sequence - _KEPT + 1 & 0xFFFF, _KEPT
        kept = dict(self._kept)
        for sequence in (first + i & 0xFFFF for i in range(count)):
            if sequence in kept:
                self._send(link, sequence, kept[sequence])
            else:
                self._send_error(link, sequence)

    def _send_error(self, link: Link, sequence: int) -> None:
        oldest = min((number for number, _ in self._kept), key=lambda n: n - sequence & 0xFFFF, default=self._sequence)
        link.send_values(_ERROR, (sequence, oldest, *link.sender, _UNAVAILABLE), self.vehicle.now_us)
