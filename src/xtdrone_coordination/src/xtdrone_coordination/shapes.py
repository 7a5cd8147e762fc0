"""Shapes for any number of vehicles: grid, circle, sphere, letters of a font, point clouds.

Each function returns the slots of the followers, shape (N-1, 3), metres, ENU, relative to the leader, which is one of
the N vehicles of the shape: the highest of it, so that the others hang below, and the most central where many are
equally high. A shape is as large as the distance asked for between its two nearest vehicles makes it. The names under
which they are asked for stand in ``patterns``.

The same arguments give the same slots, to the bit. Only letters import matplotlib, when they are asked for.
"""

from __future__ import annotations

import io
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_control import bounded_file
from xtdrone_control.bounded_file import ContentError
from xtdrone_coordination.patterns import Offsets, PatternError, rescaled

Points = NDArray[np.float64]

MAX_LETTERS = 100  # of a text
MAX_CLOUD_FILE = 16 * bounded_file.MB
MAX_FONT_FILE = 64 * bounded_file.MB
MAX_TEXT_POINTS = 500_000  # of a cloud whose file is text

_AS_HIGH = 1e-6  # of the shape's height: what lies less below the highest vehicle is as high
_ALL_AS_HIGH = 0.1  # the same for letters and clouds, of which no two need be equally high
_SEED = 0
_MAX_CLOUD = 50_000  # points of a cloud that are looked at; of larger ones so many are drawn
_SPHERE_SHIFT = 0.36  # of a step: how far the lattice's ends stay from the poles for the largest least distance
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_GAP = 0.35  # between two letters, of the letters' height; more than in print, as slots lie farther apart than ink
_BLANK = 0.6  # width of a space, likewise
_COARSE = 96  # pixels to the letters' height, of the picture that is measured and thinned to strokes
_PIXELS = 16  # to a vehicle, at least, of the picture that is filled
_MAX_PIXELS = 4_000_000  # of a picture
_FILLED = 2.5  # vehicles side by side in a stroke from which on letters are filled


def grid(count: int, spacing: float) -> Offsets:
    """Return a level square grid, as much of it as is nearest to its middle, where the leader is."""
    side = math.ceil(math.sqrt(count))
    cells = np.array([(column, -row, 0.0) for row in range(side) for column in range(side)], dtype=float)
    nearest_first = np.argsort(_from_middle(cells), kind="stable")
    return _led(spacing * cells[np.sort(nearest_first[:count])])


def circle(count: int, spacing: float) -> Offsets:
    """Return a level circle; the leader is the vehicle on its east side, which is ahead when it takes off."""
    radius = 0.5 * spacing / math.sin(math.pi / count)
    angle = 2.0 * math.pi * np.arange(count) / count
    points = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    return points[1:] - points[0]


def sphere(count: int, spacing: float) -> Offsets:
    """Return a sphere below the leader, evenly covered by a Fibonacci lattice.

    The lattice's ends are moved away from the poles, which lets the nearest two points lie farther apart (M. Roberts,
    Evenly distributing points on a sphere, 2018).
    """
    index = np.arange(count)
    height = 1.0 - 2.0 * (index + _SPHERE_SHIFT) / (count - 1 + 2.0 * _SPHERE_SHIFT)
    radius, angle = np.sqrt(1.0 - height**2), _GOLDEN_ANGLE * index
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return rescaled(_led(points), spacing)


def text(count: int, spacing: float, words: str, font: str | None = None) -> Offsets:
    """Return upright letters in the x-z plane, to be read from the south (-y).

    Few vehicles lie along the letters' strokes, many fill them.

    Args:
        count: number of vehicles N.
        spacing: least distance of two vehicles, m.
        words: one line of 1 to 100 printable characters.
        font: TrueType or OpenType file; DejaVu Sans if none is given.

    Raises:
        PatternError: the words, the font's file, or a character that the font has not.
    """
    outline = _outline(words, font)
    picture, pitch = _picture(outline, 1.0 / _COARSE)
    area, strokes = float(picture.sum()), _thinned(picture)
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
    return rescaled(_led(points, _ALL_AS_HIGH), spacing)


def cloud(count: int, spacing: float, file: str) -> Offsets:
    """Return ``count`` points of a cloud, as evenly spread over it as can be.

    Args:
        count: number of vehicles N.
        spacing: least distance of two vehicles, m; the file's own unit does not matter.
        file: see :func:`read_cloud`; its z is up.

    Raises:
        PatternError: the file cannot be read or has less than ``count`` different points.
    """
    points = read_cloud(Path(file))
    if len(points) > max(_MAX_CLOUD, count):
        keep = np.random.default_rng(_SEED).choice(len(points), max(_MAX_CLOUD, count), replace=False)
        points = points[np.sort(keep)]
    points = points - points.mean(axis=0)
    chosen = points[farthest(points, count)]
    if len(chosen) < count:
        raise PatternError(f"cloud {file}: {len(chosen)} different points, {count} vehicles need at least {count}")
    return rescaled(_led(chosen, _ALL_AS_HIGH), spacing)


