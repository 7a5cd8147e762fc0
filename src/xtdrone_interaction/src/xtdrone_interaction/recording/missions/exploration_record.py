"""A recorded exploration: true tracks, the maps that the vehicles have exchanged, and the director's events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.formation.shared_topics_and_names import EVENTS_TOPIC, TRUTH, TRUTH_TOPIC, odometry_topic
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.missions.crossing_record import CrossingRecord
from xtdrone_interaction.recording.positions import fleet_track
from xtdrone_interaction.recording.recorded_flight import LOG_TOPIC, RecordError
from xtdrone_planning.exploration.choice_of_frontier import RETURNING
from xtdrone_planning.exploration.exploration_messages import cells_of


@dataclass(frozen=True)
class ExplorationRecord(CrossingRecord):
    """One flight.

    Attributes:
        floors: times, s, and cells (nx, ny) of all vehicles' own maps, in order; see ``floor_map``.
        explored: s, when the last vehicle knew the floor and turned home; None if one never did.
    """

    floors: list[tuple[float, NDArray[np.int8]]]
    explored: float | None


def read_exploration(bag: Path, names: Sequence[str]) -> ExplorationRecord:
    """Read a flight from its bag, also one that was cut off, and the events.jsonl beside it.

    Raises:
        RecordError: the file is missing or cannot be read, or has no true positions.
    """
    if not bag.is_file():
        raise RecordError(f"flight record: {bag} does not exist")
    floors = [f"/{name}/exploration/floor" for name in names]
    states = [f"/{name}/exploration/state" for name in names]
    wanted = {*(odometry_topic(name) for name in names), TRUTH_TOPIC, EVENTS_TOPIC, LOG_TOPIC, *floors, *states}
    try:
        recording = read_bag([bag], wanted=wanted.__contains__, keep=[*floors, *states])
    except BagError as error:
        raise RecordError(str(error)) from error
    truth = fleet_track(TRUTH, [recording.models.get(name) for name in names])
    if truth is None:
        raise RecordError(f"bag: {bag} has no true positions of the vehicles; this is not a record of such a flight")
    maps = [
        (time, cells_of(message.map, message.map.info.resolution)[2])
        for topic in floors
        for time, message in recording.messages.get(topic, [])
    ]
    ends = [
        [time for time, message in recording.messages.get(topic, []) if message.data == RETURNING] for topic in states
    ]
    explored = max(times[-1] for times in ends) if all(ends) else None
    return ExplorationRecord(
        tuple(names), truth.time, truth.position, recording.events, recording.collisions,
        sorted(maps, key=lambda entry: entry[0]), explored,
    )  # fmt: skip
