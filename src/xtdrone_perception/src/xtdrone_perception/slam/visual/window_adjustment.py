"""Bundle adjustment over the last keyframes: their poses and the points that they see, by least squares.

Gauss-Newton with Huber's weights; the points are eliminated first (Schur complement, B. Triggs et al., Bundle
Adjustment - A Modern Synthesis, 1999). The first keyframe is held fixed. In addition to pixels and inverse depths, the
autopilot's rotations between keyframes are measurements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import move_pose, rotation_of

from .camera_model import BodyCamera
from .pose_from_points import huber

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_ITERATIONS = 4
_DAMPING = 1e-4  # of the points' blocks, relative to their diagonal


@dataclass(frozen=True)
class WindowProblem:
    """Measurements in a window.

    Attributes:
        turns: k - 1 rotations of the body from each keyframe to the next, in its axes.
        turn_errors: (k - 1,) their standard deviations, rad.
        frame: (m,) keyframe of each measurement.
        point: (m,) point of each measurement.
        measured: (m, 5) u, v (px), inverse depth (1/m, NaN where unknown), its slopes along u and v (1/m/px).
    """

    turns: tuple[Rotation, ...]
    turn_errors: Array
    frame: Indices
    point: Indices
    measured: Array


def adjust(
    camera: BodyCamera, deviations: Array, problem: WindowProblem, poses: Array, points: Array
) -> tuple[Array, Array]:
    """Return improved poses (k, 4, 4) and points (n, 3).

    Args:
        camera: Camera of the measurements.
        deviations: (3,) standard deviations of a measurement, px, px, 1/m.
        problem: the measurements.
        poses: (k, 4, 4) body to map; the first one is fixed.
        points: (n, 3) m, map.
    """
    best = _cost(camera, deviations, problem, poses, points)
    for _ in range(_ITERATIONS):
        pose_steps, point_steps = _steps(camera, deviations, problem, poses, points)
        tried = np.stack([move_pose(pose, step) for pose, step in zip(poses, pose_steps, strict=True)])
        cost = _cost(camera, deviations, problem, tried, points + point_steps)
        if not cost < best:
            break
        poses, points, best = tried, points + point_steps, cost
    return poses, points


def _residuals(
    camera: BodyCamera, deviations: Array, problem: WindowProblem, poses: Array, points: Array
) -> tuple[Array, Array]:
    """Return normalised residuals (m, 3), 0 where unknown, and the points in the cameras' frames (m, 3)."""
    body = np.einsum("nji,nj->ni", poses[problem.frame, :3, :3], points[problem.point] - poses[problem.frame, :3, 3])
    expected, local = camera.measure(np.eye(4), body)
    return np.nan_to_num(camera.residuals(problem.measured, expected) / deviations), local


def _turn_errors(problem: WindowProblem, poses: Array) -> Array:
    """Return the rotation vectors (k - 1, 3) from measured to estimated rotations."""
    errors = [
        (turn.inv() * rotation_of(first).inv() * rotation_of(second)).as_rotvec()
        for turn, first, second in zip(problem.turns, poses[:-1], poses[1:], strict=True)
    ]
    return np.array(errors).reshape(-1, 3)


def _cost(camera: BodyCamera, deviations: Array, problem: WindowProblem, poses: Array, points: Array) -> float:
    residual, _ = _residuals(camera, deviations, problem, poses, points)
    square = np.einsum("ni,ni->n", residual, residual)
    weight = huber(residual)
    robust = np.where(weight < 1.0, weight * square * (2.0 - weight), square)
    return float(robust.sum() + ((_turn_errors(problem, poses) / problem.turn_errors[:, None]) ** 2).sum())


def _steps(
    camera: BodyCamera, deviations: Array, problem: WindowProblem, poses: Array, points: Array
) -> tuple[Array, Array]:
    """Return the steps of poses (k, 6), 0 for the first, and of points (n, 3)."""
    count, number = len(poses), len(points)
    residual, local = _residuals(camera, deviations, problem, poses, points)
    by_pose, by_point = camera.slopes(poses[problem.frame], local, points[problem.point], problem.measured)
    known = np.isfinite(problem.measured[:, :3])[:, :, None] / deviations[:, None]
    weight = np.sqrt(huber(residual))[:, None]
    residual, by_pose, by_point = (
        weight * residual,
        weight[:, :, None] * known * by_pose,
        weight[:, :, None] * known * by_point,
    )
    pose_rows, point_rows = by_pose.transpose(0, 2, 1), by_point.transpose(0, 2, 1)
    normal, right = _pose_blocks(problem, poses)
    np.add.at(normal, (problem.frame, problem.frame), pose_rows @ by_pose)
    np.add.at(right, problem.frame, (pose_rows @ residual[:, :, None])[:, :, 0])
    mixed = np.zeros((count, number, 6, 3))
    np.add.at(mixed, (problem.frame, problem.point), pose_rows @ by_point)
    block, goal = np.zeros((number, 3, 3)), np.zeros((number, 3))
    np.add.at(block, problem.point, point_rows @ by_point)
    np.add.at(goal, problem.point, (point_rows @ residual[:, :, None])[:, :, 0])
    block += (_DAMPING * np.einsum("nii->n", block) + 1e-9)[:, None, None] * np.eye(3)
    back = np.linalg.inv(block)
    flat = mixed.transpose(0, 2, 1, 3).reshape(6 * count, 3 * number)
    eliminated = (mixed @ back).transpose(0, 2, 1, 3).reshape(6 * count, 3 * number)
    matrix = normal.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count) - eliminated @ flat.T
    side = right.ravel() - eliminated @ goal.ravel()
    free = slice(6, None)  # the first keyframe is fixed
    steps = np.zeros(6 * count)
    steps[free] = np.linalg.solve(matrix[free, free] + 1e-9 * np.eye(6 * count - 6), side[free])
    rest = goal - (flat.T @ steps).reshape(number, 3)
    return steps.reshape(count, 6), (back @ rest[:, :, None])[:, :, 0]


def _pose_blocks(problem: WindowProblem, poses: Array) -> tuple[Array, Array]:
    """Return blocks (k, k, 6, 6) and right sides (k, 6) of the turns between keyframes."""
    count = len(poses)
    normal, right = np.zeros((count, count, 6, 6)), np.zeros((count, 6))
    for k, error in enumerate(_turn_errors(problem, poses)):
        weight = 1.0 / problem.turn_errors[k] ** 2
        by_first = -(poses[k + 1, :3, :3].T @ poses[k, :3, :3])
        normal[k, k, 3:, 3:] += weight * by_first.T @ by_first
        normal[k, k + 1, 3:, 3:] += weight * by_first.T
        normal[k + 1, k, 3:, 3:] += weight * by_first
        normal[k + 1, k + 1, 3:, 3:] += weight * np.eye(3)
        right[k, 3:] -= weight * by_first.T @ error
        right[k + 1, 3:] -= weight * error
    return normal, right
