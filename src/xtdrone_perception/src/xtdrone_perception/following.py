"""Following a walking person: what a vehicle with a camera on a gimbal does to keep one track in view. No ROS.

The vehicle keeps a height and a horizontal distance, faces the person and points the gimbal at it. The person's place
is the track's, moved on by its velocity from the picture's exposure to now, so neither the detection's latency nor a
few pictures without it matter. When it has not been seen for ``predict`` seconds the vehicle stops (HOVER), then rises
slowly, with the gimbal sweeping over where the person was last; the first track that can be the same person ends that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

from xtdrone_control.checks import check_range
from xtdrone_control.frames import wrap_pi

Vector = tuple[float, float, float]

IDLE, FOLLOWING, SEARCHING, LOST = "idle", "following", "searching", "lost"
ANY = 0
"""In place of a track's id: whoever is found first."""

_PAUSE = 1.0  # s of HOVER before the search begins, in which the vehicle comes to a stop
_NEAR = 0.5  # m; nearer than this the direction to the person is not told from the vehicle's own heading
_MIDDLE = 0.85  # m above its foot, where the camera points
_LIMITS = {
    "height": (2.0, 200.0),
    "distance": (0.0, 200.0),
    "kp_xy": (0.01, 5.0),
    "kp_z": (0.01, 5.0),
    "kp_yaw": (0.01, 5.0),
    "max_speed": (0.1, 20.0),
    "max_climb": (0.1, 10.0),
    "max_yaw_rate": (0.05, 3.0),
    "predict": (0.1, 30.0),
    "search": (0.0, 600.0),
    "rise": (0.0, 100.0),
    "rise_speed": (0.05, 5.0),
    "sweep": (0.0, 3.0),
    "sweep_period": (1.0, 60.0),
    "reach_speed": (0.1, 20.0),
    "reach": (0.1, 50.0),
}


