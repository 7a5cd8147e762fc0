"""Parameters: services that list, read and write the autopilot's and mirror them on the ROS parameter server."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from mavros_msgs.msg import Param, ParamValue
from mavros_msgs.srv import (
    ParamGet,
    ParamGetResponse,
    ParamPull,
    ParamPullResponse,
    ParamPush,
    ParamPushResponse,
    ParamSet,
    ParamSetResponse,
)
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.codec import FrameError, decoder
from xtdrone_autopilot.parameters import former_parameters
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas

_INTEGERS = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i"}  # MAV_PARAM_TYPE to struct's letter
_REAL = 9
_TRY_LIMIT = 1.0  # s of wall time, MAVROS's PARAM_TIMEOUT
_RETRIES = 3
_LIST_LIMIT = 30  # consecutive attempts with progress
_BOOT_TIME_NS = 10_000_000_000  # MAVROS's BOOTUP_TIME
_NO_INDEX = 0xFFFF
_FENCE = "_HASH_CHECK"  # a read request for it is always answered
_FENCES = 2  # responses to it without one for a name; more than a lost datagram can explain

_decode = decoder("PARAM_VALUE")


@dataclass(frozen=True)
class _Value:
    kind: int
    number: int | float
    index: int
    count: int

    def message(self) -> ParamValue:
        """Return MAVROS's pair of values, with 0 in the unused field."""
        if self.kind == _REAL:
            return ParamValue(0, float(self.number))
        return ParamValue(int(self.number), 0.0)


def _number(kind: int, value: float) -> int | float | None:
    """Decode PARAM_VALUE.param_value; return None for a type that does not fit into it."""
    if kind == _REAL:
        return value
    letter = _INTEGERS.get(kind)
    if letter is None:
        return None
    size = struct.calcsize(letter)
    return int(struct.unpack(f"<{letter}", struct.pack("<f", value)[:size])[0])


def _wire(kind: int, number: float) -> float:
    """Encode ``number`` for PARAM_SET.param_value.

    Raises:
        struct.error, OverflowError, ValueError: the number does not fit into the type.
    """
    if kind == _REAL:
        struct.pack("<f", number)
        return number
    return float(struct.unpack("<f", struct.pack(f"<{_INTEGERS[kind]}", int(number)).ljust(4, b"\0"))[0])