# points


def farthest(points: Points, count: int) -> NDArray[np.intp]:
    """Return the indices of ``count`` points that cover all well: each the farthest from those before it.

    The first is the one farthest from the middle. Fewer come back when no more are different.

    Args:
        points: shape (M, D).
        count: how many.
    """
    columns = [np.ascontiguousarray(column) for column in points.T]
    far = _squares(columns, points.mean(axis=0))
    chosen = [int(far.argmax())]
    far = _squares(columns, points[chosen[0]])
    while len(chosen) < count:
        last = int(far.argmax())
        if far[last] <= 0.0:
            break
        chosen.append(last)
        np.minimum(far, _squares(columns, points[last]), out=far)
    return np.array(chosen)


def _squares(columns: list[Points], place: Points) -> Points:
    """Squared distances of points, given by columns, from a place."""
    total = (columns[0] - place[0]) ** 2
    for column, value in zip(columns[1:], place[1:], strict=True):
        total += (column - value) ** 2
    return total


def _led(points: Points, as_high: float = _AS_HIGH) -> Offsets:
    """Offsets of all others from the most central point of those that are about the highest."""
    height = points[:, 2]
    high = np.flatnonzero(height >= height.max() - as_high * float(np.ptp(height)))
    leader = high[_from_middle(points)[high].argmin()]
    return np.delete(points, leader, axis=0) - points[leader]


def _from_middle(points: Points) -> Points:
    """Level distances from the middle of the points' box, rounded: equal ones are to be equal."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return np.hypot(*(points - middle)[:, :2].T).round(9)


# letters


def _outline(words: str, font: str | None) -> list[Points]:
    """Closed polygons of the letters, in a row, in units of their greatest height, y up."""
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
    """The file of a font that has all characters of ``words``."""
    import matplotlib
    from matplotlib.font_manager import get_font

    file = font or str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf")
    try:
        bounded_file.check(file, MAX_FONT_FILE)
        known = get_font(file).get_charmap()
    except (OSError, RuntimeError) as error:
        raise PatternError(f"font {file}: {_reason(error)}") from error
    missing = dict.fromkeys(c for c in words if c != " " and ord(c) not in known)
    if missing:
        raise PatternError(f"font {file}: has no {' '.join(missing)}")
    return file


def _picture(outline: list[Points], pixel: float) -> tuple[NDArray[np.bool_], float]:
    """Pixels within the outline, shape (rows, columns), the lowest row first, a blank pixel all around; their size.

    A pixel is within when the outline goes round its centre (non-zero winding): the crossings of a row's centre line
    are counted, up or down, where they are, and summed from the left.
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


