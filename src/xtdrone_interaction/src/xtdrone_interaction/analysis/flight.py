"""What happened to all vehicles of a recording. Bags of ours and of real MAVROS, under any namespace.

A vehicle is a namespace with MAVROS's topics: ``/iris_0/mavros/...`` is iris_0, ``/mavros/...`` is "mavros". Positions
are ENU, metres. Times are the messages' own stamps, where they have any that make sense, else the recorder's; they
count from the beginning of the recording if that is a date, and are simulated time as it is if it is small.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_interaction.analysis.columns import MOST_VALUES, Array, Columns, Series
from xtdrone_interaction.analysis.layout import STAMP, Decoded, Fixed, Layout, List, MessageError, Texts, records_at
from xtdrone_interaction.analysis.places import complete, nearby
from xtdrone_interaction.analysis.ros1bag import BagError, Batch, Connection
from xtdrone_interaction.analysis.source import Layouts, Losses, Source, by_connection, large_batches, open_sources
from xtdrone_interaction.geometry import (
    EVENTS_TOPIC,
    PATTERN_TOPIC,
    TOPOLOGY_TOPIC,
    TRUTH_TOPIC,
    natural_order,
    offsets_from_message,
)
from xtdrone_interaction.record import COLLISION, LOG_TOPIC, ODOMETRY, Change, regular_times

WARNING = 4  # rosgraph_msgs/Log; more is worse
_DATE = 1e8  # s; times above are dates, not simulated
_FAR = 3600.0  # s between a stamp and the recorder's clock; further apart, they are of different clocks
_SET_BACK = 1_000_000_000  # ns; a clock that goes back by more was set back
_MOST_TEXTS = 2000  # of a topic; more are only counted
_MODEL_STATES = "gazebo_msgs/ModelStates"
# Whose places are a model's, without times of their own or with; no vehicle's names.
_MODEL, _TRUE = "/gazebo", "/truth"

_PLACES = frozenset({"pose", "odometry", "velocity"})
_XYZ = ("x", "y", "z")
_QUATERNION = ("x", "y", "z", "w")


def _under(prefix: str, names: tuple[str, ...] = _XYZ) -> tuple[str, ...]:
    return tuple(f"{prefix}.{name}" if prefix else name for name in names)


_VECTORS = (_under("linear"), _under("twist.linear"), _under(""), _under("vector"))
# By what comes after the vehicle's namespace: what it is, and the fields it may be in.
_NUMBERS: dict[str, tuple[str, tuple[tuple[str, ...], ...]]] = {
    "mavros/local_position/pose": (
        "pose",
        (_under("pose.position") + _under("pose.orientation", _QUATERNION),),
    ),
    "mavros/local_position/odom": (
        "odometry",
        (_under("pose.pose.position") + _under("pose.pose.orientation", _QUATERNION) + _under("twist.twist.linear"),),
    ),
    "mavros/local_position/velocity_local": ("velocity", (_under("twist.linear"),)),
    "mavros/setpoint_raw/local": ("setpoint", (("type_mask", *_under("position"), *_under("velocity")),)),
    "mavros/setpoint_raw/target_local": ("target", (("type_mask", *_under("position"), *_under("velocity")),)),
    "mavros/setpoint_position/local": ("position setpoint", (_under("pose.position"),)),
    "mavros/setpoint_velocity/cmd_vel": ("velocity setpoint", (_under("twist.linear"),)),
    "mavros/setpoint_velocity/cmd_vel_unstamped": ("velocity setpoint", (_under("linear"),)),
    "mavros/battery": ("battery", (("voltage", "percentage", "current"),)),
    "mavros/imu/data_raw": ("raw imu", (_under("angular_velocity") + _under("linear_acceleration"),)),
    "mavros/imu/data": ("imu", (_under("angular_velocity") + _under("linear_acceleration"),)),
    "mavros/global_position/global": ("global", (("latitude", "longitude", "altitude"),)),
}
_COMMANDS = {
    "cmd_vel_enu": "command",
    "cmd_vel_flu": "body command",
    "cmd_accel_enu": "acceleration command",
    "cmd_accel_flu": "body acceleration command",
    "avoid_vel": "avoidance",
    "avoid_accel": "avoidance",
}
_MAVROS = re.compile(r"^(?P<space>.*?)/?(?P<rest>mavros/.+)$")
_TRUTH = re.compile(r"^/xtdrone/(?P<name>[^/]+)/ground_truth/odom$")
_XTDRONE = re.compile(r"^/xtdrone/(?P<name>[^/]+)/(?P<rest>[^/]+)$")


@dataclass
class Topic:
    """How often something was said.

    Attributes:
        name, type: of the topic.
        publishers: how many.
        count: messages.
        bytes: of them.
        first, last: when, by the recorder's clock, ns.
    """

    name: str
    type: str
    publishers: int = 0
    count: int = 0
    bytes: int = 0
    first: int = 2**63 - 1
    last: int = -(2**63)

    @property
    def rate(self) -> float:
        """Messages a second."""
        span = (self.last - self.first) * 1e-9
        return (self.count - 1) / span if span > 0 else math.nan


@dataclass
class Vehicle:
    """What one vehicle did.

    Attributes:
        name: last part of its namespace.
        series: by what it is: "pose" (x, y, z m, quaternion x, y, z, w), "velocity" (m/s), "setpoint" and "target"
            (type mask, position, velocity), "position setpoint", "velocity setpoint"; XTDrone's "command" and "body
            command" (m/s), "acceleration command" and "body acceleration command" (m/s2), "avoidance" (m/s or m/s2);
            "battery" (V, share, A that flow into it), "global" (degrees, m), "imu" (rad/s and m/s2, front, left, up).
        thinned: those of which not every message was kept.
        modes: from when on it was in which mode.
        armed: from when on it was armed or not.
        commands: what it was told by XTDrone's command topic, with times.
        texts: what the autopilot said: time, severity (0 worst), text.
    """

    name: str
    series: dict[str, Series] = field(default_factory=dict)
    thinned: set[str] = field(default_factory=set)
    modes: list[tuple[float, str]] = field(default_factory=list)
    armed: list[tuple[float, bool]] = field(default_factory=list)
    commands: list[tuple[float, str]] = field(default_factory=list)
    texts: list[tuple[float, int, str]] = field(default_factory=list)

    @property
    def position(self) -> Series | None:
        """Its place, m ENU, shape (t, 3)."""
        pose = self.series.get("pose")
        return Series(pose.time, pose.value[:, :3]) if pose is not None else None


@dataclass
class Flight:
    """What a recording says.

    Attributes:
        path: of the recording.
        size: bytes.
        notes: what could not be read or is not as it seems, in words.
        cut: whether the recorder did not end in peace.
        parts: how many flights it holds, one after the other, with simulated time set back between them; this is one.
        origin: what times count from: 0 for simulated time, else s since 1970.
        duration: from the first to the last message, s.
        topics: in order of their names.
        vehicles: in order of their names.
        models: true places by name of the model, where they were recorded, m, each (t, 3).
        patterns: assigned offsets at each change, as in :class:`~xtdrone_interaction.record.FlightRecord`.
        topologies: as there.
        events: the director's, as recorded.
        log: warnings and worse of nodes: time, level, node, text.
        collisions: what the simulator said of vehicles that touched.
    """

    path: Path
    size: int
    notes: list[str] = field(default_factory=list)
    cut: bool = False
    parts: int = 1
    origin: float = 0.0
    duration: float = 0.0
    topics: list[Topic] = field(default_factory=list)
    vehicles: list[Vehicle] = field(default_factory=list)
    models: dict[str, Series] = field(default_factory=dict)
    patterns: list[Change] = field(default_factory=list)
    topologies: list[Change] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    log: list[tuple[float, int, str, str]] = field(default_factory=list)
    collisions: list[str] = field(default_factory=list)

    @property
    def time_name(self) -> str:
        """What the time axes say."""
        return "time since the recording began [s]" if self.origin else "simulated time [s]"


def read_flight(
    path: Path | Sequence[Path],
    most_values: int = MOST_VALUES,
    progress: Callable[[int], None] | None = None,
    part: int | None = None,
) -> Flight:
    """Read a recording.

    Args:
        path: of a ROS 1 bag, whole or cut off, or of a ROS 2 bag; or of several of one recording, in order of time.
        most_values: numbers kept; of longer recordings not every message is kept, and the notes say so.
        progress: gets the bytes of messages that were handled.
        part: which flight, from 1, if simulated time was set back between several; None for the longest.

    Raises:
        BagError: nothing can be read of it, or it has no such part.
    """
    source = open_sources([path] if isinstance(path, Path) else path)
    clock = _Clock()
    reading = _Reading(source, most_values)
    spans: list[tuple[float, float]] = []
    chosen: tuple[int, _Reading] | None = None

    def end_part() -> None:
        nonlocal chosen
        start, end = reading.span
        longest = max((end - start for start, end in spans), default=-1.0)
        spans.append((start, end))
        if len(spans) == part or (part is None and end - start > longest):
            chosen = len(spans), reading

    for batch in large_batches(source):
        for messages, set_back in clock.parts(batch):
            if set_back:
                end_part()
                reading = _Reading(source, most_values)
            for number, same in by_connection(messages):
                clock.saw(number, same.time)
                reading.take(number, same)
        if progress is not None:
            progress(len(batch.data))
    end_part()
    if chosen is None:
        raise BagError(f"part: {str(source.path)!r} has no part {part}; there are 1 to {len(spans)}")
    flight = chosen[1].flight()
    if clock.steps:
        flight.notes.append(f"the recorder's clock was set back {clock.steps} times; all is shown in order of time")
    if len(spans) > 1:
        flight.parts = len(spans)
        words = "; ".join(f"{i}: {start:.1f} to {end:.1f} s" for i, (start, end) in enumerate(spans, 1))
        flight.notes.append(
            f"time was set back {len(spans) - 1} times, so there are {len(spans)} parts ({words}); part {chosen[0]} is "
            "shown, another with --part"
        )
    return flight


class _Clock:
    """Watches whether time goes on, topic by topic: a bag may have been written one topic after the other.

    Attributes:
        steps: how often a clock that tells dates was set back.
    """

    def __init__(self) -> None:
        self.steps = 0
        self._last: dict[int, int] = {}  # by connection, ns

    def saw(self, number: int, time: NDArray[np.int64]) -> None:
        """Take down when a connection's messages were recorded, ns, shape (n,), n > 0."""
        last = int(time.max())
        self._last[number] = max(last, self._last.get(number, last))

    def parts(self, batch: Batch) -> Iterator[tuple[Batch, bool]]:
        """Yield a batch in parts, each with whether simulated time was set back before it."""
        set_back = False
        while (row := self._set_back(batch)) is not None:
            yield Batch(batch.data, *(column[:row] for column in batch[1:])), set_back
            batch = Batch(batch.data, *(column[row:] for column in batch[1:]))
            set_back = int(batch.time[0]) * 1e-9 < _DATE
            self.steps += not set_back
            self._last.clear()
        yield batch, set_back

    def _set_back(self, batch: Batch) -> int | None:
        """Return the row of the first message that is earlier than one of its topic before it; None if none is.

        If so, most topics go on earlier; where few do, the one before has a time that is damaged.
        """
        latest = np.maximum(np.maximum.accumulate(batch.time), max(self._last.values(), default=-(2**63)))
        numbers = np.unique(batch.connection[latest - batch.time > _SET_BACK]).tolist()
        late = np.zeros(len(batch.time), bool)
        for number in numbers:
            mine = np.flatnonzero(batch.connection == number)
            time = batch.time[mine]
            known = np.maximum(np.maximum.accumulate(time), self._last.get(number, int(time[0])))
            late[mine] = known - time > _SET_BACK
        if not late.any():
            return None
        row = int(late.argmax())
        before = np.union1d(batch.connection[:row], list(self._last))
        topics, first = np.unique(batch.connection[row:], return_index=True)
        going_on = late[row + first[np.isin(topics, before)]]
        if 2 * going_on.sum() >= len(going_on):
            return row
        for number in numbers:
            self._last.pop(number, None)
        return None


