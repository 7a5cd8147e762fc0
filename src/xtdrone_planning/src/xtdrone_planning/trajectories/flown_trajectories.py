"""Which vehicles fly the trajectories that they have published, and which of these keep clear of each other. No ROS.

Two vehicles on trajectories that stay apart need no barrier between them, although they may pass at speeds from which
they could not stop. A vehicle counts as flying its trajectory while it is close to the trajectory's position at about
the present time. Its deviation in space is added to the distance that must be kept; its deviation in time shifts the
trajectory. So two vehicles stay apart as long as neither deviation grows; if one does, the barrier applies again.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.trajectories.moving_vehicles import MovingVehicles
from xtdrone_planning.trajectories.separation import places_at
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline

Array = NDArray[np.float64]

_STEP = 0.02  # s
_SHIFTS = _STEP * np.array(sorted(range(-20, 21), key=abs))  # s: as early or late as a vehicle may be, 0 first
_AHEAD = np.arange(-0.1, 1.0, _STEP)  # s: setpoints lead the trajectory by the lag of the vehicle
_SAME = 0.1  # m between a setpoint and the trajectory that it belongs to


class Flown(NamedTuple):
    """A trajectory as a vehicle flies it.

    Attributes:
        spline: as published, but as early or late as the vehicle is.
        before: the one that a late vehicle still flies until the start of ``spline``, likewise; None: it waits there.
        off: distance of the vehicle from its trajectory, m.
        radius: Radius of the vehicle, m.
    """

    spline: UniformSpline
    before: UniformSpline | None
    off: float
    radius: float

    def at(self, time: float) -> UniformSpline:
        """Return which of both the vehicle flies at a ROS time, s."""
        return self.before if self.before is not None and time < self.spline.start else self.spline


class _Published:
    """What one vehicle has published: the trajectory before the present one, the present one, and those to come."""

    def __init__(self) -> None:
        self.radius = 0.0
        self.latest: tuple[int, float] | None = None  # number and start, s; numbers begin again after a restart
        self.before: UniformSpline | None = None
        self.present: UniformSpline | None = None
        self.coming: list[UniformSpline] = []

    def add(self, number: int, spline: UniformSpline, radius: float) -> None:
        """Add a trajectory, which replaces those from its start on; a repetition changes nothing."""
        if (number, spline.start) == self.latest:
            return
        self.latest, self.radius = (number, spline.start), radius
        self.coming = [entry for entry in self.coming if entry.start < spline.start]
        self.coming.append(spline)

    def advance(self, now: float) -> None:
        """Begin the trajectories whose time has come."""
        while self.coming and self.coming[0].start <= now:
            self.before, self.present = self.present, self.coming.pop(0)

    def places(self, times: Array) -> Array:
        """Return where the vehicle should be, (n, 3), m, at times (n,), s."""
        assert self.present is not None
        places = _places(self.present, times)
        if self.before is not None:
            earlier = times < self.present.start
            places[earlier] = _places(self.before, times[earlier])
        return places


class FlownTrajectories:
    """The trajectories of N vehicles."""

    def __init__(self, count: int, distance: float, tracking: float) -> None:
        """Begin without trajectories.

        Args:
            count: Number of vehicles.
            distance: that two must keep, m.
            tracking: distance of a vehicle from its trajectory up to which it flies it, m.
        """
        self._distance, self._tracking = distance, tracking
        self._published = [_Published() for _ in range(count)]
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        self._published = [_Published() for _ in self._published]
        self._flown: list[Flown | None] = [None] * len(self._published)
        self._agreed: dict[tuple[int, int], bool] = {}
        self._now = -math.inf

    def on_trajectory(self, index: int, number: int, spline: UniformSpline, radius: float) -> None:
        """Store a trajectory that a vehicle has published.

        Args:
            index: Index of the vehicle.
            number: Number of the trajectory; the same one with the same start again is a repetition.
            spline: the trajectory.
            radius: Radius of the vehicle, m.
        """
        self._published[index].add(number, spline, radius)

    def update(self, positions: Array, now: float) -> None:
        """Determine which vehicles fly their trajectories.

        Args:
            positions: Positions of all vehicles, shape (N, 3), m; NaN: unknown.
            now: s of ROS time.
        """
        self._now = now
        self._agreed.clear()
        for index, published in enumerate(self._published):
            published.advance(now)
            self._flown[index] = self._as_flown(published, positions[index])

    def flown(self, index: int) -> Flown | None:
        """Return the trajectory that a vehicle flies, None if it flies none."""
        return self._flown[index]

    def commands(self, index: int, setpoint: Sequence[float] | None) -> bool:
        """Return whether a vehicle flies its trajectory and a position setpoint, (3,) m in map, belongs to it.

        Without a position setpoint (None), as with velocities, it does not.
        """
        if setpoint is None or self._flown[index] is None:
            return False
        published, times = self._published[index], self._now + _AHEAD
        places = [published.places(times), *(_places(spline, times) for spline in published.coming)]
        away = np.concatenate(places) - np.asarray(setpoint)
        return bool((away * away).sum(axis=1).min() < _SAME * _SAME)

    def agreed(self, index: int, other: int) -> bool:
        """Return whether two vehicles fly trajectories that stay apart."""
        pair = min(index, other), max(index, other)
        if pair not in self._agreed:
            self._agreed[pair] = self._stay_apart(*pair)
        return self._agreed[pair]

    def _as_flown(self, published: _Published, position: Array) -> Flown | None:
        if published.present is None or not np.isfinite(position).all():
            return None
        away = published.places(self._now + _SHIFTS) - position
        squares = (away * away).sum(axis=1)
        best = int(np.argmin(squares))
        off = math.sqrt(float(squares[best]))
        if off > self._tracking:
            return None
        shift, before = float(_SHIFTS[best]), published.before
        return Flown(
            _earlier(published.present, shift),
            None if before is None else _earlier(before, shift),
            off,
            published.radius,
        )

    def _stay_apart(self, one: int, other: int) -> bool:
        first, second = self._flown[one], self._flown[other]
        if first is None or second is None:
            return False
        distance = self._distance + first.off + second.off
        begins = sorted({self._now, *(max(self._now, flown.spline.start) for flown in (first, second))})
        for begin, end in itertools.pairwise([*begins, math.inf]):  # between them, both stay on one trajectory
            vehicle = MovingVehicles([second.at(begin)], [distance])
            if math.isfinite(vehicle.conflict_time(first.at(begin), begin, end)):
                return False
        return True


def _earlier(spline: UniformSpline, shift: float) -> UniformSpline:
    """Return a trajectory ``shift`` s earlier."""
    return UniformSpline(spline.start - shift, spline.interval, spline.points)


def _places(spline: UniformSpline, times: Array) -> Array:
    places = np.empty((len(times), 3))
    places_at(spline.points, spline.interval, spline.start, times, places)
    return places
