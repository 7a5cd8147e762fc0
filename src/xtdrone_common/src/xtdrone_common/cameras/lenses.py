"""Lenses with the distortion models of sensor_msgs/CameraInfo: the displacement of image points relative to a pinhole.

``plumb_bob``: with x, y the coordinates of a viewing ray at z = 1 and r^2 = x^2 + y^2, the lens images it at

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

(D. C. Brown, "Decentering distortion of lenses", 1966; sensor_msgs/CameraInfo lists D as k1, k2, p1, p2, k3).

``equidistant``, whose field of view may exceed a hemisphere: a ray at the angle t from the optical axis is imaged at

    d = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)

from the principal point, in focal lengths, on the ray's own side (J. Kannala and S. Brandt, "A generic camera model and
calibration method for conventional, wide-angle, and fish-eye lenses", 2006; OpenCV's ``fisheye``;
sensor_msgs/distortion_models.h lists D as k1, k2, k3, k4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.settings import check_range

_FIXED_POINT_TURNS = 100
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
            for _ in range(_FIXED_POINT_TURNS):
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


_GRID = 4096
_NEWTON_TURNS = 4  # of Newton's method, from a point of the grid


@dataclass(frozen=True)
class Equidistant:
    """A camera with a fisheye lens.

    Attributes:
        pinhole: the camera without distortion, with the focal lengths and principal point of the lens.
        coefficients: k1, k2, k3, k4.
    """

    model: ClassVar[str] = "equidistant"
    names: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4")

    pinhole: Pinhole
    coefficients: tuple[float, ...]

    @staticmethod
    def of_view(width: int, height: int, horizontal_fov: float, coefficients: tuple[float, ...]) -> Equidistant:
        """Return the lens with the given angle between left and right edge and the principal point in the middle.

        Args:
            width, height: pixels, 1 to 8192.
            horizontal_fov: rad, 0.01 to 6.
            coefficients: k1, k2, k3, k4.

        Raises:
            ValueError: an argument is out of range, or the distances do not grow with the angles up to the edges.
        """
        check_range("width", width, 1, 8192, "px")
        check_range("height", height, 1, 8192, "px")
        half = 0.5 * check_range("horizontal_fov", horizontal_fov, 0.01, 6.0, "rad")
        unit = Equidistant(Pinhole(int(width), int(height), 1.0, 1.0, 0.5 * width, 0.5 * height), coefficients)
        if unit.widest < half:
            text = ", ".join(f"{value:g}" for value in coefficients)
            raise ValueError(
                f"distortion: [{text}] is not allowed, coefficients with a ray for each pixel: beyond "
                f"{unit.widest:.2f} rad from the axis the distances from the middle do not grow"
            )
        focal = 0.5 * width / float(unit.distances(np.array([half]))[0])
        return Equidistant(Pinhole(int(width), int(height), focal, focal, 0.5 * width, 0.5 * height), coefficients)

    def distances(self, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances from the principal point, in focal lengths, of rays at angles from the axis, rad."""
        k1, k2, k3, k4 = self.coefficients
        square = angles * angles
        return angles * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))))

    def scales(self, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivative of ``distances``."""
        k1, k2, k3, k4 = self.coefficients
        square = angles * angles
        return 1.0 + square * (3.0 * k1 + square * (5.0 * k2 + square * (7.0 * k3 + square * 9.0 * k4)))

    @property
    def widest(self) -> float:
        """Greatest angle up to which the distances grow, rad, at most pi."""
        grid = np.linspace(0.0, math.pi, _GRID)
        falling = np.flatnonzero(self.scales(grid) <= 0.0)
        return float(grid[falling[0] - 1]) if len(falling) else math.pi

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rays of pixels (n, 2) as (n, 3) unit vectors in the optical frame.

        Pixels beyond the lens's image circle have no ray: NaN.
        """
        p = self.pinhole
        x, y = (pixels[:, 0] - p.cx) / p.fx, (pixels[:, 1] - p.cy) / p.fy
        shown = np.hypot(x, y)
        grid = np.linspace(0.0, self.widest, _GRID)
        steps = self.distances(grid)
        angles = np.interp(shown, steps, grid)
        for _ in range(_NEWTON_TURNS):
            slope = np.maximum(self.scales(angles), 1e-9)
            angles = np.clip(angles - (self.distances(angles) - shown) / slope, 0.0, grid[-1])
        angles = np.where(shown <= steps[-1], angles, np.nan)
        across = np.divide(np.sin(angles), shown, out=np.ones_like(shown), where=shown > 0.0)
        return np.column_stack([x * across, y * across, np.cos(angles)])
