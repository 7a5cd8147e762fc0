"""Lens distortion of the model ``plumb_bob``: the displacement of image points relative to a pinhole.

With x, y the coordinates of a viewing ray at z = 1 and r^2 = x^2 + y^2, the lens images it at

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

(D. C. Brown, "Decentering distortion of lenses", 1966; sensor_msgs/CameraInfo lists D as k1, k2, p1, p2, k3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.cameras.pinhole import Pinhole

_TURNS = 100
_CLOSE = 1e-3  # pixels


@dataclass(frozen=True)
class PlumbBob:
    """A camera whose image is distorted.

    Attributes:
        pinhole: the camera without distortion.
        coefficients: k1, k2, p1, p2, k3.
    """

    model: ClassVar[str] = "plumb_bob"
    names: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2", "k3")

    pinhole: Pinhole
    coefficients: tuple[float, ...]

    def distort(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distorted positions, (n, 2) at z = 1, of rays given by x and y at z = 1, (n, 2)."""
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
        """Return the rays that the lens images at ``shown``, both (n, 2) at z = 1; the inverse of ``distort``.

        Raises:
            ValueError: no ray is imaged there, or the iteration does not converge.
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

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rays of pixels (n, 2), as (n, 3) in the optical frame with z = 1.

        Raises:
            ValueError: as ``undistort``.
        """
        rays = self.undistort(self.pinhole.rays(pixels)[:, :2])
        return np.column_stack([rays, np.ones(len(rays))])
