"""Heightmaps: terrain from a greyscale image, as Wavefront files, which renderer, rays and physics read.

The files are in the user's cache, named by a hash of their source. The terrain is a surface without thickness. For
collisions it is cut into square tiles, so that a vehicle is near only those below it.
"""

from __future__ import annotations

import hashlib
import io
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.files import MB, read_bytes
from xtdrone_common.rotation import Vector
from xtdrone_worlds.data_files import cached_folder
from xtdrone_worlds.worlds.sdf.world_records import SdfError

LARGEST_PICTURE = 32 * MB
MOST_POINTS = 385
"""Largest number of points along a side; a larger image is reduced to it, to 300 000 triangles at most."""

_FORMAT = b"1"  # of the cached files; a new version invalidates them
_MOST_PIXELS = 64_000_000
_TILE = 32  # cells along a side of a tile
_WHOLE = "terrain.obj"
_FOLDER = "heightmaps"  # in the cache

Array = NDArray[np.float64]


def read_heightmap(path: Path, size: Vector, pos: Vector = (0.0, 0.0, 0.0), texture: float = 10.0) -> tuple[Path, ...]:
    """Return the Wavefront files of a terrain, the whole and then its tiles; the first call for an image writes them.

    As in Gazebo (gazebo/common/ImageHeightmap.cc, physics/HeightmapShape.cc), black is the height 0 and the brightest
    pixel that of ``size``; columns run along x, and the image's top is at the largest y.

    Args:
        path: PNG or JPEG file of 8 or 16 bits; of a colour image, the red channel is used.
        size: size of the terrain along x, y and z, m.
        pos: position of its middle at the height 0, m.
        texture: side of one texture, m.

    Raises:
        SdfError: the file cannot be read, is too large, or has a side of less than two pixels.
    """
    try:
        data = read_bytes(path, LARGEST_PICTURE)
    except OSError as error:
        raise SdfError(f"{path}: {error.strerror or error}") from error
    key = hashlib.sha256(_FORMAT + repr((size, pos, texture)).encode() + data).hexdigest()[:24]
    try:
        folder = cached_folder(_FOLDER, key, lambda folder: _write(_heights(data, path), size, pos, texture, folder))
    except OSError as error:
        raise SdfError(f"{path}: its terrain cannot be written: {error.strerror or error}") from error
    return _files(folder)


def is_terrain(path: Path) -> bool:
    """Return whether a mesh file is a terrain or a tile of one, as ``read_heightmap`` returns them."""
    return path.parent.parent.name == _FOLDER


@lru_cache(maxsize=64)
def _files(folder: Path) -> tuple[Path, ...]:
    tiles = sorted(path for path in folder.glob("tile_*.obj"))
    return (folder / _WHOLE, *tiles)


def _heights(data: bytes, path: Path) -> Array:
    """Return the heights, 0 to 1, rows from the smallest y, columns from the smallest x."""
    from PIL import Image  # few worlds have terrain

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as picture:
            if picture.width * picture.height > _MOST_PIXELS:
                raise SdfError(f"{path}: it has {picture.width} x {picture.height} pixels, at most {_MOST_PIXELS}")
            values = np.asarray(picture.convert("RGB") if picture.mode == "P" else picture, float)
    except SdfError:
        raise
    except Exception as error:  # any exception of the decoder
        raise SdfError(f"{path}: not a PNG or JPEG file: {type(error).__name__}: {error}") from error
    values = values[:, :, 0] if values.ndim == 3 else values
    if min(values.shape) < 2:
        raise SdfError(f"{path}: it has {values.shape[1]} x {values.shape[0]} pixels, at least 2 x 2 are needed")
    values = _reduce(_reduce(values[::-1]).T).T
    return values / max(float(values.max()), 1e-9)


def _reduce(values: Array) -> Array:
    """Return ``MOST_POINTS`` rows at most, at equal distances from the first to the last, linear between pixels."""
    if len(values) <= MOST_POINTS:
        return values
    at = np.linspace(0.0, len(values) - 1.0, MOST_POINTS)
    low = np.minimum(at.astype(int), len(values) - 2)
    share = (at - low)[:, None]
    return (1.0 - share) * values[low] + share * values[low + 1]


def _write(heights: Array, size: Vector, pos: Vector, texture: float, folder: Path) -> None:
    """Write the whole and the tiles as Wavefront files."""
    rows, columns = heights.shape
    x = pos[0] + size[0] * (np.arange(columns) / (columns - 1) - 0.5)
    y = pos[1] + size[1] * (np.arange(rows) / (rows - 1) - 0.5)
    z = pos[2] + size[2] * heights
    slope_y, slope_x = np.gradient(z, y, x)
    points = np.stack([*np.meshgrid(x, y), z], axis=2)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(z)], axis=2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    _write_grid(folder / _WHOLE, points, normals, texture)
    for i in range(0, rows - 1, _TILE):
        for j in range(0, columns - 1, _TILE):
            some = slice(i, i + _TILE + 1), slice(j, j + _TILE + 1)
            _write_grid(folder / f"tile_{i:03d}_{j:03d}.obj", points[some], normals[some], texture)


def _write_grid(path: Path, points: Array, normals: Array, texture: float) -> None:
    """Write a grid (rows, columns, 3) of points as triangles, two for each cell, that face upwards."""
    rows, columns = points.shape[:2]
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in points.reshape(-1, 3).tolist()]
    lines += [f"vt {x:.6g} {y:.6g}\n" for x, y in (points[:, :, :2] / texture).reshape(-1, 2).tolist()]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in normals.reshape(-1, 3).tolist()]
    at = 1 + np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    faces = np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2).reshape(-1, 3)
    lines += [f"f {i}/{i}/{i} {j}/{j}/{j} {k}/{k}/{k}\n" for i, j, k in faces.tolist()]
    path.write_text("".join(lines), encoding="ascii")
