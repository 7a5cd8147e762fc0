"""A recorded flight of a fleet: true tracks, and what the director has reported.

All positions are in the ``map`` frame: ENU, metres. Times are simulated seconds.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.positions import FleetTrack, fleet_track
from xtdrone_interaction.recording.recorded_flight import RecordError, Recording
from xtdrone_interaction.recording.series_in_bounded_memory import Array
from xtdrone_interaction.recording.topics import (
    EVENTS_TOPIC,
    LOG_TOPIC,
    SEARCH_EVENTS_TOPIC,
    TRUTH,
    TRUTH_TOPIC,
    odometry_topic,
)


@dataclass(frozen=True)
class FleetRecord:
    """One flight.

    Attributes:
        names: Names of the vehicles.
        time: Times of the true positions, shape (t,), s.
        position: True positions, shape (t, n, 3).
        events: Events of the director, in order.
        collisions: The simulator's collision messages, in order.
    """

    names: tuple[str, ...]
    time: Array
    position: Array
    events: list[dict[str, Any]]
    collisions: list[str]

    def outcome_of(self, name: str) -> dict[str, Any]:
        """Return outcome, goal, begun and ended (s, None if unknown) of a vehicle, as its last event has them."""
        own = [event for event in self.events if event.get("vehicle") == name]
        unknown = {"outcome": "the record ends before", "goal": None, "begun": None, "ended": None}
        return {**unknown, **{key: own[-1][key] for key in unknown if own and own[-1].get(key) not in (None, "")}}


def read_fleet(
    bag: Path, names: Sequence[str], keep: Collection[str] = (), models: Collection[str] = ()
) -> tuple[Recording, FleetTrack]:
    """Read a flight from its bag, also one that was cut off, and the events.jsonl beside it.

    Args:
        bag: File of the flight.
        names: Names of the vehicles.
        keep: Topics whose messages are kept.
        models: Further models whose true positions are read.

    Returns:
        The recording, and the true positions of the vehicles.

    Raises:
        RecordError: the file is missing or cannot be read, or has no true positions.
    """
    if not bag.is_file():
        raise RecordError(f"flight record: {bag} does not exist")
    odometry = {odometry_topic(name) for name in (*names, *models)}
    wanted = {*odometry, TRUTH_TOPIC, EVENTS_TOPIC, SEARCH_EVENTS_TOPIC, LOG_TOPIC, *keep}
    try:
        recording = read_bag([bag], wanted=wanted.__contains__, keep=keep)
    except BagError as error:
        raise RecordError(str(error)) from error
    truth = fleet_track(TRUTH, [recording.models.get(name) for name in names])
    if truth is None:
        raise RecordError(f"bag: {bag} has no true positions of the vehicles; this is not a record of such a flight")
    return recording, truth


def read_fleet_record(bag: Path, names: Sequence[str]) -> FleetRecord:
    """Read what all flights have from a bag; see :func:`read_fleet`."""
    recording, truth = read_fleet(bag, names)
    return FleetRecord(tuple(names), truth.time, truth.position, recording.events, recording.collisions)
