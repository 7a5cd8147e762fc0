"""EGM96 height of the geoid above the WGS84 ellipsoid, to convert heights above mean sea level to ellipsoidal heights.

``egm96.xz`` contains the 15-minute grid WW15MGH.DAC of the US National Geospatial-Intelligence Agency (public domain):
heights in cm, 721 rows from 90 deg N to 90 deg S, 1440 columns from 0 deg E. The values are differenced along rows,
then along columns, and stored as little-endian int16 with LZMA compression. Cubic interpolation is within 0.17 m of the
model (C. Karney, GeographicLib, "Geoid height"); the original MAVROS interpolates the 5-minute grid.
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
    """Return the height at a node, m; rows beyond a pole continue on the opposite meridian."""
    if not 0 <= row < _ROWS:
        row = -row if row < 0 else 2 * (_ROWS - 1) - row
        column += _COLUMNS // 2
    return float(_grid()[row, column % _COLUMNS]) * 0.01


def _weights(t: float) -> tuple[float, float, float, float]:
    """Return the weights at ``t`` in 0..1 of the Lagrange cubic through nodes at -1, 0, 1 and 2."""
    return (
        -t * (t - 1.0) * (t - 2.0) / 6.0,
        (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
        -(t + 1.0) * t * (t - 2.0) / 2.0,
        (t + 1.0) * t * (t - 1.0) / 6.0,
    )


def undulation(latitude: float, longitude: float) -> float:
    """Return the height of the geoid above the ellipsoid, m.

    Args:
        latitude: deg, -90..90.
        longitude: deg, finite.

    Raises:
        ValueError: latitude or longitude out of range.
    """
    if not (abs(latitude) <= 90.0 and math.isfinite(longitude)):
        raise ValueError(f"geoid: latitude {latitude}, longitude {longitude} are not allowed, -90..90 and finite")
    y, x = (90.0 - latitude) * _PER_DEGREE, (longitude % 360.0) * _PER_DEGREE
    row, column = min(int(y), _ROWS - 2), int(x)
    patch, across = _patch(row, column % _COLUMNS), _weights(x - column)
    lines = (sum(w * h for w, h in zip(across, line, strict=True)) for line in patch)
    return sum(w * line for w, line in zip(_weights(y - row), lines, strict=True))
