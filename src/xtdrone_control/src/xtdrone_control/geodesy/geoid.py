"""Height of the geoid over the WGS84 ellipsoid by EGM96, which turns heights above mean sea level into GPS heights.

``egm96.xz`` holds the figures of the 15-minute grid WW15MGH.DAC of the US National Geospatial-Intelligence Agency
(public domain): int16, cm, 721 rows from 90 deg N to 90 deg S, 1440 columns from 0 deg E; of each the difference to its
left neighbour, of these the difference to the one above, little-endian, LZMA. Interpolated by cubics it is within
0.17 m of the model (C. Karney, GeographicLib, "Geoid height"); real MAVROS interpolates the 5-minute grid.
"""

from __future__ import annotations

import lzma
import math
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_ROWS, _COLUMNS = 721, 1440
_PER_DEGREE = 4
_FILE = Path(__file__).with_name("egm96.xz")


@cache
def _grid() -> NDArray[np.int16]:
    """Return the grid, cm, shape (721, 1440)."""
    data = np.frombuffer(lzma.decompress(_FILE.read_bytes()), "<i2").reshape(_ROWS, _COLUMNS)
    heights = np.cumsum(np.cumsum(data, axis=0, dtype=np.int32), axis=1, dtype=np.int32)
    return heights.astype(np.int16)


@cache
def _patch(row: int, column: int) -> tuple[tuple[float, ...], ...]:
    """Return the 4 x 4 heights, m, around the cell whose north-west corner is (row, column)."""
    return tuple(tuple(_height(row + i, column + j) for j in range(-1, 3)) for i in range(-1, 3))


def _height(row: int, column: int) -> float:
    """Return the height at a node, m; beyond a pole the meridian goes on on the other side."""
    if not 0 <= row < _ROWS:
        row = -row if row < 0 else 2 * (_ROWS - 1) - row
        column += _COLUMNS // 2
    return float(_grid()[row, column % _COLUMNS]) * 0.01


def _weights(t: float) -> tuple[float, float, float, float]:
    """Return the weights of the cubic through four nodes at -1, 0, 1, 2 (Lagrange) at ``t`` in 0..1."""
    return (
        -t * (t - 1.0) * (t - 2.0) / 6.0,
        (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
        -(t + 1.0) * t * (t - 2.0) / 2.0,
        (t + 1.0) * t * (t - 1.0) / 6.0,
    )


def undulation(latitude: float, longitude: float) -> float:
    """Return the height of the geoid over the ellipsoid, m, positive where the geoid is above.

    Args:
        latitude: deg, -90..90.
        longitude: deg, any turn.

    Raises:
        ValueError: no such place.
    """
    if not (abs(latitude) <= 90.0 and math.isfinite(longitude)):
        raise ValueError(f"geoid: latitude {latitude}, longitude {longitude}: -90..90 and finite are allowed")
    y, x = (90.0 - latitude) * _PER_DEGREE, (longitude % 360.0) * _PER_DEGREE
    row, column = min(int(y), _ROWS - 2), int(x)
    patch, across = _patch(row, column % _COLUMNS), _weights(x - column)
    lines = (sum(w * h for w, h in zip(across, line, strict=True)) for line in patch)
    return sum(w * line for w, line in zip(_weights(y - row), lines, strict=True))
