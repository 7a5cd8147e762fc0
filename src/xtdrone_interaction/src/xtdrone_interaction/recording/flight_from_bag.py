"""Read bags of this project and of the original MAVROS, complete or cut off.

A vehicle is a namespace with MAVROS's topics: ``/iris_0/mavros/...`` is iris_0, ``/mavros/...`` is "mavros". Positions
are ENU, metres. Times are the messages' own stamps where these are plausible, else the recorder's. Simulated time stays
as it is; dates count from the beginning of the recording.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_interaction.bags.bag_kinds import Layouts, Losses, Source, by_connection, large_batches, open_sources
from xtdrone_interaction.bags.decode import STAMP, Decoded, Fixed, Layout, List, MessageError, Texts, records_at
from xtdrone_interaction.bags.ros1bag import BagError, Batch, Connection
from xtdrone_interaction.recording.distances import offsets_from_message
from xtdrone_interaction.recording.flight_events import EVENTS_FILE, parse_event, read_events
from xtdrone_interaction.recording.positions import complete, plausible, regular_times
from xtdrone_interaction.recording.recorded_flight import Change, Recording, TopicStatistics, VehicleRecord
from xtdrone_interaction.recording.series_in_bounded_memory import MOST_VALUES, Array, Columns, Series
from xtdrone_interaction.recording.topics import (
    EVENTS_TOPIC,
    LOG_TOPIC,
    PATTERN_TOPIC,
    SEARCH_EVENTS_TOPIC,
    TOPOLOGY_TOPIC,
    TRUTH_TOPIC,
    natural_order,
)

COLLISION = "collision of "  # the beginning of the simulator node's message
WARNING = 4  # rosgraph_msgs/Log level; errors have higher ones
_DATE = 1e8  # s; times above are dates, not simulated
_FAR = 3600.0  # s between a stamp and the recorder's clock; further apart, they are of different clocks
_SET_BACK = 1_000_000_000  # ns; a clock that goes back by more was set back
_MOST_TEXTS = 2000  # kept per topic
_MODEL_STATES = "gazebo_msgs/ModelStates"
_MODEL, _TRUE = "/gazebo", "/truth"  # owners of model positions without and with own times; no vehicle has such a name
_TRUE_POSE, _ODOMETRY = "/true_pose", "/odometry"  # owners of whole poses; the name of an odometry is VEHICLE/SOURCE
_OWNERS = (_MODEL, _TRUE, _TRUE_POSE, _ODOMETRY)

_POSITIONS_AND_VELOCITIES = frozenset({"pose", "odometry", "velocity"})
_XYZ = ("x", "y", "z")
_QUATERNION = ("x", "y", "z", "w")


def _under(prefix: str, names: tuple[str, ...] = _XYZ) -> tuple[str, ...]:
    return tuple(f"{prefix}.{name}" if prefix else name for name in names)


_VECTORS = (_under("linear"), _under("twist.linear"), _under(""), _under("vector"))
# By topic below the vehicle's namespace: the quantity, and alternative sets of fields.
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
_ODOMETRY_TOPIC = re.compile(r"^/(?P<name>[^/]+)/(?P<source>(?!mavros)[^/]+)/odometry$")
_TRUE_POSITION = _under("pose.pose.position")
_TRUE_ORIENTATION = _under("pose.pose.orientation", _QUATERNION)


def read_bag(
    paths: Sequence[Path],
    *,
    part: int | None = None,
    wanted: Callable[[str], bool] | None = None,
    keep: Collection[str] = (),
    most_values: float = MOST_VALUES,
) -> Recording:
    """Read a recording from one bag, or from the consecutive bags of a split one.

    Args:
        paths: ROS 1 bags, whole or cut off, or ROS 2 bags.
        part: number of the flight, from 1, if simulated time was reset between several; None for the longest.
        wanted: whether a topic is decoded; None for all.
        keep: topics whose messages are returned as they are.
        most_values: limit of numbers kept; a longer recording is thinned, and the notes say so.

    Raises:
        BagError: nothing can be read, or there is no such part.
    """
    source = open_sources(paths)
    clock = _Clock()
    spans: list[tuple[float, float]] = []
    shown, chosen = 0, None
    for number, flight in enumerate(_flights(source, clock, wanted, keep, most_values), 1):
        spans.append(flight.span)
        longer = chosen is None or flight.span[1] - flight.span[0] > chosen.span[1] - chosen.span[0]
        if number == part or (part is None and longer):
            shown, chosen = number, flight
    if chosen is None:
        raise BagError(f"part: {str(source.path)!r} has no part {part}; there are 1 to {len(spans)}")
    recording = chosen.recording()
    if clock.steps:
        recording.notes.append(f"the recorder's clock was set back {clock.steps} times; all is shown in order of time")
    if len(spans) > 1:
        recording.parts = len(spans)
        words = "; ".join(f"{i}: {start:.1f} to {end:.1f} s" for i, (start, end) in enumerate(spans, 1))
        recording.notes.append(
            f"time was set back {len(spans) - 1} times, so there are {len(spans)} parts ({words}); part {shown} is "
            "shown, another with --part"
        )
    recording.events = _events(recording)
    return recording


def _flights(
    source: Source,
    clock: _Clock,
    wanted: Callable[[str], bool] | None,
    keep: Collection[str],
    most_values: float,
) -> Iterator[_Collector]:
    """Yield the flights of a recording, separated by resets of simulated time."""
    flight = _Collector(source, wanted, keep, most_values)
    for batch in large_batches(source):
        for messages, set_back in clock.split(batch):
            if set_back:
                yield flight
                flight = _Collector(source, wanted, keep, most_values)
            for number, same in by_connection(messages):
                clock.saw(number, same.time)
                flight.add(number, same)
    yield flight


def _events(recording: Recording) -> list[dict[str, Any]]:
    """Return the flight's events, by its times; the file beside the bag also has those before the recorder started."""
    events = recording.events
    if recording.parts == 1:  # else the file may be of another part
        with contextlib.suppress(OSError, ValueError):
            events = read_events(recording.path.with_name(EVENTS_FILE)) or events
    known = [e for e in events if isinstance(e.get("time"), int | float) and isinstance(e.get("event"), str)]
    return [{**event, "time": event["time"] - recording.origin} for event in known]


