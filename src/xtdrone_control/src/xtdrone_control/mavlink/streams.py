"""When each telemetry message is due on a link.

Due times are multiples of a stream's interval, so that the vehicles' telemetry falls on the same ticks and a flight is
the same in every run. Default rates are those of PX4's onboard and ground-station modes, as far as the messages can be
filled with what is known; the ground station's have upstream XTDrone's 50 Hz set.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping

from .dialect import MESSAGE_ID
from .packing import Format
from .telemetry import Telemetry, Values

_NEVER_US = 1 << 62
_LEAST_INTERVAL_US = 4000  # the autopilot's step
_LARGEST_INTERVAL_US = (1 << 31) - 1  # what MESSAGE_INTERVAL can tell
_FALLBACK_RATE = 1.0  # Hz, for a message without a default rate when its default is asked for

ONBOARD_RATES: dict[str, float] = {
    "HEARTBEAT": 1.0,
    "ALTITUDE": 10.0,
    "ATTITUDE": 100.0,
    "ATTITUDE_QUATERNION": 50.0,
    "ATTITUDE_TARGET": 10.0,
    "BATTERY_STATUS": 0.5,
    "ESTIMATOR_STATUS": 1.0,
    "EXTENDED_SYS_STATE": 5.0,
    "GLOBAL_POSITION_INT": 50.0,
    "GPS_GLOBAL_ORIGIN": 0.1,
    "GPS_RAW_INT": 5.0,
    "HIGHRES_IMU": 50.0,
    "HOME_POSITION": 0.5,
    "LOCAL_POSITION_NED": 30.0,
    "ODOMETRY": 30.0,
    "POSITION_TARGET_LOCAL_NED": 10.0,
    "SCALED_PRESSURE": 1.0,
    "SERVO_OUTPUT_RAW": 10.0,
    "SYSTEM_TIME": 1.0,
    "SYS_STATUS": 5.0,
    "VFR_HUD": 10.0,
}

GCS_RATES: dict[str, float] = {
    "HEARTBEAT": 1.0,
    "ALTITUDE": 1.0,
    "ATTITUDE": 50.0,
    "ATTITUDE_QUATERNION": 50.0,
    "ATTITUDE_TARGET": 50.0,
    "BATTERY_STATUS": 0.5,
    "ESTIMATOR_STATUS": 0.5,
    "EXTENDED_SYS_STATE": 1.0,
    "GLOBAL_POSITION_INT": 50.0,
    "GPS_GLOBAL_ORIGIN": 0.1,
    "GPS_RAW_INT": 1.0,
    "HOME_POSITION": 0.5,
    "LOCAL_POSITION_NED": 50.0,
    "POSITION_TARGET_LOCAL_NED": 50.0,
    "SCALED_PRESSURE": 1.0,
    "SERVO_OUTPUT_RAW": 50.0,
    "SYS_STATUS": 1.0,
    "VFR_HUD": 4.0,
}

_OTHERS = ("SCALED_IMU",)  # can be asked for, without a default rate
FORMATS: dict[int, Format] = {
    f.number: f for f in (Format(name) for name in dict.fromkeys([*ONBOARD_RATES, *GCS_RATES, *_OTHERS]))
}
HEARTBEAT = FORMATS[MESSAGE_ID["HEARTBEAT"]]
_PAYLOAD_BYTES = 4000.0  # a second: "mavlink start -r 4000" of PX4's payload link
_FRAME_OVERHEAD = 12  # bytes of a MAVLink 2 frame besides its payload


def _scaled(rates: dict[str, float], limit: float) -> dict[str, float]:
    """Return ``rates`` multiplied by one factor so that a link carries ``limit`` bytes a second; HEARTBEAT stays."""
    load = {name: rate * (FORMATS[MESSAGE_ID[name]].size + _FRAME_OVERHEAD) for name, rate in rates.items()}
    beat = load["HEARTBEAT"]
    factor = min((limit - beat) / (sum(load.values()) - beat), 1.0)
    return {name: rate if name == "HEARTBEAT" else rate * factor for name, rate in rates.items()}


PAYLOAD_RATES: dict[str, float] = _scaled(ONBOARD_RATES, _PAYLOAD_BYTES)


def _allowed(interval_us: float) -> int:
    return round(min(max(interval_us, _LEAST_INTERVAL_US), _LARGEST_INTERVAL_US))


class _Stream:
    __slots__ = ("due_us", "format", "interval_us", "values")

    def __init__(self, message: Format, values: Callable[[], Values | None]) -> None:
        self.format = message
        self.values = values
        self.interval_us = _NEVER_US
        self.due_us = _NEVER_US

    def schedule(self, now_us: int) -> None:
        """Set the first due time after ``now_us``."""
        interval = self.interval_us
        self.due_us = _NEVER_US if interval == _NEVER_US else (now_us // interval + 1) * interval


def _read(stream: _Stream, report: Callable[[str], None]) -> Values | None:
    try:
        return stream.values()
    except (ValueError, OverflowError) as error:  # an estimate that is not finite
        report(f"not sent: {stream.format.name}: {error}")
        return None


class Streams:
    """The streams of one link of one vehicle.

    Attributes:
        next_due_us: when the next message is due.
        active: whether more than the heartbeat is sent.
    """

    def __init__(self, telemetry: Telemetry, rates: Mapping[str, float]) -> None:
        """Take the default ``rates`` (message name to Hz). Nothing but the heartbeat is due before ``start``."""
        self._defaults = rates
        self.active = False
        self._streams = {
            number: _Stream(f, getattr(telemetry, f.name.lower())) for number, f in FORMATS.items()
        }  # fmt: skip
        self._heap: list[tuple[int, int]] = []
        self.next_due_us = 0
        for name, rate in rates.items():
            self._streams[MESSAGE_ID[name]].interval_us = round(1e6 / rate)
        self._streams[HEARTBEAT.number].schedule(-1)
        self._rebuild()

    def start(self, now_us: int) -> None:
        """Begin with all streams: somebody listens."""
        if self.active:
            return
        self.active = True
        for number, stream in self._streams.items():
            if number != HEARTBEAT.number:
                stream.schedule(now_us)
        self._rebuild()

    def stop(self) -> None:
        """Go back to the heartbeat alone: nobody listens."""
        if self.active:
            self.active = False
            self._rebuild()

    def interval(self, number: int) -> int | None:
        """Return the interval of message ``number`` in us; -1 when it is off, None when there is no such stream."""
        stream = self._streams.get(number)
        if stream is None:
            return None
        return -1 if stream.interval_us == _NEVER_US else stream.interval_us

    def set_interval(self, number: int, interval_us: float, now_us: int) -> bool:
        """Set the interval of a message as MAV_CMD_SET_MESSAGE_INTERVAL does.

        Args:
            number: message id.
            interval_us: microseconds, cut to what is possible; negative: off; 0: the default.
            now_us: simulated time.

        Returns:
            Whether there is such a stream and it may be changed; the heartbeat may not.
        """
        stream = self._streams.get(number)
        if stream is None or number == HEARTBEAT.number:
            return False
        if interval_us == 0:
            interval_us = round(1e6 / self._defaults.get(stream.format.name, _FALLBACK_RATE))
        stream.interval_us = _NEVER_US if interval_us < 0 else _allowed(interval_us)
        stream.schedule(now_us)
        self._rebuild()
        return True

    def _rebuild(self) -> None:
        numbers = self._streams if self.active else (HEARTBEAT.number,)
        due = ((self._streams[number].due_us, number) for number in numbers)
        self._heap = [entry for entry in due if entry[0] != _NEVER_US]
        heapq.heapify(self._heap)
        self.next_due_us = self._heap[0][0] if self._heap else _NEVER_US

    def due(self, now_us: int, report: Callable[[str], None]) -> Iterator[tuple[Format, Values]]:
        """Yield what is due by ``now_us``, and set when it is due again. A stream that is late is not made up for.

        ``report`` is told of a message that cannot be made of the present estimate.
        """
        heap = self._heap
        while heap and heap[0][0] <= now_us:
            number = heap[0][1]
            stream = self._streams[number]
            stream.schedule(now_us)
            heapq.heapreplace(heap, (stream.due_us, number))
            values = _read(stream, report)
            if values is not None:
                yield stream.format, values
        self.next_due_us = heap[0][0] if heap else _NEVER_US

    def values(self, number: int, report: Callable[[str], None]) -> tuple[Format, Values] | None:
        """Return message ``number`` as it is now, or None when it cannot be given; ``report`` as in ``due``."""
        stream = self._streams.get(number)
        values = None if stream is None else _read(stream, report)
        return None if stream is None or values is None else (stream.format, values)