class _Reading:
    """Collects what batches of messages say."""

    def __init__(self, source: Source, most_values: int) -> None:
        self.source = source
        self.columns = Columns(most_values)
        self.layouts = Layouts()
        self.topics: dict[str, Topic] = {}
        self.seen: set[int] = set()
        self.states: dict[str, list[tuple[float, str, bool]]] = {}
        self.commands: dict[str, list[tuple[float, str]]] = {}
        self.texts: dict[str, list[tuple[float, int, str]]] = {}
        self.events: list[dict[str, Any]] = []
        self.log: list[tuple[float, int, str, str]] = []
        self.collisions: list[str] = []
        self.changes: dict[str, list[tuple[float, Any]]] = {PATTERN_TOPIC: [], TOPOLOGY_TOPIC: []}
        self.last_raw: dict[str, bytes] = {}
        self.losses = Losses()
        self.strange: dict[str, str] = {}

    def take(self, number: int, batch: Batch) -> None:
        """Take the messages of a connection."""
        connection = self.source.connections.get(number)
        if connection is None:
            self.losses.unknown += len(batch.time)
            return
        topic = self.topics.setdefault(connection.topic, Topic(connection.topic, connection.type))
        topic.publishers += number not in self.seen
        self.seen.add(number)
        topic.count += len(batch.time)
        topic.bytes += int(batch.length.sum())
        topic.first = min(topic.first, int(batch.time.min()))
        topic.last = max(topic.last, int(batch.time.max()))
        take = self._taker(connection)
        if take is not None and (layout := self.layouts.of(connection)) is not None:
            take(connection, layout, batch)

    def _taker(self, connection: Connection) -> Callable[[Connection, Layout, Batch], None] | None:
        """Return what takes messages of a topic; None if nobody wants them."""
        name = connection.topic
        if name == LOG_TOPIC:
            return self._take_log
        if name == EVENTS_TOPIC:
            return self._take_events
        if name in self.changes:
            return self._take_changes
        if name == TRUTH_TOPIC and connection.type == _MODEL_STATES:
            return self._take_models
        if _TRUTH.match(name):
            return self._take_truth
        if (found := _MAVROS.match(name)) and found["rest"] in _NUMBERS:
            return self._take_numbers
        if found and found["rest"] == "mavros/state":
            return self._take_state
        if found and found["rest"] == "mavros/statustext/recv":
            return self._take_texts
        if (found := _XTDRONE.match(name)) and found["rest"] in _COMMANDS:
            return self._take_numbers
        if found and found["rest"] == "cmd":
            return self._take_commands
        return None

    def _decoded(self, connection: Connection, layout: Layout, batch: Batch, *paths: str) -> tuple[Decoded, Array]:
        """Return fields of messages, and their times, s."""
        wanted = {*paths, *STAMP} if layout.stamped else set(paths)
        decoded = layout.decode(batch.data, batch.offset, batch.length, wanted)
        self.losses.add(connection, layout, batch, decoded.kept)
        time = batch.time[decoded.kept] * 1e-9
        if layout.stamped:
            stamp = decoded.stamps() * 1e-9
            time = np.where((stamp > 0) & (np.abs(stamp - time) < _FAR), stamp, time)
        return decoded, time

    def _take_numbers(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        name = connection.topic
        if found := _MAVROS.match(name):
            what, choices = _NUMBERS[found["rest"]]
            vehicle = _vehicle_name(found["space"])
        else:
            found = _XTDRONE.match(name)
            assert found is not None
            what, choices, vehicle = _COMMANDS[found["rest"]], _VECTORS, found["name"]
        fields = layout.fields
        paths = next((choice for choice in choices if all(path in fields for path in choice)), None)
        if paths is None:
            self.strange[name] = connection.type
            return
        decoded, time = self._decoded(connection, layout, batch, *paths)
        if len(time):
            self.columns.add((vehicle, what), time, decoded.numbers(paths))

    def _has(self, connection: Connection, layout: Layout, *paths: str) -> bool:
        if all(path in layout.fields or path in layout.texts for path in paths):
            return True
        self.strange[connection.topic] = connection.type
        return False

    def _take_state(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        found = _MAVROS.match(connection.topic)
        if found is None or not self._has(connection, layout, "mode", "armed"):
            return
        decoded, time = self._decoded(connection, layout, batch, "mode", "armed")
        rows = self.states.setdefault(_vehicle_name(found["space"]), [])
        armed = decoded.found.get("armed", np.empty(0)).astype(bool).tolist()
        for at, mode, is_armed in zip(time.tolist(), decoded.texts("mode"), armed, strict=True):
            if not rows or rows[-1][1:] != (mode, is_armed):
                rows.append((at, mode, is_armed))

    def _take_texts(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        found = _MAVROS.match(connection.topic)
        if found is None or not self._has(connection, layout, "severity", "text"):
            return
        decoded, time = self._decoded(connection, layout, batch, "severity", "text")
        rows = self.texts.setdefault(_vehicle_name(found["space"]), [])
        severity = decoded.numbers(["severity"])[:, 0].astype(int).tolist()
        rows.extend(zip(time.tolist(), severity, decoded.texts("text"), strict=True))
        del rows[_MOST_TEXTS:]

    def _take_commands(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        found = _XTDRONE.match(connection.topic)
        if found is None or not self._has(connection, layout, "data"):
            return
        decoded, time = self._decoded(connection, layout, batch, "data")
        rows = self.commands.setdefault(found["name"], [])
        for at, text in zip(time.tolist(), decoded.texts("data"), strict=True):
            if text and (not rows or rows[-1][1] != text) and len(rows) < _MOST_TEXTS:
                rows.append((at, text))

    def _take_events(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        if not self._has(connection, layout, "data"):
            return
        for text in self._decoded(connection, layout, batch, "data")[0].texts("data"):
            try:
                event = json.loads(text)
            except ValueError:
                continue
            if isinstance(event, dict) and "event" in event and "time" in event:
                self.events.append(event)

    def _take_log(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        if not self._has(connection, layout, "level", "name", "msg"):
            return
        decoded, time = self._decoded(connection, layout, batch, "level", "name", "msg")
        level = decoded.numbers(["level"])[:, 0].astype(int).tolist()
        for at, how_bad, node, text in zip(
            time.tolist(), level, decoded.texts("name"), decoded.texts("msg"), strict=True
        ):
            if COLLISION in text:
                self.collisions.append(text)
            if how_bad >= WARNING and len(self.log) < _MOST_TEXTS:
                self.log.append((at, how_bad, node, text))

    def _take_changes(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        """Take the assigned offsets or topologies that differ from those before."""
        rows = self.changes[connection.topic]
        kept = []
        times = (batch.time * 1e-9).tolist()
        for row, (start, size) in enumerate(zip(batch.offset.tolist(), batch.length.tolist(), strict=True)):
            raw = batch.data[start : start + size].tobytes()
            if raw != self.last_raw.get(connection.topic):
                try:
                    message = layout.message(raw)
                except MessageError:
                    continue
                self.last_raw[connection.topic] = raw
                rows.append((times[row], np.asarray(message.data)))
            kept.append(row)
        self.losses.add(connection, layout, batch, np.array(kept, np.int64))

    def _take_truth(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        """Take the true places of one model."""
        found = _TRUTH.match(connection.topic)
        if found is None or not self._has(connection, layout, *ODOMETRY):
            return
        decoded, time = self._decoded(connection, layout, batch, *ODOMETRY)
        if len(time):
            self.columns.add((_TRUE, found["name"]), time, decoded.numbers(ODOMETRY))

    def _take_models(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        """Take the true places of all models."""
        parts = {part.path: part for part in layout.parts if isinstance(part, Texts | List)}
        pose = parts.get("pose")
        if not isinstance(parts.get("name"), Texts) or not isinstance(pose, List):
            self.strange[connection.topic] = connection.type
            return
        decoded = layout.decode(batch.data, batch.offset, batch.length, ("name", "pose"))
        self.losses.add(connection, layout, batch, decoded.kept)
        time = batch.time[decoded.kept] * 1e-9
        lists = decoded.text_lists("name")
        order: dict[tuple[str, ...], list[int]] = {}
        for row, names in enumerate(lists):
            order.setdefault(names, []).append(row)
        for names, chosen in order.items():
            rows = np.array(chosen)
            rows = rows[decoded.found["pose"].count[rows] == len(names)]
            if len(rows) and names:
                self._add_models(decoded, pose.item, names, rows, time[rows])

    def _add_models(self, decoded: Decoded, item: Fixed, names: tuple[str, ...], rows: Any, time: Array) -> None:
        record = item.dtype()
        starts = decoded.found["pose"].start[rows][:, None] + record.itemsize * np.arange(len(names))
        values = records_at(decoded.data, starts, record)
        places = np.stack([values[f"position.{axis}"] for axis in _XYZ], axis=-1)
        for i, name in enumerate(names):
            self.columns.add((_MODEL, name), time, places[:, i])

    @property
    def span(self) -> tuple[float, float]:
        """Times of the first and the last message by the recorder's clock, s; 0 if there is none."""
        first = min((topic.first for topic in self.topics.values()), default=0)
        last = max((topic.last for topic in self.topics.values()), default=0)
        return first * 1e-9, last * 1e-9

    def flight(self) -> Flight:
        """Return what was collected."""
        flight = Flight(self.source.path, self.source.size)
        flight.topics = sorted(self.topics.values(), key=lambda topic: topic.name)
        flight.cut = bool(self.source.notes)
        flight.notes = [*self.source.notes, *self._notes()]
        first, last = self.span
        flight.origin = first if first > _DATE else 0.0
        flight.duration = last - first
        self._fill_vehicles(flight)
        flight.patterns = [
            Change(at - flight.origin, offsets_from_message(data))
            for at, data in self.changes[PATTERN_TOPIC]
            if len(data) and len(data) % 3 == 0
        ]
        flight.topologies = [
            Change(at - flight.origin, np.asarray(data, np.int64).reshape(size, size))
            for at, data in self.changes[TOPOLOGY_TOPIC]
            if (size := math.isqrt(len(data))) ** 2 == len(data) > 0
        ]
        flight.events = self.events
        flight.log = [(at - flight.origin, *rest) for at, *rest in self.log]  # type: ignore[misc]
        flight.collisions = self.collisions
        return flight

    def _notes(self) -> list[str]:
        """Return what the messages themselves put in doubt."""
        self.losses.failed = self.layouts.failed
        notes = self.losses.notes()
        notes += [f"topic {name} of type {kind} is not MAVROS's; left out" for name, kind in self.strange.items()]
        if self.columns.stride > 1:
            notes.append(
                f"it is long: of the fastest topics one message in {self.columns.stride} is shown, so what happened "
                "between them is not seen"
            )
        return notes

    def _fill_vehicles(self, flight: Flight) -> None:
        thinned = self.columns.thinned
        series = {key: value.moved(flight.origin) for key, value in self.columns.series().items()}
        for key, value in series.items():
            if key[1] in _PLACES or key[0] in (_MODEL, _TRUE):
                series[key] = nearby(value)
                if (lost := len(value) - len(series[key])) > 0:
                    flight.notes.append(f"{lost} places of {' '.join(key)} are beyond anything, and left out")
        names = {key[0] for key in series if key[0] not in (_MODEL, _TRUE)} | set(self.states) | set(self.texts)
        for name in sorted(names, key=natural_order):
            vehicle = Vehicle(name, {what: value for (owner, what), value in series.items() if owner == name})
            if not (vehicle.series.keys() - set(_COMMANDS.values()) or name in self.states):
                continue  # a topic of XTDrone's that is no vehicle's, as /xtdrone/leader/...
            vehicle.thinned = {what for owner, what in thinned if owner == name}
            if (raw := vehicle.series.pop("raw imu", None)) is not None:
                vehicle.series["imu"] = raw
                vehicle.thinned = {"imu" if what == "raw imu" else what for what in vehicle.thinned - {"imu"}}
            for at, mode, armed in self.states.get(name, ()):
                if not vehicle.modes or vehicle.modes[-1][1] != mode:
                    vehicle.modes.append((at - flight.origin, mode))
                if not vehicle.armed or vehicle.armed[-1][1] != armed:
                    vehicle.armed.append((at - flight.origin, armed))
            vehicle.commands = [(at - flight.origin, text) for at, text in self.commands.get(name, ())]
            vehicle.texts = [(at - flight.origin, bad, text) for at, bad, text in self.texts.get(name, ())]
            flight.vehicles.append(vehicle)
        flight.notes += complete({vehicle.name: vehicle.series for vehicle in flight.vehicles})
        for (owner, name), value in series.items():
            if owner == _MODEL:  # they have no stamps, and the recorder's clock may be off
                flight.models[name] = Series(regular_times(value.time), value.value)
        flight.models |= {name: value for (owner, name), value in series.items() if owner == _TRUE}


def _vehicle_name(space: str) -> str:
    return space.strip("/").replace("/", "_") or "mavros"
