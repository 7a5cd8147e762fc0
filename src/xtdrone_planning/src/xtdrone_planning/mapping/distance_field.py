"""Kernels for the distance to the nearest obstacle, exact up to a greatest distance.

Squared distances are separable: the least along one axis, then of those with the squared offset along the next one
(A. Rosenfeld, J. Pfaltz, Distance functions on digital pictures, Pattern Recognition 1, 1968; T. Saito, J. Toriwaki,
New algorithms for Euclidean distance transformation of an n-dimensional digitized picture, Pattern Recognition 27,
1994). As only offsets below the greatest distance matter, and integers of two bytes hold the squares, vector
instructions compare whole rows; in a forest this takes a quarter of the time of lower envelopes of parabolas.
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel

_MOST_SHORT = 127
"""Greatest reach, in voxels, for which twice its square is an integer of two bytes."""


@kernel
def distance_field(evidence, occupied_from, resolution, farthest, distance):
    """Compute the Euclidean distances to the nearest occupied voxel.

    Args:
        evidence: (nx, ny, nz) int16, contiguous.
        occupied_from: least evidence of an occupied voxel.
        resolution: side of a voxel, m.
        farthest: distances are limited to this, m.
        distance: (nx, ny, nz) float32, contiguous, m between middles of voxels; the result.
    """
    nx, ny, nz = evidence.shape
    reach = math.ceil(farthest / resolution) + 1
    if reach <= _MOST_SHORT:
        squares = np.empty((nx + 1, ny * nz), np.int16)
        _from_squares(squares, evidence, occupied_from, reach, resolution, farthest, distance)
    else:
        long_squares = np.empty((nx + 1, ny * nz), np.int32)
        _from_squares(long_squares, evidence, occupied_from, reach, resolution, farthest, distance)


@kernel
def _from_squares(squares, evidence, occupied_from, reach, resolution, farthest, distance):
    """Compute the distances by squares, (nx + 1, ny * nz), in voxels; the last row is work space. See above."""
    nx, _, nz = evidence.shape
    side, limit = np.float32(resolution), np.float32(farthest)
    row = squares[nx]
    is_empty = np.empty(nx, np.bool_)
    for i in range(nx):
        is_empty[i] = _along_columns(evidence[i], occupied_from, reach, row)
        _along_rows(row, nz, reach, is_empty[i], squares[i])
    for i in range(nx):
        row[:] = squares[i]
        for offset in range(1, reach):
            for other in (i - offset, i + offset):
                if 0 <= other < nx and not is_empty[other]:
                    _take_nearer(squares[other], offset, row)
        _lengths(row, side, limit, distance[i].reshape(-1))


@kernel
def _along_columns(plane, occupied_from, reach, squares):
    """Write the squared distances to the nearest occupied voxel of the same column; return whether there is none.

    Args:
        plane: (ny, nz) evidence.
        occupied_from: see ``distance_field``.
        reach: distances are limited to this, in voxels.
        squares: (ny * nz,) the result.
    """
    ny, nz = plane.shape
    is_empty = True
    for j in range(ny):
        first = j * nz
        last = -reach  # the occupied voxel below
        for k in range(nz):
            if plane[j, k] < occupied_from:
                squares[first + k] = min(k - last, reach) ** 2
                continue
            for below in range(k, max((last + k) // 2, k - reach, -1), -1):
                squares[first + below] = (k - below) ** 2
            last = k
            is_empty = False
    return is_empty


@kernel
def _along_rows(columns, nz, reach, is_empty, squares):
    """Write the squared distances within a plane, (ny * nz,), from those within its columns."""
    squares[:] = columns
    if is_empty:
        return
    size = len(squares)
    for offset in range(1, min(reach, size // nz)):
        away = offset * nz
        _take_nearer(columns[away:], offset, squares[: size - away])
        _take_nearer(columns[: size - away], offset, squares[away:])


@kernel
def _take_nearer(squares, offset, nearest):
    """Replace squared distances by those by way of voxels that are ``offset`` away, where these are less."""
    across = nearest.dtype.type(offset * offset)
    for n in range(len(nearest)):
        nearest[n] = min(nearest[n], nearest.dtype.type(squares[n] + across))


@kernel
def _lengths(squares, side, limit, distance):
    """Write the distances, m, of squared distances in voxels with ``side`` m."""
    for n in range(len(squares)):
        distance[n] = min(limit, np.float32(math.sqrt(np.float32(squares[n]))) * side)
