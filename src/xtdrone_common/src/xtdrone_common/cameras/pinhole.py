"""Pinhole camera without distortion: intrinsics, projection, viewing rays.

The optical frame is that of REP 103: x right, y down, z ahead. Pixel coordinates start at the left and upper edge of
the image, so the centre of the upper left pixel is (0.5, 0.5) and the principal point (width / 2, height / 2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.settings import check_range


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics of a camera.

    Attributes:
        width, height: pixels.
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels from the left and upper edge of the image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @staticmethod
    def of_view(width: int, height: int, horizontal_fov: float) -> Pinhole:
        """Return the camera with square pixels and the principal point at the image centre.

        Args:
            width, height: pixels, 1 to 8192.
            horizontal_fov: angle between left and right edge, rad, 0.01 to 3.1.

        Raises:
            ValueError: an argument is out of range.
        """
        check_range("width", width, 1, 8192, "px")
        check_range("height", height, 1, 8192, "px")
        check_range("horizontal_fov", horizontal_fov, 0.01, 3.1, "rad")
        focal = 0.5 * width / math.tan(0.5 * horizontal_fov)
        return Pinhole(int(width), int(height), focal, focal, 0.5 * width, 0.5 * height)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points to the image, (n, 2) pixels from the left and upper edge; NaN for points behind the camera.

        Args:
            points: (n, 3) m, optical frame.
        """
        points = np.asarray(points, float)
        depth = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        return np.column_stack(
            [self.fx * points[:, 0] / depth + self.cx, self.fy * points[:, 1] / depth + self.cy],
        )

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the viewing rays of pixels, (n, 3), optical frame, z = 1.

        Args:
            pixels: (n, 2) from the left and upper edge.
        """
        pixels = np.asarray(pixels, float)
        return np.column_stack(
            [(pixels[:, 0] - self.cx) / self.fx, (pixels[:, 1] - self.cy) / self.fy, np.ones(len(pixels))],
        )
