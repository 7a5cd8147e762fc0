"""The formation flight without ROS: the demo's mission over a ``Swarm``, in one process.

The vehicles of the swarm may be simplified ones or, with ``CoreVehicles``, those of the full simulator. The result is
a record of the same type as one read from a flight's bag, so that the same code makes the report and pictures.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from xtdrone_coordination.leader import CommandError
from xtdrone_interaction.missions.formation.record import FormationRecord
from xtdrone_interaction.missions.formation.state_machine import (
    CLEARANCE,
    SETTLE_LIMIT,
    FleetState,
    FormationMission,
    MissionError,
)
from xtdrone_interaction.recording.distances import Array
from xtdrone_interaction.recording.positions import FleetTrack
from xtdrone_interaction.recording.recorded_flight import Change
from xtdrone_interaction.recording.topics import ORIGIN

if TYPE_CHECKING:
    from xtdrone_swarm import Swarm

SOURCE = "truth (in one process)"
PROGRESS_TURNS = 6  # turns between two calls of ``progress``: 5 Hz of simulated time
_SETTLE_TIME = 6.0  # s for each metre between the leader and the farthest slot: followers fly 1 m/s
_MANY = 200  # vehicles; for larger swarms, every third turn is recorded
_MANY_TURNS = 3

Progress = Callable[[dict[str, Any]], None]
EventListener = Callable[[dict[str, Any]], None]


def fly_formation(
    swarm: Swarm,
    patterns: Sequence[str],
    *,
    clearance: float = CLEARANCE,
    source: str = SOURCE,
    progress: Progress | None = None,
    on_event: EventListener | None = None,
    on_turn: Callable[[], None] | None = None,
) -> FormationRecord:
    """Fly the formation mission: takeoff, origin, each pattern with the leader moving between, origin, landing.

    A flight that fails is landed and recorded, too; its last event is ``failed`` instead of ``done``.

    Args:
        swarm: on the ground, at the start; ``Swarm(..., airborne=False)``.
        patterns: flown in turn.
        clearance: minimum height of any slot above the ground, m.
        source: description of the recorded positions, for captions.
        progress: called five times per simulated second with the content of /xtdrone/demo/progress.
        on_event: called with each event.
        on_turn: called after each turn of 30 Hz, to draw the flight.

    Returns:
        The record; positions are the true ones at 30 Hz (10 Hz for more than 200 vehicles).

    Raises:
        PatternError: an unknown pattern.
    """
    flight = FormationFlight(swarm, patterns, clearance=clearance, source=source, progress=progress, on_event=on_event)
    for _ in flight.turns():
        if on_turn is not None:
            on_turn()
    return flight.record()


class FormationFlight:
    """Feeds the mission's view from the swarm, sends its commands, and keeps the record.

    Attributes:
        mission: the mission flown.
        view: the fleet's state as the mission sees it.
    """

    def __init__(
        self,
        swarm: Swarm,
        patterns: Sequence[str],
        *,
        clearance: float = CLEARANCE,
        source: str = SOURCE,
        progress: Progress | None = None,
        on_event: EventListener | None = None,
    ) -> None:
        """Prepare the flight; see :func:`fly_formation`."""
        known = swarm.leader.patterns
        slots = {name: known.offsets(name) for name in dict.fromkeys([ORIGIN, *patterns])}
        self.view = FleetState(swarm.vehicles.names)
        self.view.connected = [True] * len(self.view.names)
        reach = max(float(np.linalg.norm(offsets, axis=1).max()) for offsets in slots.values())
        limit = max(SETTLE_LIMIT, _SETTLE_TIME * reach)
        self.mission = FormationMission(self.view, self, patterns, slots, clearance, limit)
        self._swarm = swarm
        self._source = source
        self._on_progress = progress
        self._on_event = on_event
        self._turns_apart = _MANY_TURNS if len(self.view.names) > _MANY else 1
        self._turn = 0
        self._least_distance = np.inf
        self._times: list[float] = []
        self._places: list[Array] = []
        self._events: list[dict[str, Any]] = []
        self._patterns: list[Change] = []
        self._topologies: list[Change] = []
        self._pattern = ""
        self._look()

    # the mission's Commands

    def vehicle(self, index: int, command: str) -> None:
        """Send an XTDrone command to one vehicle; the mission repeats commands without effect."""
        self._swarm.vehicle(index, command)

    def leader(self, command: str) -> None:
        """Send a command to the leader; log a warning if it is rejected, like the leader's node."""
        try:
            self._swarm.command(command)
        except CommandError as error:
            self.event("refused", reason=str(error))

    def leader_velocity(self, velocity: Array) -> None:
        """Command the leader's velocity, shape (3,), m/s FLU."""
        x, y, z = velocity.tolist()
        self._swarm.steer((x, y, z), 0.0)

    def event(self, event: str, **values: Any) -> None:
        """Record an event, with the monotonic wall time for the report's real-time factor."""
        found = {"event": event, "time": self.view.time, **values, "wall": time.monotonic()}
        self._events.append(found)
        if self._on_event is not None:
            self._on_event(found)

    # the flight

    def turns(self) -> Iterator[None]:
        """Fly to the end, one turn of 30 Hz per step; the last event is ``done`` or ``failed``."""
        self.event("start", vehicles=list(self.view.names), patterns=self.mission.patterns)
        try:
            yield from self._advance(self.mission.fly())
        except MissionError as error:
            yield from self._give_up(str(error))
        else:
            self.event("done", **self.mission.result)

    def _give_up(self, reason: str) -> Iterator[None]:
        """Land all vehicles; the flight has failed for ``reason``."""
        self.event("giving up", reason=reason)
        self.mission.phase = "landing after a failure"
        try:
            yield from self._advance(self.mission.land())
        except MissionError as error:
            self.event("not landed", reason=str(error))
        self.event("failed", reason=reason)

    def _advance(self, ticks: Iterator[None]) -> Iterator[None]:
        """Advance ``ticks`` once a turn until it ends.

        Raises:
            MissionError: the mission has failed.
        """
        for number, _ in enumerate(ticks):
            if self._on_progress is not None and number % PROGRESS_TURNS == 0:
                self._on_progress(self._progress())
            self._swarm.step()
            self._look()
            yield

    def _look(self) -> None:
        """Update the mission's view from the swarm, and record the positions."""
        swarm, view = self._swarm, self.view
        vehicles = swarm.vehicles
        view.time = vehicles.time_us / 1e6
        places = np.array(vehicles.true_position)
        known = np.isfinite(vehicles.position).all(axis=1, keepdims=True)
        view.position[:] = np.where(known, places, np.nan)
        view.armed[:] = vehicles.armed  # in place: the mission keeps the lists
        view.mode[:] = vehicles.mode
        view.leader_yaw = float(vehicles.yaw[0])
        if self._turn % self._turns_apart == 0:
            self._times.append(view.time)
            self._places.append(places)
        self._turn += 1
        leader = swarm.leader
        if leader.pattern == self._pattern:
            return
        self._pattern = leader.pattern
        assert leader.offsets is not None
        assert leader.adjacency is not None
        view.offsets = leader.offsets.copy()
        self._patterns.append(Change(view.time, leader.offsets.copy()))
        self._topologies.append(Change(view.time, leader.adjacency.copy()))

    def _progress(self) -> dict[str, Any]:
        error = self.mission.error()
        distance = float(self._swarm.least_distance())
        if self.mission.step > 1:
            self._least_distance = min(self._least_distance, distance)
        return {
            "phase": self.mission.phase,
            "step": self.mission.step,
            "steps": self.mission.steps,
            "sim_time": self.view.time,
            "error": None if error is None or not np.isfinite(error).all() else float(error.max()),
            "distance": distance if np.isfinite(distance) else None,
            "least_distance": self._least_distance if np.isfinite(self._least_distance) else None,
            "positions": self._source,
        }

    def record(self) -> FormationRecord:
        """Return the record of the flight; collisions occur only in full physics."""
        return FormationRecord(
            names=tuple(self.view.names),
            truth=FleetTrack(self._source, np.array(self._times), np.array(self._places)),
            estimate=None,
            patterns=self._patterns,
            topologies=self._topologies,
            events=self._events,
            collisions=list(getattr(self._swarm.vehicles, "collisions", ())),
        )


def outcome_of(record: FormationRecord) -> tuple[str, str]:
    """Return how a flight ended, ``done`` or ``failed``, and why."""
    last = record.events[-1]
    return cast(str, last["event"]), cast(str, last.get("reason", ""))
