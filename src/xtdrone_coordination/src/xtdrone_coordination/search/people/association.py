"""Association of sightings with candidates."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection

import shapely
from shapely.geometry import Polygon

from ..reports import round_xy
from ..search_settings import MissionSettings
from ..searching_vehicle import Vehicle
from .candidates import Candidate, Sighting, nearest

_WALKING_SPEED = 1.5  # m/s that a person may move while unseen
ReportEvent = Callable[..., None]
"""Reports an event by its name, vehicle and fields, see ``mission_control.SearchMission.report``."""


class Association:
    """Merges sightings into candidates, and adds a candidate for each sighting of a new place."""

    def __init__(
        self, candidates: list[Candidate], region: Polygon, settings: MissionSettings, report: ReportEvent
    ) -> None:
        """Prepare the region.

        Args:
            candidates: list that new candidates are appended to.
            region: searched region, m ENU.
            settings: Settings of the mission control.
            report: called with the event ``candidate``.
        """
        self._candidates = candidates
        self._region = region.buffer(settings.margin)
        shapely.prepare(self._region)
        self._settings = settings
        self._report = report

    def observe(self, vehicle: Vehicle, time: float, sighting: Sighting, tracked: Collection[int]) -> Candidate | None:
        """Merge a sighting into its candidate and return it; None outside the region, or if the image shows nothing.

        Args:
            vehicle: vehicle that took the image.
            time: Time of the exposure, s.
            sighting: one object of the image.
            tracked: ids of all tracks of the camera.
        """
        if not sighting.probability > 0.0 or not all(map(math.isfinite, sighting.position)):
            return None
        candidate = self._match(vehicle, time, sighting)
        if candidate is None:
            if not shapely.contains_xy(self._region, *sighting.position):
                return None
            candidate = Candidate(sighting.position, sighting.velocity, sighting.covariance, time)
            self._candidates.append(candidate)
        if not _is_beside_followed(vehicle, candidate, sighting, tracked):
            candidate.see(vehicle.name, time, sighting, tracked)
            self._report_if_new(vehicle, candidate)
        return candidate

    def _match(self, vehicle: Vehicle, time: float, sighting: Sighting) -> Candidate | None:
        following = vehicle.following
        if following is not None and sighting.id == following.track:
            return following.candidate  # the camera's track is more reliable than the extrapolated position
        found = nearest(self._candidates, sighting.position, time, self._settings.same_place)
        if found is None or found.status == "seen":
            found = self._match_handed_over(vehicle, time, sighting) or found
        return found

    def _match_handed_over(self, vehicle: Vehicle, time: float, sighting: Sighting) -> Candidate | None:
        """Return the handed-over candidate if the sighting may be the same person, allowing for motion while unseen."""
        look, settings = vehicle.look, self._settings
        if look is None or look.takes_over is None or sighting.probability < settings.candidate_probability:
            return None
        unseen = max(time - look.candidate.seen_at, 0.0)
        reach = min(settings.same_place + _WALKING_SPEED * unseen, settings.look_apart)
        apart = math.dist(look.candidate.place(time), sighting.position)
        return look.candidate if apart <= reach else None

    def _report_if_new(self, vehicle: Vehicle, candidate: Candidate) -> None:
        hits = candidate.hits[vehicle.name]
        if hits == self._settings.candidate_hits and candidate.pictures == hits and candidate.status == "seen":
            probability = round(candidate.probability, 3)
            self._report(
                "candidate", vehicle, position=round_xy(candidate.position), probability=probability, hits=hits
            )


def _is_beside_followed(vehicle: Vehicle, candidate: Candidate, sighting: Sighting, tracked: Collection[int]) -> bool:
    """Return whether a sighting is another object beside the followed person, whose own track still exists."""
    following = vehicle.following
    return (
        following is not None
        and candidate is following.candidate
        and sighting.id != following.track
        and following.track in tracked
    )
