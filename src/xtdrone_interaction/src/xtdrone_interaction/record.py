"""What happened in a flight, read back from its bag, or from the archive of a flight without ROS. No ROS is needed.

All positions are in the common ``map`` frame: ENU, metres. Times are simulated seconds.

The times of a bag are those at which the recorder saw /clock when a message came. In a simulation that runs fast on a
busy machine they are early or late by up to seconds. So nothing here rests on them: poses and the true ones carry their
own stamps, the director's events too. Where of the truth only /gazebo/model_states was recorded, which has none, its
times are taken from its constant rate, and are right to a few steps.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.ndimage import median_filter

from xtdrone_interaction.analysis.columns import Series
from xtdrone_interaction.analysis.stamped import read_stamped
from xtdrone_interaction.geometry import (
    ESTIMATE,
    EVENTS_TOPIC,
    PATTERN_TOPIC,
    TOPOLOGY_TOPIC,
    TRUTH,
    TRUTH_TOPIC,
    Array,
    least_distances,
    odometry_topic,
    offsets_from_message,
)

LOG_TOPIC = "/rosout"
SEARCH_START = "started"
"""The first event of a search, which names its vehicles, too."""
COLLISION = "collision of "  # in the words of the simulator node
_POSE = ("pose.position.x", "pose.position.y", "pose.position.z")
ODOMETRY = tuple(f"pose.{field}" for field in _POSE)
"""Fields of a place in nav_msgs/Odometry."""
_BAG_BEGIN = b"#ROSBAG V2.0\n"
_BASE_STEP = 0.004  # s; every period of the simulator is a multiple of it
_MEDIAN_SPAN = 10.0  # s; the recorder's clock is right most of the time in any span of this length
_TAIL = 1.0  # s of a flight's end that a recorder may miss though nothing happened to it


class RecordError(ValueError):
    """A file that is no record of a formation flight."""


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
        part = self.part(start, end)
        return Track(self.source, self.time[part], self.position[part])

    def part(self, start: float, end: float) -> slice:
        """Return which rows have ``start <= time <= end``."""
        return slice(int(np.searchsorted(self.time, start, "left")), int(np.searchsorted(self.time, end, "right")))

    @cached_property
    def least_distance(self) -> Array:
        """The least distance between any two vehicles at each time, m, shape (t,); searched for once."""
        return least_distances(self.position)


@dataclass(frozen=True)
class Change:
    """A new value on a topic that is repeated all the time.

    Attributes:
        time: when it was first seen by the recorder's clock, s.
        value: assigned offsets, shape (n - 1, 3), or a topology, shape (n, n).
    """

    time: float
    value: NDArray[Any]


@dataclass(frozen=True)
class Window:
    """One reconfiguration, from the command of a pattern to the director's next phase.

    Attributes:
        pattern: name.
        start: time of the command, s.
        end: s.
        offsets: assigned, from the leader, in follower order, shape (n - 1, 3), m.
        topology: row i: whom vehicle i listens to, shape (n, n); None when it was not recorded.
    """

    pattern: str
    start: float
    end: float
    offsets: Array
    topology: NDArray[Any] | None


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
        collisions: what the simulator said of vehicles that touched, in order.
    """

    names: tuple[str, ...]
    truth: Track | None
    estimate: Track | None
    patterns: list[Change] = field(default_factory=list)
    topologies: list[Change] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    collisions: list[str] = field(default_factory=list)

    @property
    def track(self) -> Track:
        """The positions to judge by: the truth where there is one, else the estimates."""
        track = self.truth or self.estimate
        if track is None:
            raise RecordError(
                "flight record: neither ground_truth/odom, /gazebo/model_states nor local_position/pose was recorded"
            )
        return track

    @property
    def phases(self) -> list[dict[str, Any]]:
        """The events that begin a phase."""
        return [e for e in self.events if e["event"] == "phase"]

    @property
    def cut(self) -> float | None:
        """When the positions end, s, if that is before the flight's end: its recorder was killed or stopped."""
        end = float(self.track.time[-1])
        return end if self.events and end < self.events[-1]["time"] - _TAIL else None

    @property
    def windows(self) -> list[Window]:
        """The reconfigurations in order; without those never assigned or ``unrecorded``."""
        end = self.track.time[-1] + _TAIL
        return [window for window in self._flown() if window.end <= end]

    @property
    def unrecorded(self) -> list[Window]:
        """The reconfigurations whose positions were not recorded to their end, in order."""
        end = self.track.time[-1] + _TAIL
        return [window for window in self._flown() if window.end > end]

    def _flown(self) -> list[Window]:
        windows: list[Window] = []
        ends = [p["time"] for p in self.phases[1:]] + [self.events[-1]["time"]]
        search = 0
        for phase, end in zip(self.phases, ends, strict=True):
            assigned = [e for e in self.events if e["event"] == "assigned" and phase["time"] <= e["time"] <= end]
            if not phase.get("pattern") or not assigned:
                continue
            offsets = np.array(assigned[0]["offsets"], dtype=np.float64)
            found = self._change_to(offsets, search)
            search = search if found is None else found
            topology = None if found is None else self._topology_at(found)
            windows.append(Window(phase["pattern"], phase["time"], end, offsets, topology))
        return windows

    def _change_to(self, offsets: Array, first: int) -> int | None:
        """Return the number of the change to ``offsets`` from the one numbered ``first`` on."""
        for number in range(first, len(self.patterns)):
            if np.allclose(self.patterns[number].value, offsets, atol=1e-3):
                return number
        return None

    def _topology_at(self, number: int) -> NDArray[Any] | None:
        """Return the topology that held in the middle of the pattern of a number; both by the recorder's clock."""
        start = self.patterns[number].time
        end = self.patterns[number + 1].time if number + 1 < len(self.patterns) else np.inf
        known = [c.value for c in self.topologies if c.time <= start + 0.5 * min(end - start, 1.0)]
        return known[-1] if known else None


