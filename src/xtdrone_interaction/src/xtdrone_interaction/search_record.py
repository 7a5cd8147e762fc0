"""What happened in a cooperative search, read back from its bag and its events. No ROS is needed.

All positions are in the ``map`` frame: ENU, metres. Times are simulated seconds.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from xtdrone_interaction.analysis.stamped import read_stamped
from xtdrone_interaction.geometry import TRUTH, TRUTH_TOPIC, odometry_topic
from xtdrone_interaction.record import (
    LOG_TOPIC,
    ODOMETRY,
    RecordError,
    Track,
    messages,
    read_events,
    regular_times,
    track_of,
)

Array = NDArray[np.float64]

EVENTS_TOPIC = "/xtdrone/search/event"
PROGRESS_TOPIC = "/xtdrone/search/progress"
CUT_SHORT = "cut short"  # outcome of a search whose record ends before it did
_COLLISION = "collision of "  # in the words of the simulator node


@dataclass(frozen=True)
class Sight:
    """What one picture showed.

    Attributes:
        time: of the exposure, s.
        dropped: pictures that had been passed over so far, because the detector was busy.
        ids: of the tracks in it, whether this picture showed them or not.
        seen: of those that this picture showed.
    """

    time: float
    dropped: int
    ids: tuple[int, ...]
    seen: tuple[int, ...]


@dataclass(frozen=True)
class SearchRecord:
    """One search.

    Attributes:
        names: vehicles.
        time: of the true positions, shape (t,), s.
        position: true positions of the vehicles, shape (t, n, 3).
        persons: true positions of the actors by name, each (t, 3); NaN before the first message that names them.
        sights: what each vehicle's pictures showed, in order.
        events: of the mission control, in order; the last one is "finished", with the outcome CUT_SHORT where the
            record ends before the search did.
        collisions: what the simulator said of vehicles that touched something, in order.
    """

    names: tuple[str, ...]
    time: Array
    position: Array
    persons: dict[str, Array]
    sights: dict[str, list[Sight]]
    events: list[dict[str, Any]]
    collisions: list[str]

    @property
    def finished(self) -> dict[str, Any]:
        """The last event."""
        return self.events[-1]

    def person_at(self, name: str, time: float) -> Array:
        """Return where an actor truly was, shape (3,), between two messages by interpolation."""
        track = self.persons[name]
        return np.array([np.interp(time, self.time, track[:, axis]) for axis in range(3)])

    def nearest_person(self, place: tuple[float, float], time: float) -> tuple[str, float] | None:
        """Return who stood nearest to ``place`` (x, y) at ``time`` and how far off, m; None where nobody is."""
        distances = {
            name: float(np.hypot(*(self.person_at(name, time)[:2] - np.asarray(place)))) for name in self.persons
        }
        distances = {name: distance for name, distance in distances.items() if np.isfinite(distance)}
        return min(distances.items(), key=lambda item: item[1]) if distances else None


def read_search(bag: Path, names: tuple[str, ...], persons: tuple[str, ...]) -> SearchRecord:
    """Read a search's bag, and events.jsonl beside it where it is there.

    Args:
        bag: the file.
        names: the vehicles.
        persons: the actors.

    Raises:
        RecordError: the file is missing or cannot be read, or has no true positions.
    """
    if not bag.is_file():
        raise RecordError(f"flight record: {bag} does not exist")
    try:
        with AnyReader([bag]) as reader:
            return _read(reader, bag, names, persons, read_events(bag.with_name("events.jsonl")))
    except RecordError:
        raise
    except Exception as error:  # rosbags raises many kinds for a damaged file
        raise RecordError(f"bag: {bag} cannot be read ({error}); 'rosbag reindex' may mend it") from error


def _read(
    reader: AnyReader, bag: Path, names: tuple[str, ...], persons: tuple[str, ...], events: list[dict[str, Any]]
) -> SearchRecord:
    truth = _stamped_truth(bag, names, persons) or _states(reader, names, persons)
    events = events or [json.loads(m.data) for _, _, m in messages(reader, [EVENTS_TOPIC])]
    if not events or events[-1].get("event") != "finished":
        events = [*events, _cut_short(reader, float(truth.time[-1]), events)]
    return SearchRecord(
        names=names,
        time=truth.time,
        position=truth.position[:, : len(names)],
        persons={name: truth.position[:, len(names) + i] for i, name in enumerate(persons)},
        sights={name: _sights(reader, name) for name in names},
        events=events,
        collisions=[m.msg for _, _, m in messages(reader, [LOG_TOPIC]) if _COLLISION in m.msg],
    )


def _cut_short(reader: AnyReader, time: float, events: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what is known at the end of a record that has none."""
    covered = None
    for _, _, message in messages(reader, [PROGRESS_TOPIC]):
        covered = json.loads(message.data)["covered_fraction"]
    return {
        "event": "finished",
        "time": time,
        "outcome": CUT_SHORT,
        "reason": "the record ends before the search did",
        "lost": [event["vehicle"] for event in events if event["event"] == "lost_vehicle"],
        "covered_fraction": covered,
    }


def _stamped_truth(bag: Path, names: tuple[str, ...], persons: tuple[str, ...]) -> Track | None:
    """Return the true places of vehicles and persons, None if somebody's were not recorded with their times."""
    topics = [odometry_topic(name) for name in (*names, *persons)]
    series = read_stamped(bag, dict.fromkeys(topics, ODOMETRY))
    return track_of(TRUTH, [series.get(topic) for topic in topics])


def _states(reader: AnyReader, names: tuple[str, ...], persons: tuple[str, ...]) -> Track:
    stamps, rows = [], []
    for _, stamp, message in messages(reader, [TRUTH_TOPIC]):
        places = {
            name: (p.position.x, p.position.y, p.position.z) for name, p in zip(message.name, message.pose, strict=True)
        }
        stamps.append(stamp)
        rows.append([places.get(name, (np.nan,) * 3) for name in (*names, *persons)])
    if not rows:
        raise RecordError(f"bag: no true positions on {TRUTH_TOPIC}; this is no record of a search")
    return Track(TRUTH, regular_times(np.array(stamps)), np.array(rows))


def _sights(reader: AnyReader, name: str) -> list[Sight]:
    sights = []
    for _, _, message in messages(reader, [f"/xtdrone/{name}/objects"]):
        stamp = message.header.stamp
        tracks = message.objects
        sights.append(
            Sight(
                time=stamp.sec + stamp.nanosec * 1e-9,
                dropped=int(message.dropped),
                ids=tuple(int(o.id) for o in tracks),
                seen=tuple(int(o.id) for o in tracks if o.probability > 0.0),
            )
        )
    return sights
