"""Motion compensation (deskewing) of scans: transform all points to the end of the scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScanMotion:
    """Motion of the vehicle during a scan.

    Attributes:
        times: (k,) s after the first ray, ascending; the last one is the end of the scan. k >= 2.
        turns: (k, 3) rotation vector, rad, from the body at that time to the body at the end, in the axes of the
        latter.
        velocity: (3,) m/s of the body, in its axes at the end.
    """

    times: Array
    turns: Array
    velocity: Array

    @property
    def end(self) -> float:
        """End of the scan, s after its first ray."""
        return float(self.times[-1])


def motion_of(times: Array, attitudes: Rotation, velocity: Array) -> ScanMotion:
    """Return the motion during a scan.

    Args:
        times: (k,) s after the first ray, ascending; the last one is the end of the scan.
        attitudes: k attitudes, body to world.
        velocity: (3,) m/s, world.
    """
    end = attitudes[-1].inv()
    return ScanMotion(times, (end * attitudes).as_rotvec(), end.apply(velocity))


def deskew(points: Array, times: Array, motion: ScanMotion) -> Array:
    """Return the points in the body's frame at the end of the scan.

    Rotation vectors are interpolated in time and applied to second order: for 0.1 rad per scan the error is 0.2 mrad.

    Args:
        points: (n, 3) m, each in the body's frame at its own time.
        times: (n,) s after the first ray.
        motion: Motion of the body.
    """
    turn = np.stack([np.interp(times, motion.times, column) for column in motion.turns.T], axis=1)
    once = np.cross(turn, points)
    moved: Array = points + once + 0.5 * np.cross(turn, once) + np.outer(times - motion.end, motion.velocity)
    return moved
