"""Following a walking person with a camera on a gimbal. No ROS.

The vehicle keeps a height and a horizontal distance, faces the person and points the gimbal at the person. The track is
extrapolated from the exposure to the current time with its velocity, so detection latency and a few missed images do
not matter. When the person has not been seen for ``predict`` seconds, the vehicle stops (HOVER), then climbs slowly
with the gimbal sweeping around the last known position, until a track appears that can be the same person.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from xtdrone_common.rotation import wrap_pi_by_remainder
from xtdrone_common.settings import Settings, setting

Vector = tuple[float, float, float]

IDLE, FOLLOWING, SEARCHING, LOST = "idle", "following", "searching", "lost"
ANY = 0
"""Track id that stands for the first person found."""

_PAUSE = 1.0  # s of HOVER for the vehicle to stop before the search
_NEAR = 0.5  # m; closer than this the direction to the person is undefined
_MIDDLE = 0.85  # m above the foot, where the camera points


@dataclass(frozen=True)
class FollowSettings(Settings):
    """Distances, gains and limits for following a person, and the search after a loss."""

    height: float = setting(15.0, low=2.0, high=200.0, unit="m", text="height above the person's feet")
    distance: float = setting(10.0, low=0.0, high=200.0, unit="m", text="horizontal distance to the person")
    kp_xy: float = setting(0.5, low=0.01, high=5.0, unit="1/s", text="horizontal speed per position error")
    kp_z: float = setting(1.0, low=0.01, high=5.0, unit="1/s", text="vertical speed per height error")
    kp_yaw: float = setting(1.0, low=0.01, high=5.0, unit="1/s", text="yaw rate per heading error")
    max_speed: float = setting(5.0, low=0.1, high=20.0, unit="m/s", text="highest horizontal speed")
    max_climb: float = setting(2.0, low=0.1, high=10.0, unit="m/s", text="highest vertical speed")
    max_yaw_rate: float = setting(0.8, low=0.05, high=3.0, unit="rad/s", text="highest yaw rate")
    predict: float = setting(
        2.0, low=0.1, high=30.0, unit="s", text="time for which an unseen person is still followed"
    )
    search: float = setting(60.0, low=0.0, high=600.0, unit="s", text="duration of the search after that")
    rise: float = setting(10.0, low=0.0, high=100.0, unit="m", text="climb during the search")
    rise_speed: float = setting(0.5, low=0.05, high=5.0, unit="m/s", text="climb rate during the search")
    sweep: float = setting(0.6, low=0.0, high=3.0, unit="rad", text="gimbal yaw to each side during the search")
    sweep_period: float = setting(8.0, low=1.0, high=60.0, unit="s", text="period of the gimbal sweep")
    reach: float = setting(
        3.0, low=0.1, high=50.0, unit="m",
        text="a new track within this distance of the predicted position is the same person",
    )  # fmt: skip
    reach_speed: float = setting(
        2.0, low=0.1, high=20.0, unit="m/s", text="growth of ``reach`` with the time since the last sighting"
    )


class SeenTrack(NamedTuple):
    """A track shown by an image.

    Attributes:
        id: Id of the track, from 1.
        time: Time of the exposure, s.
        position: Position of the foot, m, map.
        velocity: (vx, vy) m/s, map.
        probability: Probability of the detection.
    """

    id: int
    time: float
    position: Vector
    velocity: tuple[float, float]
    probability: float


class FollowCommand(NamedTuple):
    """FollowCommand of the vehicle and its gimbal.

    Attributes:
        velocity: forward, left, up, m/s; None: no velocity command.
        yaw_rate: rad/s, positive to the left.
        gimbal: pitch (negative down) and yaw (positive right of the heading), rad; None: unchanged.
        order: one-off command for the communication node: ``HOVER``; empty: none.
    """

    velocity: Vector | None = None
    yaw_rate: float = 0.0
    gimbal: tuple[float, float] | None = None
    order: str = ""


class Following:
    """Controller that follows one person.

    Attributes:
        state: IDLE (no person to follow), FOLLOWING, SEARCHING (after a loss), or LOST (search failed).
        target: id of the current or last followed track; 0: none so far.
    """

    def __init__(self, settings: FollowSettings | None = None) -> None:
        """Start idle."""
        self.settings = settings or FollowSettings()
        self.state = IDLE
        self.target = 0
        self._wanted: int | None = None
        self._last: SeenTrack | None = None
        self._lost_at = 0.0
        self._from_height = 0.0

    def follow(self, track: int) -> None:
        """Start following a track, or ANY: the first person found."""
        self._wanted, self._last, self.target = track, None, 0
        self.state = IDLE

    def stop(self) -> FollowCommand:
        """Stop following; return HOVER if a person was followed."""
        was = self.state
        self.follow(ANY)
        self._wanted = None
        return FollowCommand(order="" if was == IDLE else "HOVER")

    def see(self, seen: Sequence[SeenTrack]) -> None:
        """Process the tracks of an image.

        Args:
            seen: tracks shown by this image only.
        """
        chosen = self._choose(seen)
        if chosen is None or (self._last is not None and chosen.time < self._last.time):
            return
        self._last, self.target = chosen, chosen.id
        self.state = FOLLOWING

    def _choose(self, seen: Sequence[SeenTrack]) -> SeenTrack | None:
        """Return the track of the person, None if there is none."""
        if self._wanted is None:
            return None
        for entry in seen:
            if entry.id == (self.target or self._wanted):
                return entry
        if self._last is None:
            return max(seen, key=lambda entry: entry.probability, default=None) if self._wanted == ANY else None
        # The track may have ended and restarted under another id.
        near = [(self._relative_distance(entry), entry) for entry in seen if entry.time > self._last.time]
        near = [(off, entry) for off, entry in near if off <= 1.0]
        return min(near, default=(0.0, None))[1]

    def _relative_distance(self, entry: SeenTrack) -> float:
        """Return the distance of a track from the expected position, as a fraction of the allowed one."""
        assert self._last is not None
        passed = entry.time - self._last.time
        x, y, _ = self.expected(entry.time)
        far = math.hypot(entry.position[0] - x, entry.position[1] - y)
        return far / (self.settings.reach + self.settings.reach_speed * passed)

    def expected(self, now: float) -> Vector:
        """Return the extrapolated position of the person at a time, m, map; at most ``predict`` s ahead.

        Raises:
            ValueError: no person has been seen yet.
        """
        if self._last is None:
            raise ValueError("no person has been seen yet")
        ahead = min(max(now - self._last.time, 0.0), self.settings.predict)
        (x, y, z), (vx, vy) = self._last.position, self._last.velocity
        return x + vx * ahead, y + vy * ahead, z

    def update(self, now: float, position: Vector, yaw: float) -> FollowCommand:
        """Return the command for now.

        Args:
            now: time, s.
            position: Position of the vehicle, m, map.
            yaw: heading of the vehicle, rad, ENU.
        """
        if self._wanted is None or self._last is None:
            return FollowCommand()
        if self.state == FOLLOWING and now - self._last.time > self.settings.predict:
            self.state, self._lost_at, self._from_height = SEARCHING, now, position[2]
            return FollowCommand(gimbal=self._aim(now, position, yaw), order="HOVER")
        if self.state == FOLLOWING:
            return self._pursue(now, position, yaw)
        if self.state == SEARCHING:
            return self._search(now, position, yaw)
        return FollowCommand()

    def _pursue(self, now: float, position: Vector, yaw: float) -> FollowCommand:
        assert self._last is not None
        settings, (vx, vy) = self.settings, self._last.velocity
        x, y, z = self.expected(now)
        ahead, left = _rotate(x - position[0], y - position[1], -yaw)
        away = math.hypot(ahead, left)
        unit = (ahead / away, left / away) if away > _NEAR else (1.0, 0.0)
        own_ahead, own_left = _rotate(vx, vy, -yaw)
        # Limit the correction before adding the person's velocity, so that the path is straight when far away.
        pull = _clip(settings.kp_xy * (away - settings.distance), settings.max_speed)
        velocity = _limit((own_ahead + pull * unit[0], own_left + pull * unit[1]), settings.max_speed)
        climb = _clip(settings.kp_z * (z + settings.height - position[2]), settings.max_climb)
        turn = 0.0
        if away > _NEAR:
            across = (unit[0] * (own_left - velocity[1]) - unit[1] * (own_ahead - velocity[0])) / away
            turn = _clip(settings.kp_yaw * math.atan2(left, ahead) + across, settings.max_yaw_rate)
        return FollowCommand((*velocity, climb), turn, self._aim(now, position, yaw))

    def _aim(self, now: float, position: Vector, yaw: float) -> tuple[float, float]:
        """Return gimbal pitch and yaw towards the person; the yaw stays 0 because the vehicle faces the person."""
        x, y, z = self.expected(now)
        away = math.hypot(x - position[0], y - position[1])
        return -math.atan2(position[2] - z - _MIDDLE, away), 0.0

    def _search(self, now: float, position: Vector, yaw: float) -> FollowCommand:
        settings, passed = self.settings, now - self._lost_at
        pitch, _ = self._aim(now, position, yaw)
        if passed > settings.search:
            self.state = LOST
            return FollowCommand(gimbal=(pitch, 0.0), order="HOVER")
        x, y, _ = self.expected(now)
        beside = wrap_pi_by_remainder(yaw - math.atan2(y - position[1], x - position[0]))
        sweep = settings.sweep * math.sin(2.0 * math.pi * max(passed - _PAUSE, 0.0) / settings.sweep_period)
        gimbal = (pitch, wrap_pi_by_remainder(beside + sweep))
        if passed < _PAUSE:
            return FollowCommand(gimbal=gimbal)
        rising = position[2] - self._from_height < settings.rise
        return FollowCommand((0.0, 0.0, settings.rise_speed if rising else 0.0), 0.0, gimbal)


def _rotate(x: float, y: float, angle: float) -> tuple[float, float]:
    """Return a vector rotated to the left by ``angle`` rad."""
    c, s = math.cos(angle), math.sin(angle)
    return c * x - s * y, s * x + c * y


def _clip(value: float, most: float) -> float:
    return min(max(value, -most), most)


def _limit(vector: tuple[float, float], most: float) -> tuple[float, float]:
    length = math.hypot(*vector)
    return vector if length <= most else (vector[0] * most / length, vector[1] * most / length)
