"""A formation flight: positions of the fleet, patterns, topologies and the director's events.

All positions are in the common ``map`` frame: ENU, metres. Times are simulated seconds.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.files import replacing
from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.recording.distances import Array
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.open_recording import read_archive
from xtdrone_interaction.recording.positions import FleetTrack, fleet_track
from xtdrone_interaction.recording.recorded_flight import Change, RecordError, Recording
from xtdrone_interaction.recording.topics import (
    ESTIMATE,
    EVENTS_TOPIC,
    LOG_TOPIC,
    PATTERN_TOPIC,
    TOPOLOGY_TOPIC,
    TRUTH_TOPIC,
)

SEARCH_START = "started"
"""The first event of a search; it lists vehicles, too."""
END = "end of the recording"
"""The event added to a recording that ends before its flight."""
_LAST = ("done", "failed")
_LEAST_WINDOW = 0.2  # s; a pattern commanded later than this before the end is left out
_TAIL = 1.0  # s at a flight's end that a recorder may miss though nothing went wrong
_BAG_BEGIN = b"#ROSBAG V2.0\n"
_TOPICS = frozenset({EVENTS_TOPIC, PATTERN_TOPIC, TOPOLOGY_TOPIC, TRUTH_TOPIC, LOG_TOPIC})
_POSITIONS = re.compile(r"/xtdrone/[^/]+/ground_truth/odom|/[^/]+/mavros/local_position/pose")


@dataclass(frozen=True)
class PatternWindow:
    """One reconfiguration, from the command of a pattern to the director's next phase.

    Attributes:
        pattern: name.
        start: time of the command, s.
        end: s.
        offsets: assigned, from the leader, in follower order, shape (n - 1, 3), m.
        topology: row i: the vehicles that vehicle i listens to, shape (n, n); None when it was not recorded.
    """

    pattern: str
    start: float
    end: float
    offsets: Array
    topology: NDArray[Any] | None


@dataclass
class FormationRecord:
    """One formation flight.

    Attributes:
        names: vehicles; the first is the leader.
        truth: ground truth, where it was recorded.
        estimate: the autopilots' own estimates.
        patterns: assigned offsets from the leader in follower order, at each change.
        topologies: topology matrices (row i: the vehicles that vehicle i listens to), at each change.
        events: the director's events in order.
        collisions: the simulator's collision messages in order.
    """

    names: tuple[str, ...]
    truth: FleetTrack | None
    estimate: FleetTrack | None
    patterns: list[Change] = field(default_factory=list)
    topologies: list[Change] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    collisions: list[str] = field(default_factory=list)

    @property
    def track(self) -> FleetTrack:
        """The positions that the flight is judged by: the truth if recorded, else the estimates."""
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
    def windows(self) -> list[PatternWindow]:
        """The reconfigurations in order; without those never assigned or ``unrecorded``."""
        end = self.track.time[-1] + _TAIL
        return [window for window in self._flown() if window.end <= end]

    @property
    def unrecorded(self) -> list[PatternWindow]:
        """The reconfigurations whose positions were not recorded to their end, in order."""
        end = self.track.time[-1] + _TAIL
        return [window for window in self._flown() if window.end > end]

    def _flown(self) -> list[PatternWindow]:
        windows: list[PatternWindow] = []
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
            windows.append(PatternWindow(phase["pattern"], phase["time"], end, offsets, topology))
        return windows

    def _change_to(self, offsets: Array, first: int) -> int | None:
        """Return the number of the first change to ``offsets``, counted and searched from ``first`` on."""
        for number in range(first, len(self.patterns)):
            value = self.patterns[number].value
            if value.shape == offsets.shape and np.allclose(value, offsets, atol=1e-3):
                return number
        return None

    def _topology_at(self, number: int) -> NDArray[Any] | None:
        """Return the topology in the middle of a pattern, given by its number; both by the recorder's clock."""
        start = self.patterns[number].time
        end = self.patterns[number + 1].time if number + 1 < len(self.patterns) else np.inf
        known = [c.value for c in self.topologies if c.time <= start + 0.5 * min(end - start, 1.0)]
        return known[-1] if known else None


