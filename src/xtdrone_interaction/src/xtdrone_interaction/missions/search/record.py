"""A cooperative search: tracks of vehicles and persons, camera images, and the mission's events.

All positions are in the ``map`` frame: ENU, metres. Times are simulated seconds.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xtdrone_interaction.missions.fleet_record import read_fleet
from xtdrone_interaction.recording.recorded_flight import Recording
from xtdrone_interaction.recording.series_in_bounded_memory import Array
from xtdrone_interaction.recording.topics import SEARCH_PROGRESS_TOPIC

CUT_SHORT = "cut short"  # outcome of a search whose recording ends before it did


@dataclass(frozen=True)
class Sight:
    """Objects in one camera image.

    Attributes:
        time: of the exposure, s.
        dropped: images skipped so far because the detector was busy.
        ids: of all current tracks.
        seen: of the tracks that this image showed.
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
        sights: by vehicle, in order.
        events: of the search mission, in order; the last one is "finished", with the outcome CUT_SHORT if the recording
            ends before the search did.
        collisions: the simulator's collision messages in order.
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
        """Return an actor's interpolated true position, shape (3,)."""
        track = self.persons[name]
        return np.array([np.interp(time, self.time, track[:, axis]) for axis in range(3)])

    def nearest_person(self, place: tuple[float, float], time: float) -> tuple[str, float] | None:
        """Return the person nearest to ``place`` (x, y) at ``time`` and their distance, m; None without persons."""
        distances = {
            name: float(np.hypot(*(self.person_at(name, time)[:2] - np.asarray(place)))) for name in self.persons
        }
        distances = {name: distance for name, distance in distances.items() if np.isfinite(distance)}
        return min(distances.items(), key=lambda item: item[1]) if distances else None


def read_search(bag: Path, names: Sequence[str], persons: Sequence[str]) -> SearchRecord:
    """Read a search from its bag, also one that was cut off, and the events.jsonl beside it.

    Args:
        bag: the file.
        names: the vehicles.
        persons: the actors.

    Raises:
        RecordError: the file is missing or cannot be read, or has no true positions.
    """
    objects = {name: f"/xtdrone/{name}/objects" for name in names}
    recording, truth = read_fleet(bag, names, {*objects.values(), SEARCH_PROGRESS_TOPIC}, persons)
    events = recording.events
    if not events or events[-1]["event"] != "finished":
        events = [*events, _cut_short(recording, float(truth.time[-1]))]
    return SearchRecord(
        names=tuple(names),
        time=truth.time,
        position=truth.position,
        persons={name: _person_track(recording, name, truth.time) for name in persons},
        sights={name: [_sight(message) for _, message in recording.messages[topic]] for name, topic in objects.items()},
        events=events,
        collisions=recording.collisions,
    )


def _person_track(recording: Recording, name: str, time: Array) -> Array:
    """Return an actor's positions at some times, shape (t, 3); NaN before the first message, held after the last."""
    series = recording.models.get(name)
    if series is None or not len(series):
        return np.full((len(time), 3), np.nan)
    return np.column_stack([np.interp(time, series.time, series.value[:, axis], left=np.nan) for axis in range(3)])


def _cut_short(recording: Recording, time: float) -> dict[str, Any]:
    """Return the last event of a search whose recording ends before it, at ``time``."""
    progress = recording.messages[SEARCH_PROGRESS_TOPIC]
    return {
        "event": "finished",
        "time": time,
        "outcome": CUT_SHORT,
        "reason": "the record ends before the search did",
        "lost": [event["vehicle"] for event in recording.events if event["event"] == "lost_vehicle"],
        "covered_fraction": json.loads(progress[-1][1].data)["covered_fraction"] if progress else None,
    }


def _sight(message: Any) -> Sight:
    """Return the sight in an xtdrone_msgs/ObjectsOnGround."""
    stamp, tracks = message.header.stamp, message.objects
    return Sight(
        time=stamp.sec + stamp.nanosec * 1e-9,
        dropped=int(message.dropped),
        ids=tuple(int(o.id) for o in tracks),
        seen=tuple(int(o.id) for o in tracks if o.probability > 0.0),
    )