@dataclass(frozen=True)
class FollowSettings:
    """How a person is followed; ``LIMITS`` of each are checked.

    Attributes:
        height: over the person's foot, m, 2 to 200.
        distance: horizontal, m, 0 to 200.
        kp_xy, kp_z: speed by error, 1/s, 0.01 to 5.
        kp_yaw: yaw rate by error, 1/s, 0.01 to 5.
        max_speed, max_climb: m/s, 0.1 to 20 and 10.
        max_yaw_rate: rad/s, 0.05 to 3.
        predict: how long a person that is not seen is followed, s, 0.1 to 30.
        search: how long it is searched for after that, s, 0 to 600.
        rise, rise_speed: how far and how fast the vehicle rises meanwhile, m, m/s.
        sweep, sweep_period: how far to each side the gimbal turns meanwhile, rad, and in how long back and forth, s.
        reach, reach_speed: a new track is the same person if it is no farther from where that was expected than
            ``reach`` m and ``reach_speed`` m/s since it was seen.
    """

    height: float = 15.0
    distance: float = 10.0
    kp_xy: float = 0.5
    kp_z: float = 1.0
    kp_yaw: float = 1.0
    max_speed: float = 5.0
    max_climb: float = 2.0
    max_yaw_rate: float = 0.8
    predict: float = 2.0
    search: float = 60.0
    rise: float = 10.0
    rise_speed: float = 0.5
    sweep: float = 0.6
    sweep_period: float = 8.0
    reach: float = 3.0
    reach_speed: float = 2.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: one is not allowed.
        """
        for entry in fields(self):
            check_range(entry.name, getattr(self, entry.name), *_LIMITS[entry.name])


class Seen(NamedTuple):
    """A track in a picture that showed it.

    Attributes:
        id: of the track, from 1.
        time: of the exposure, s.
        position: of the foot, m, map.
        velocity: (vx, vy) m/s, map.
        probability: of the find.
    """

    id: int
    time: float
    position: Vector
    velocity: tuple[float, float]
    probability: float


class Command(NamedTuple):
    """What the vehicle is to do now.

    Attributes:
        velocity: ahead, left, up, m/s; None: none is commanded.
        yaw_rate: rad/s, to the left.
        gimbal: pitch (negative looks down) and yaw (to the right, from the heading), rad; None: as it is.
        order: for the communication node, once: ``HOVER``; empty: none.
    """

    velocity: Vector | None = None
    yaw_rate: float = 0.0
    gimbal: tuple[float, float] | None = None
    order: str = ""


class Following:
    """Follows one person.

    Attributes:
        state: IDLE (nobody is to be followed), FOLLOWING, SEARCHING (after a loss), or LOST (searched in vain).
        target: id of the track that is followed or was last; 0: none so far.
    """

    def __init__(self, settings: FollowSettings | None = None) -> None:
        """Start idle."""
        self.settings = settings or FollowSettings()
        self.state = IDLE
        self.target = 0
        self._wanted: int | None = None
        self._last: Seen | None = None
        self._lost_at = 0.0
        self._from_height = 0.0
        self._hovered = True

    def follow(self, track: int) -> None:
        """Begin to follow a track, or ANY: whoever is found first."""
        self._wanted, self._last, self.target = track, None, 0
        self.state, self._hovered = IDLE, True

    def stop(self) -> Command:
        """Follow nobody any more; return HOVER if somebody was followed."""
        was = self.state
        self.follow(ANY)
        self._wanted = None
        return Command(order="" if was == IDLE else "HOVER")

    def see(self, seen: Sequence[Seen]) -> None:
        """Take what a picture shows.

        Args:
            seen: the tracks that it shows; those that it does not must be left out.
        """
        chosen = self._choose(seen)
        if chosen is None or (self._last is not None and chosen.time < self._last.time):
            return
        self._last, self.target = chosen, chosen.id
        self.state = FOLLOWING

    def _choose(self, seen: Sequence[Seen]) -> Seen | None:
        """Return the person among the tracks, None if it is none of them."""
        if self._wanted is None:
            return None
        for entry in seen:
            if entry.id == (self.target or self._wanted):
                return entry
        if self._last is None:
            return max(seen, key=lambda entry: entry.probability, default=None) if self._wanted == ANY else None
        # The track may have ended and begun anew under another id. One that is still seen has its own.
        near = [(self._off(entry), entry) for entry in seen if entry.time > self._last.time]
        near = [(off, entry) for off, entry in near if off <= 1.0]
        return min(near, default=(0.0, None))[1]

    def _off(self, entry: Seen) -> float:
        """Return how far a track is from where the person is expected, in parts of what is allowed."""
        assert self._last is not None
        passed = entry.time - self._last.time
        x, y, _ = self.expected(entry.time)
        far = math.hypot(entry.position[0] - x, entry.position[1] - y)
        return far / (self.settings.reach + self.settings.reach_speed * passed)

    def expected(self, now: float) -> Vector:
        """Return where the person is at a time, m, map; it walks on for ``predict`` s after it was seen.

        Raises:
            ValueError: none has been seen.
        """
        if self._last is None:
            raise ValueError("nobody has been seen yet")
        ahead = min(max(now - self._last.time, 0.0), self.settings.predict)
        (x, y, z), (vx, vy) = self._last.position, self._last.velocity
        return x + vx * ahead, y + vy * ahead, z

    def update(self, now: float, position: Vector, yaw: float) -> Command:
        """Return what to do now.

        Args:
            now: time, s.
            position: the vehicle's, m, map.
            yaw: its heading, rad, ENU.
        """
        if self._wanted is None or self._last is None:
            return Command()
        if self.state == FOLLOWING and now - self._last.time > self.settings.predict:
            self.state, self._lost_at, self._from_height = SEARCHING, now, position[2]
            return Command(gimbal=self._aim(now, position, yaw), order="HOVER")
        if self.state == FOLLOWING:
            return self._pursue(now, position, yaw)
        if self.state == SEARCHING:
            return self._look_around(now, position, yaw)
        return Command()

    def _pursue(self, now: float, position: Vector, yaw: float) -> Command:
        assert self._last is not None
        settings, (vx, vy) = self.settings, self._last.velocity
        x, y, z = self.expected(now)
        ahead, left = _turned(x - position[0], y - position[1], -yaw)
        away = math.hypot(ahead, left)
        unit = (ahead / away, left / away) if away > _NEAR else (1.0, 0.0)
        own_ahead, own_left = _turned(vx, vy, -yaw)
        # The correction is bounded before the person's own velocity comes on top, so that far away the way is straight.
        pull = _clipped(settings.kp_xy * (away - settings.distance), settings.max_speed)
        velocity = _shortened((own_ahead + pull * unit[0], own_left + pull * unit[1]), settings.max_speed)
        climb = _clipped(settings.kp_z * (z + settings.height - position[2]), settings.max_climb)
        turn = 0.0
        if away > _NEAR:
            across = (unit[0] * (own_left - velocity[1]) - unit[1] * (own_ahead - velocity[0])) / away
            turn = _clipped(settings.kp_yaw * math.atan2(left, ahead) + across, settings.max_yaw_rate)
        return Command((*velocity, climb), turn, self._aim(now, position, yaw))

    def _aim(self, now: float, position: Vector, yaw: float) -> tuple[float, float]:
        """Return pitch and yaw of the gimbal towards the person; the vehicle faces it, so the yaw stays 0."""
        x, y, z = self.expected(now)
        away = math.hypot(x - position[0], y - position[1])
        return -math.atan2(position[2] - z - _MIDDLE, away), 0.0

    def _look_around(self, now: float, position: Vector, yaw: float) -> Command:
        settings, passed = self.settings, now - self._lost_at
        pitch, _ = self._aim(now, position, yaw)
        if passed > settings.search:
            self.state = LOST
            return Command(gimbal=(pitch, 0.0), order="HOVER")
        x, y, _ = self.expected(now)
        beside = wrap_pi(yaw - math.atan2(y - position[1], x - position[0]))
        sweep = settings.sweep * math.sin(2.0 * math.pi * max(passed - _PAUSE, 0.0) / settings.sweep_period)
        gimbal = (pitch, wrap_pi(beside + sweep))
        if passed < _PAUSE:
            return Command(gimbal=gimbal)
        rising = position[2] - self._from_height < settings.rise
        return Command((0.0, 0.0, settings.rise_speed if rising else 0.0), 0.0, gimbal)


def _turned(x: float, y: float, angle: float) -> tuple[float, float]:
    """Return a vector turned to the left, rad."""
    c, s = math.cos(angle), math.sin(angle)
    return c * x - s * y, s * x + c * y


def _clipped(value: float, most: float) -> float:
    return min(max(value, -most), most)


def _shortened(vector: tuple[float, float], most: float) -> tuple[float, float]:
    length = math.hypot(*vector)
    return vector if length <= most else (vector[0] * most / length, vector[1] * most / length)


def heading_of(q: tuple[float, float, float, float]) -> float:
    """Return the yaw of an attitude (x, y, z, w), rad."""
    x, y, z, w = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
