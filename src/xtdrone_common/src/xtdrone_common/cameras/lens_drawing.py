"""Images of lenses, resampled from the pinhole images that a renderer draws.

A lens with a field of view little wider than its pinhole's is drawn as one wider pinhole image. One with a wider view,
up to the full sphere, is drawn as up to six images, the faces of a cube, stacked vertically in one *sheet*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.cameras.lenses import Equidistant, PlumbBob
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.rotation import Quaternion

MOST_GROWTH = 3.0
"""Limit of width and height of the image that a lens needs, as a multiple of its own."""

_AHEAD: Quaternion = (1.0, 0.0, 0.0, 0.0)
_HALF = math.sqrt(0.5)
_FACES: tuple[Quaternion, ...] = (
    _AHEAD,
    (_HALF, 0.0, 0.0, _HALF),  # to the left
    (_HALF, 0.0, 0.0, -_HALF),  # to the right
    (_HALF, 0.0, -_HALF, 0.0),  # up
    (_HALF, 0.0, _HALF, 0.0),  # down
    (0.0, 0.0, 0.0, 1.0),  # back
)
"""Orientations of the cube's faces in the camera's frame (x ahead, y left, z up)."""
_AXES = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
    ],
    float,
)
"""For each face, its x, y and z axes (REP 103's optical frame: right, down, ahead) in the optical frame of the camera.
"""
_MARGIN = 2  # margin, pixels, so that interpolation near an edge of a face uses only pixels of that face
_NOWHERE = -10.0  # a place outside of every image


@dataclass(frozen=True)
class Drawing:
    """Recipe for a lens's image.

    Attributes:
        pinhole: camera of each image to draw; together they cover the lens's field of view.
        faces: orientation of each image's camera in that of the lens (x ahead, y left, z up).
        columns, rows: of the lens's pixels in the sheet, (height, width) float32; the centre of the upper left pixel is
            (0, 0), as in OpenCV. Pixels without a ray have places outside the sheet.
        plain: the same for the pixels of the lens's ``pinhole``, which give the image without distortion.
    """

    pinhole: Pinhole
    faces: tuple[Quaternion, ...]
    columns: NDArray[np.float32]
    rows: NDArray[np.float32]
    plain: tuple[NDArray[np.float32], NDArray[np.float32]]


@lru_cache(maxsize=32)
def drawing_of(lens: PlumbBob | Equidistant) -> Drawing:
    """Return how to draw a lens's images.

    Raises:
        ValueError: some pixel of the lens has no ray, or the lens needs an image larger than ``MOST_GROWTH`` times its
            own.
    """
    own = lens.pinhole
    columns, rows = np.meshgrid(np.arange(own.width) + 0.5, np.arange(own.height) + 0.5)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = lens.rays(pixels)
    single = _single(lens, rays)
    if isinstance(lens, Equidistant):
        cube, used = _cube(lens, rays)
        if single is None or single.width * single.height > cube.width * cube.height * len(used):
            faces = tuple(_FACES[k] for k in used)
            shown, plain = (_in_cube(cube, used, some) for some in (rays, own.rays(pixels)))
            return Drawing(cube, faces, *_maps(own, shown), _maps(own, plain))
    if single is None:
        raise ValueError(_too_wide(lens, rays))
    shown, plain = (_in_single(single, some) for some in (rays, own.rays(pixels)))
    return Drawing(single, (_AHEAD,), *_maps(own, shown), _maps(own, plain))


def _maps(own: Pinhole, places: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    maps = places.astype(np.float32).reshape(own.height, own.width, 2)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


def _needed(own: Pinhole, rays: NDArray[np.float64]) -> tuple[int, int]:
    """Return width and height, pixels, of the pinhole image that contains all rays, which must point ahead."""
    across, down = np.abs(rays[:, :2] / rays[:, 2:]).max(axis=0)
    return 2 * math.ceil(across * own.fx + 1.0), 2 * math.ceil(down * own.fy + 1.0)


def _single(lens: PlumbBob | Equidistant, rays: NDArray[np.float64]) -> Pinhole | None:
    """Return the single pinhole whose image contains all rays; None if that image is too large."""
    own = lens.pinhole
    seen = rays[~np.isnan(rays[:, 2])]
    if (seen[:, 2] < 1e-3).any():
        return None
    width, height = _needed(own, seen)
    if width > MOST_GROWTH * own.width + 4 or height > MOST_GROWTH * own.height + 4:
        return None
    return Pinhole(width, height, own.fx, own.fy, 0.5 * width, 0.5 * height)


def _too_wide(lens: PlumbBob | Equidistant, rays: NDArray[np.float64]) -> str:
    own = lens.pinhole
    width, height = _needed(own, rays)
    text = ", ".join(f"{value:g}" for value in lens.coefficients)
    return (
        f"distortion: [{text}] is not allowed, it needs a view of {width}x{height} pixels, at most "
        f"{MOST_GROWTH:g} times {own.width}x{own.height}"
    )


def _in_single(pinhole: Pinhole, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixel positions of rays in the image of one pinhole, (n, 2)."""
    with np.errstate(invalid="ignore"):
        flat = rays[:, :2] / rays[:, 2:]
    places = flat * (pinhole.fx, pinhole.fy) + (pinhole.cx - 0.5, pinhole.cy - 0.5)
    return np.where(np.isnan(places), _NOWHERE, places)


def _cube(lens: Equidistant, rays: NDArray[np.float64]) -> tuple[Pinhole, list[int]]:
    """Return the camera of a cube's faces, and which of ``_FACES`` are needed for rays.

    A face has at least as many pixels per angle as the lens.

    Raises:
        ValueError: the faces would be too large.
    """
    seen = rays[~np.isnan(rays[:, 2])]
    farthest = float(np.arccos(np.clip(seen[:, 2].min(), -1.0, 1.0)))
    focal = math.ceil(lens.pinhole.fx * lens.scales(np.linspace(0.0, farthest, 1000)).max())
    side = 2 * (focal + _MARGIN)
    most = MOST_GROWTH * max(lens.pinhole.width, lens.pinhole.height) + 2 * _MARGIN
    if side > most:
        text = ", ".join(f"{value:g}" for value in lens.coefficients)
        raise ValueError(
            f"distortion: [{text}] is not allowed, it needs views of {side}x{side} pixels, at most {most:g}"
        )
    used = np.unique(_face_of(seen)[0]).tolist()
    return Pinhole(side, side, float(focal), float(focal), 0.5 * side, 0.5 * side), used


def _face_of(rays: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the face of the cube that each ray hits, and the ray in that face's optical frame."""
    face = np.argmax(rays @ _AXES[:, 2].T, axis=1)
    return face, np.einsum("nij,nj->ni", _AXES[face], rays)


def _in_cube(cube: Pinhole, used: list[int], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixel positions of rays in the sheet of the used faces, (n, 2)."""
    row = np.full(len(_FACES), -1)
    row[used] = np.arange(len(used))
    there = ~np.isnan(rays[:, 2])
    face, turned = _face_of(np.where(there[:, None], rays, (0.0, 0.0, 1.0)))
    places = turned[:, :2] / turned[:, 2:] * cube.fx + (cube.cx - 0.5)
    places[:, 1] += row[face] * cube.height
    return np.where((there & (row[face] >= 0))[:, None], places, _NOWHERE)