class ParamPlugin(Plugin):
    """MAVROS's param. Values are fetched when a service needs them; ``set`` uses the parameter's type.

    The autopilot does not answer requests for unknown names. MAVROS, which fetches all parameters at its start, knows
    them from its table. Here a request for the hash of all parameters follows each request: its answer without one for
    the name shows that there is no such parameter.

    Answers arrive in the receiver thread, services wait in their own threads.
    """

    name = "param"

    def __init__(self, uas: Uas) -> None:
        """Offer the services and the topic."""
        super().__init__(uas)
        self._values: dict[str, _Value] = {}
        self._fences = 0  # answers to requests for the hash
        self._changed = threading.Condition()
        self._turn = threading.Lock()  # one list or write at a time
        self._complete = False
        self._topic = uas.topic("param/param_value", Param())
        self.messages = {"PARAM_VALUE": Feed(self._publish, self._topic)}
        self.replies = {"PARAM_VALUE": self._on_value}
        uas.service("param/get", ParamGet, self._get)
        uas.service("param/set", ParamSet, self._set)
        uas.service("param/pull", ParamPull, self._pull)
        uas.service("param/push", ParamPush, self._push)
        self._lists_at_ns: int | None = None  # ROS time of the list that follows a connection
        uas.timer(1.0, self._list_for_subscribers)

    def connected(self, connected: bool) -> None:
        """Drop the values of another autopilot, or of this one before a reboot."""
        self._lists_at_ns = self.uas.now_ns + _BOOT_TIME_NS if connected else None
        with self._changed:
            self._values.clear()
            self._complete = False

    def _list_for_subscribers(self) -> None:
        """Request all parameters 10 s after the connection, as MAVROS does, if a subscriber receives them."""
        if self._lists_at_ns is not None and self.uas.now_ns >= self._lists_at_ns:
            self._lists_at_ns = None
            if self._topic.needed:
                self.uas.link.send(mavlink.MAVLink_param_request_list_message(*self.uas.target))

    def _publish(self, m: Any) -> None:
        number = _number(m.param_type, m.param_value)
        if number is None or m.param_id == _FENCE:
            return
        message = self._topic.message
        self.uas.stamp_now(message.header)
        message.param_id, message.param_index, message.param_count = m.param_id, m.param_index, m.param_count
        message.value = _Value(m.param_type, number, m.param_index, m.param_count).message()
        self._topic.publish(message)

    def _on_value(self, frame: bytes) -> None:
        try:
            m = _decode(frame)
        except FrameError:
            return  # the main thread logs it
        if m.param_id == _FENCE:
            with self._changed:
                self._fences += 1
                self._changed.notify_all()
            return
        number = _number(m.param_type, m.param_value)
        if number is not None and m.param_index != _NO_INDEX:
            with self._changed:
                self._values[m.param_id] = _Value(m.param_type, number, m.param_index, m.param_count)
                self._changed.notify_all()

    def _ask(self, build: Callable[[], Iterable[Any]], answered: Callable[[], bool]) -> bool:
        """Send until ``answered`` holds, at most 1 + 3 times; return whether it does."""
        for _ in range(1 + _RETRIES):
            for message in build():
                self.uas.link.send(message)
            with self.uas.ros.needs_time(), self._changed:
                if self._changed.wait_for(answered, _TRY_LIMIT):
                    return True
        return False

    def _lookup(self, name: str) -> _Value | None:
        """Return a parameter's value, fetching it if it is not cached yet; None if it does not exist."""
        encoded = name.encode()
        if not 0 < len(encoded) <= 16 or 0 in encoded:
            return None
        with self._turn:
            if name not in self._values and not self._complete:
                self._read(name, encoded)
        return self._values.get(name)

    def _read(self, name: str, encoded: bytes) -> None:
        """Request a parameter until it arrives, or until the autopilot has shown twice that it does not exist."""
        read = mavlink.MAVLink_param_request_read_message
        for _ in range(_FENCES):
            before = self._fences
            self._ask(
                lambda: [read(*self.uas.target, asked, -1) for asked in (encoded, _FENCE.encode())],
                lambda before=before: name in self._values or self._fences > before,  # type: ignore[misc]
            )
            if name in self._values:
                return

    def _write(self, name: str, known: _Value, number: float) -> bool:
        """Write a parameter; return whether the autopilot answered with a value."""
        try:
            value = _wire(known.kind, number)
        except (struct.error, ValueError, OverflowError) as error:
            self.uas.warn(f"param {name}", "parameter %s cannot be %s: %s", name, number, error)
            return False
        target = self.uas.target
        with self._turn:
            with self._changed:
                self._values.pop(name, None)
            written = self._ask(
                lambda: [mavlink.MAVLink_param_set_message(*target, name.encode(), value, known.kind)],
                lambda: name in self._values,
            )
            with self._changed:
                self._values.setdefault(name, known)
        return written

    def _warn_of_type(self, name: str, known: _Value, asked: Any) -> None:
        """Warn about a value whose type MAVROS would pass on and PX4 would leave without an answer."""
        given, right = ("an integer", "real") if asked.integer else ("a real number", "integer")
        if (asked.integer or asked.real) and (known.kind == _REAL) == bool(asked.integer):
            text = "param/set: %s is given as %s, which a real PX4 rejects: use value.%s"
            self.uas.warn(f"param {name}", text, name, given, right)

    def _warn_of(self, service: str, name: str) -> None:
        text = "%s: parameter %s does not exist%s"
        self.uas.warn(f"param {name}", text, service, name, former_parameters.hint(name))

    def _warn_of_effect(self, name: str) -> None:
        """Warn that a parameter of PX4 v1.11 is kept only for old scripts, if the autopilot has its successors."""
        self.uas.warn(f"param {name}", "param/set: %s is out of use%s", name, former_parameters.hint(name))

    def _get(self, request: Any) -> ParamGetResponse:
        value = self._lookup(request.param_id)
        if value is None:
            self._warn_of("param/get", request.param_id)
            return ParamGetResponse(False, ParamValue())
        return ParamGetResponse(True, value.message())

    def _set(self, request: Any) -> ParamSetResponse:
        name, asked = request.param_id, request.value
        known = self._lookup(name)
        if known is None:
            self._warn_of("param/set", name)
            return ParamSetResponse(False, ParamValue())
        if name in former_parameters.NAMES:
            self._warn_of_effect(name)
        number = asked.integer if asked.integer else asked.real
        self._warn_of_type(name, known, asked)
        success = self._write(name, known, number)
        value = self._values.get(name, known)
        self.uas.ros.set_param(f"{self.uas.prefix}/param/{name}", value.number)
        return ParamSetResponse(success, value.message())

    def _pull(self, request: Any) -> ParamPullResponse:
        with self._turn:
            if request.force_pull or not self._complete:
                with self._changed:
                    self._values.clear()
                    self._complete = False
                self._complete = self._fetch()
            values = {name: value.number for name, value in sorted(self._values.items())}
        self.uas.ros.set_param(f"{self.uas.prefix}/param", values)
        return ParamPullResponse(self._complete, len(values))

    def _fetch(self) -> bool:
        """Request the list, and then its missing entries; return whether it is complete."""
        target = self.uas.target
        if not self._ask(lambda: [mavlink.MAVLink_param_request_list_message(*target)], lambda: bool(self._values)):
            return False
        count = next(iter(self._values.values())).count
        tries = 0
        while len(self._values) < count and tries < _RETRIES + 1:
            before = len(self._values)
            with self.uas.ros.needs_time(), self._changed:
                self._changed.wait_for(lambda: len(self._values) >= count, _TRY_LIMIT)
            if len(self._values) == before:
                tries += 1
                present = {value.index for value in self._values.values()}
                for index in [i for i in range(count) if i not in present][:_LIST_LIMIT]:
                    self.uas.link.send(mavlink.MAVLink_param_request_read_message(*target, b"", index))
        return len(self._values) >= count

    def _push(self, _request: Any) -> ParamPushResponse:
        mirrored = self.uas.ros.get_param(f"{self.uas.prefix}/param", {})
        sent = 0
        for name, number in sorted(mirrored.items()) if isinstance(mirrored, dict) else ():
            known = self._lookup(name)
            if known is None or isinstance(number, bool) or not isinstance(number, (int, float)):
                self.uas.warn(f"param {name}", "ROS parameter %s does not exist on the autopilot", name)
            else:  # MAVROS writes and counts those that are equal, too
                sent += number == known.number or self._write(name, known, number)
        return ParamPushResponse(True, sent)
