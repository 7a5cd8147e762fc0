"""Odometry by a 2D laser: levelled scans are matched to a map built from them; the height comes from a range finder.

Roll and pitch come from the autopilot. They project a scan's points onto the horizontal plane; points that may belong
to the ground are dropped. At a step of the ground (a table), a jump of the range relative to the predicted height
changes the ground height, not the vehicle's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import pose_of, turned_about_z, yaw_of
from xtdrone_common.settings import Settings, setting
from xtdrone_perception.slam.deskewing import ScanMotion, deskew
from xtdrone_perception.slam.odometry_health import Estimate, weakest_share

from .scan_matching import LineMap, Match, normals_of

Array = NDArray[np.float64]

_HEIGHT_NOISE, _TILT_NOISE = 0.02, 0.01  # m, rad: standard deviations of the axes that the scan does not observe


@dataclass(frozen=True)
class ScanMatchSettings(Settings):
    """Private parameters of the matching."""

    range_min: float = setting(0.3, low=0.0, high=100.0, unit="m", text="closer points are ignored")
    range_max: float = setting(30.0, low=1.0, high=1000.0, unit="m", text="farther points are ignored")
    reach: float = setting(0.5, low=0.05, high=10.0, unit="m", text="maximum distance of corresponding points")
    noise: float = setting(0.02, above=0.0, high=1.0, unit="m", text="standard deviation of points from their lines")
    ground: float = setting(0.1, low=0.0, high=10.0, unit="m", text="points closer to the ground are ignored")
    slab: float = setting(
        1.5, low=0.05, high=10.0, unit="m", text="points farther above or below the vehicle are ignored"
    )
    key_step: float = setting(
        0.3, above=0.0, high=100.0, unit="m", text="distance after which a scan is added to the map"
    )
    key_turn: float = setting(0.2, above=0.0, high=3.2, unit="rad", text="rotation after which one is added")
    step: float = setting(
        0.12, above=0.0, high=10.0, unit="m", text="jump of the range that counts as a step of the ground"
    )
    least_points: int = setting(60, low=10, high=100_000, text="minimum number of points of a scan that is matched")


@dataclass(frozen=True)
class LaserSweep:
    """A scan with the vehicle's motion and height.

    Attributes:
        points: (n, 3) m, in the body, in the order of the rays, each at its own time.
        times: (n,) s after the first ray.
        motion: Motion of the body during the scan.
        attitude: Attitude of the autopilot at the scan's end, body to its map.
        below: m, distance of the body's origin from the ground along its z axis; None: unknown.
    """

    points: Array
    times: Array
    motion: ScanMotion
    attitude: Rotation
    below: float | None


@dataclass(frozen=True, kw_only=True)
class LaserEstimate(Estimate):
    """Result of one scan.

    Attributes:
        points: (n, 2) m, in the horizontal plane, relative to the body.
        floor: height of the ground below, m, None where it is unknown.
    """

    points: Array
    floor: float | None


class LaserOdometry:
    """The map and the vehicle's pose in it.

    Attributes:
        pose: (4, 4) body to map, at the end of the last scan.
    """

    def __init__(self, settings: ScanMatchSettings, start: Array) -> None:
        """Start with an empty map; start: (4, 4) pose of the body."""
        self._settings = settings
        self._map = LineMap()
        self._floor: float | None = None
        self._key: Array | None = None
        self.pose = start

    @property
    def map_points(self) -> Array:
        """Points of the map, (n, 3) m, at the vehicle's height."""
        points = self._map.points
        return np.column_stack([points, np.full(len(points), self.pose[2, 3])])

    def register(self, sweep: LaserSweep, predicted: Array) -> LaserEstimate:
        """Return the pose of a scan; map and ``pose`` do not change.

        Args:
            sweep: the scan.
            predicted: (4, 4) pose of the body at its end.
        """
        tilt = turned_about_z(-yaw_of(pose_of((0.0, 0.0, 0.0), sweep.attitude))) * sweep.attitude
        height, floor = self._height(sweep.below, tilt, predicted[2, 3])
        points = self._level(sweep, tilt, height, floor)
        start = np.array([predicted[0, 3], predicted[1, 3], yaw_of(predicted)])
        is_first = not len(self._map) and len(points) >= self._settings.least_points
        if is_first or len(points) < self._settings.least_points:
            found = Match(start, float(is_first), 0.0, np.zeros((3, 3)))
        else:
            found = self._map.match(points, start, self._settings.reach, self._settings.noise)
        x, y, yaw = found.place.tolist()
        return LaserEstimate(
            pose=pose_of((x, y, height), turned_about_z(yaw) * tilt),
            predicted=predicted,
            count=len(points),
            share=found.share,
            residual=found.residual,
            weakest=float(is_first) or weakest_share(found.information[:2, :2]),
            covariance=_covariance(found, is_first),
            is_first=is_first,
            points=points,
            floor=floor,
        )

    def accept(self, found: LaserEstimate) -> None:
        """Move to the pose of a scan, and add it to the map if it is far from the last one there."""
        self.pose, self._floor = found.pose, found.floor
        place = np.array([*found.pose[:2, 3], yaw_of(found.pose)])
        if self._key is not None and not self._is_far(place - self._key):
            return
        self._key = place
        turn = turned_about_z(place[2]).as_matrix()[:2, :2]
        self._map.insert(found.points @ turn.T + place[:2], normals_of(found.points) @ turn.T)

    def move(self, pose: Array) -> None:
        """Move to a predicted pose, without a scan."""
        self.pose = pose

    def _is_far(self, step: Array) -> bool:
        turn = abs((step[2] + np.pi) % (2.0 * np.pi) - np.pi)
        return bool(np.hypot(step[0], step[1]) > self._settings.key_step or turn > self._settings.key_turn)

    def _height(self, below: float | None, tilt: Rotation, predicted: float) -> tuple[float, float | None]:
        """Return the body's height in the map and that of the ground below, m."""
        if below is None:
            return predicted, self._floor
        above = below * float(tilt.as_matrix()[2, 2])
        floor = predicted - above if self._floor is None else self._floor
        if abs(floor + above - predicted) > self._settings.step:
            floor = predicted - above
        return floor + above, floor

    def _level(self, sweep: LaserSweep, tilt: Rotation, height: float, floor: float | None) -> Array:
        """Return the usable points in the horizontal plane, (n, 2) m, about the body."""
        settings = self._settings
        ranges = np.linalg.norm(sweep.points, axis=1)
        near = (ranges >= settings.range_min) & (ranges <= settings.range_max)
        level = tilt.apply(deskew(sweep.points[near], sweep.times[near], sweep.motion))
        lowest = -settings.slab if floor is None else max(-settings.slab, floor + settings.ground - height)
        usable = (level[:, 2] >= lowest) & (level[:, 2] <= settings.slab)
        found: Array = level[usable, :2]
        return found


def _covariance(found: Match, is_first: bool) -> Array:
    """Return the covariance of x, y, z and rotation; height and tilt come from other sensors."""
    covariance = np.diag([0.0, 0.0, _HEIGHT_NOISE**2, _TILT_NOISE**2, _TILT_NOISE**2, 0.0])
    known = 1e-6 * np.eye(3) if is_first else np.linalg.pinv(found.information, hermitian=True)
    order = [0, 1, 5]
    covariance[np.ix_(order, order)] = known * max(found.residual, 0.1) ** 2
    return covariance
