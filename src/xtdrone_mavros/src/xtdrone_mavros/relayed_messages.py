"""Plugins that relay messages unchanged: a table maps messages to topics instead of a class for each.

A row copies the fields that have the same name on both sides; a conversion function provides the others. Time stamps,
target ids and the header's frame are filled in automatically.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial
from operator import attrgetter
from typing import Any, ClassVar

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID, MESSAGES, message
from xtdrone_mavros.feeds import Feed, Topic
from xtdrone_mavros.link.ros_values_to_mavlink import FieldError, require_finite
from xtdrone_mavros.uas import Plugin, Uas

_STAMPS = ("time_usec", "time_boot_ms", "time_last_baseline_ms")

Convert = Callable[[Any], Mapping[str, Any]]


def _nothing(_: Any) -> Mapping[str, Any]:
    return {}


class Out:
    """A MAVLink message that is published.

    Attributes:
        message: MAVLink name.
        topic: topic below the vehicle's prefix.
        kind: ROS type.
        latch: whether the topic is latched.
        frame_id: frame_id of the header.
    """

    def __init__(
        self,
        message: str,
        topic: str,
        kind: type,
        convert: Convert = _nothing,
        *,
        frame_id: str = "",
        latch: bool = False,
        any_sender: bool = False,
    ) -> None:
        """Define a row.

        Args:
            message: MAVLink name.
            topic: topic below the vehicle's prefix.
            kind: ROS type.
            convert: maps the MAVLink message to ROS fields by name (``geo.latitude``); overrides fields of equal name.
            frame_id: frame_id of the header.
            latch: keep the last message for later subscribers.
            any_sender: accept it from every system and component, not only from the autopilot.
        """
        self.message, self.topic, self.kind = message, topic, kind
        self.frame_id, self.latch, self.any_sender = frame_id, latch, any_sender
        self._convert = convert
        known = MESSAGES[MESSAGE_ID[message]].fieldnames
        self._same = [name for name in _slots(kind) if name in known]
        self._header = "header" in _slots(kind)
        self._time = next((name for name in _STAMPS if name in known), "")

    def publish(self, uas: Uas, topic: Topic, m: Any) -> None:
        """Publish ``m``, a decoded MAVLink message, on ``topic``."""
        ros = topic.message
        if self._header:
            self._stamp(uas, ros.header, m)
        for name in self._same:
            setattr(ros, name, getattr(m, name))
        try:
            converted = self._convert(m)
        except FieldError as error:
            uas.warn(self.topic, "%s: %s; the message is not published", self.topic, error)
            return
        for path, value in converted.items():
            parent, _, leaf = path.rpartition(".")
            setattr(attrgetter(parent)(ros) if parent else ros, leaf, value)
        topic.publish(ros)

    def _stamp(self, uas: Uas, header: Any, m: Any) -> None:
        if self._time == "time_usec":
            uas.stamp_us(header, m.time_usec)
        elif self._time:
            uas.stamp(header, getattr(m, self._time))
        else:
            uas.stamp_now(header)


class In:
    """A topic that is forwarded to the autopilot."""

    def __init__(
        self,
        topic: str,
        kind: type,
        message: str,
        convert: Convert = _nothing,
        *,
        as_component: str = "",
        rate: tuple[str, float] | None = None,
        free: Collection[str] = (),
    ) -> None:
        """Define a row.

        Args:
            topic: topic below the vehicle's prefix.
            kind: ROS type.
            message: MAVLink name.
            convert: maps the ROS message to MAVLink fields; overrides equal names. Fields missing in both are 0.
            as_component: ROS field with the component id of the sender.
            rate: parameter and default (Hz) of the rate limit; faster messages are dropped.
            free: MAVLink fields that need not be finite, e.g. where NaN means "unknown".
        """
        self.topic, self.kind, self.message, self.rate = topic, kind, message, rate
        self._convert = convert
        self._as_component = as_component
        self._free = frozenset(free)
        definition: Any = MESSAGES[MESSAGE_ID[message]]
        lengths = dict(zip(definition.ordered_fieldnames, definition.lengths, strict=True))
        self._zeros = {
            name: b"" if kind == "char" else [0] * lengths[name] if lengths[name] > 1 else 0
            for name, kind in zip(definition.fieldnames, definition.fieldtypes, strict=True)
        }
        self._same = [name for name in self._zeros if name in _slots(kind)]

    def forward(self, uas: Uas, ros: Any) -> None:
        """Send the ROS message as MAVLink.

        Raises:
            FieldError: a value is not finite or does not fit.
        """
        values = dict(self._zeros)
        for name, value in (("target_system", uas.target[0]), ("target_component", uas.target[1])):
            if name in values:
                values[name] = value
        if hasattr(ros, "header"):
            ns = ros.header.stamp.to_nsec()
            values |= {name: time for name, time in _times(ns) if name in values}
        values |= {name: _plain(getattr(ros, name)) for name in self._same}
        values |= self._convert(ros)
        out = message(self.message, values)
        require_finite(out, self._free)
        uas.link.send(out, getattr(ros, self._as_component) if self._as_component else None)


class Relay(Plugin):
    """A plugin defined by a table.

    Attributes:
        outs: rows that publish.
        ins: rows that forward.
        topics: topics of ``outs``, by name.
    """

    outs: ClassVar[tuple[Out, ...]] = ()
    ins: ClassVar[tuple[In, ...]] = ()

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe."""
        super().__init__(uas)
        self.topics: dict[str, Topic] = {}
        for out in self.outs:
            self.topics[out.topic] = topic = uas.topic(out.topic, out.kind(), latch=out.latch, on_demand=True)
            if out.frame_id:
                topic.message.header.frame_id = out.frame_id
            self.messages[out.message] = Feed(partial(out.publish, uas, topic), topic, any_sender=out.any_sender)
        for row in self.ins:
            forward = partial(row.forward, uas)
            uas.subscribe(row.topic, row.kind, limit_rate(uas, forward, *row.rate) if row.rate else forward)


