"""Letters of a font as a pattern: vehicles along their strokes, or filling them.

Only this module needs matplotlib, imported when letters are made.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common import files
from xtdrone_coordination.patterns.slot_offsets_and_spacing import ALL_AS_HIGH, Points, choose_leader, farthest

from .slot_offsets_and_spacing import Offsets, PatternError, rescaled

MAX_LETTERS = 100  # of a text
MAX_FONT_FILE = 64 * files.MB

_GAP = 0.35  # between two letters, of the letters' height; more than in print, as slots lie farther apart than ink
_BLANK = 0.6  # width of a space, of the letters' height
_COARSE = 96  # pixels to the letters' height, of the image that is measured and thinned to strokes
_PIXELS = 16  # per vehicle, at least, in the image that is filled
_MAX_PIXELS = 4_000_000  # of an image
_FILLED = 2.5  # letters whose strokes are at least this many vehicles wide are filled


def text(count: int, spacing: float, words: str, font: str | None = None) -> Offsets:
    """Return upright letters in the x-z plane, read from the south (-y).

    A few vehicles lie along the strokes, many fill them.

    Args:
        count: number of vehicles N.
        spacing: minimum distance of two vehicles, m.
        words: one line of 1 to 100 printable characters.
        font: TrueType or OpenType file; by default DejaVu Sans.

    Raises:
        PatternError: the words or the font file are not allowed, or the font lacks a character.
    """
    outline = _outline(words, font)
    picture, pitch = _picture(outline, 1.0 / _COARSE)
    area, strokes = float(picture.sum()), _thin(picture)
    length = max(float(strokes.sum()), 1.0)
    # a stroke is area / length wide; filled vehicles stand sqrt(area / (0.866 count)) apart
    if area / length >= _FILLED * math.sqrt(area / (0.866 * count)) or length < 8 * count:
        finer = min(math.sqrt(area / (_PIXELS * count)), 1.0)
        picture, pitch = _picture(outline, pitch * finer)
        places = _places(picture, pitch)
    else:
        places = _places(strokes, pitch)
    flat = places[farthest(places, count)]
    points = np.stack([flat[:, 0], np.zeros(count), flat[:, 1]], axis=1)
    return rescaled(choose_leader(points, ALL_AS_HIGH), spacing)


def _outline(words: str, font: str | None) -> list[Points]:
    """Return closed polygons of the letters, in a row, in units of their maximum height, y up."""
    if not words.strip() or len(words) > MAX_LETTERS or not words.isprintable():
        raise PatternError(f"text: {words!r} is not allowed; 1 to {MAX_LETTERS} printable characters")
    from matplotlib.font_manager import FontProperties
    from matplotlib.path import Path as Outline
    from matplotlib.textpath import TextToPath

    properties: Any = FontProperties(fname=_font_file(words, font))
    letters: list[list[Points]] = []
    for character in words:
        corners, codes = TextToPath().get_text_path(properties, character)
        letters.append(Outline(corners, codes).to_polygons(closed_only=True) if len(corners) else [])
    heights = [polygon[:, 1] for letter in letters for polygon in letter]
    unit = float(np.ptp(np.concatenate(heights))) if heights else 0.0
    if unit <= 0.0:
        raise PatternError(f"text: {words!r} has nothing to draw")
    row: list[Points] = []
    right = 0.0
    for letter in letters:
        if not letter:
            right += _BLANK
            continue
        x = np.concatenate([polygon[:, 0] for polygon in letter]) / unit
        row += [polygon / unit + (right - x.min(), 0.0) for polygon in letter]
        right += float(np.ptp(x)) + _GAP
    return row


def _font_file(words: str, font: str | None) -> str:
    """Return the file of a font that has all characters of ``words``."""
    import matplotlib
    from matplotlib.font_manager import get_font

    file = font or str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf")
    try:
        files.check(file, MAX_FONT_FILE)
        known = get_font(file).get_charmap()
    except (OSError, RuntimeError) as error:
        raise PatternError(f"font {file}: {getattr(error, 'strerror', None) or error}") from error
    missing = dict.fromkeys(c for c in words if c != " " and ord(c) not in known)
    if missing:
        raise PatternError(f"font {file}: has no {' '.join(missing)}")
    return file


def _picture(outline: list[Points], pixel: float) -> tuple[NDArray[np.bool_], float]:
    """Return the pixels inside the outline, shape (rows, columns), lowest row first, blank border; and their size.

    A pixel is inside if the winding number of the outline around its centre is not zero: crossings of the centre line
    of a row are counted, upwards or downwards, and accumulated from the left.
    """
    corners = np.vstack(outline)
    low, size = corners.min(axis=0), np.ptp(corners, axis=0)
    pixel = max(pixel, math.sqrt(float(size.prod()) / _MAX_PIXELS))
    columns, rows = (np.ceil(size / pixel).astype(int) + 2).tolist()
    starts = (np.vstack([polygon[:-1] for polygon in outline]) - low) / pixel + 1.0
    ends = (np.vstack([polygon[1:] for polygon in outline]) - low) / pixel + 1.0
    winding = np.zeros((rows, columns + 1), dtype=np.int32)
    for (x0, y0), (x1, y1) in zip(starts.tolist(), ends.tolist(), strict=True):
        below, above = sorted((y0, y1))
        row = np.arange(math.ceil(below - 0.5), math.ceil(above - 0.5))
        if len(row):
            x = x0 + (row + 0.5 - y0) * (x1 - x0) / (y1 - y0)
            winding[row, np.ceil(x - 0.5).astype(int)] += 1 if y1 > y0 else -1
    return np.cumsum(winding, axis=1)[:, :columns] != 0, pixel


def _thin(picture: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the centre lines of the strokes, one pixel wide (T. Y. Zhang and C. Y. Suen, CACM 27-3, 1984)."""
    left = picture.copy()
    while True:
        before = int(left.sum())
        for step in (0, 1):
            left &= ~_loose(left, step)
        if int(left.sum()) == before:
            return left


def _loose(picture: NDArray[np.bool_], step: int) -> NDArray[np.bool_]:
    """Return the border pixels removed by Zhang and Suen's first (0) or second (1) subiteration."""
    padded = np.pad(picture, 1)
    rows, columns = picture.shape
    ring = [padded[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns] for dy, dx in _RING]  # P2 to P9
    around = sum((p.astype(np.int8) for p in ring), np.zeros(picture.shape, dtype=np.int8))
    turns = sum((~p & q).astype(np.int8) for p, q in zip(ring, [*ring[1:], ring[0]], strict=True))
    p2, _, p4, _, p6, _, p8, _ = ring
    open_side = ~(p4 & p6 & (p2 | p8)) if step == 0 else ~(p2 & p8 & (p4 | p6))
    return picture & (around >= 2) & (around <= 6) & (turns == 1) & open_side


_RING = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))


def _places(picture: NDArray[np.bool_], pixel: float) -> Points:
    """Return the centres of the set pixels, shape (M, 2)."""
    return pixel * np.argwhere(picture)[:, ::-1].astype(float)
