"""Transfers of missions, geofences and rally points for blocking services.

Calls block in service threads; messages arrive in the receiver thread. Timeouts are wall time, as for commands: they
detect an autopilot that does not answer, independently of simulated time.
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

from xtdrone_autopilot.mavlink.wire.codec import decoder
from xtdrone_mavros.link.ros_values_to_mavlink import pack, whole

LIMIT = 1.0  # s, timeout of an answer, MAVROS's WP_TIMEOUT
RETRIES = 3
_ACCEPTED = 0  # MAV_MISSION_RESULT
_GLOBAL_FRAMES = (0, 3, 5, 6, 10, 11)
_LOCAL_FRAMES = (1, 4, 7, 8, 9, 12, 20, 21)
_ANSWERS = ("MISSION_ACK", "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_REQUEST", "MISSION_REQUEST_INT")
MISSION = 0  # MAV_MISSION_TYPE
_DRY = mavlink.MAVLink(None)  # packs items for validation before the first one is sent


def _scale(frame: int) -> float:
    """Return the factor of a waypoint's x and y in MISSION_ITEM_INT."""
    if frame in _GLOBAL_FRAMES:
        return 1e7
    return 1e4 if frame in _LOCAL_FRAMES else 1.0


def _integer(value: float) -> int | float:
    """Return a scaled coordinate; NaN (none) becomes 0, as MAVLink's integers have no other representation."""
    return 0 if math.isnan(value) else whole(value)


def to_waypoint(item: Any) -> Waypoint:
    """Convert a MISSION_ITEM_INT to a waypoint."""
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
    """Convert a waypoint to a MISSION_ITEM_INT."""
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
    """Transfers with one autopilot; they run one at a time.

    Attributes:
        replies: MAVLink name to the function that the receiver thread calls with each of its frames.
    """

    def __init__(
        self,
        send: Callable[[Any], None],
        target: tuple[int, int],
        meanwhile: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        """Prepare the transfers.

        Args:
            send: sends a message.
            target: the autopilot's system and component id.
            meanwhile: returns a context manager that is held while waiting for an answer.
        """
        self._send = send
        self._target = target
        self._meanwhile = meanwhile
        self._turn = threading.Lock()
        self._waiting = False
        self._inbox: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        names = (*_ANSWERS, "MISSION_CURRENT")
        self.replies: dict[str, Callable[[bytes], None]] = {name: self._collector(name) for name in names}

    def _collector(self, name: str) -> Callable[[bytes], None]:
        decode = decoder(name)

        def collect(frame: bytes) -> None:
            if self._waiting:  # otherwise unsolicited
                self._inbox.put((name, decode(frame)))

        return collect

    def push(self, kind: int, waypoints: Sequence[Any]) -> tuple[bool, int]:
        """Replace the list ``kind``; return whether the autopilot accepted it, and how many items it requested.

        Raises:
                FieldError: too many waypoints, or a value that MAVLink cannot represent; nothing is sent.
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
        """Return the list ``kind``, None if the autopilot does not send it."""
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
        """Clear the list ``kind``; return whether the autopilot accepted."""
        with self._exchange():
            found = self._ask(mavlink.MAVLink_mission_clear_all_message(*self._target, kind), kind, "MISSION_ACK")
            return found is not None and found[1].type == _ACCEPTED

    def set_current(self, seq: int) -> bool:
        """Make ``seq`` the current mission item; return whether the autopilot confirmed it within 4 s."""
        ask = mavlink.MAVLink_mission_set_current_message(*self._target, seq)
        with self._exchange():
            for _ in range(1 + RETRIES):
                self._send(ask)
                if self._wait(lambda name, m: name == "MISSION_CURRENT" and m.seq == seq) is not None:
                    return True
            return False

    def _ask(self, message: Any, kind: int, *names: str) -> tuple[str, Any] | None:
        """Send a request, with retries, and return the first answer among ``names`` for the list ``kind``."""
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

    def claim(self) -> bool:
        """Return whether no transfer is running, and if so keep the next ones waiting until ``release``."""
        return self._turn.acquire(blocking=False)

    def release(self) -> None:
        """End a claim."""
        self._turn.release()

    @contextmanager
    def _exchange(self) -> Iterator[None]:
        """Hold the lock and receive messages, starting with an empty inbox."""
        with self._meanwhile():  # a claim ends as time advances
            self._turn.acquire()
        try:
            while not self._inbox.empty():
                self._inbox.get()
            self._waiting = True
            yield
        finally:
            self._waiting = False
            self._turn.release()