def read_record(file: str | Path) -> FlightRecord:
    """Read a flight's ``flight.bag``, or the ``flight.npz`` of one without ROS.

    A bag's events come from ``events.jsonl`` beside it where that is, because a recorder that starts late on a busy
    machine misses the first ones; else from the bag.

    Raises:
        RecordError: the file is missing, cannot be read, or holds no events of the director.
    """
    path = Path(file)
    if not path.is_file():
        raise RecordError(f"flight record: {path} {'is a folder' if path.is_dir() else 'does not exist'}")
    if path.suffix == ".npz":
        return _read_archive(path)
    try:
        with path.open("rb") as opened:
            begin = opened.read(len(_BAG_BEGIN))
    except OSError as error:
        raise RecordError(f"flight record: {path} cannot be read: {error.strerror}") from error
    if path.suffix != ".bag" or not begin or not _BAG_BEGIN.startswith(begin):
        raise RecordError(
            f"flight record: {path} is neither a bag of version 2.0 (.bag) nor a flight.npz; './xtdrone analyse' reads "
            "flight logs, other bags, and what is left of damaged ones"
        )
    try:
        with AnyReader([path]) as reader:
            return _read(reader, path, read_events(path.with_name("events.jsonl")))
    except RecordError:
        raise
    except Exception as error:  # rosbags raises many kinds for a damaged file
        raise RecordError(f"bag: {path} cannot be read ({error}); './xtdrone analyse' shows what is left") from error


def save_record(record: FlightRecord, path: str | Path) -> None:
    """Write ``record`` as a NumPy archive (.npz), which :func:`read_record` reads.

    It holds ``names`` (n,), ``time`` (t,) s, ``position`` (t, n, 3) m ENU, and for each change of the pattern its
    ``pattern_time`` (p,), ``offsets`` (p, n - 1, 3) and ``topology`` (p, n, n); ``source``: what the positions are;
    ``events`` and ``collisions`` as JSON.
    """
    track = record.track
    archive = io.BytesIO()  # so that a full disk is an error of the file, not of the archive within it
    np.savez_compressed(
        archive,
        names=np.array(record.names),
        time=track.time,
        position=track.position,
        pattern_time=np.array([change.time for change in record.patterns]),
        offsets=np.array([change.value for change in record.patterns]),
        topology=np.array([change.value for change in record.topologies]),
        source=track.source,
        events=json.dumps(record.events),
        collisions=json.dumps(record.collisions),
    )
    Path(path).write_bytes(archive.getvalue())


def _read_archive(path: Path) -> FlightRecord:
    """Read what :func:`save_record` has written.

    Raises:
        RecordError: it is something else.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            times = data["pattern_time"].tolist()
            return FlightRecord(
                names=tuple(data["names"].tolist()),
                truth=Track(str(data["source"]), data["time"], data["position"]),
                estimate=None,
                patterns=[Change(t, value) for t, value in zip(times, data["offsets"], strict=True)],
                topologies=[Change(t, value) for t, value in zip(times, data["topology"], strict=True)],
                events=json.loads(str(data["events"])),
                collisions=json.loads(str(data["collisions"])),
            )
    except (OSError, KeyError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise RecordError(f"flight record: {path} cannot be read ({error})") from error


def read_events(path: Path) -> list[dict[str, Any]]:
    """Return the events in a file of JSON lines, none when there is no such file."""
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines if line.endswith("}")]  # the last may be cut off


def starts_of(events: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return those that name a formation flight's vehicles: start, which a late recorder misses, and takeoff."""
    return [event for event in events if "vehicles" in event and event.get("event") != SEARCH_START]


