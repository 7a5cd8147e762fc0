"""Tracks of things on the ground from what each picture shows of them: who is who, where, and how fast.

Every track is a Kalman filter with constant velocity in the plane; a picture's finds go to the tracks by the cheapest
assignment within a gate (Hungarian method), those confirmed first. Numbers in, numbers out; time steps may vary.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from xtdrone_control.settings import SettingError, Settings, setting

from .geolocation import GroundPoint

Array = NDArray[np.float64]
InView = Callable[[Array], bool]

_FORBIDDEN = 1e9  # cost of what is outside of the gate
_PLACE = np.eye(2, 4)  # of the state x, y, vx, vy


@dataclass(frozen=True)
class TrackerSettings(Settings):
    """Beginning, association and end of tracks."""

    acceleration: float = setting(
        0.7, low=0.01, high=100.0, unit="m/s^2/sqrt(Hz)", text="spectral density of a target's acceleration"
    )
    speed: float = setting(
        1.5, low=0.01, high=100.0, unit="m/s", text="standard deviation of a new track's velocity on each axis"
    )
    gate: float = setting(
        13.8,
        low=1.0,
        high=100.0,
        text="highest squared Mahalanobis distance between a track and its detection; 13.8 keeps 99.9 %",
    )
    birth: float = setting(0.5, low=0.0, high=1.0, text="lowest probability of a detection that begins a track")
    confirm_hits: int = setting(3, low=1, high=50, text="detections in ``confirm_of`` pictures that confirm a track")
    confirm_of: int = setting(5, low=1, high=50, text="pictures in which ``confirm_hits`` are counted")
    misses: int = setting(8, low=1, high=1000, text="consecutive expected detections missed that end a track")
    widest: float = setting(
        15.0, low=0.1, high=1000.0, unit="m", text="position uncertainty that ends a track, standard deviation"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.confirm_hits > self.confirm_of:
            raise SettingError("confirm_hits", self.confirm_hits, f"at most confirm_of, {self.confirm_of}")


@dataclass(frozen=True)
class Find:
    """What a picture shows of a thing.

    Attributes:
        point: where it stands.
        object_class: its class's name.
        probability: above 0, at most 1.
        box: in the picture: xmin, ymin, xmax, ymax, px.
    """

    point: GroundPoint
    object_class: str
    probability: float
    box: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass
class Track:
    """A thing that is followed.

    Attributes:
        id: from 1; 0 until it is confirmed.
        object_class: its class's name.
        state: (4,) x, y, m, map; vx, vy, m/s.
        covariance: (4, 4) of the state, without what all pictures have in common.
        last: the find that it had last.
        hits: pictures that showed it.
        missed: pictures since that should have and did not.
        probability: in the last picture, 0 when it was not shown.
        seen_at: time of the last picture that showed it, s.
    """

    object_class: str
    state: Array
    covariance: Array
    last: Find
    seen_at: float
    id: int = 0
    hits: int = 1
    missed: int = 0
    probability: float = 0.0
    history: deque[bool] = field(default_factory=deque)

    @property
    def confirmed(self) -> bool:
        """Whether enough pictures have shown it."""
        return self.id > 0

    @property
    def position(self) -> Array:
        """Where it stands, (3,) m, map."""
        return np.array([self.state[0], self.state[1], self.last.point.position[2]])

    @property
    def velocity(self) -> Array:
        """How fast it moves, (2,) m/s, map."""
        return self.state[2:]

    @property
    def position_covariance(self) -> Array:
        """Covariance of the position with what all pictures have in common, (3, 3) m^2."""
        whole = self.last.point.covariance.copy()
        whole[:2, :2] = self.covariance[:2, :2] + self.last.point.shared[:2, :2]
        return whole


class Tracker:
    """Tracks of one camera.

    Attributes:
        tracks: all that there are, those not confirmed too, in the order of their beginnings.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        """Start with no tracks."""
        self.settings = settings or TrackerSettings()
        self.tracks: list[Track] = []
        self._time: float | None = None
        self._next_id = 1

    @property
    def confirmed(self) -> list[Track]:
        """The tracks that enough pictures have shown."""
        return [track for track in self.tracks if track.confirmed]

    def reset(self) -> None:
        """Forget all tracks and times; ids go on, so that none means two things."""
        self.tracks = []
        self._time = None

    def update(self, time: float, finds: Sequence[Find], in_view: InView | None = None) -> list[Track]:
        """Take what a picture shows and return the confirmed tracks.

        Args:
            time: of its exposure, s; not before the last one's.
            finds: all that it shows; may be none.
            in_view: whether the picture should show a thing at a place (2,), m; None: everywhere.

        Raises:
            ValueError: the time is not finite or before the last one.
        """
        if not math.isfinite(time) or (self._time is not None and time < self._time):
            raise ValueError(f"time: {time!r} is not allowed, {self._time!r} s or later")
        step = 0.0 if self._time is None else time - self._time
        self._time = time
        for track in self.tracks:
            self._predict(track, step)
        left = list(range(len(finds)))
        for confirmed in (True, False):
            group = [track for track in self.tracks if track.confirmed == confirmed]
            left = self._assign(group, finds, left, time, in_view)
        self.tracks = [track for track in self.tracks if self._goes_on(track)]
        for i in left:
            if finds[i].probability >= self.settings.birth:
                self.tracks.append(self._begun(finds[i], time))
        for track in self.tracks:
            if not track.confirmed and sum(track.history) >= self.settings.confirm_hits:
                track.id = self._next_id
                self._next_id += 1
        return self.confirmed

    def _predict(self, track: Track, step: float) -> None:
        move = np.eye(4)
        move[0, 2] = move[1, 3] = step
        q = self.settings.acceleration**2
        noise = np.kron(q * np.array([[step**3 / 3.0, step**2 / 2.0], [step**2 / 2.0, step]]), np.eye(2))
        track.state = move @ track.state
        track.covariance = move @ track.covariance @ move.T + noise

    def _assign(
        self, tracks: list[Track], finds: Sequence[Find], left: list[int], time: float, in_view: InView | None
    ) -> list[int]:
        """Give finds to tracks and return the indices of those that are left."""
        costs = np.array([[self._cost(track, finds[i]) for i in left] for track in tracks]).reshape(
            len(tracks), len(left)
        )
        pairs = [(t, f) for t, f in zip(*linear_sum_assignment(costs), strict=True) if costs[t, f] < _FORBIDDEN]
        given = dict(pairs)
        for t, track in enumerate(tracks):
            if t in given:
                self._correct(track, finds[left[given[t]]], time)
            else:
                track.probability = 0.0
                if in_view is None or in_view(track.state[:2]):
                    track.missed += 1
                    track.history.append(False)
        taken = set(given.values())
        return [i for f, i in enumerate(left) if f not in taken]

    def _cost(self, track: Track, find: Find) -> float:
        """Return minus twice the logarithm of how likely a find is the track's, but for a constant."""
        if find.object_class != track.object_class:
            return _FORBIDDEN
        # What all pictures have in common may have changed a little since the track began.
        spread = track.covariance[:2, :2] + find.point.covariance[:2, :2]
        error = find.point.position[:2] - track.state[:2]
        distance = float(error @ np.linalg.solve(spread, error))
        if not distance <= self.settings.gate:
            return _FORBIDDEN
        return distance + math.log(np.linalg.det(spread)) - 2.0 * math.log(max(find.probability, 1e-6))

    def _correct(self, track: Track, find: Find, time: float) -> None:
        noise = find.point.fresh[:2, :2]
        gain = track.covariance @ _PLACE.T @ np.linalg.inv(track.covariance[:2, :2] + noise)
        track.state = track.state + gain @ (find.point.position[:2] - track.state[:2])
        rest = np.eye(4) - gain @ _PLACE
        track.covariance = rest @ track.covariance @ rest.T + gain @ noise @ gain.T
        track.last, track.seen_at, track.probability = find, time, find.probability
        track.hits += 1
        track.missed = 0
        track.history.append(True)

    def _goes_on(self, track: Track) -> bool:
        settings = self.settings
        if track.missed >= settings.misses or np.linalg.eigvalsh(track.covariance[:2, :2])[-1] > settings.widest**2:
            return False
        return track.confirmed or track.history.count(False) <= settings.confirm_of - settings.confirm_hits

    def _begun(self, find: Find, time: float) -> Track:
        covariance = np.diag([0.0, 0.0, self.settings.speed**2, self.settings.speed**2])
        covariance[:2, :2] = find.point.fresh[:2, :2]
        state = np.array([*find.point.position[:2], 0.0, 0.0])
        return Track(
            find.object_class,
            state,
            covariance,
            find,
            time,
            probability=find.probability,
            history=deque([True], maxlen=self.settings.confirm_of),
        )
