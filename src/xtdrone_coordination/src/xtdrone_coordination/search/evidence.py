"""What pictures say for and against a person at a place."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from .coverage import Point

_SURE = 0.95  # what a detector's probability counts at most with: its errors do not come one by one
_MISS = -1.5  # of a picture that shows the place and nobody there: about one in four shows a person and misses him
AHEAD = 3.0  # s for which a velocity is believed


@dataclass(frozen=True)
class Sighting:
    """What a picture shows, as one entry of ObjectsOnGround.

    Attributes:
        id: of the track, the same as long as the camera keeps it.
        position: on the ground, m ENU.
        velocity: m/s ENU.
        covariance: of the position: xx, xy, yx, yy, m^2.
        probability: the detector's; 0 where this picture did not show it.
    """

    id: int
    position: Point
    velocity: Point = (0.0, 0.0)
    covariance: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)
    probability: float = 0.9


@dataclass
class Evidence:
    """The second look at a place, picture by picture.

    Attributes:
        log_odds: the sum of the pictures' logarithms of odds, 0 at the beginning.
        pictures: that showed the place.
        hits: that showed somebody there.
        total: sum of their probabilities.
    """

    log_odds: float = 0.0
    pictures: int = 0
    hits: int = 0
    total: float = 0.0

    def hit(self, probability: float) -> None:
        """Take a picture that shows somebody."""
        p = min(max(probability, 1.0 - _SURE), _SURE)
        self.log_odds += math.log(p / (1.0 - p))
        self.pictures += 1
        self.hits += 1
        self.total += probability

    def miss(self) -> None:
        """Take a picture that shows nobody."""
        self.log_odds += _MISS
        self.pictures += 1

    @property
    def mean(self) -> float:
        """Mean probability over all pictures of the place."""
        return self.total / self.pictures if self.pictures else 0.0


@dataclass
class Candidate:
    """Somebody who may be there.

    Attributes:
        position, velocity, covariance: of the newest picture that showed him.
        seen_at: its time, s.
        track: his id with each vehicle; of several tracks in one place the surest is he.
        hits, total: pictures that showed him and their probabilities' sum, by vehicle.
        status: ``seen``, ``looked at``, ``rejected`` or ``confirmed``.
        looked_by: vehicles that have had a second look.
        found: whether a second look has ever confirmed him.
        weight: sum of the probabilities of each track that was taken for him, by vehicle and id.
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
        """Take a picture of a vehicle that shows him.

        Args:
            vehicle: its name.
            time: of the exposure, s.
            sighting: what is taken for him.
            tracked: all tracks that the vehicle's camera has.
        """
        self.hits[vehicle] = self.hits.get(vehicle, 0) + 1
        self.total[vehicle] = self.total.get(vehicle, 0.0) + sighting.probability
        mine = vehicle, sighting.id
        self.weight[mine] = self.weight.get(mine, 0.0) + sighting.probability
        known = self.track.get(vehicle, sighting.id)
        if known in tracked and self.weight[vehicle, known] > self.weight[mine]:
            return  # something beside him
        self.position, self.velocity, self.covariance = sighting.position, sighting.velocity, sighting.covariance
        self.seen_at = time
        self.track[vehicle] = sighting.id

    def place(self, time: float) -> Point:
        """Return where he is at a time, if he goes on as he was seen; what is nobody stands."""
        if self.status == "rejected":
            return self.position
        ahead = min(max(time - self.seen_at, 0.0), AHEAD)
        return self.position[0] + ahead * self.velocity[0], self.position[1] + ahead * self.velocity[1]

    def mean(self, vehicle: str) -> float:
        """Return the mean probability of the pictures of a vehicle that showed him."""
        return self.total.get(vehicle, 0.0) / max(self.hits.get(vehicle, 0), 1)

    @property
    def probability(self) -> float:
        """Mean probability of all pictures that showed him."""
        return sum(self.total.values()) / max(sum(self.hits.values()), 1)


def nearest(candidates: Iterable[Candidate], place: Point, time: float, radius: float) -> Candidate | None:
    """Return the candidate that is nearest to a place at a time, within ``radius`` m."""
    found = [(math.dist(candidate.place(time), place), i, candidate) for i, candidate in enumerate(candidates)]
    near = min(found, default=None, key=lambda entry: entry[:2])
    return near[2] if near is not None and near[0] <= radius else None
