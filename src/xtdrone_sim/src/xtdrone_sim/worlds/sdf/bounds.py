"""How much room shapes take."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.bounded_file import MB, read_text
from xtdrone_sim.vehicles.poses import rotate
from xtdrone_sim.vehicles.visual import Box, Cylinder, Geometry, Pose, Sphere
from xtdrone_sim.worlds.sdf.types import SdfError

Array = NDArray[np.float64]

LARGEST_MESH = 64 * MB


def box_of(geometry: Geometry, pose: Pose) -> tuple[Array, Array]:
    """Return the lowest and the highest corner (3,) of the box along the axes that holds a shape placed by ``pose``.

    Raises:
        SdfError: a mesh file that cannot be read.
    """
    if isinstance(geometry, Sphere):
        middle = np.asarray(pose.position)
        return middle - geometry.radius, middle + geometry.radius
    if isinstance(geometry, Box):
        low, high = -0.5 * np.asarray(geometry.size), 0.5 * np.asarray(geometry.size)
    elif isinstance(geometry, Cylinder):
        high = np.array([geometry.radius, geometry.radius, 0.5 * geometry.length])
        low = -high
    else:
        scaled = _vertices(geometry.path) * np.asarray(geometry.scale)
        low, high = scaled.min(axis=0), scaled.max(axis=0)
    columns = [rotate(pose.orientation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    turn = np.array(columns).T
    middle = turn @ (0.5 * (low + high)) + np.asarray(pose.position)
    reach = np.abs(turn) @ (0.5 * (high - low))
    return middle - reach, middle + reach


@lru_cache(maxsize=1024)
def _vertices(path: Path) -> Array:
    """Return the lowest and the highest corner (2, 3) of a Wavefront file's points."""
    try:
        text = read_text(path, LARGEST_MESH)
        rows = [line.split(None, 4)[1:4] for line in text.splitlines() if line.startswith("v ")]
        points = np.array(rows, float).reshape(-1, 3)
    except (OSError, ValueError) as error:
        raise SdfError(f"{path}: not a Wavefront file: {error}") from error
    if not len(points):
        raise SdfError(f"{path}: not a Wavefront file: it has no points")
    return np.array([points.min(axis=0), points.max(axis=0)])
