"""Lens distortion of the model ``plumb_bob``: where a lens shows what a pinhole would show elsewhere.

With x, y the coordinates of a viewing ray at z = 1 and r^2 = x^2 + y^2, the lens shows it at

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

(D. C. Brown, "Decentering distortion of lenses", 1966; sensor_msgs/CameraInfo lists D as k1, k2, p1, p2, k3).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import numpy as np
from numpy.typing import NDArray

from .pinhole import Pinhole

MOST_GROWTH = 3.0
"""Width and height of the picture that a lens needs, in those of its own, at most."""

_TURNS = 100
_CLOSE = 1e-3  # pixels


@dataclass(frozen=True)
class Lens:
    """A camera whose picture is distorted.

    Attributes:
        pinhole: the camera without distortion.
        coefficients: k1, k2, p1, p2, k3.
    """

    pinhole: Pinhole
    coefficients: tuple[float, float, float, float, float]

    def distort(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where rays (n, 2), x and y at z = 1, are shown, (n, 2) at z = 1."""
        k1, k2, p1, p2, k3 = self.coefficients
        x, y = rays[:, 0], rays[:, 1]
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        return np.column_stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
                y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
            ]
        )

    def undistort(self, shown: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rays that the lens shows at ``shown``, both (n, 2) at z = 1; the inverse of ``distort``.

        Raises:
            ValueError: the lens shows no ray there, or the iteration does not find it.
        """
        rays = shown.copy()
        with np.errstate(all="ignore"):
            for _ in range(_TURNS):
                rays = rays - (self.distort(rays) - shown)
            wrong = np.abs(self.distort(rays) - shown).max(initial=0.0) * self.pinhole.fx
        if not wrong < _CLOSE:
            text = ", ".join(f"{value:g}" for value in self.coefficients)
            raise ValueError(f"distortion: [{text}] is not allowed, coefficients with a ray for each pixel")
        return rays


@dataclass(frozen=True)
class Drawing:
    """How a lens's picture is made from that of a pinhole.

    Attributes:
        pinhole: the pinhole, with the focal length of the lens's camera, which sees all that the lens shows.
        columns, rows: of the lens's pixels in the pinhole's picture, (height, width) float32; the centre of the upper
            left pixel is (0, 0), as in OpenCV.
    """

    pinhole: Pinhole
    columns: NDArray[np.float32]
    rows: NDArray[np.float32]


@lru_cache(maxsize=32)
def drawing_of(lens: Lens) -> Drawing:
    """Return how to draw a lens's pictures.

    Raises:
        ValueError: the lens shows no ray in some pixel, or needs a picture greater than ``MOST_GROWTH`` of its own.
    """
    own = lens.pinhole
    columns, rows = np.meshgrid(np.arange(own.width) + 0.5, np.arange(own.height) + 0.5)
    rays = lens.undistort(own.rays(np.column_stack([columns.ravel(), rows.ravel()]))[:, :2])
    across, down = np.abs(rays).max(axis=0)
    width, height = 2 * ceil(across * own.fx + 1.0), 2 * ceil(down * own.fy + 1.0)
    if width > MOST_GROWTH * own.width + 4 or height > MOST_GROWTH * own.height + 4:
        text = ", ".join(f"{value:g}" for value in lens.coefficients)
        raise ValueError(
            f"distortion: [{text}] is not allowed, it needs a view of {width}x{height} pixels, at most "
            f"{MOST_GROWTH:g} times {own.width}x{own.height}"
        )
    pinhole = Pinhole(width, height, own.fx, own.fy, 0.5 * width, 0.5 * height)
    places = rays * (own.fx, own.fy) + (pinhole.cx - 0.5, pinhole.cy - 0.5)
    maps = places.astype(np.float32).reshape(own.height, own.width, 2)
    return Drawing(pinhole, np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1]))
