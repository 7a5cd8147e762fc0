"""Coverage map: the part of a region that the cameras have shown, image by image, on a grid of places."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from xtdrone_common.cameras.pinhole import Pinhole

from .planning.coverage_path import PERSON

_MAX_CELLS = 40_000  # a larger region gets wider cells
SEEN, UNSEEN, OUTSIDE = 100, 0, -1
"""Values of a coverage grid's cells."""


class CoverageGrid(NamedTuple):
    """A coverage map as cells.

    Attributes:
        corner: x and y of the first cell's lowest corner, m ENU.
        cell: side of a cell, m.
        values: (columns along x, rows along y), int8: 100 seen, 0 not seen, -1 outside the region.
    """

    corner: tuple[float, float]
    cell: float
    values: NDArray[np.int8]


class CoverageMap:
    """Grid of places in a region, each marked once an image shows it.

    Attributes:
        region_area: m^2.
    """

    def __init__(
        self, region: Polygon, camera: Pinhole, *, ground: float = 0.0, pixels: float = 12.0, cell: float = 1.0
    ) -> None:
        """Create the grid with no place seen.

        Args:
            region: m ENU.
            camera: intrinsics, the same for all vehicles.
            ground: height of the ground in the map frame, m.
            pixels: minimum height of a person in the image, px.
            cell: distance between places, m; increased if the grid would have more than 40000 places.
        """
        self.region_area = float(region.area)
        low_x, low_y, high_x, high_y = region.bounds
        cell = max(cell, ((high_x - low_x) * (high_y - low_y) / _MAX_CELLS) ** 0.5)
        x, y = np.meshgrid(
            np.arange(low_x + 0.5 * cell, high_x, cell), np.arange(low_y + 0.5 * cell, high_y, cell), indexing="ij"
        )
        inside = shapely.contains_xy(region, x, y)
        places = np.column_stack([x[inside], y[inside]])
        self._corner, self._cell, self._inside = (float(low_x), float(low_y)), float(cell), inside
        if not len(places):  # a sliver between the places of the grid
            point = region.representative_point()
            places = np.array([[point.x, point.y]])
            self._corner, self._inside = (point.x - 0.5 * cell, point.y - 0.5 * cell), np.ones((1, 1), bool)
        self._feet = np.column_stack([places, np.full(len(places), ground)])
        self._camera = camera
        self._pixels = pixels
        self._seen = np.zeros(len(places), bool)

    def add_picture(self, position: NDArray[np.float64], rotation: NDArray[np.float64]) -> None:
        """Mark the places that an image shows.

        Args:
            position: (3,) of the camera, m, map.
            rotation: (3, 3) from the optical frame (x right, y down, z ahead) to the map frame.
        """
        left = np.flatnonzero(~self._seen)
        shown = shows(self._camera, position, rotation, self._feet[left], self._pixels)
        self._seen[left[shown]] = True

    def grid(self) -> CoverageGrid:
        """Return the places as cells."""
        values = np.full(self._inside.shape, OUTSIDE, np.int8)
        values[self._inside] = np.where(self._seen, SEEN, UNSEEN)
        return CoverageGrid(self._corner, self._cell, values)

    @property
    def fraction(self) -> float:
        """Covered fraction of the region, 0 to 1."""
        return float(np.mean(self._seen))

    @property
    def area(self) -> float:
        """Covered area, m^2."""
        return self.fraction * self.region_area


def shows(
    camera: Pinhole,
    position: NDArray[np.float64],
    rotation: NDArray[np.float64],
    feet: NDArray[np.float64],
    pixels: float = 0.0,
) -> NDArray[np.bool_]:
    """Return, for each place, whether an image would show a person standing there whole and large enough.

    Args:
        camera: intrinsics.
        position: (3,) of the camera, m, map.
        rotation: (3, 3) from the optical frame to the map frame.
        feet: (n, 3) places on the ground, m, map.
        pixels: minimum height of the person in the image, px.

    Returns:
        (n,) bool.
    """
    foot = camera.project((feet - position) @ rotation)
    head = camera.project((feet - position + np.array([0.0, 0.0, PERSON])) @ rotation)
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):  # NaN behind the camera: not inside
        inside = np.all((foot >= 0.0) & (foot <= size) & (head >= 0.0) & (head <= size), axis=1)
        return np.asarray(inside & (np.hypot(*(foot - head).T) >= pixels))
