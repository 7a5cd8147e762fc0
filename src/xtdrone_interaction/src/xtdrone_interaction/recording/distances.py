"""Distances between vehicles, and to the slots of a formation. Imports NumPy only: nodes must start fast.

Positions are ENU in the ``map`` frame, metres; index 0 is the leader.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DISTANCE_LIMIT = 0.5  # m between any two vehicles of a good flight
_CHUNK = 1_000_000  # distances in memory at once
_MANY = 250  # vehicles; of more, only neighbours are searched


def relative(positions: Array) -> Array:
    """Return the followers' positions relative to the leader, (..., n - 1, 3), from positions (..., n, 3)."""
    return positions[..., 1:, :] - positions[..., :1, :]


def formation_error(positions: Array, offsets: Array) -> Array:
    """Return the followers' distances from their slots, m, shape (..., n - 1).

    Args:
        positions: of all vehicles, the leader first, shape (..., n, 3), m.
        offsets: assigned offsets from the leader, shape (n - 1, 3), m.
    """
    return np.linalg.norm(relative(positions) - offsets, axis=-1)


def least_distances(positions: Array) -> Array:
    """Return the minimum distance between any two vehicles at each time, m, shape (t,); infinite for one vehicle.

    Args:
        positions: shape (t, n, 3), m.
    """
    if positions.shape[1] < 2:
        return np.full(len(positions), np.inf)
    if positions.shape[1] > _MANY:
        return _nearest(positions)
    first, second = np.triu_indices(positions.shape[1], 1)
    rows = max(1, _CHUNK // len(first))
    parts = [positions[i : i + rows] for i in range(0, len(positions), rows)]
    return np.concatenate([np.linalg.norm(p[:, first] - p[:, second], axis=-1).min(axis=1) for p in parts])


def _nearest(positions: Array) -> Array:
    """Return :func:`least_distances` by a search for neighbours; NaN where a position is unknown."""
    from scipy.spatial import cKDTree  # slow to import, and nodes have few vehicles

    found = np.full(len(positions), np.nan)
    for row, places in enumerate(positions):
        if np.isfinite(places).all():
            found[row] = cKDTree(places).query(places, k=2)[0][:, 1].min()
    return found


def close_pairs(positions: Array, limit: float, nearest: Array) -> dict[tuple[int, int], tuple[int, float]]:
    """Return the pairs of vehicles that come closer than ``limit``, each with its closest row and distance, m.

    Args:
        positions: shape (t, n, 3), m.
        limit: m.
        nearest: result of :func:`least_distances`, shape (t,), m; only rows below the limit are searched.
    """
    from scipy.spatial import cKDTree  # see _nearest

    found: dict[tuple[int, int], tuple[int, float]] = {}
    for row in np.flatnonzero(nearest < limit).tolist():
        places = positions[row]
        pairs = cKDTree(places).query_pairs(limit, output_type="ndarray")
        distances = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
        for (i, j), distance in zip(pairs.tolist(), distances.tolist(), strict=True):
            if distance < found.get((i, j), (0, limit))[1]:
                found[i, j] = row, distance
    return found


def offsets_from_message(data: Iterable[float]) -> Array:
    """Return assigned offsets, (n - 1, 3), m, from the row-major 3 x (n - 1) data of a formation_pattern message.

    Raises:
        ValueError: the number of values is not a multiple of 3.
    """
    flat = np.asarray(data, dtype=np.float64)
    if flat.size % 3:
        raise ValueError(f"formation_pattern: {flat.size} values; 3 x (n - 1) are expected")
    return flat.reshape(3, -1).T.copy()
