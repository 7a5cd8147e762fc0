"""Plates with AprilTags, as black and white boxes side by side, which both renderers draw with sharp edges.

No box covers another, because surfaces a millimetre apart flicker with a depth buffer of 16 bits.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose, compose
from xtdrone_common.settings import SettingError
from xtdrone_common.tag_boards import Tag, TagBoard
from xtdrone_worlds.shapes.visual import Box, Collision, Visual
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel

CELLS = 8  # of a tag of 36h11 along its edge, with the black border
BLACK, WHITE = (0.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0, 1.0)
_EQUAL = 1e-9  # m


def cells_of(number: int) -> NDArray[np.bool_]:
    """Return the black cells of a tag of 36h11 as a mask, (8, 8), upper row first, as its authors print it.

    OpenCV's dictionary has the same patterns turned by 180 degrees.
    """
    import cv2  # slow to import, and needed only for boards

    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    picture = np.asarray(cv2.aruco.generateImageMarker(family, number, CELLS, borderBits=1))
    return np.asarray(np.rot90(picture, 2) < 128)


def plate(board: TagBoard, length: float, width: float, thickness: float, top: Pose) -> list[Visual]:
    """Return a white plate with a board in its middle.

    Args:
        board: tags, which fit on the plate with a white margin of one cell.
        length, width, thickness: of the plate, m.
        top: pose of the centre of its upper face, z upwards.

    Raises:
        SettingError: the tags do not fit, or overlap.
    """
    _check_room(board, length, width)
    lines = sorted({y for tag in board.tags for y in _edges(tag.y, tag.size)} | {-0.5 * width, 0.5 * width})
    visuals: list[Visual] = []
    for low, high in itertools.pairwise(lines):
        if high - low > _EQUAL:
            for left, right, black in _runs(board, 0.5 * (low + high), length):
                box = Box((round(right - left, 9), round(high - low, 9), thickness))
                place = Pose((round(0.5 * (left + right), 9), round(0.5 * (low + high), 9), -0.5 * thickness))
                visuals.append(Visual(box, compose(top, place), BLACK if black else WHITE))
    return visuals


def model(name: str, board: TagBoard, length: float, width: float) -> SdfModel:
    """Return a board that lies on the ground, as a model of the world, 2 cm thick."""
    thickness = 0.02
    top = Pose((0.0, 0.0, thickness))
    solid = Collision(Box((length, width, thickness)), Pose((0.0, 0.0, 0.5 * thickness)))
    link = SdfLink("link", visuals=tuple(plate(board, length, width, thickness, top)), collisions=(solid,))
    return SdfModel(name, Pose(), True, (link,))


def _edges(middle: float, size: float) -> list[float]:
    """Return the coordinates between the cells of a tag along one axis, rounded so that equal ones are equal."""
    return [round(middle + (k / CELLS - 0.5) * size, 9) for k in range(CELLS + 1)]


def _runs(board: TagBoard, y: float, length: float) -> list[tuple[float, float, bool]]:
    """Return the black and white runs (begin, end, whether black) along x on the line at ``y``, m."""
    black: list[tuple[float, float]] = []
    for tag in board.tags:
        row = int(np.floor((0.5 - (y - tag.y) / tag.size) * CELLS))
        if 0 <= row < CELLS:
            edges = _edges(tag.x, tag.size)
            black += [(edges[k], edges[k + 1]) for k in range(CELLS) if cells_of(tag.id)[row, k]]
    runs: list[tuple[float, float, bool]] = []
    at = -0.5 * length
    for begin, end in sorted(black):
        if begin > at + _EQUAL:
            runs.append((at, begin, False))
        if runs and runs[-1][2] and begin <= runs[-1][1] + _EQUAL:
            runs[-1] = (runs[-1][0], end, True)
        else:
            runs.append((begin, end, True))
        at = end
    if 0.5 * length > at + _EQUAL:
        runs.append((at, 0.5 * length, False))
    return runs


def _check_room(board: TagBoard, length: float, width: float) -> None:
    margins = [_half(tag) for tag in board.tags]
    for tag, half in zip(board.tags, margins, strict=True):
        if abs(tag.x) + half > 0.5 * length + _EQUAL or abs(tag.y) + half > 0.5 * width + _EQUAL:
            raise SettingError(
                f"tag {tag.id}", tag.size, f"on {length:g} x {width:g} m with a white margin of one cell"
            )
    for (one, a), (other, b) in itertools.combinations(zip(board.tags, margins, strict=True), 2):
        if max(abs(one.x - other.x), abs(one.y - other.y)) < a + b - max(one.size, other.size) / CELLS - _EQUAL:
            raise SettingError(f"tag {one.id}", one.size, f"apart from tag {other.id}")


def _half(tag: Tag) -> float:
    return tag.size * (0.5 + 1.0 / CELLS)
