"""Exchanges of MAVLink's log protocol (LOG_REQUEST_LIST and LOG_REQUEST_DATA).

A vehicle sends the requested part of a log in messages of 90 bytes without confirmation, and serves one request at a
time. So lost messages are requested again as one range, from the first gap to the last.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from .exchange import AUTOPILOT, Exchange, Heartbeat, Progress, RefusalError, Unanswered, ignore_progress

_ALL = 0xFFFF
_CHUNK = 90  # bytes of LOG_DATA
WINDOW = 4096 * _CHUNK  # bytes per request, written once they are complete
_UNANSWERED = 15  # consecutive unanswered requests before giving up


@dataclass(frozen=True)
class Log:
    """A log of a vehicle.

    Attributes:
        number: id in the vehicle's list, which may change when logs are erased.
        time: start of the log, s since 1970; 0 if unknown.
        size: bytes.
    """

    number: int
    time: int
    size: int

    @property
    def name(self) -> str:
        """Name of its file without suffix."""
        when = time.strftime("%Y-%m-%d_%H-%M-%S", time.gmtime(self.time)) if self.time else "undated"
        return f"log_{self.number}_{when}"


def end_transfer(system: int) -> list[Any]:
    """Return the messages that end a transfer of the autopilot of ``system``."""
    return [mavlink.MAVLink_log_request_end_message(system, AUTOPILOT)]


def fetch_list(heartbeat: Heartbeat) -> Exchange[list[Log]]:
    """Return the logs of a vehicle, oldest first.

    Raises:
        RefusalError: the vehicle does not list all of them.
    """
    ask = mavlink.MAVLink_log_request_list_message(heartbeat.system, AUTOPILOT, 0, _ALL)
    found: dict[int, Log] = {}
    count: int | None = None
    unanswered, news = 0, False
    outgoing = [ask]
    while count is None or len(found) < count:
        answer = yield outgoing
        outgoing = []
        if type(answer).__name__ == "LOG_ENTRY":
            count, news = answer.num_logs, True
            if count:
                found[answer.id] = Log(answer.id, answer.time_utc, answer.size)
        elif answer is None:
            unanswered = 0 if news else unanswered + 1
            if unanswered > _UNANSWERED:
                known = "" if count is None else f" of {count}"
                raise RefusalError(f"logs: the vehicle has listed {len(found)}{known}", True)
            outgoing = [] if news else [ask]
            news = False
    yield Unanswered(end_transfer(heartbeat.system))
    return [found[number] for number in sorted(found)]


def download(
    heartbeat: Heartbeat, log: Log, write: Callable[[bytes], None], start: int = 0, progress: Progress = ignore_progress
) -> Exchange[None]:
    """Download a log.

    Args:
        heartbeat: of the vehicle.
        log: the log.
        write: callback for its bytes, in order and without gaps.
        start: first byte to download.
        progress: callback, in kB.

    Raises:
        RefusalError: the vehicle does not send it, or it is shorter than announced.
    """
    while start < log.size:
        data = yield from _window(heartbeat, log, start, min(WINDOW, log.size - start))
        write(data)
        start += len(data)
        progress("reading log, kB", start // 1000, log.size // 1000)
    yield Unanswered(end_transfer(heartbeat.system))


def _window(heartbeat: Heartbeat, log: Log, start: int, size: int) -> Exchange[bytes]:
    """Download a part of a log.

    Raises:
        RefusalError: the vehicle does not send it.
    """
    data = bytearray(size)
    missing = set(range(0, size, _CHUNK))
    unanswered, news = 0, False
    last = size  # end of the requested range
    outgoing = [_request(heartbeat, log, start, size)]
    while missing:
        answer = yield outgoing
        outgoing = []
        over = False
        if answer is None:
            over, unanswered, news = not news, 0 if news else unanswered + 1, False
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
        if unanswered > _UNANSWERED:
            raise RefusalError(f"log {log.number}: the vehicle sends no more at {start} of {log.size} bytes", True)
        first, last = min(missing), min(max(missing) + _CHUNK, size)
        outgoing = [_request(heartbeat, log, start + first, last - first)]
    return bytes(data)


def _request(heartbeat: Heartbeat, log: Log, start: int, size: int) -> Any:
    return mavlink.MAVLink_log_request_data_message(heartbeat.system, AUTOPILOT, log.number, start, size)
