"""Multi-object tracker on the ground plane.

Each track is a constant-velocity Kalman filter in the plane. The detections of an image are assigned to the tracks at
minimum cost within a gate (Hungarian method), confirmed tracks first. Time steps may vary. No ROS.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from xtdrone_common.settings import SettingError, Settings, setting

from .geolocation import GroundPoint

Array = NDArray[np.float64]
InView = Callable[[Array], bool]

_FORBIDDEN = 1e9  # cost outside the gate
_PLACE = np.eye(2, 4)  # measurement matrix of the state x, y, vx, vy


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
        13.8, low=1.0, high=100.0,
        text="maximum squared Mahalanobis distance between a track and its detection; 13.8 keeps 99.9 %",
    )  # fmt: skip
    birth: float = setting(0.5, low=0.0, high=1.0, text="minimum probability of a detection that starts a track")
    confirm_hits: int = setting(3, low=1, high=50, text="detections in ``confirm_of`` images that confirm a track")
    confirm_of: int = setting(5, low=1, high=50, text="images in which ``confirm_hits`` are counted")
    misses: int = setting(8, low=1, high=1000, text="consecutive expected detections missed that end a track")
    widest: float = setting(
        15.0, low=0.1, high=1000.0, unit="m", text="position uncertainty that ends a track, standard deviation"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.confirm_hits > self.confirm_of:
            raise SettingError("confirm_hits", self.confirm_hits, f"at most confirm_of, {self.confirm_of}")


@dataclass(frozen=True)
class GroundDetection:
    """A detection located on the ground.

    Attributes:
        point: position on the ground.
        object_class: name of its class.
        probability: above 0, at most 1.
        box: Box in the image: xmin, ymin, xmax, ymax, px.
    """

    point: GroundPoint
    object_class: str
    probability: float
    box: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass
class Track:
    """Track of an object.

    Attributes:
        id: Number from 1; 0 until confirmed.
        object_class: name of its class.
        state: (4,) x, y, m, map; vx, vy, m/s.
        covariance: (4, 4) of the state, without the error shared by all images.
        last: its last detection.
        hits: number of images that showed it.
        missed: number of images since the last hit that should have shown it.
        probability: Probability in the last image, 0 if not shown.
        seen_at: time of the last image that showed it, s.
    """

    object_class: str
    state: Array
    covariance: Array
    last: GroundDetection
    seen_at: float
    id: int = 0
    hits: int = 1
    missed: int = 0
    probability: float = 0.0
    history: deque[bool] = field(default_factory=deque)

    @property
    def confirmed(self) -> bool:
        """Whether enough images have shown the object."""
        return self.id > 0

    @property
    def position(self) -> Array:
        """Position on the ground, (3,) m, map."""
        return np.array([self.state[0], self.state[1], self.last.point.position[2]])

    @property
    def velocity(self) -> Array:
        """Velocity, (2,) m/s, map."""
        return self.state[2:]

    @property
    def position_covariance(self) -> Array:
        """Covariance of the position, including the error shared by all images, (3, 3) m^2."""
        whole = self.last.point.covariance.copy()
        whole[:2, :2] = self.covariance[:2, :2] + self.last.point.shared[:2, :2]
        return whole


class Tracker:
    """Tracker of one camera.

    Attributes:
        tracks: all tracks, confirmed or not, oldest first.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        """Start with no tracks."""
        self.settings = settings or TrackerSettings()
        self.tracks: list[Track] = []
        self._time: float | None = None
        self._next_id = 1

    @property
    def confirmed(self) -> list[Track]:
        """The confirmed tracks."""
        return [track for track in self.tracks if track.confirmed]

    def reset(self) -> None:
        """Remove all tracks and the time; ids continue, so that none is used twice."""
        self.tracks = []
        self._time = None

    def update(self, time: float, detections: Sequence[GroundDetection], in_view: InView | None = None) -> list[Track]:
        """Update the tracks with an image and return the confirmed ones.

        Args:
            time: Time of the exposure, s; not before that of the last image.
            detections: Detections of the image, may be empty.
            in_view: returns whether the image should show an object at a position (2,), m; None: always.

        Raises:
            ValueError: the time is not finite or before that of the last image.
        """
        if not math.isfinite(time) or (self._time is not None and time < self._time):
            raise ValueError(f"time: {time!r} is not allowed, {self._time!r} s or later")
        step = 0.0 if self._time is None else time - self._time
        self._time = time
        for track in self.tracks:
            self._predict(track, step)
        left = list(range(len(detections)))
        for confirmed in (True, False):
            group = [track for track in self.tracks if track.confirmed == confirmed]
            left = self._assign(group, detections, left, time, in_view)
        self.tracks = [track for track in self.tracks if self._survives(track)]
        for i in left:
            if detections[i].probability >= self.settings.birth:
                self.tracks.append(self._new_track(detections[i], time))
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
        self,
        tracks: list[Track],
        detections: Sequence[GroundDetection],
        left: list[int],
        time: float,
        in_view: InView | None,
    ) -> list[int]:
        """Assign detections to tracks and return the indices of those left over."""
        costs = np.array([[self._cost(track, detections[i]) for i in left] for track in tracks]).reshape(
            len(tracks), len(left)
        )
        pairs = [(t, f) for t, f in zip(*linear_sum_assignment(costs), strict=True) if costs[t, f] < _FORBIDDEN]
        given = dict(pairs)
        for t, track in enumerate(tracks):
            if t in given:
                self._correct(track, detections[left[given[t]]], time)
            else:
                track.probability = 0.0
                if in_view is None or in_view(track.state[:2]):
                    track.missed += 1
                    track.history.append(False)
        taken = set(given.values())
        return [i for f, i in enumerate(left) if f not in taken]

    def _cost(self, track: Track, detection: GroundDetection) -> float:
        """Return minus twice the log-likelihood that a detection belongs to the track, up to a constant."""
        if detection.object_class != track.object_class:
            return _FORBIDDEN
        # The shared error may have changed slightly since the track began.
        spread = track.covariance[:2, :2] + detection.point.covariance[:2, :2]
        error = detection.point.position[:2] - track.state[:2]
        distance = float(error @ np.linalg.solve(spread, error))
        if not distance <= self.settings.gate:
            return _FORBIDDEN
        return distance + math.log(np.linalg.det(spread)) - 2.0 * math.log(max(detection.probability, 1e-6))

    def _correct(self, track: Track, detection: GroundDetection, time: float) -> None:
        noise = detection.point.independent[:2, :2]
        gain = track.covariance @ _PLACE.T @ np.linalg.inv(track.covariance[:2, :2] + noise)
        track.state = track.state + gain @ (detection.point.position[:2] - track.state[:2])
        rest = np.eye(4) - gain @ _PLACE
        track.covariance = rest @ track.covariance @ rest.T + gain @ noise @ gain.T
        track.last, track.seen_at, track.probability = detection, time, detection.probability
        track.hits += 1
        track.missed = 0
        track.history.append(True)

    def _survives(self, track: Track) -> bool:
        settings = self.settings
        if track.missed >= settings.misses or np.linalg.eigvalsh(track.covariance[:2, :2])[-1] > settings.widest**2:
            return False
        return track.confirmed or track.history.count(False) <= settings.confirm_of - settings.confirm_hits

    def _new_track(self, detection: GroundDetection, time: float) -> Track:
        covariance = np.diag([0.0, 0.0, self.settings.speed**2, self.settings.speed**2])
        covariance[:2, :2] = detection.point.independent[:2, :2]
        state = np.array([*detection.point.position[:2], 0.0, 0.0])
        return Track(
            detection.object_class,
            state,
            covariance,
            detection,
            time,
            probability=detection.probability,
            history=deque([True], maxlen=self.settings.confirm_of),
        )
