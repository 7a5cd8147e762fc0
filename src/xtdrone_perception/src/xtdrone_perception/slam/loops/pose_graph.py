"""Pose graph optimisation: poses that best fit measured relative poses, some of which may be outliers.

Nonlinear least squares over SE(3) (G. Grisetti et al., A Tutorial on Graph-Based SLAM, IEEE ITS Magazine 2(4), 2010)
by Levenberg-Marquardt steps on sparse normal equations. Loops have a robust Cauchy kernel, which reduces the weight of
wrong ones. The kernel is narrowed gradually (H. Yang et al., Graduated Non-Convexity for Robust Spatial Perception,
RA-L 5(2), 2020), because drift makes correct loops look wrong at first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, identity
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import pose_of_vector

Array = NDArray[np.float64]

_WIDER = (100.0, 30.0, 10.0, 3.0, 1.0)  # factors of the kernel, applied in this order
_STEPS = 20
_SMALL = 1e-7  # m or rad: smaller steps end the iteration
_DIFFERENCE = 1e-6
_MOST_DAMPING = 1e6


@dataclass(frozen=True)
class Edge:
    """A measured relative pose.

    Attributes:
        first, second: indices of the poses.
        measured: (4, 4) pose of the second in the first.
        information: (6, 6) inverse covariance; x, y, z (m), rotation vector (rad), in the second's axes.
        robust: whether it may be wrong, like a loop.
    """

    first: int
    second: int
    measured: Array
    information: Array
    robust: bool = False


def optimise_graph(poses: Sequence[Array], edges: Sequence[Edge], kernel: float = 3.0) -> list[Array]:
    """Return the optimised poses; the first one is fixed.

    Args:
        poses: (4, 4) each, the initial estimate.
        edges: Edges of a connected graph.
        kernel: normalised error of a robust edge at which it begins to lose weight.

    Raises:
        ValueError: an edge names a pose that does not exist.
    """
    for edge in edges:
        if not (0 <= edge.first < len(poses) and 0 <= edge.second < len(poses)) or edge.first == edge.second:
            raise ValueError(f"edge: {edge.first} to {edge.second} is not allowed, there are {len(poses)} poses")
    found = np.array(poses)
    if len(found) < 2 or not edges:
        return list(found)
    for wider in _WIDER:
        found = _descend(found, _Edges(edges, wider * kernel))
    return list(found)


def _descend(found: Array, graph: _Edges) -> Array:
    """Return the poses (n, 4, 4) at the nearest minimum of the cost."""
    cost, damping = graph.cost(found), 1e-6
    for _ in range(_STEPS):
        matrix, vector = graph.normal_equations(found)
        step = spsolve((matrix + damping * identity(matrix.shape[0])).tocsc(), -vector).reshape(-1, 6)
        tried = found.copy()
        tried[1:] = found[1:] @ _poses_of(step)
        new = graph.cost(tried)
        if new <= cost:
            found, cost, damping = tried, new, max(damping * 0.1, 1e-9)
        else:
            damping *= 100.0
        if np.abs(step).max() < _SMALL or damping > _MOST_DAMPING:
            break
    return found


class _Edges:
    """All edges of a graph as arrays."""

    def __init__(self, edges: Sequence[Edge], kernel: float) -> None:
        """Stack them."""
        self._first = np.array([edge.first for edge in edges])
        self._second = np.array([edge.second for edge in edges])
        self._back = _inverses(np.array([edge.measured for edge in edges]))
        self._information = np.array([edge.information for edge in edges])
        self._robust = np.array([edge.robust for edge in edges])
        self._kernel = kernel

    def _errors(self, poses: Array) -> Array:
        """Return the errors (e, 6): translation (m) and rotation vector (rad)."""
        return _vectors(self._back @ _inverses(poses[self._first]) @ poses[self._second])

    def _squares(self, errors: Array) -> Array:
        squares: Array = np.einsum("ei,eij,ej->e", errors, self._information, errors)
        return squares

    def cost(self, poses: Array) -> float:
        """Return the sum of squares, with robust edges down-weighted."""
        squares, limit = self._squares(self._errors(poses)), self._kernel**2
        return float(np.where(self._robust, limit * np.log1p(squares / limit), squares).sum())

    def normal_equations(self, poses: Array) -> tuple[csc_matrix, Array]:
        """Return matrix and vector of the steps of all poses but the first, each in its own axes."""
        errors = self._errors(poses)
        scale = np.where(self._robust, 1.0 / (1.0 + self._squares(errors) / self._kernel**2), 1.0)
        weights = self._information * scale[:, None, None]
        jacobians = self._jacobians(poses, errors)
        ends = self._first, self._second
        vector = np.zeros((len(poses), 6))
        rows, columns, values = [], [], []
        inner = np.arange(6)
        for i, a in zip(ends, jacobians, strict=True):
            weighted = np.swapaxes(a, 1, 2) @ weights
            np.add.at(vector, i, np.einsum("eij,ej->ei", weighted, errors))
            for j, b in zip(ends, jacobians, strict=True):
                block = weighted @ b
                rows.append(np.broadcast_to((6 * i)[:, None, None] + inner[:, None], block.shape).ravel())
                columns.append(np.broadcast_to((6 * j)[:, None, None] + inner, block.shape).ravel())
                values.append(block.ravel())
        size = 6 * len(poses)
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return coo_matrix(entries, shape=(size, size)).tocsc()[6:, 6:], vector.ravel()[6:]

    def _jacobians(self, poses: Array, errors: Array) -> tuple[Array, Array]:
        """Return the derivatives (e, 6, 6) of the errors with respect to small motions of the first and second
        poses."""
        before = self._back @ _inverses(poses[self._first])
        between = _inverses(poses[self._first]) @ poses[self._second]
        left, right = np.empty((len(errors), 6, 6)), np.empty((len(errors), 6, 6))
        for k in range(6):
            small = np.zeros(6)
            small[k] = _DIFFERENCE
            left[:, :, k] = _vectors(self._back @ pose_of_vector(-small) @ between) - errors
            right[:, :, k] = _vectors(before @ poses[self._second] @ pose_of_vector(small)) - errors
        return left / _DIFFERENCE, right / _DIFFERENCE


def _inverses(poses: Array) -> Array:
    found = np.zeros_like(poses)
    found[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    found[:, :3, 3] = -np.einsum("nij,nj->ni", found[:, :3, :3], poses[:, :3, 3])
    found[:, 3, 3] = 1.0
    return found


def _vectors(poses: Array) -> Array:
    return np.concatenate([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()], axis=1)


def _poses_of(vectors: Array) -> Array:
    found = np.tile(np.eye(4), (len(vectors), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = Rotation.from_rotvec(vectors[:, 3:]).as_matrix(), vectors[:, :3]
    return found
