"""The form of an exchange with a vehicle, and the simplest exchanges: its heartbeat, single messages, its state.

An exchange is a generator. It yields the messages to send and receives the vehicle's next message out of ``ANSWERS``,
or None after a timeout; its return value is the result. The caller gives up on a vehicle that stays silent.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import Any, NamedTuple, TypeVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID

SYSTEM, COMPONENT = 254, mavlink.MAV_COMP_ID_MISSIONPLANNER
"""MAVLink ids of this ground station; 255 is QGroundControl's system id, which may be connected too."""
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1

ANSWERS = (
    "AUTOPILOT_VERSION",
    "COMMAND_ACK",
    "ESTIMATOR_STATUS",
    "EXTENDED_SYS_STATE",
    "GLOBAL_POSITION_INT",
    "GPS_GLOBAL_ORIGIN",
    "GPS_RAW_INT",
    "HEARTBEAT",
    "HOME_POSITION",
    "LOG_DATA",
    "LOG_ENTRY",
    "LOCAL_POSITION_NED",
    "MISSION_ACK",
    "MISSION_COUNT",
    "MISSION_ITEM_INT",
    "MISSION_REQUEST",
    "MISSION_REQUEST_INT",
    "PARAM_VALUE",
    "STATUSTEXT",
    "SYS_STATUS",
    "TIMESYNC",
)
"""Messages that are passed to exchanges."""

_REQUESTS = 100  # requests of a message before the vehicle counts as not having it
_STATE_MESSAGES = (
    "SYS_STATUS",
    "EXTENDED_SYS_STATE",
    "GLOBAL_POSITION_INT",
    "LOCAL_POSITION_NED",
    "GPS_RAW_INT",
    "ESTIMATOR_STATUS",
)
_STATE_REQUESTS = 4  # consecutive unanswered requests before the missing messages count as not available

Progress = Callable[[str, int, int], None]
"""Callback for progress: description, number of finished parts, total number of parts."""

T = TypeVar("T")
Exchange = Generator[list[Any], Any, T]


class Heartbeat(NamedTuple):
    """A vehicle's HEARTBEAT with its sender, as passed to exchanges.

    Attributes:
        system: MAVLink system id.
        autopilot: MAV_AUTOPILOT.
        kind: MAV_TYPE.
        base_mode, custom_mode: its mode.
    """

    system: int
    autopilot: int
    kind: int
    base_mode: int
    custom_mode: int


class Presence(NamedTuple):
    """The sender of a TIMESYNC, as passed to exchanges: the reply to ``probe``."""

    system: int


class RefusalError(Exception):
    """The vehicle has rejected a request.

    Attributes:
        final: whether a retry is useless.
    """

    def __init__(self, text: str, final: bool) -> None:
        super().__init__(text)
        self.final = final


class Unanswered(list[Any]):
    """Messages without an answer; the caller sends them and resumes the exchange at once."""


def ignore_progress(_what: str, _done: int, _total: int) -> None:
    """Discard progress."""


def is_message(message: Any, *names: str) -> bool:
    """Return whether a message is of one of these types."""
    return type(message).__name__ in names


def probe() -> list[Any]:
    """Return a message that every vehicle answers without any effect on its flight."""
    return [mavlink.MAVLink_timesync_message(0, 1)]


def request_message(system: int, number: int) -> Any:
    """Return the request for one transmission of a message (its id)."""
    return mavlink.MAVLink_command_long_message(
        system, AUTOPILOT, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, number, *[0.0] * 6
    )


def await_heartbeat(system: int = 0) -> Exchange[Heartbeat]:
    """Wait for the heartbeat of a vehicle; ``system``: its id, 0 if unknown."""
    answer = yield [*probe(), *([request_message(system, mavlink.MAVLINK_MSG_ID_HEARTBEAT)] if system else [])]
    while not isinstance(answer, Heartbeat):
        if isinstance(answer, Presence):
            system = answer.system
        ask = [request_message(system, mavlink.MAVLINK_MSG_ID_HEARTBEAT)] if system else probe()
        answer = yield ask if answer is None or isinstance(answer, Presence) else []
    return answer


def fetch_message(system: int, name: str) -> Exchange[Any]:
    """Request a message and return it; None if the vehicle does not have it."""
    ask = request_message(system, MESSAGE_ID[name])
    answer = yield [ask]
    for _ in range(_REQUESTS):
        while answer is not None:
            if is_message(answer, name):
                return answer
            denied = is_message(answer, "COMMAND_ACK") and answer.command == mavlink.MAV_CMD_REQUEST_MESSAGE
            if denied and answer.result != mavlink.MAV_RESULT_ACCEPTED:
                return None
            answer = yield []
        answer = yield [ask]
    return None


def request_state(heartbeat: Heartbeat) -> Exchange[None]:
    """Request all messages of a vehicle's state once, which works also while its time stands still."""
    missing = dict.fromkeys(_STATE_MESSAGES)
    unanswered = 0
    outgoing = _requests(heartbeat.system, missing)
    while missing and unanswered < _STATE_REQUESTS:
        answer = yield outgoing
        outgoing = []
        name = type(answer).__name__
        if name in missing:
            del missing[name]
            unanswered = 0
        elif answer is None:
            unanswered += 1
            outgoing = _requests(heartbeat.system, missing)


def _requests(system: int, names: Iterable[str]) -> list[Any]:
    return [request_message(system, MESSAGE_ID[name]) for name in names]
