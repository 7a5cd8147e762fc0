"""Requests to the autopilot to start streams with subscribers and to stop the others.

A stream is stopped when it arrives without a plugin that needs it, and requested when a plugin begins to need it. An
autopilot that rejects a request is asked a few times and then left alone. A stream whose interval a user has set, by
whatever command of this node, is left to the user until the autopilot restarts, as MAVROS sets no rates itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID

# Answers and events: they have no rate, and stopping them would break a protocol.
_UNMANAGED_NAMES = (
    "HEARTBEAT STATUSTEXT COMMAND_ACK PING TIMESYNC AUTOPILOT_VERSION PARAM_VALUE GPS_GLOBAL_ORIGIN MISSION_ACK "
    "MISSION_COUNT MISSION_CURRENT MISSION_ITEM MISSION_ITEM_INT MISSION_ITEM_REACHED MISSION_REQUEST "
    "MISSION_REQUEST_INT FILE_TRANSFER_PROTOCOL LOG_ENTRY LOG_DATA"
)
UNMANAGED = frozenset(MESSAGE_ID[name] for name in _UNMANAGED_NAMES.split()) | {410, 411}  # 410, 411: PX4's events

DEFAULT_RATE_US = 0  # SET_MESSAGE_INTERVAL: the autopilot's default rate
OFF_US = -1

_ATTEMPTS = 3


class StreamRequests:
    """The stream requests made to one autopilot."""

    def __init__(self, request: Callable[[int, int], None], rates: Mapping[str, float]) -> None:
        """Prepare the requests.

        Args:
            request: called with message id and interval in microseconds.
            rates: message name to Hz, for messages that need another rate than the autopilot's default.

        Raises:
            ValueError: an unknown message name, or a rate that is not positive.
        """
        self._request = request
        self._rates: dict[int, int] = {}
        for name, rate in rates.items():
            if name not in MESSAGE_ID:
                raise ValueError(f"stream_rates: message {name!r} is not in the MAVLink dialect")
            if not rate > 0.0:
                raise ValueError(f"stream_rates/{name}: {rate} Hz is not allowed, more than 0")
            self._rates[MESSAGE_ID[name]] = round(1e6 / rate)
        self._asked: dict[int, int] = {}
        self._refused: dict[int, int] = {}
        self._user: set[int] = set()

    def reset(self) -> None:
        """Forget all requests after a restart of the autopilot."""
        self.reconnect()
        self._user.clear()

    def reconnect(self) -> None:
        """Forget the own requests when a link is made; an autopilot that has not restarted keeps the user's rates."""
        self._asked.clear()
        self._refused.clear()

    def stopped_ids(self) -> set[int]:
        """Return the ids of the messages that the autopilot was asked to stop."""
        return {number for number, interval in self._asked.items() if interval == OFF_US}

    def leave(self, number: int) -> None:
        """Leave message ``number`` to the user, who has set its interval."""
        self._user.add(number)

    def note_command(self, command: int, number: float) -> None:
        """Leave the message that a user's command sets the interval of.

        Args:
            command: MAV_CMD number; all but SET_MESSAGE_INTERVAL are ignored.
            number: its first parameter.
        """
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL and math.isfinite(number):
            self.leave(round(number))

    def update(self, wanted: Iterable[int], unwanted_seen: Iterable[int]) -> None:
        """Request the changes.

        Args:
            wanted: ids that plugins need now.
            unwanted_seen: unneeded ids received since the last call.
        """
        wanted = frozenset(wanted)
        for number in sorted(wanted - UNMANAGED - self._user):
            interval = self._rates.get(number, DEFAULT_RATE_US)
            if self._asked.get(number) != interval:
                self._asked[number] = interval
                self._refused.pop(number, None)
                self._request(number, interval)
        for number in sorted(set(unwanted_seen) - wanted - UNMANAGED - self._user):
            tries = self._refused.get(number, 0)
            if tries < _ATTEMPTS:
                self._refused[number] = tries + 1
                self._asked[number] = OFF_US
                self._request(number, OFF_US)
