"""The true surfaces of a world that a lidar could see along its path, and how well a map agrees with them.

Precision and recall at a distance as A. Knapitsch et al. define them (Tanks and Temples, ACM Transactions on Graphics
36, 2017): precision is the share of the map within that distance of a true surface, recall the share of the true
surfaces within it of the map.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.metrics.odometry_errors import Trajectory
from xtdrone_sim.rays.scene import RayScene
from xtdrone_sim.rays.surface_points import distances_from, points_on
from xtdrone_sim.vehicles.mounts.fleet_sensor import lidars_of
from xtdrone_worlds.worlds.catalogue import load_world

Array = NDArray[np.float64]

_DRAWN = 60_000  # points on the surfaces around the path
_MOST_POINTS = 60_000  # of the map that are compared; the others are left out, by the seed
_STEP = 1.0  # m of the path between two viewpoints
_TOUCH = 0.02  # m by which a ray may end before its target point
_FARTHEST_ERROR = 5.0  # m; errors of the map beyond count as this
WITHIN = 0.1
"""Distance of precision and recall, m."""


@dataclass(frozen=True)
class MapAccuracy:
    """A map against the truth.

    Attributes:
        points: number of points of the map.
        surface_points: number of points on the true surfaces that could be seen.
        error: mean distance of the map's points from the true surfaces, m.
        gap: mean distance of the surfaces' points from the map, m; None without any.
        chamfer: mean of both, m; None without gap.
        precision: share of the map's points within 0.1 m of a surface.
        recall: share of the surfaces' points within 0.1 m of the map; None without any.
        f_score: harmonic mean of precision and recall.
    """

    points: int
    surface_points: int
    error: float
    gap: float | None
    chamfer: float | None
    precision: float
    recall: float | None
    f_score: float | None


def map_accuracy(errors: Array, found: Array, surface_points: Array) -> MapAccuracy:
    """Compare a map with the truth.

    Args:
        errors: (n,) distances of the map's points from the nearest true surface, m.
        found: (n, 3) the points of the map, m, at least one.
        surface_points: (m, 3) points on the surfaces that could be seen, m.
    """
    error, precision = float(errors.mean()), float((errors <= WITHIN).mean())
    if not len(surface_points):
        return MapAccuracy(len(found), 0, error, None, None, precision, None, None)
    gaps, _ = cKDTree(found).query(surface_points)
    gap, recall = float(gaps.mean()), float((gaps <= WITHIN).mean())
    both = precision + recall
    f_score = 2.0 * precision * recall / both if both else 0.0
    return MapAccuracy(len(found), len(surface_points), error, gap, 0.5 * (error + gap), precision, recall, f_score)


class Sight(NamedTuple):
    """Field of view of a lidar.

    Attributes:
        range: m.
        lowest, highest: rad, elevation in the vehicle's frame.
    """

    range: float
    lowest: float
    highest: float


ALL_ROUND = Sight(15.0, -np.pi / 2, np.pi / 2)
"""For a vehicle whose sensor is not known."""


def sight_of(vehicle: str) -> Sight:
    """Return the field of view of a vehicle's spinning lidar, at most 15 m; without one ``ALL_ROUND``."""
    try:
        lidars = lidars_of(parse_fleet(f"{vehicle.rpartition('_')[0]}:1"))
    except ValueError:
        return ALL_ROUND
    for lidar in lidars:
        if lidar.mount.kind == "spinning":
            mount = lidar.mount
            return Sight(min(mount.range_max, ALL_ROUND.range), mount.vertical_min, mount.vertical_max)
    return ALL_ROUND


class TrueWorld:
    """The surfaces of a world that rays see."""

    def __init__(self, world: str) -> None:
        """Build the scene.

        Raises:
            ValueError: no such world, or one that cannot be used.
        """
        self._scene = RayScene(load_world(world).models)
        self.surfaces = self._scene.layout.trees.surfaces

    def visible(self, ways: list[tuple[Trajectory, Sight]], seed: int) -> Array:
        """Return points on the surfaces visible along some paths, (n, 3) m in map, evenly by area.

        A point counts if it is visible from a true position on a path (one every metre): within the lidar's range,
        at most 15 m, and its vertical field of view, with nothing in between.
        """
        if not ways:
            return np.zeros((0, 3))
        reach = max(sight.range for _, sight in ways)
        places = np.concatenate([way.position for way, _ in ways])
        points = points_on(self.surfaces, _DRAWN, places.min(axis=0) - reach, places.max(axis=0) + reach, seed)
        seen = np.zeros(len(points), np.bool_)
        for way, sight in ways:
            steps = np.unique(
                np.searchsorted(way.way, np.arange(0.0, way.way[-1] + _STEP, _STEP)).clip(0, len(way) - 1)
            )
            for n in steps:
                self._look(way.position[n], way.rotation[int(n)].as_matrix(), sight, points, seen)
        return points[seen]

    def _look(self, place: Array, turn: Array, sight: Sight, points: Array, seen: NDArray[np.bool_]) -> None:
        """Mark the points that are in sight of a place."""
        rays = points - place
        distance = np.linalg.norm(rays, axis=1)
        near = np.flatnonzero(~seen & (distance <= sight.range) & (distance > _TOUCH))
        elevation = np.arcsin(np.clip((rays[near] @ turn)[:, 2] / distance[near], -1.0, 1.0))
        near = near[(elevation >= sight.lowest) & (elevation <= sight.highest)]
        origins = np.tile(place, (len(near), 1))
        ranges = self._scene.cast(origins, rays[near], sight.range + 1.0).ranges
        seen[near[np.abs(ranges - distance[near]) <= _TOUCH]] = True

    def compare(self, found: Array, ways: list[tuple[Trajectory, Sight]], seed: int = 0) -> dict[str, Any] | None:
        """Return the accuracy of a map as plain data; None for a map without points.

        Args:
            found: (n, 3) points of the map, or centres of its occupied voxels, m in map.
            ways: true paths of the vehicles that mapped, with their fields of view.
            seed: of the points on surfaces.
        """
        if not len(found):
            return None
        rng = np.random.default_rng(seed)
        some = found if len(found) <= _MOST_POINTS else found[rng.choice(len(found), _MOST_POINTS, replace=False)]
        errors = distances_from(self.surfaces, some, _FARTHEST_ERROR)
        accuracy = map_accuracy(errors, found, self.visible(ways, seed))
        return asdict(accuracy)
