"""The camera: the displayed box, which follows the vehicles, and its perspective projection to pixels.

Matplotlib's 3D axes draw a hundred vehicles with trails 22 times a second; one matrix product for all points and plain
2D artists are several times as fast and have equal scales on all axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AZIMUTH, ELEVATION = -58.0, 22.0  # deg, of the eye seen from the box's centre; azimuth from east, counter-clockwise
ZOOM_RANGE = (0.2, 20.0)
_DISTANCE = 3.4  # from the eye to the centre, in half diagonals of the box
_LEAST_SIZE = 4.0  # m, minimum edge of the box
_LEAST_SHARE = 0.55  # minimum edge as a fraction of the longest one
_EMPTY = _LEAST_SIZE * np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]])  # m, the box without vehicles
_MARGIN = 0.08  # between the outermost vehicles and the box, as a fraction of the longest edge
_SLACK = 0.12  # excess size, as a fraction of the longest edge, at which the box starts to shrink
_SNAP = 0.1  # fraction of that slack: a floor this close to the ground is moved to it
_GROW, _SHRINK = 0.25, 1.6  # s, time constants of the box
_GROUND_REACH = 0.9  # the ground is shown if it is at most this many box widths below the swarm ...
_UNDERGROUND = 0.5  # m below 0 at which a vehicle still counts as on the ground
_GROUND_SHARE = 0.8  # minimum width of the ground as a fraction of the height
_GROUND_LEAST = 4.0  # m ... or at most this distance


@dataclass(frozen=True)
class Box:
    """The displayed part of space.

    Attributes:
        low: minimum x, y, z, m ENU, shape (3,).
        high: maximum x, y, z, likewise.
    """

    low: Array
    high: Array

    @property
    def corners(self) -> Array:
        """Return the eight corners, shape (8, 3), m ENU."""
        edges = np.stack([self.low, self.high])
        return np.array([[edges[i, 0], edges[j, 1], edges[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])

    @property
    def middle(self) -> Array:
        """Return the centre, shape (3,), m ENU."""
        return 0.5 * (self.low + self.high)

    @property
    def radius(self) -> float:
        """Return half the diagonal, m."""
        return 0.5 * float(np.linalg.norm(self.high - self.low))


class FollowingBox:
    """A box that contains all vehicles: it grows fast, shrinks slowly, and does not move while it fits."""

    def __init__(self) -> None:
        """Create a box without contents."""
        self._edges: Array | None = None
        self._time = 0.0

    def forget(self) -> None:
        """Discard the history and start with the next points."""
        self._edges = None

    def follow(self, time: float, points: Array) -> Box:
        """Update the box for a set of points and return it.

        Args:
            time: simulated time, s; the time since the last call determines the smoothing.
            points: shape (n, 3), m ENU; rows that are not finite are ignored.
        """
        target = _target(points)
        if target is None:
            target = _EMPTY if self._edges is None else self._edges
        elapsed = time - self._time
        self._time = time
        if self._edges is None or elapsed < 0.0:
            self._edges = target
        else:
            self._edges = _ease(self._edges, target, elapsed)
        return Box(self._edges[0].copy(), self._edges[1].copy())


def _target(points: Array) -> Array | None:
    """Return the box edges (low, high) for a set of points, shape (2, 3); None without a finite point."""
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    longest = max(float((high - low).max()), _LEAST_SIZE)
    margin = _MARGIN * longest + 0.5
    size = np.maximum(high - low + 2.0 * margin, _LEAST_SHARE * (longest + 2.0 * margin))
    middle = 0.5 * (low + high)
    edges = np.stack([middle - 0.5 * size, middle + 0.5 * size])
    reach = max(_GROUND_LEAST, _GROUND_REACH * float(size[:2].max()))
    if low[2] >= -_UNDERGROUND and (low[2] <= reach or edges[0, 2] <= 0.0):
        edges[0, 2] = 0.0
        edges[1, 2] = max(edges[1, 2], high[2] + margin, size[2])
        size[:2] = np.maximum(size[:2], _GROUND_SHARE * edges[1, 2])
        edges[:, :2] = middle[:2] - 0.5 * size[:2], middle[:2] + 0.5 * size[:2]
    return edges


def _ease(edges: Array, target: Array, elapsed: float) -> Array:
    """Return the edges after ``elapsed`` s of motion to the target; growth is faster than shrinkage."""
    slack = _SLACK * float((target[1] - target[0]).max())
    grow, shrink = (1.0 - math.exp(-elapsed / constant) for constant in (_GROW, _SHRINK))
    excess = np.stack([target[0] - edges[0], edges[1] - target[1]])  # above 0: the box is larger than necessary
    step = np.where(excess < 0.0, grow * excess, shrink * np.maximum(0.0, excess - slack))
    eased = np.stack([edges[0] + step[0], edges[1] - step[1]])
    if target[0, 2] == 0.0 and eased[0, 2] < _SNAP * slack:
        eased[0, 2] = 0.0  # the ground instead of a floor just above it
    return eased


class Camera:
    """Projects points of the map to pixels.

    Attributes:
        azimuth: azimuth of the eye seen from the centre, deg counter-clockwise from east (x).
        elevation: elevation of the eye above the horizon, deg, -89 to 89.
        zoom: magnification; at 1 the box fills the picture.
    """

    def __init__(self) -> None:
        """Set the default view."""
        self.reset()

    def reset(self) -> None:
        """Return to the default view."""
        self.azimuth = AZIMUTH
        self.elevation = ELEVATION
        self.zoom = 1.0

    def turn(self, azimuth: float, elevation: float) -> None:
        """Rotate the view by angles, deg."""
        self.azimuth = (self.azimuth + azimuth + 180.0) % 360.0 - 180.0
        self.elevation = min(89.0, max(-89.0, self.elevation + elevation))

    def magnify(self, factor: float) -> None:
        """Zoom about the centre by a factor, within ``ZOOM_RANGE``."""
        self.zoom = min(ZOOM_RANGE[1], max(ZOOM_RANGE[0], self.zoom * factor))

    @property
    def basis(self) -> Array:
        """Return the picture's right and up directions and the direction to the eye as rows, ENU, shape (3, 3)."""
        azimuth, elevation = math.radians(self.azimuth), math.radians(self.elevation)
        ca, sa, ce, se = math.cos(azimuth), math.sin(azimuth), math.cos(elevation), math.sin(elevation)
        return np.array([[-sa, ca, 0.0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]])

    def look(self, box: Box, area: tuple[float, float, float, float]) -> Projection:
        """Return the projection that fits a box into an area of the picture.

        Args:
            box: the box to show.
            area: left, bottom, width, height, pixels, y upwards.
        """
        return Projection(self.basis, box, area, self.zoom)