class _Clock:
    """Detects time that was set back, topic by topic: a bag may have been written one topic after the other.

    Attributes:
        steps: how often a clock of dates was set back.
    """

    def __init__(self) -> None:
        self.steps = 0
        self._last: dict[int, int] = {}  # by connection, ns

    def saw(self, number: int, time: NDArray[np.int64]) -> None:
        """Register when messages of a connection were recorded, ns, shape (n,), n > 0."""
        last = int(time.max())
        self._last[number] = max(last, self._last.get(number, last))

    def split(self, batch: Batch) -> Iterator[tuple[Batch, bool]]:
        """Yield the parts of a batch, each with a flag: simulated time was reset before it."""
        set_back = False
        while (row := self._set_back(batch)) is not None:
            yield Batch(batch.data, *(column[:row] for column in batch[1:])), set_back
            batch = Batch(batch.data, *(column[row:] for column in batch[1:]))
            set_back = int(batch.time[0]) * 1e-9 < _DATE
            self.steps += not set_back
            self._last.clear()
        yield batch, set_back

    def _set_back(self, batch: Batch) -> int | None:
        """Return the row of the first message after time was set back; None if it was not.

        Time was set back if most topics continue at earlier times; if only few do, a single time stamp is damaged.
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


class _Collector:
    """Collects one flight from batches of messages."""

    def __init__(
        self, source: Source, wanted: Callable[[str], bool] | None, keep: Collection[str], most_values: float
    ) -> None:
        self.source = source
        self.wanted = wanted
        self.kept: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in keep}
        self.columns = Columns(most_values)
        self.layouts = Layouts()
        self.topics: dict[str, TopicStatistics] = {}
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
        self.mismatched: dict[str, str] = {}

    def add(self, number: int, batch: Batch) -> None:
        """Add messages of one connection."""
        connection = self.source.connections.get(number)
        if connection is None:
            self.losses.unknown += len(batch.time)
            return
        topic = self.topics.setdefault(connection.topic, TopicStatistics(connection.topic, connection.type))
        topic.publishers += number not in self.seen
        self.seen.add(number)
        topic.count += len(batch.time)
        topic.bytes += int(batch.length.sum())
        topic.first = min(topic.first, int(batch.time.min()))
        topic.last = max(topic.last, int(batch.time.max()))
        handle = self._handler(connection)
        if handle is not None and (layout := self.layouts.of(connection)) is not None:
            handle(connection, layout, batch)

    def _handler(self, connection: Connection) -> Callable[[Connection, Layout, Batch], None] | None:
        """Return the method for messages of a topic; None if they are not needed."""
        name = connection.topic
        if name in self.kept:
            return self._keep
        if self.wanted is not None and not self.wanted(name):
            return None
        if name == LOG_TOPIC:
            return self._add_log
        if name in (EVENTS_TOPIC, SEARCH_EVENTS_TOPIC):
            return self._add_events
        if name in self.changes:
            return self._add_changes
        if name == TRUTH_TOPIC and connection.type == _MODEL_STATES:
            return self._add_models
        if _TRUTH.match(name):
            return self._add_truth
        if _ODOMETRY_TOPIC.match(name):
            return self._add_odometry
        if (found := _MAVROS.match(name)) and found["rest"] in _NUMBERS:
            return self._add_numbers
        if found and found["rest"] == "mavros/state":
            return self._add_state
        if found and found["rest"] == "mavros/statustext/recv":
            return self._add_texts
        if (found := _XTDRONE.match(name)) and found["rest"] in _COMMANDS:
            return self._add_numbers
        if found and found["rest"] == "cmd":
            return self._add_commands
        return None

    def _keep(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        """Keep messages as rosbags decodes them."""
        rows = []
        for row, (start, size) in enumerate(zip(batch.offset.tolist(), batch.length.tolist(), strict=True)):
            with contextlib.suppress(MessageError):
                message = layout.message(batch.data[start : start + size].tobytes())
                self.kept[connection.topic].append((float(batch.time[row]) * 1e-9, message))
                rows.append(row)
        self.losses.add(connection, layout, batch, np.array(rows, np.int64))

    def _decoded(self, connection: Connection, layout: Layout, batch: Batch, *paths: str) -> tuple[Decoded, Array]:
        """Return decoded fields of messages, and the times of the messages, s."""
        wanted = {*paths, *STAMP} if layout.stamped else set(paths)
        decoded = layout.decode(batch.data, batch.offset, batch.length, wanted)
        self.losses.add(connection, layout, batch, decoded.kept)
        time = batch.time[decoded.kept] * 1e-9
        if layout.stamped:
            stamp = decoded.stamps() * 1e-9
            time = np.where((stamp > 0) & (np.abs(stamp - time) < _FAR), stamp, time)
        return decoded, time

    def _add_numbers(self, connection: Connection, layout: Layout, batch: Batch) -> None:
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
            self.mismatched[name] = connection.type
            return
        decoded, time = self._decoded(connection, layout, batch, *paths)
        if len(time):
            self.columns.add((vehicle, what), time, decoded.numbers(paths))

    def _has(self, connection: Connection, layout: Layout, *paths: str) -> bool:
        """Return whether messages have these fields; if not, note the topic."""
        if all(path in layout.fields or path in layout.texts for path in paths):
            return True
        self.mismatched[connection.topic] = connection.type
        return False

    def _add_state(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        found = _MAVROS.match(connection.topic)
        if found is None or not self._has(connection, layout, "mode", "armed"):
            return
        decoded, time = self._decoded(connection, layout, batch, "mode", "armed")
        rows = self.states.setdefault(_vehicle_name(found["space"]), [])
        armed = decoded.found.get("armed", np.empty(0)).astype(bool).tolist()
        for at, mode, is_armed in zip(time.tolist(), decoded.texts("mode"), armed, strict=True):
            if not rows or rows[-1][1:] != (mode, is_armed):
                rows.append((at, mode, is_armed))

    def _add_texts(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        found = _MAVROS.match(connection.topic)
        if found is None or not self._has(connection, layout, "severity", "text"):
            return
        decoded, time = self._decoded(connection, layout, batch, "severity", "text")
        rows = self.texts.setdefault(_vehicle_name(found["space"]), [])
        severity = decoded.numbers(["severity"])[:, 0].astype(int).tolist()
        rows.extend(zip(time.tolist(), severity, decoded.texts("text"), strict=True))
        del rows[_MOST_TEXTS:]

    def _add_commands(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        found = _XTDRONE.match(connection.topic)
        if found is None or not self._has(connection, layout, "data"):
            return
        decoded, time = self._decoded(connection, layout, batch, "data")
        rows = self.commands.setdefault(found["name"], [])
        for at, text in zip(time.tolist(), decoded.texts("data"), strict=True):
            if text and (not rows or rows[-1][1] != text) and len(rows) < _MOST_TEXTS:
                rows.append((at, text))

    def _add_events(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        if not self._has(connection, layout, "data"):
            return
        for text in self._decoded(connection, layout, batch, "data")[0].texts("data"):
            try:
                event = parse_event(text)
            except ValueError:
                continue
            if isinstance(event, dict) and "event" in event and "time" in event:
                self.events.append(event)

    def _add_log(self, connection: Connection, layout: Layout, batch: Batch) -> None:
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

    def _add_changes(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        """Add the assigned offsets or topologies that differ from those before."""
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

    def _add_truth(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        """Add true positions of one model."""
        found = _TRUTH.match(connection.topic)
        if found is None or not self._has(connection, layout, *_TRUE_POSITION):
            return
        decoded, time = self._decoded(connection, layout, batch, *_TRUE_POSITION)
        if len(time):
            self.columns.add((_TRUE, found["name"]), time, decoded.numbers(_TRUE_POSITION))
        if all(path in layout.fields for path in _TRUE_ORIENTATION):
            self._add_pose((_TRUE_POSE, found["name"]), connection, layout, batch)

    def _add_odometry(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        """Add the poses of a node such as lidar_odometry."""
        found = _ODOMETRY_TOPIC.match(connection.topic)
        if found is not None and self._has(connection, layout, *_TRUE_POSITION, *_TRUE_ORIENTATION):
            self._add_pose((_ODOMETRY, f"{found['name']}/{found['source']}"), connection, layout, batch)

    def _add_pose(self, key: tuple[str, str], connection: Connection, layout: Layout, batch: Batch) -> None:
        paths = _TRUE_POSITION + _TRUE_ORIENTATION
        decoded, time = self._decoded(connection, layout, batch, *paths)
        if len(time):
            self.columns.add(key, time, decoded.numbers(paths))

    def _add_models(self, connection: Connection, layout: Layout, batch: Batch) -> None:
        """Add true positions of all models."""
        parts = {part.path: part for part in layout.parts if isinstance(part, Texts | List)}
        pose = parts.get("pose")
        if not isinstance(parts.get("name"), Texts) or not isinstance(pose, List):
            self.mismatched[connection.topic] = connection.type
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
                self._add_model_positions(decoded, pose.item, names, rows, time[rows])

    def _add_model_positions(
        self, decoded: Decoded, item: Fixed, names: tuple[str, ...], rows: Any, time: Array
    ) -> None:
        record = item.dtype()
        starts = decoded.found["pose"].start[rows][:, None] + record.itemsize * np.arange(len(names))
        values = records_at(decoded.data, starts, record)
        places = np.stack([values[f"position.{axis}"] for axis in _XYZ], axis=-1)
        for i, name in enumerate(names):
            self.columns.add((_MODEL, name), time, places[:, i])

    @property
    def span(self) -> tuple[float, float]:
        """Recorder's times of the first and the last message, s; 0 without messages."""
        first = min((topic.first for topic in self.topics.values()), default=0)
        last = max((topic.last for topic in self.topics.values()), default=0)
        return first * 1e-9, last * 1e-9

    def recording(self) -> Recording:
        """Return everything collected; the events are those in the bag."""
        recording = Recording(self.source.path, self.source.size)
        recording.topics = sorted(self.topics.values(), key=lambda topic: topic.name)
        recording.cut = self.source.cut
        recording.notes = [*self.source.notes, *self._notes()]
        first, last = self.span
        recording.origin = first if first > _DATE else 0.0
        recording.duration = last - first
        self._fill_vehicles(recording)
        recording.patterns = [
            Change(at - recording.origin, offsets_from_message(data))
            for at, data in self.changes[PATTERN_TOPIC]
            if len(data) and len(data) % 3 == 0
        ]
        recording.topologies = [
            Change(at - recording.origin, np.asarray(data, np.int64).reshape(size, size))
            for at, data in self.changes[TOPOLOGY_TOPIC]
            if (size := math.isqrt(len(data))) ** 2 == len(data) > 0
        ]
        recording.events = self.events
        recording.log = [(at - recording.origin, *rest) for at, *rest in self.log]  # type: ignore[misc]
        recording.collisions = self.collisions
        recording.messages = self.kept
        return recording

    def _notes(self) -> list[str]:
        """Return notes about undecodable and missing messages."""
        self.losses.failed = self.layouts.failed
        notes = self.losses.notes()
        notes += [
            f"topic {name} of type {kind} does not have MAVROS's type; left out"
            for name, kind in self.mismatched.items()
        ]
        if self.columns.stride > 1:
            notes.append(
                f"it is long: one message in {self.columns.stride} of the fastest topics is shown, events between "
                f"them are not"
            )
        return notes

    def _fill_vehicles(self, recording: Recording) -> None:
        thinned = self.columns.thinned
        series = {key: value.since(recording.origin) for key, value in self.columns.series().items()}
        for key, value in series.items():
            if key[1] in _POSITIONS_AND_VELOCITIES or key[0] in _OWNERS:
                series[key] = plausible(value)
                if (lost := len(value) - len(series[key])) > 0:
                    recording.notes.append(f"{lost} positions of {' '.join(key)} are out of range, and left out")
        located = {what.partition("/")[0] for owner, what in series if owner == _ODOMETRY}
        names = {key[0] for key in series if key[0] not in _OWNERS} | set(self.states) | set(self.texts) | located
        for name in sorted(names, key=natural_order):
            vehicle = VehicleRecord(name, {what: value for (owner, what), value in series.items() if owner == name})
            if not (vehicle.series.keys() - set(_COMMANDS.values()) or name in self.states or name in located):
                continue  # a topic of XTDrone that belongs to no vehicle, such as /xtdrone/leader/...
            vehicle.odometry = {
                what.partition("/")[2]: value
                for (owner, what), value in series.items()
                if owner == _ODOMETRY and what.partition("/")[0] == name
            }
            vehicle.thinned = {what for owner, what in thinned if owner == name}
            if (raw := vehicle.series.pop("raw imu", None)) is not None:
                vehicle.series["imu"] = raw
                vehicle.thinned = {"imu" if what == "raw imu" else what for what in vehicle.thinned - {"imu"}}
            for at, mode, armed in self.states.get(name, ()):
                if not vehicle.modes or vehicle.modes[-1][1] != mode:
                    vehicle.modes.append((at - recording.origin, mode))
                if not vehicle.armed or vehicle.armed[-1][1] != armed:
                    vehicle.armed.append((at - recording.origin, armed))
            vehicle.commands = [(at - recording.origin, text) for at, text in self.commands.get(name, ())]
            vehicle.texts = [(at - recording.origin, bad, text) for at, bad, text in self.texts.get(name, ())]
            recording.vehicles.append(vehicle)
        recording.notes += complete({vehicle.name: vehicle.series for vehicle in recording.vehicles})
        for (owner, name), value in series.items():
            if owner == _MODEL:  # without stamps; the recorder's clock may be off
                recording.models[name] = Series(regular_times(value.time), value.value)
        recording.models |= {name: value for (owner, name), value in series.items() if owner == _TRUE}
        recording.true_poses = {name: value for (owner, name), value in series.items() if owner == _TRUE_POSE}


def _vehicle_name(space: str) -> str:
    return space.strip("/").replace("/", "_") or "mavros"
