"""Camera pose from known points and their measurements: RANSAC, then robust least squares.

RANSAC with EPnP is OpenCV's, which uses the same random numbers on each call. Least squares are solved by Gauss-Newton
with Huber weights, over pixels, inverse depths, and the rotation measured by the autopilot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import inverse, move_pose, pose_of, rotation_of
from xtdrone_common.settings import Settings, setting

from .camera_model import BodyCamera

Array = NDArray[np.float64]

_ITERATIONS = 10
_SMALL = 1e-7  # m and rad: smaller steps end the iteration
_KNEE = 2.0  # normalised residual beyond which weights decrease
_RANSAC_ROUNDS, _RANSAC_CONFIDENCE = 60, 0.999
_LEAST = 6  # points


@dataclass(frozen=True)
class NoiseSettings(Settings):
    """Private parameters: standard deviations of measurements."""

    pixel_noise: float = setting(0.4, above=0.0, high=20.0, unit="px", text="standard deviation of a corner")
    depth_noise: float = setting(
        0.001, above=0.0, high=1.0, unit="1/m",
        text="standard deviation of a depth camera's inverse depth; at depth z it means z^2 times this, m",
    )  # fmt: skip
    disparity_noise: float = setting(
        0.3, above=0.0, high=20.0, unit="px", text="standard deviation of a stereo disparity"
    )
    turn_noise: float = setting(
        0.003, above=0.0, high=1.0, unit="rad",
        text="standard deviation of the autopilot's rotation between two images or keyframes",
    )  # fmt: skip
    turn_drift: float = setting(
        0.01, low=0.0, high=1.0, unit="rad/s",
        text="growth of that error: the autopilot's attitude is corrected, above all in the first seconds",
    )  # fmt: skip
    most_reprojection: float = setting(
        2.5, above=0.0, high=50.0, unit="px", text="reprojection error above which a point is an outlier"
    )

    def turn_error(self, seconds: float) -> float:
        """Return the standard deviation of the autopilot's turn over some time, rad."""
        return math.hypot(self.turn_noise, self.turn_drift * seconds)


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations: (3,) px, px, 1/m of a measurement, and rad of the rotation since the last image."""

    measured: Array
    turn: float


class Solved(NamedTuple):
    """A pose, its inliers, and the quality of the fit.

    Attributes:
        pose: (4, 4) body to map.
        inliers: (n,) bool.
        residual: RMS of the normalised residuals of the inliers' pixels and depths.
        information: (6, 6) of translation (map) and rotation (body), from the points alone.
    """

    pose: Array
    inliers: NDArray[np.bool_]
    residual: float
    information: Array


def solve(
    camera: BodyCamera, sigmas: Sigmas, most: float, predicted: Array, points: Array, measured: Array
) -> Solved | None:
    """Return the pose of the body; None if RANSAC finds none.

    Args:
        camera: Camera of the measurements.
        sigmas: Standard deviations of the measurements.
        most: px, maximum error of an inlier.
        predicted: (4, 4) body to map, from the autopilot.
        points: (n, 3) m, map.
        measured: (n, 5) u, v (px), inverse depth (1/m, NaN where unknown), its slopes along u and v (1/m/px).
    """
    if len(points) < _LEAST:
        return None
    chosen = _consensus(camera, most, predicted, points, measured)
    if chosen is None:
        return None
    pose = _refine(camera, sigmas, predicted, points[chosen], measured[chosen])
    expected, local = camera.measure(pose, points)
    residual = camera.residuals(measured, expected)
    off = np.linalg.norm(residual[:, :2], axis=1)
    deep = np.abs(np.nan_to_num(residual[:, 2])) / sigmas.measured[2]
    inliers = (off <= most) & (local[:, 2] > 0.0) & (deep <= 2.0 * most / sigmas.measured[0])
    if inliers.sum() < _LEAST:
        return None
    pose = _refine(camera, sigmas, pose, points[inliers], measured[inliers], predicted)
    normal, residuals = _normal_equations(camera, sigmas, pose, points[inliers], measured[inliers])[::2]
    return Solved(pose, inliers, float(np.sqrt(np.mean(residuals**2))), normal)


def _consensus(
    camera: BodyCamera, most: float, predicted: Array, points: Array, measured: Array
) -> NDArray[np.intp] | None:
    """Return the indices of the points that agree with one pose."""
    matrix = np.diag([camera.focal[0], camera.focal[1], 1.0])
    matrix[:2, 2] = camera.centre
    start = inverse(predicted @ camera.mount)
    no_lens: Any = None
    found, _, _, chosen = cv2.solvePnPRansac(
        points - predicted[:3, 3],  # near the origin, to limit rounding errors
        measured[:, :2].copy(),
        matrix,
        no_lens,
        rotation_of(start).as_rotvec(),
        start[:3, 3] + start[:3, :3] @ predicted[:3, 3],
        useExtrinsicGuess=True,
        iterationsCount=_RANSAC_ROUNDS,
        reprojectionError=most,
        confidence=_RANSAC_CONFIDENCE,
    )
    if not found or chosen is None or len(chosen) < _LEAST:
        return None
    return np.sort(chosen.ravel())


def _refine(
    camera: BodyCamera, sigmas: Sigmas, start: Array, points: Array, measured: Array, predicted: Array | None = None
) -> Array:
    """Return the robust least-squares pose."""
    predicted = start if predicted is None else predicted
    pose = start
    for _ in range(_ITERATIONS):
        normal, right, _ = _normal_equations(camera, sigmas, pose, points, measured)
        turn = (rotation_of(predicted).inv() * rotation_of(pose)).as_rotvec()
        weight = 1.0 / sigmas.turn**2
        normal[3:, 3:] += weight * np.eye(3)
        right[3:] -= weight * turn
        step = np.linalg.solve(normal + 1e-9 * np.eye(6), right)
        pose = move_pose(pose, step)
        if np.abs(step).max() < _SMALL:
            break
    return pose_of(pose[:3, 3], Rotation.from_matrix(pose[:3, :3]))


def _normal_equations(
    camera: BodyCamera, sigmas: Sigmas, pose: Array, points: Array, measured: Array
) -> tuple[Array, Array, Array]:
    """Return matrix (6, 6), right side (6,), and the normalised residuals that are known, (k,)."""
    expected, local = camera.measure(pose, points)
    slopes, _ = camera.slopes(np.broadcast_to(pose, (len(points), 4, 4)), local, points, measured)
    residual = camera.residuals(measured, expected) / sigmas.measured
    known = np.isfinite(residual)
    residual, slopes = np.where(known, residual, 0.0), slopes / sigmas.measured[:, None] * known[:, :, None]
    weight = np.sqrt(huber(residual))[:, None]
    rows, sides = (weight[:, :, None] * slopes).reshape(-1, 6), (weight * residual).ravel()
    return rows.T @ rows, rows.T @ sides, residual[known]


def huber(residual: Array) -> Array:
    """Return the Huber weights (n,) of normalised residuals (n, 3)."""
    length = np.sqrt(np.einsum("ni,ni->n", residual, residual))
    return np.asarray(np.minimum(1.0, _KNEE / np.maximum(length, 1e-12)))