def _read(reader: AnyReader, path: Path, events: list[dict[str, Any]]) -> FlightRecord:
    events = events or [json.loads(m.data) for _, _, m in messages(reader, [EVENTS_TOPIC])]
    starts = starts_of(events)
    if not starts and any(event.get("event") == SEARCH_START for event in events):
        raise RecordError(
            f"bag: {path} is a search's, and what './xtdrone demo search' has prepared for it is not beside it "
            "(search.world, region.yaml, plans); './xtdrone analyse' draws what was flown"
        )
    if not starts:
        raise RecordError(f"bag: no takeoff on {EVENTS_TOPIC}; this is no record of a formation flight")
    names = tuple(starts[-1]["vehicles"])
    topics = {odometry_topic(name): ODOMETRY for name in names}
    topics |= {pose_topic(name): _POSE for name in names}
    series = read_stamped(path, topics)
    return FlightRecord(
        names=names,
        truth=track_of(TRUTH, [series.get(odometry_topic(name)) for name in names]) or _read_states(reader, names),
        estimate=track_of(ESTIMATE, [series.get(pose_topic(name)) for name in names]),
        # empty: taken back when time was set back
        patterns=[Change(t, offsets_from_message(m.data)) for t, m in _changes(reader, PATTERN_TOPIC) if len(m.data)],
        topologies=[
            Change(t, np.asarray(m.data, dtype=np.int64).reshape(len(names), len(names)))
            for t, m in _changes(reader, TOPOLOGY_TOPIC)
            if len(m.data)
        ],
        events=events,
        collisions=[m.msg for _, _, m in messages(reader, [LOG_TOPIC]) if COLLISION in m.msg],
    )


def messages(reader: AnyReader, topics: list[str]) -> Iterable[tuple[str, float, Any]]:
    """Yield (topic, bag time in s, message) of those of ``topics`` that were recorded, in order of time."""
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


def track_of(source: str, series: Sequence[Series | None]) -> Track | None:
    """Return where vehicles were at the times of the first one's messages, None if anyone's are missing.

    Args:
        source: what the positions are.
        series: of each vehicle, the first three numbers its place, m.
    """
    found = [entry for entry in series if entry is not None and len(entry)]
    if not found or len(found) < len(series):
        return None
    time = found[0].time
    places = np.empty((len(time), len(found), 3))
    for i, entry in enumerate(found):
        for axis in range(3):
            places[:, i, axis] = np.interp(time, entry.time, entry.value[:, axis])
    return Track(source, time, places)


def pose_topic(name: str) -> str:
    """Return where a vehicle's autopilot says where it believes to be."""
    return f"/{name}/mavros/local_position/pose"


def _read_states(reader: AnyReader, names: tuple[str, ...]) -> Track | None:
    connections = [c for c in reader.connections if c.topic == TRUTH_TOPIC]
    if not connections:
        return None
    stamps: list[float] = []
    rows: list[list[tuple[float, float, float]]] = []
    for connection, stamp, raw in reader.messages(connections):
        message: Any = reader.deserialize(raw, connection.msgtype)
        places = dict(zip(message.name, message.pose, strict=True))
        if all(name in places for name in names):
            stamps.append(stamp * 1e-9)
            rows.append([(p.x, p.y, p.z) for p in (places[name].position for name in names)])
    return Track(TRUTH, regular_times(np.array(stamps)), np.array(rows)) if rows else None


def regular_times(stamps: Array) -> Array:
    """Return when the messages of a topic with a constant rate were sent, from the times at which they were recorded.

    The k-th was sent at k times the period, plus an offset that grows when messages were lost: the median over a while
    of what the recorder's clock says.

    Args:
        stamps: shape (t,), s, in the order of sending.
    """
    count = len(stamps)
    period = _BASE_STEP * round((stamps[-1] - stamps[0]) / max(1, count - 1) / _BASE_STEP)
    if period == 0.0:  # faster than our simulator, or a single message
        return np.maximum.accumulate(stamps)
    offset = stamps - period * np.arange(count)
    smooth = median_filter(offset, size=min(count, round(_MEDIAN_SPAN / period)), mode="nearest")
    return np.maximum.accumulate(period * np.arange(count) + smooth)
