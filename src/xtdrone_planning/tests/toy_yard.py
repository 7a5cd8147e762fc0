"""A yard with boxes of random size and heading, as maps of voxels, and vehicles that see parts of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.pose_matrices import inverse, pose_of, transform_points, turned_about_z
from xtdrone_planning.merging.frame_links import Pairs

Array = NDArray[np.float64]

SPACING = 0.1  # m, of points on surfaces
VOXEL = 0.2  # m


def yard(seed: int, size: tuple[float, float] = (40.0, 20.0), boxes: int = 16) -> Array:
    """Return points (n, 3) m on the ground and on the sides of boxes."""
    rng = np.random.default_rng(seed)
    ground = np.stack(np.meshgrid(*(np.arange(0.0, s, 0.4) for s in size)), axis=-1).reshape(-1, 2)
    parts = [np.column_stack([ground, np.zeros(len(ground))])]
    for _ in range(boxes):
        middle = np.append(rng.uniform(1.0, np.array(size) - 1.0), 0.0)
        turn = turned_about_z(rng.uniform(0.0, np.pi))
        parts.append(transform_points(pose_of(middle, turn), _sides(*rng.uniform(1.0, 4.0, 3))))
    return np.concatenate(parts)


def _sides(length: float, width: float, height: float) -> Array:
    z = np.arange(0.0, height, SPACING)
    parts = []
    for half, across, axes in ((length / 2, width / 2, (0, 1)), (width / 2, length / 2, (1, 0))):
        u, v = (part.ravel() for part in np.meshgrid(np.arange(-half, half, SPACING), z))
        for side in (-across, across):
            side_points = np.empty((len(u), 3))
            side_points[:, axes[0]], side_points[:, axes[1]], side_points[:, 2] = u, side, v
            parts.append(side_points)
    return np.concatenate(parts)


def seen(points: Array, limits: tuple[float, float], frame: Array, seed: int) -> Array:
    """Return the centres (n, 3) m of the voxels that a vehicle has seen, in its map.

    Args:
        points: of the yard.
        limits: least and greatest x that it has seen, m.
        frame: (4, 4) its map in the yard.
        seed: of the noise, 3 cm.
    """
    part = points[(points[:, 0] >= limits[0]) & (points[:, 0] < limits[1])]
    noisy = part + 0.03 * np.random.default_rng(seed).standard_normal(part.shape)
    cells = np.unique(np.floor(transform_points(inverse(frame), noisy) / VOXEL).astype(int), axis=0)
    return (cells + 0.5) * VOXEL


def way(number: int, times: Array) -> Array:
    """Return the positions of vehicle ``number``, (n, 3) m in the yard."""
    phase = 0.1 * times + 1.3 * number
    return np.stack([12.0 + 8.0 * number + 6.0 * np.cos(phase), 10.0 + 5.0 * np.sin(phase), 2.0 + 0.0 * times], axis=1)


def pairs(
    first: tuple[int, Array], second: tuple[int, Array], seed: int, noise: float = 0.15, outliers: float = 0.0
) -> Pairs:
    """Return estimates of the second vehicle by the first for 60 s, both as number and map frame (4, 4)."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 60.0, 0.5)
    here, there = way(first[0], times), way(second[0], times)
    relative = (there - here) @ first[1][:3, :3] + noise * rng.standard_normal(here.shape)
    wrong = rng.random(len(times)) < outliers
    relative[wrong] += rng.normal(0.0, 8.0, (wrong.sum(), 3)) + 5.0
    own = transform_points(inverse(first[1]), here)
    return Pairs(times, own + relative, transform_points(inverse(second[1]), there), np.full(len(times), noise))
