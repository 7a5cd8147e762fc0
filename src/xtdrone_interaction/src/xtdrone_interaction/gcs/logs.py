"""Logs of a vehicle: exchanges of MAVLink's log protocol (LOG_REQUEST_LIST and LOG_REQUEST_DATA).

The vehicle sends a part of a log in messages of 90 bytes, whatever becomes of them. What was lost is asked for again
as one stretch from the first gap to the last, since a vehicle serves one request at a time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from .exchanges import Beat, Exchange, Progress, RefusalError, Say, nobody

_AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
_ALL = 0xFFFF
_CHUNK = 90  # bytes of LOG_DATA
WINDOW = 4096 * _CHUNK  # bytes that are asked for at a time, and handed on when they are whole
_FRUITLESS = 15  # requests in a row without an answer until nothing more is hoped for


@dataclass(frozen=True)
class Log:
    """A log of a vehicle.

    Attributes:
        number: its id in the vehicle's list, which may be another's when logs were erased.
        time: when it was begun, s since 1970; 0 when that is not known.
        size: bytes.
    """

    number: int
    time: int
    size: int

    @property
    def name(self) -> str:
        """What its file is called, without an ending."""
        when = time.strftime("%Y-%m-%d_%H-%M-%S", time.gmtime(self.time)) if self.time else "undated"
        return f"log_{self.number}_{when}"


def closing(system: int) -> list[Any]:
    """Return what ends a transfer of the autopilot of ``system``."""
    return [mavlink.MAVLink_log_request_end_message(system, _AUTOPILOT)]


def suffix_of(beat: Beat) -> str:
    """Return the ending of a vehicle's logs."""
    return ".bin" if beat.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA else ".ulg"


def fetch_list(beat: Beat) -> Exchange[list[Log]]:
    """Return which logs a vehicle has, the oldest first.

    Raises:
        RefusalError: it does not tell all of them.
    """
    ask = mavlink.MAVLink_log_request_list_message(beat.system, _AUTOPILOT, 0, _ALL)
    found: dict[int, Log] = {}
    count: int | None = None
    fruitless, news = 0, False
    outgoing = [ask]
    while count is None or len(found) < count:
        answer = yield outgoing
        outgoing = []
        if type(answer).__name__ == "LOG_ENTRY":
            count, news = answer.num_logs, True
            if count:
                found[answer.id] = Log(answer.id, answer.time_utc, answer.size)
        elif answer is None:
            fruitless = 0 if news else fruitless + 1
            if fruitless > _FRUITLESS:
                raise RefusalError(f"logs: the vehicle tells of {len(found)}{'' if count is None else f' of {count}'}",
                                   True)  # fmt: skip
            outgoing = [] if news else [ask]
            news = False
    yield Say(closing(beat.system))
    return [found[number] for number in sorted(found)]


def download(
    beat: Beat, log: Log, take: Callable[[bytes], None], start: int = 0, progress: Progress = nobody
) -> Exchange[None]:
    """Read a log.

    Args:
        beat: of the vehicle.
        log: which.
        take: given its bytes, in order, without gaps.
        start: where in it to begin, bytes: what was read before.
        progress: told of it, in kB.

    Raises:
        RefusalError: the vehicle does not send it, or it is shorter than it was said to be.
    """
    while start < log.size:
        data = yield from _window(beat, log, start, min(WINDOW, log.size - start))
        take(data)
        start += len(data)
        progress("reading log, kB", start // 1000, log.size // 1000)
    yield Say(closing(beat.system))


def _window(beat: Beat, log: Log, start: int, size: int) -> Exchange[bytes]:
    """Return a part of a log.

    Raises:
        RefusalError: the vehicle does not send it.
    """
    data = bytearray(size)
    missing = set(range(0, size, _CHUNK))
    fruitless, news = 0, False
    last = size  # where what was asked for ends
    outgoing = [_request(beat, log, start, size)]
    while missing:
        answer = yield outgoing
        outgoing = []
        over = False
        if answer is None:
            over, fruitless, news = not news, 0 if news else fruitless + 1, False
        elif type(answer).__name__ == "LOG_DATA" and answer.id == log.number and 0 <= answer.ofs - start < size:
            place = answer.ofs - start
            room = min(_CHUNK, size - place)
            if answer.count < room:
                raise RefusalError(f"log {log.number}: it ends before {log.size} bytes", True)
            if place in missing:
                data[place : place + room] = bytes(answer.data[:room])
                missing.remove(place)
                news = True
            over = place + room >= last
        if not over or not missing:
            continue
        if fruitless > _FRUITLESS:
            raise RefusalError(f"log {log.number}: the vehicle sends no more at {start} of {log.size} bytes", True)
        first, last = min(missing), min(max(missing) + _CHUNK, size)
        outgoing = [_request(beat, log, start + first, last - first)]
    return bytes(data)


def _request(beat: Beat, log: Log, start: int, size: int) -> Any:
    return mavlink.MAVLink_log_request_data_message(beat.system, _AUTOPILOT, log.number, start, size)
