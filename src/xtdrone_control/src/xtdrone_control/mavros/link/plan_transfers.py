"""Missions, geofences and rally points to and from the autopilot, for services that wait.

Calls come from service threads and wait there; messages come from the receiver thread. Time-outs are wall time, as with
commands: they give up on an autopilot that does not answer, whatever the simulated time does meanwhile.
"""

from __future__ import annotations

import contextlib
import math
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from mavros_msgs.msg import Waypoint
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.mavlink.wire.codec import decoder
from xtdrone_control.mavros.link.packing import pack, whole

LIMIT = 1.0  # s for an answer, as MAVROS's WP_TIMEOUT
RETRIES = 3
_ACCEPTED = 0  # MAV_MISSION_RESULT
_GLOBAL_FRAMES = (0, 3, 5, 6, 10, 11)
_LOCAL_FRAMES = (1, 4, 7, 8, 9, 12, 20, 21)
_ANSWERS = ("MISSION_ACK", "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_REQUEST", "MISSION_REQUEST_INT")
MISSION = 0  # MAV_MISSION_TYPE
_DRY = mavlink.MAVLink(None)  # packs what is checked before the first of it is sent


def _scale(frame: int) -> float:
    """Return what a waypoint's x and y are multiplied by in MISSION_ITEM_INT."""
    if frame in _GLOBAL_FRAMES:
        return 1e7
    return 1e4 if frame in _LOCAL_FRAMES else 1.0


def _integer(value: float) -> int | float:
    """Return a scaled coordinate; NaN, which means none, as 0, as MAVLink has no other word for it in an integer."""
    return 0 if math.isnan(value) else whole(value)


def to_waypoint(item: Any) -> Waypoint:
    """Return a MISSION_ITEM_INT as a waypoint."""
    scale = _scale(item.frame)
    return Waypoint(
        frame=item.frame,
        command=item.command,
        is_current=bool(item.current),
        autocontinue=bool(item.autocontinue),
        param1=item.param1,
        param2=item.param2,
        param3=item.param3,
        param4=item.param4,
        x_lat=item.x / scale,
        y_long=item.y / scale,
        z_alt=item.z,
    )


def to_item(waypoint: Any, seq: int, kind: int, target: tuple[int, int]) -> Any:
    """Return a waypoint as MISSION_ITEM_INT."""
    scale = _scale(waypoint.frame)
    return mavlink.MAVLink_mission_item_int_message(
        *target,
        seq,
        waypoint.frame,
        waypoint.command,
        int(waypoint.is_current),
        int(waypoint.autocontinue),
        waypoint.param1,
        waypoint.param2,
        waypoint.param3,
        waypoint.param4,
        _integer(waypoint.x_lat * scale),
        _integer(waypoint.y_long * scale),
        waypoint.z_alt,
        kind,
    )


class PlanTransfers:
    """The transfers with one autopilot; they take turns.

    Attributes:
        replies: MAVLink name to what the receiver thread calls with each frame of it.
    """

    def __init__(
        self,
        send: Callable[[Any], None],
        target: tuple[int, int],
        meanwhile: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        """Prepare.

        Args:
            send: sends a message.
            target: the autopilot's system and component id.
            meanwhile: returns what is to be entered while an answer is waited for.
        """
        self._send = send
        self._target = target
        self._meanwhile = meanwhile
        self._turn = threading.Lock()
        self._waiting = False
        self._inbox: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        names = (*_ANSWERS, "MISSION_CURRENT")
        self.replies: dict[str, Callable[[bytes], None]] = {name: self._taker(name) for name in names}

    def _taker(self, name: str) -> Callable[[bytes], None]:
        decode = decoder(name)

        def take(frame: bytes) -> None:
            if self._waiting:  # else nobody has asked
                self._inbox.put((name, decode(frame)))

        return take

    def push(self, kind: int, waypoints: Sequence[Any]) -> tuple[bool, int]:
        """Replace the list ``kind``; return whether the autopilot took it, and how many items it asked for.

        Raises:
            FieldError: too many waypoints, or a value that MAVLink cannot hold; nothing is sent.
        """
        count = mavlink.MAVLink_mission_count_message(*self._target, len(waypoints), kind)
        pack(count, _DRY)
        for seq, waypoint in enumerate(waypoints):
            pack(to_item(waypoint, seq, kind, self._target), _DRY)
        asked = 0
        with self._exchange():
            message: Any = count
            while True:
                found = self._ask(message, kind, "MISSION_ACK", "MISSION_REQUEST", "MISSION_REQUEST_INT")
                if found is None:
                    return False, asked
                name, answer = found
                if name == "MISSION_ACK":
                    return answer.type == _ACCEPTED and asked == len(waypoints), asked
                if answer.seq < len(waypoints):
                    asked = max(asked, answer.seq + 1)
                    message = to_item(waypoints[answer.seq], answer.seq, kind, self._target)

    def pull(self, kind: int) -> list[Waypoint] | None:
        """Return the list ``kind``, None when the autopilot does not tell it."""
        with self._exchange():
            found = self._ask(mavlink.MAVLink_mission_request_list_message(*self._target, kind), kind, "MISSION_COUNT")
            if found is None:
                return None
            items = []
            for seq in range(found[1].count):
                item = self._fetch(seq, kind)
                if item is None:
                    return None
                items.append(to_waypoint(item))
            self._send(mavlink.MAVLink_mission_ack_message(*self._target, _ACCEPTED, kind))
            return items

    def _fetch(self, seq: int, kind: int) -> Any:
        ask = mavlink.MAVLink_mission_request_int_message(*self._target, seq, kind)
        for _ in range(1 + RETRIES):
            found = self._ask(ask, kind, "MISSION_ITEM_INT", "MISSION_ACK")
            if found is None or found[0] == "MISSION_ACK":
                return None
            if found[1].seq == seq:
                return found[1]
        return None

    def clear(self, kind: int) -> bool:
        """Empty the list ``kind``; return whether the autopilot did."""
        with self._exchange():
            found = self._ask(mavlink.MAVLink_mission_clear_all_message(*self._target, kind), kind, "MISSION_ACK")
            return found is not None and found[1].type == _ACCEPTED

    def set_current(self, seq: int) -> bool:
        """Make ``seq`` the current mission item; return whether the autopilot told so within 4 s."""
        ask = mavlink.MAVLink_mission_set_current_message(*self._target, seq)
        with self._exchange():
            for _ in range(1 + RETRIES):
                self._send(ask)
                if self._wait(lambda name, m: name == "MISSION_CURRENT" and m.seq == seq) is not None:
                    return True
            return False

    def _ask(self, message: Any, kind: int, *names: str) -> tuple[str, Any] | None:
        """Send, a few times, and return the first of the answers ``names`` for the list ``kind``."""
        for _ in range(1 + RETRIES):
            self._send(message)
            found = self._wait(lambda name, m: name in names and m.mission_type == kind)
            if found is not None:
                return found
        return None

    def _wait(self, fits: Callable[[str, Any], bool]) -> tuple[str, Any] | None:
        end = time.monotonic() + LIMIT
        with self._meanwhile():
            while True:
                try:
                    found = self._inbox.get(timeout=max(end - time.monotonic(), 0.0))
                except queue.Empty:
                    return None
                if fits(*found):
                    return found

    @contextmanager
    def _exchange(self) -> Iterator[None]:
        """Take the turn and listen, with nothing heard so far."""
        with self._turn:
            while not self._inbox.empty():
                self._inbox.get()
            self._waiting = True
            try:
                yield
            finally:
                self._waiting = False
