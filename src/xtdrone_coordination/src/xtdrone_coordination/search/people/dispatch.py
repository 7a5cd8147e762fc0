"""Dispatch: which vehicle takes a second look at which candidate."""

from __future__ import annotations

from collections.abc import Sequence

from ..searching_vehicle import OFFBOARD_STATES, Vehicle
from ..states.common_supervision import MissionControl
from .candidates import Candidate


class Dispatch:
    """Sends vehicles to candidates."""

    def __init__(self, control: MissionControl, candidates: Sequence[Candidate]) -> None:
        self._control = control
        self._candidates = candidates

    def update(self) -> None:
        """Send vehicles to the candidates they have seen often enough."""
        if self._control.ending or self._control.found:
            return
        for candidate in self._candidates:
            if candidate.status not in ("seen", "rejected") or len(candidate.looked_by) > 1:
                continue
            able = [vehicle for vehicle in self._available(candidate) if self._has_seen(vehicle, candidate)]
            if able and self._is_apart(candidate):
                self._send_nearest(able, candidate, None)

    def hand_over(self, candidate: Candidate, takes_over: float | None) -> bool:
        """Send the nearest vehicle that has not looked at a candidate yet; return whether one is available.

        Args:
            candidate: the candidate.
            takes_over: remaining time of the following to take over, s; None for a first look.
        """
        able = [] if self._control.ending else self._available(candidate)
        if able:
            self._send_nearest(able, candidate, takes_over)
        return bool(able)

    def _available(self, candidate: Candidate) -> list[Vehicle]:
        vehicles = self._control.vehicles.values()
        return [vehicle for vehicle in vehicles if vehicle.available and vehicle.name not in candidate.looked_by]

    def _has_seen(self, vehicle: Vehicle, candidate: Candidate) -> bool:
        settings, hits = self._control.settings, candidate.hits.get(vehicle.name, 0)
        return hits >= settings.candidate_hits and candidate.mean(vehicle.name) >= settings.candidate_probability

    def _is_apart(self, candidate: Candidate) -> bool:
        """Return whether no low-flying vehicle is near a candidate."""
        place = candidate.place(self._control.now)
        return all(
            vehicle.state not in OFFBOARD_STATES
            or vehicle.position is None
            or vehicle.distance_to(place) > self._control.settings.look_apart
            for vehicle in self._control.vehicles.values()
        )

    def _send_nearest(self, vehicles: Sequence[Vehicle], candidate: Candidate, takes_over: float | None) -> None:
        place = candidate.place(self._control.now)
        self._control.begin_look(min(vehicles, key=lambda v: v.distance_to(place)), candidate, takes_over)
