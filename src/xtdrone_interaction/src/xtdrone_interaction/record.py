"""What happened in a flight, read back from its bag. No ROS is needed to read it.

All positions are in the common ``map`` frame: ENU, metres. Times are simulated seconds.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from xtdrone_interaction.geometry import (
    ESTIMATE,
    EVENTS_TOPIC,
    PATTERN_TOPIC,
    TOPOLOGY_TOPIC,
    TRUTH,
    TRUTH_TOPIC,
    Array,
    offsets_from_message,
)

TRUTH_PERIOD = 0.01  # s; a record at 100 Hz is fine enough for distances, the topic may be published at 250 Hz


class RecordError(ValueError):
    """A bag that is no record of a formation flight."""


@dataclass(frozen=True)
class Track:
    """Where all vehicles were.

    Attributes:
        source: what the positions are, for captions and the report.
        time: shape (t,), increasing, s.
        position: shape (t, n, 3), metres ENU.
    """

    source: str
    time: Array
    position: Array

    def between(self, start: float, end: float) -> Track:
        """Return the part with ``start <= time <= end``."""
        part = slice(np.searchsorted(self.time, start, "left"), np.searchsorted(self.time, end, "right"))
        return Track(self.source, self.time[part], self.position[part])


@dataclass(frozen=True)
class Change:
    """A new value on a topic that is repeated all the time.

    Attributes:
        time: when it was first seen, s.
        value: assigned offsets, shape (n - 1, 3), or a topology, shape (n, n).
    """

    time: float
    value: NDArray[Any]


@dataclass
class FlightRecord:
    """One formation flight.

    Attributes:
        names: vehicles; the first is the leader.
        truth: ground truth, where it was recorded.
        estimate: the autopilots' own estimates.
        patterns: assigned offsets from the leader in follower order, at each change.
        topologies: topology matrices (row i: whom vehicle i listens to), at each change.
        events: the director's events in order.
    """

    names: tuple[str, ...]
    truth: Track | None
    estimate: Track | None
    patterns: list[Change] = field(default_factory=list)
    topologies: list[Change] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)

    @property
    def track(self) -> Track:
        """The positions to judge by: the truth where there is one, else the estimates."""
        track = self.truth or self.estimate
        if track is None:
            raise RecordError("flight record: neither /gazebo/model_states nor local_position/pose was recorded")
        return track

    @property
    def phases(self) -> list[dict[str, Any]]:
        """The events that begin a phase."""
        return [e for e in self.events if e["event"] == "phase"]

    def latest(self, changes: list[Change], time: float) -> NDArray[Any] | None:
        """Return the value of ``changes`` that held at ``time``, or None before the first."""
        values = [c.value for c in changes if c.time <= time]
        return values[-1] if values else None


def read_record(bag: str | Path) -> FlightRecord:
    """Read a flight's bag.

    The events come from ``events.jsonl`` beside it where that is, because a recorder that starts late on a busy machine
    misses the first ones; else from the bag.

    Raises:
        RecordError: the file is missing, is not a readable bag, or holds no events of the director.
    """
    path = Path(bag)
    if not path.is_file():
        raise RecordError(f"bag: {path} does not exist")
    try:
        with AnyReader([path]) as reader:
            return _read(reader, read_events(path.with_name("events.jsonl")))
    except RecordError:
        raise
    except Exception as error:  # rosbags raises many kinds for a damaged file
        raise RecordError(f"bag: {path} cannot be read ({error}); 'rosbag reindex' may mend it") from error


def read_events(path: Path) -> list[dict[str, Any]]:
    """Return the events in a file of JSON lines, none when there is no such file."""
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines if line.endswith("}")]  # the last may be cut off


def _read(reader: AnyReader, events: list[dict[str, Any]]) -> FlightRecord:
    events = events or [json.loads(m.data) for _, _, m in _messages(reader, [EVENTS_TOPIC])]
    starts = [e for e in events if "vehicles" in e]  # start and take-off; a recorder that is late misses the first
    if not starts:
        raise RecordError(f"bag: no take-off on {EVENTS_TOPIC}; this is no record of a formation flight")
    names = tuple(starts[-1]["vehicles"])
    return FlightRecord(
        names=names,
        truth=_read_truth(reader, names),
        estimate=_read_estimates(reader, names),
        patterns=[Change(t, offsets_from_message(m.data)) for t, m in _changes(reader, PATTERN_TOPIC)],
        topologies=[
            Change(t, np.asarray(m.data, dtype=np.int64).reshape(len(names), len(names)))
            for t, m in _changes(reader, TOPOLOGY_TOPIC)
        ],
        events=events,
    )


def _messages(reader: AnyReader, topics: list[str]) -> Iterable[tuple[str, float, Any]]:
    """Yield (topic, bag time in s, message) in order of time."""
    connections = [c for c in reader.connections if c.topic in topics]
    if not connections:
        return
    for connection, stamp, raw in reader.messages(connections):
        yield connection.topic, stamp * 1e-9, reader.deserialize(raw, connection.msgtype)


def _changes(reader: AnyReader, topic: str) -> Iterable[tuple[float, Any]]:
    """Yield (time, message) where the content differs from the message before."""
    connections = [c for c in reader.connections if c.topic == topic]
    if not connections:
        return
    last = None
    for connection, stamp, raw in reader.messages(connections):
        if raw != last:
            last = raw
            yield stamp * 1e-9, reader.deserialize(raw, connection.msgtype)


def _read_truth(reader: AnyReader, names: tuple[str, ...]) -> Track | None:
    connections = [c for c in reader.connections if c.topic == TRUTH_TOPIC]
    if not connections:
        return None
    times: list[float] = []
    rows: list[list[tuple[float, float, float]]] = []
    for connection, stamp, raw in reader.messages(connections):
        time = stamp * 1e-9
        if times and time - times[-1] < TRUTH_PERIOD - 1e-6:
            continue
        message: Any = reader.deserialize(raw, connection.msgtype)
        places = dict(zip(message.name, message.pose, strict=True))
        if all(name in places for name in names):
            times.append(time)
            rows.append([(p.x, p.y, p.z) for p in (places[name].position for name in names)])
    return Track(TRUTH, np.array(times), np.array(rows)) if times else None


def _read_estimates(reader: AnyReader, names: tuple[str, ...]) -> Track | None:
    """Read every vehicle's pose, at the times of the leader's messages."""
    topics = {f"/{name}/mavros/local_position/pose": i for i, name in enumerate(names)}
    times: list[list[float]] = [[] for _ in names]
    places: list[list[tuple[float, float, float]]] = [[] for _ in names]
    for topic, _, message in _messages(reader, list(topics)):
        i, stamp, p = topics[topic], message.header.stamp, message.pose.position
        times[i].append(stamp.sec + stamp.nanosec * 1e-9)
        places[i].append((p.x, p.y, p.z))
    if not all(times):
        return None
    grid = np.array(times[0])
    rows = np.empty((len(grid), len(names), 3))
    for i, (stamps, points) in enumerate(zip(times, places, strict=True)):
        values = np.array(points)
        for axis in range(3):
            rows[:, i, axis] = np.interp(grid, stamps, values[:, axis])
    return Track(ESTIMATE, grid, rows)
