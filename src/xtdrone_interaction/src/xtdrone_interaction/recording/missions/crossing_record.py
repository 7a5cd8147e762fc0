"""A recorded flight through obstacles: true tracks, and what the director has reported.

All positions are in the ``map`` frame: ENU, metres. Times are simulated seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.formation.shared_topics_and_names import EVENTS_TOPIC, TRUTH, TRUTH_TOPIC, odometry_topic
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.positions import fleet_track
from xtdrone_interaction.recording.recorded_flight import LOG_TOPIC, RecordError
from xtdrone_interaction.recording.series_in_bounded_memory import Array


@dataclass(frozen=True)
class CrossingRecord:
    """One flight.

    Attributes:
        names: vehicles.
        time: of the true positions, shape (t,), s.
        position: true positions, shape (t, n, 3).
        events: of the director, in order.
        collisions: the simulator's collision messages in order.
    """

    names: tuple[str, ...]
    time: Array
    position: Array
    events: list[dict[str, Any]]
    collisions: list[str]

    def crossing_of(self, name: str) -> dict[str, Any]:
        """Return outcome, goal, begun and ended (s, None if unknown) of a vehicle, as its last event has them."""
        own = [event for event in self.events if event.get("vehicle") == name]
        unknown = {"outcome": "the record ends before", "goal": None, "begun": None, "ended": None}
        return {**unknown, **{key: own[-1][key] for key in unknown if own and own[-1].get(key) not in (None, "")}}


def read_crossing(bag: Path, names: Sequence[str]) -> CrossingRecord:
    """Read a flight from its bag, also one that was cut off, and the events.jsonl beside it.

    Raises:
        RecordError: the file is missing or cannot be read, or has no true positions.
    """
    if not bag.is_file():
        raise RecordError(f"flight record: {bag} does not exist")
    wanted = {*(odometry_topic(name) for name in names), TRUTH_TOPIC, EVENTS_TOPIC, LOG_TOPIC}
    try:
        recording = read_bag([bag], wanted=wanted.__contains__)
    except BagError as error:
        raise RecordError(str(error)) from error
    truth = fleet_track(TRUTH, [recording.models.get(name) for name in names])
    if truth is None:
        raise RecordError(f"bag: {bag} has no true positions of the vehicles; this is not a record of such a flight")
    return CrossingRecord(tuple(names), truth.time, truth.position, recording.events, recording.collisions)