class Projection:
    """Projection of map points to pixels, for one box and one viewpoint.

    Attributes:
        basis: see :attr:`Camera.basis`.
        scale: pixels per metre at the centre of the box.
    """

    def __init__(self, basis: Array, box: Box, area: tuple[float, float, float, float], zoom: float) -> None:
        """Fit ``box`` into ``area``; see :meth:`Camera.look`."""
        left, bottom, width, height = area
        self.basis = basis
        self._middle = box.middle
        self._radius = box.radius
        self._distance = _DISTANCE * box.radius
        plane, _ = self._to_plane(box.corners)
        low, high = plane.min(axis=0), plane.max(axis=0)
        self.scale = zoom * float(min(width / (high[0] - low[0]), height / (high[1] - low[1])))
        self._origin = np.array([left + 0.5 * width, bottom + 0.5 * height]) - self.scale * 0.5 * (low + high)

    def _to_plane(self, points: Array) -> tuple[Array, Array]:
        """Return points on the plane through the centre, m, shape (..., 2), and their magnification, shape (...)."""
        seen = (points - self._middle) @ self.basis.T
        # A vehicle behind the eye, as in a diverging simulation, must not invert the picture.
        factor = self._distance / np.maximum(self._distance - seen[..., 2], 0.1 * self._distance)
        return seen[..., :2] * factor[..., None], factor

    def pixels(self, points: Array) -> Array:
        """Return the positions of points in the picture, pixels from its lower left corner, shape (..., 2).

        Args:
            points: shape (..., 3), m ENU.
        """
        return self._to_plane(points)[0] * self.scale + self._origin

    def pixels_and_nearness(self, points: Array) -> tuple[Array, Array]:
        """Return :meth:`pixels` and the magnification relative to the centre, shape (...)."""
        plane, factor = self._to_plane(points)
        return plane * self.scale + self._origin, factor

    @property
    def nearness_range(self) -> tuple[float, float]:
        """Return the magnification at the far and at the near end of the box."""
        return self._distance / (self._distance + self._radius), self._distance / (self._distance - self._radius)
