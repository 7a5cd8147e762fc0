"""Tracking of corners from image to image, by pyramidal Lucas-Kanade (OpenCV).

Pixel coordinates here are OpenCV's: the centre of the upper left pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from xtdrone_common.settings import Settings, setting

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

_BORDER = 6.0  # px, corners closer to the edge are lost
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
_MOST_SLANT = 1.0  # px, maximum row difference of a corner in a stereo pair
_LEAST_DISPARITY = 0.5  # px
_EDGE = 0.08  # relative difference of neighbouring depths above which they are not one surface


@dataclass(frozen=True)
class TrackSettings(Settings):
    """Private parameters of the corners."""

    corners: int = setting(250, low=20, high=5000, text="maximum number of tracked corners")
    corner_distance: float = setting(
        14.0, low=2.0, high=200.0, unit="px", text="minimum distance between two new corners"
    )
    corner_quality: float = setting(
        0.01, low=1e-4, high=0.5, text="minimum strength of a corner, relative to the strongest"
    )
    window: int = setting(21, low=5, high=61, unit="px", text="side of the tracked patch")
    levels: int = setting(3, low=0, high=6, text="pyramid levels above the image itself")
    most_return: float = setting(
        0.7, above=0.0, high=10.0, unit="px", text="maximum error of tracking a corner forth and back"
    )


def track(
    settings: TrackSettings, before: Grey, after: Grey, pixels: Array, guess: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Track corners into another image; return positions, (n, 2) px, and whether they were found, (n,) bool.

    Each is tracked forth and back.

    Args:
        settings: Settings of the corners.
        before, after: (height, width).
        pixels: (n, 2) px in ``before``.
        guess: (n, 2) px in ``after``.
    """
    if not len(pixels):
        return np.empty((0, 2)), np.empty(0, bool)
    options: dict[str, Any] = {
        "winSize": (settings.window, settings.window),
        "maxLevel": settings.levels,
        "criteria": _CRITERIA,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    start = np.ascontiguousarray(pixels, np.float32).reshape(-1, 1, 2)
    first = np.ascontiguousarray(guess, np.float32).reshape(-1, 1, 2).copy()
    there, seen, _ = cv2.calcOpticalFlowPyrLK(before, after, start, first, **options)
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, start.copy(), **options)
    found = there.reshape(-1, 2).astype(float)
    off = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    height, width = after.shape
    inside = ((found >= _BORDER) & (found <= np.array([width, height]) - 1.0 - _BORDER)).all(axis=1)
    good = (seen.ravel() == 1) & (seen_back.ravel() == 1) & (off < settings.most_return) & inside
    return found, good


def new_corners(settings: TrackSettings, picture: Grey, known: Array, usable: NDArray[np.bool_] | None) -> Array:
    """Return strong corners away from known ones, (n, 2) px, strongest first.

    Args:
        settings: Settings of the corners.
        picture: (height, width).
        known: (m, 2) px.
        usable: (height, width), mask of allowed corner positions; None: everywhere.
    """
    wanted = settings.corners - len(known)
    if wanted <= 0:
        return np.empty((0, 2))
    mask: Any = np.full(picture.shape, 255, np.uint8) if usable is None else usable.astype(np.uint8) * np.uint8(255)
    for x, y in np.round(known).astype(int).tolist():
        cv2.circle(mask, (x, y), round(settings.corner_distance), (0,), -1)
    found = cv2.goodFeaturesToTrack(picture, wanted, settings.corner_quality, settings.corner_distance, mask=mask)
    corners = np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(float)
    height, width = picture.shape
    inside = ((corners >= _BORDER) & (corners <= np.array([width, height]) - 1.0 - _BORDER)).all(axis=1)
    kept: Array = corners[inside]
    return kept


def depth_at(depth: NDArray[np.float32], pixels: Array) -> tuple[Array, Array]:
    """Return depths at pixels, (n,) m, NaN where there is none or on an edge, and slopes of 1 / depth, (n, 2) 1/m/px.

    Args:
        depth: (height, width) m along the optical axis, NaN or 0 where unknown.
        pixels: (n, 2) px, at least 1 px within the image.
    """
    column, row = np.floor(pixels).astype(int).T
    right, down = (pixels - np.floor(pixels)).T
    around = np.stack([depth[row + i, column + j] for i in (0, 1) for j in (0, 1)]).astype(float)
    around[~(around > 0.0)] = np.nan
    share = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right])
    corners = 1.0 / around
    inverse = (share * corners).sum(axis=0)  # the inverse depth of a plane is linear in the image
    along = (1 - down) * (corners[1] - corners[0]) + down * (corners[3] - corners[2])
    across = (1 - right) * (corners[2] - corners[0]) + right * (corners[3] - corners[1])
    spread = around.max(axis=0) - around.min(axis=0)
    found: Array = np.where(spread * inverse <= _EDGE, 1.0 / inverse, np.nan)
    return found, np.nan_to_num(np.column_stack([along, across]))


def stereo_depth(settings: TrackSettings, left: Grey, right: Grey, pixels: Array, base: float, guess: Array) -> Array:
    """Return the depths (n,) m of corners of the left image of a rectified pair; NaN where none was found.

    Args:
        settings: Settings of the corners.
        left, right: (height, width).
        pixels: (n, 2) px in the left image.
        base: focal length times baseline, px m.
        guess: (n,) m, depth where it is known, NaN elsewhere.
    """
    shift = np.where(np.isfinite(guess), base / np.where(guess > 0.0, guess, np.inf), 0.0)
    start = pixels - np.stack([shift, np.zeros(len(pixels))], axis=1)
    there, good = track(settings, left, right, pixels, start)
    disparity = pixels[:, 0] - there[:, 0]
    good &= (np.abs(there[:, 1] - pixels[:, 1]) <= _MOST_SLANT) & (disparity >= _LEAST_DISPARITY)
    return np.where(good, base / np.where(good, disparity, 1.0), np.nan)
