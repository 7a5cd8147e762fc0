"""Candidates: places where images show a person, and the evidence for and against each."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from ..planning.coverage_path import Point

_MAX_PROBABILITY = 0.95  # cap on a detector's probability: its errors are correlated from image to image
_MISS = -1.5  # log-odds of an image of the place without a detection: about one in four misses a person
EXTRAPOLATION = 3.0  # s for which a velocity is extrapolated


@dataclass(frozen=True)
class Sighting:
    """An object in an image, one entry of ObjectsOnGround.

    Attributes:
        id: Id of the track, constant as long as the camera keeps it.
        position: Position on the ground, m ENU.
        velocity: m/s ENU.
        covariance: Covariance of the position: xx, xy, yx, yy, m^2.
        probability: the detector's; 0 if this image does not show the track.
    """

    id: int
    position: Point
    velocity: Point = (0.0, 0.0)
    covariance: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)
    probability: float = 0.9


@dataclass
class Evidence:
    """Evidence that a person is at a place, accumulated over the images of a second look.

    Attributes:
        log_odds: sum over the images, 0 at the start.
        pictures: number of images of the place.
        hits: number of images that show a person there.
        total: sum of the probabilities of the hits.
    """

    log_odds: float = 0.0
    pictures: int = 0
    hits: int = 0
    total: float = 0.0

    def hit(self, probability: float) -> None:
        """Add an image that shows a person."""
        p = min(max(probability, 1.0 - _MAX_PROBABILITY), _MAX_PROBABILITY)
        self.log_odds += math.log(p / (1.0 - p))
        self.pictures += 1
        self.hits += 1
        self.total += probability

    def miss(self) -> None:
        """Add an image of the place that shows no person."""
        self.log_odds += _MISS
        self.pictures += 1

    @property
    def mean(self) -> float:
        """Mean probability over all images of the place."""
        return self.total / self.pictures if self.pictures else 0.0


@dataclass(eq=False)
class Candidate:
    """A possible person, compared by identity.

    Attributes:
        position, velocity, covariance: of the newest image.
        seen_at: time of the newest image, s.
        track: the person's track id by vehicle; of several tracks at the place, the one with the maximum weight.
        hits, total: number of images that show the person, and the sum of their probabilities, by vehicle.
        status: ``seen``, ``looked at``, ``rejected`` or ``confirmed``.
        looked_by: vehicles that have taken a second look.
        found: whether a second look has ever confirmed it.
        weight: sum of the probabilities of each track merged into it, by vehicle and track id.
    """

    position: Point
    velocity: Point
    covariance: tuple[float, float, float, float]
    seen_at: float
    track: dict[str, int] = field(default_factory=dict)
    hits: dict[str, int] = field(default_factory=dict)
    total: dict[str, float] = field(default_factory=dict)
    status: str = "seen"
    looked_by: set[str] = field(default_factory=set)
    found: bool = False
    weight: dict[tuple[str, int], float] = field(default_factory=dict)

    def see(self, vehicle: str, time: float, sighting: Sighting, tracked: Collection[int] = ()) -> None:
        """Merge a sighting into the candidate.

        Args:
            vehicle: name of the vehicle that took the image.
            time: Time of the exposure, s.
            sighting: the sighting.
            tracked: ids of all tracks of the vehicle's camera.
        """
        self.hits[vehicle] = self.hits.get(vehicle, 0) + 1
        self.total[vehicle] = self.total.get(vehicle, 0.0) + sighting.probability
        this = vehicle, sighting.id
        self.weight[this] = self.weight.get(this, 0.0) + sighting.probability
        known = self.track.get(vehicle, sighting.id)
        if known in tracked and self.weight[vehicle, known] > self.weight[this]:
            return  # another object beside the person
        self.position, self.velocity, self.covariance = sighting.position, sighting.velocity, sighting.covariance
        self.seen_at = time
        self.track[vehicle] = sighting.id

    def place(self, time: float) -> Point:
        """Return the extrapolated position at a time, m ENU; a rejected candidate is taken to stand still."""
        if self.status == "rejected":
            return self.position
        ahead = min(max(time - self.seen_at, 0.0), EXTRAPOLATION)
        return self.position[0] + ahead * self.velocity[0], self.position[1] + ahead * self.velocity[1]

    def mean(self, vehicle: str) -> float:
        """Return the mean probability of a vehicle's images of the candidate."""
        return self.total.get(vehicle, 0.0) / max(self.hits.get(vehicle, 0), 1)

    @property
    def pictures(self) -> int:
        """Number of images of all vehicles that show it."""
        return sum(self.hits.values())

    @property
    def probability(self) -> float:
        """Mean probability over all images that show it."""
        return sum(self.total.values()) / max(self.pictures, 1)


def nearest(candidates: Iterable[Candidate], place: Point, time: float, radius: float) -> Candidate | None:
    """Return the candidate nearest to a place at a time, None if none is within ``radius`` m."""
    found = [(math.dist(candidate.place(time), place), i, candidate) for i, candidate in enumerate(candidates)]
    near = min(found, default=None, key=lambda entry: entry[:2])
    return near[2] if near is not None and near[0] <= radius else None