def formation_of(recording: Recording) -> FormationRecord | None:
    """Return the formation flight in a recording; None if there is none.

    Without the director's events, each assigned pattern lasts until the next, and the first vehicle is the leader.
    """
    starts = _starts(recording.events)
    if starts:
        names = tuple(str(name) for name in starts[-1]["vehicles"])
    else:
        names = tuple(vehicle.name for vehicle in recording.vehicles)
    truth = fleet_track(recording.truth_source, [recording.models.get(name) for name in names])
    known = {vehicle.name: vehicle.position for vehicle in recording.vehicles}
    estimate = fleet_track(ESTIMATE, [known.get(name) for name in names])
    track = truth or estimate
    if len(names) < 2 or track is None:
        return None
    if starts:
        events = _completed(recording.events, float(track.time[-1]))
    else:
        fitting = [change for change in recording.patterns if len(change.value) == len(names) - 1]
        if not fitting:
            return None
        events = _inferred_events(fitting, names, track)
    return FormationRecord(
        names, truth, estimate, recording.patterns, recording.topologies, events, recording.collisions
    )


def _starts(events: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the events that list a formation flight's vehicles: start, which a late recorder misses, and takeoff."""
    return [event for event in events if "vehicles" in event and event.get("event") != SEARCH_START]


def _completed(events: list[dict[str, Any]], end: float) -> list[dict[str, Any]]:
    """Return the director's events, with END after those of a flight whose last event was not recorded.

    Args:
        events: at least one.
        end: of the positions, s.
    """
    if events[-1]["event"] in _LAST:
        return events
    end = max(end, events[-1]["time"])
    kept = [event for event in events if event["event"] != "phase" or event["time"] < end - _LEAST_WINDOW]
    return [*kept, {"event": END, "time": end}]


def _inferred_events(patterns: list[Change], names: tuple[str, ...], track: FleetTrack) -> list[dict[str, Any]]:
    start, end = float(track.time[0]), float(track.time[-1])
    events: list[dict[str, Any]] = [
        {"event": "start", "time": start, "vehicles": list(names)},
        {"event": "phase", "phase": "takeoff", "time": start},
    ]
    for number, change in enumerate(patterns, 1):
        if start <= change.time < end:
            pattern = f"pattern {number}"
            events.append({"event": "phase", "phase": pattern, "pattern": pattern, "time": change.time})
            events.append({"event": "assigned", "pattern": pattern, "time": change.time, "offsets": change.value})
    return [*events, {"event": END, "time": end}]


def read_formation(file: str | Path) -> FormationRecord:
    """Read a formation flight with its director's events: a ``flight.bag``, or a ``flight.npz`` of one without ROS.

    Raises:
        RecordError: the file is missing, cannot be read, or holds no events of the director.
    """
    path = Path(file)
    if not path.is_file():
        raise RecordError(f"flight record: {path} {'is a folder' if path.is_dir() else 'does not exist'}")
    recording = read_archive(path) if path.suffix == ".npz" else _read_formation_bag(path)
    if not _starts(recording.events):
        if any(event.get("event") == SEARCH_START for event in recording.events):
            raise RecordError(
                f"bag: {path} is a search's, and what './xtdrone demo search' has prepared for it is not beside it "
                "(search.world, region.yaml, plans); './xtdrone analyse' draws what was flown"
            )
        raise RecordError(f"bag: no takeoff on {EVENTS_TOPIC}; this is not a record of a formation flight")
    record = formation_of(recording)
    if record is None:
        raise RecordError(
            f"flight record: {path} has no formation: two vehicles are needed, and the positions of each "
            "(ground_truth/odom, /gazebo/model_states or local_position/pose)"
        )
    return record


def _read_formation_bag(path: Path) -> Recording:
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
        return read_bag([path], wanted=_is_wanted, most_values=np.inf)
    except BagError as error:
        raise RecordError(str(error)) from error


def _is_wanted(topic: str) -> bool:
    return topic in _TOPICS or _POSITIONS.fullmatch(topic) is not None


def save_formation(record: FormationRecord, path: str | Path) -> None:
    """Write ``record`` as a NumPy archive (.npz), which ``open_recording.read_archive`` reads.

    It holds ``names`` (n,), ``time`` (t,) s, ``position`` (t, n, 3) m ENU, and for each change of the pattern its
    ``pattern_time`` (p,), ``offsets`` (p, n - 1, 3) and ``topology`` (p, n, n); ``source``: a description of the
    positions; ``events`` and ``collisions`` as JSON.
    """
    track = record.track
    archive = io.BytesIO()  # a full disk is then an error of the file, not of the archive inside it
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
    with replacing(Path(path)) as draft:
        draft.write_bytes(archive.getvalue())
