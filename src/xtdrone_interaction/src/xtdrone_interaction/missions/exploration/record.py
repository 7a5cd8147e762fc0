"""A recorded exploration: true tracks, the maps that vehicles have exchanged, the director's events, map merging."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.missions.fleet_record import FleetRecord, read_fleet
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_planning.exploration.choice_of_frontier import RETURNING
from xtdrone_planning.exploration.exploration_messages import cells_of

_TOPIC = "/diagnostics"
_STATUS = ": map merging"  # after the vehicle's name


@dataclass(frozen=True)
class ExplorationRecord(FleetRecord):
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
    floors = [f"/{name}/exploration/floor" for name in names]
    states = [f"/{name}/exploration/state" for name in names]
    recording, truth = read_fleet(bag, names, [*floors, *states])
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


def read_merging(bag: Path, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return by vehicle: whether its map was ``merged`` at the end, the last ``state``, and ``since`` when.

    ``since`` is the time, s, from which on the map was merged until the end; None without. Vehicles that were not
    reported are left out.

    Raises:
        RecordError: the bag cannot be read.
    """
    try:
        recording = read_bag([bag], wanted=lambda name: name == _TOPIC, keep=[_TOPIC])
    except BagError as error:
        raise RecordError(str(error)) from error
    found: dict[str, dict[str, Any]] = {}
    wanted = {f"{name}{_STATUS}": name for name in names}
    for time, message in recording.messages.get(_TOPIC, []):
        for status in message.status:
            if status.name not in wanted:
                continue
            entry = found.setdefault(wanted[status.name], {"since": None})
            entry["merged"], entry["state"] = status.level == 0, status.message
            if not entry["merged"]:
                entry["since"] = None
            elif entry["since"] is None:
                entry["since"] = round(time, 3)
    return {name: found[name] for name in names if name in found}