def relay(plugin: str, *rows: Out | In) -> type[Relay]:
    """Return a class for the plugin ``plugin`` that relays ``rows``."""

    class Made(Relay):
        name = plugin
        outs = tuple(row for row in rows if isinstance(row, Out))
        ins = tuple(row for row in rows if isinstance(row, In))

    Made.__name__ = Made.__qualname__ = f"Relay<{plugin}>"
    return Made


def limit_rate(uas: Uas, call: Callable[[Any], None], parameter: str, default: float) -> Callable[[Any], None]:
    """Return ``call`` limited to the rate in ``parameter`` (Hz of ROS time).

    Raises:
        ValueError: the rate is not positive.
    """
    rate = uas.params.get(parameter, default)
    if not rate > 0.0:
        raise ValueError(f"{parameter}: {rate} Hz is not allowed, more than 0")
    period_ns = round(1e9 / rate)
    last_ns = -period_ns

    def call_limited(ros: Any) -> None:
        nonlocal last_ns
        now_ns = uas.ros.now_ns()
        if not 0 <= now_ns - last_ns < period_ns:  # a negative difference means that the simulation was reset
            last_ns = now_ns
            call(ros)

    return call_limited


def text(value: str, size: int) -> bytes:
    """Return a text for a MAVLink field of ``size`` bytes, truncated as in MAVROS."""
    return value.encode("utf-8", "replace")[:size]


def wrap_bits(value: int, bits: int) -> int:
    """Return an unsigned number as the signed number of ``bits`` bits with the same bit pattern, like a C++ cast."""
    return value - (1 << bits) if value >> (bits - 1) & 1 else value


def _slots(kind: Any) -> list[str]:
    return list(kind.__slots__)


def _times(ns: int) -> tuple[tuple[str, int], ...]:
    return ("time_usec", ns // 1000), ("usec", ns // 1000), ("time_boot_ms", ns // 1_000_000 & 0xFFFFFFFF)


def _plain(value: Any) -> Any:
    """Convert an array to a list for MAVLink's message objects; rospy provides bytes, a list or a tuple."""
    return list(value) if isinstance(value, (bytes, tuple, list)) else value