def _thinned(picture: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The strokes' middle lines, one pixel wide (T. Y. Zhang and C. Y. Suen, CACM 27-3, 1984)."""
    left = picture.copy()
    while True:
        before = int(left.sum())
        for step in (0, 1):
            left &= ~_loose(left, step)
        if int(left.sum()) == before:
            return left


def _loose(picture: NDArray[np.bool_], step: int) -> NDArray[np.bool_]:
    """Pixels of the border that Zhang and Suen's first (0) or second (1) subiteration takes away."""
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
    """Centres of the pixels that are set, shape (M, 2)."""
    return pixel * np.argwhere(picture)[:, ::-1].astype(float)


# clouds


def read_cloud(file: Path) -> Points:
    """Return the points in a file, shape (M, 3), in its own unit.

    ``.ply`` (text or binary, of either byte order), ``.npy`` (shape (M, 3 or more)); every other file is read as text
    with x, y, z in the first three columns, blanks, commas or semicolons between them; ``#`` begins a remark, and a
    first line that holds no numbers is a heading. The file's content is never part of a message: a pattern may be
    asked for over a topic, by a user who may not read the file.

    Raises:
        PatternError: the file cannot be read, is no regular file, is larger than 16 MB or malformed, or a point in it
            is not finite.
    """
    readers = {".ply": _read_ply, ".npy": _read_npy}
    try:
        points = readers.get(file.suffix.lower(), _read_table)(bounded_file.read_bytes(file, MAX_CLOUD_FILE))
    except (OSError, ContentError) as error:
        raise PatternError(f"cloud {file}: {_reason(error)}") from error
    if not len(points):
        raise PatternError(f"cloud {file}: has no points")
    if not np.isfinite(points).all():
        bad = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise PatternError(f"cloud {file}: point {bad} is not finite, all must be")
    return points


def _read_npy(data: bytes) -> Points:
    stream = io.BytesIO(data)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        shape, _, kind = readers[np.lib.format.read_magic(stream)](stream)
    except (KeyError, ValueError, EOFError):
        raise ContentError("is no .npy file") from None
    if len(shape) != 2 or shape[1] < 3 or kind.kind not in "fiu":
        raise ContentError(f"shape {shape} of another type or size; (points, 3) of numbers is needed")
    if math.prod(shape) * kind.itemsize > len(data) - stream.tell():
        raise ContentError(f"ends before its {shape[0]} points")
    values = np.load(io.BytesIO(data), allow_pickle=False)
    return np.asarray(values[:, :3].astype(float))


def _read_table(data: bytes) -> Points:
    rows: list[list[float]] = []
    for number, line in enumerate(_lines(data), 1):
        fields = re.split(r"[\s,;]+", line.partition("#")[0].strip(), maxsplit=3)
        if fields == [""]:
            continue
        try:
            x, y, z, *_ = (float(field) for field in fields[:3])
        except ValueError:
            if not rows and number == 1:
                continue
            raise ContentError(f"line {number}: does not begin with three numbers") from None
        if len(rows) == MAX_TEXT_POINTS:
            raise ContentError(f"line {number}: more than {MAX_TEXT_POINTS} points")
        rows.append([x, y, z])
    return np.array(rows).reshape(-1, 3)


def _lines(data: bytes) -> io.TextIOWrapper:
    """Return the lines of a text, to be read one by one; what is no UTF-8 comes as a character that is no number."""
    return io.TextIOWrapper(io.BytesIO(data), encoding="utf-8", errors="replace")


_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_MANY_DIGITS = 16  # of a number of vertices
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def _read_ply(data: bytes) -> Points:
    """The vertices of a PLY file (G. Turk, The PLY polygon file format, 1994); they must be its first element."""
    head, mark, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not mark:
        raise ContentError("no PLY file: it does not begin with 'ply' and a header up to 'end_header'")
    body = body[body.index(b"\n") + 1 :] if b"\n" in body[:2] else body[1:]
    order, count, properties = _ply_header(head.decode("ascii", "replace"))
    names = [name for name, _ in properties]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) != len(names):
        raise ContentError("vertices have other properties; x, y and z are needed, each once")
    if order == "":
        return _ply_rows(body, count, names)
    vertex = np.dtype([(name, order + kind) for name, kind in properties])
    if len(body) < count * vertex.itemsize:
        raise ContentError(f"ends before its {count} vertices of {vertex.itemsize} bytes")
    values = np.frombuffer(body, vertex, count)
    return np.stack([values[axis].astype(float) for axis in "xyz"], axis=1)


def _ply_rows(body: bytes, count: int, names: list[str]) -> Points:
    """The places of ``count`` vertices, one in each line that is not empty."""
    if count > MAX_TEXT_POINTS:
        raise ContentError(f"{count} points as text, at most {MAX_TEXT_POINTS} are allowed")
    columns = [names.index(axis) for axis in "xyz"]
    rows: list[list[float]] = []
    for fields in (line.split() for line in _lines(body) if line.strip()):
        if len(rows) == count or len(fields) < len(names):
            break
        try:
            rows.append([float(fields[column]) for column in columns])
        except ValueError:
            raise ContentError(f"vertex {len(rows)}: not three numbers") from None
    if len(rows) < count:
        raise ContentError(f"ends before its {count} vertices of {len(names)} numbers")
    return np.array(rows).reshape(-1, 3)


def _ply_header(head: str) -> tuple[str, int, list[tuple[str, str]]]:
    """Byte order, number of vertices, and names and types of their properties."""
    order: str | None = None
    count, properties = -1, []
    for number_of_line, line in enumerate(head.splitlines(), 1):
        match line.split():
            case ["format", name, *_]:
                order = _PLY_ORDERS.get(name)
            case ["element", "vertex", number] if number.isdecimal() and len(number) < _MANY_DIGITS:
                count = int(number)
            case ["element", *_] if count >= 0:
                break
            case ["element", *_]:
                raise ContentError("another element stands before the vertices; they must be the first")
            case ["property", kind, name] if kind in _PLY_TYPES:
                properties.append((name, _PLY_TYPES[kind]))
            case ["property", *_]:
                raise ContentError(f"line {number_of_line}: not allowed of a vertex; properties that are numbers are")
            case _:
                continue
    if order is None or count < 0:
        raise ContentError(f"header has no {'vertices' if order is not None else 'format that is known'}")
    return order, count, properties


def _reason(error: Exception) -> str:
    """What went wrong, without the file's name, which is said before."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
