"""Point clouds as patterns: files of points, thinned evenly to the number of vehicles."""

from __future__ import annotations

import io
import math
import re
from pathlib import Path

import numpy as np

from xtdrone_common import files
from xtdrone_common.files import ContentError
from xtdrone_coordination.patterns.slot_offsets_and_spacing import ALL_AS_HIGH, Points, choose_leader, farthest

from .slot_offsets_and_spacing import Offsets, PatternError, rescaled

MAX_CLOUD_FILE = 16 * files.MB
MAX_TEXT_POINTS = 500_000  # of a cloud whose file is text

_SEED = 0
_MAX_CLOUD = 50_000  # points of a cloud that are considered; larger clouds are sampled at random first
_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_MANY_DIGITS = 16  # of a number of vertices
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def cloud(count: int, spacing: float, file: str) -> Offsets:
    """Return ``count`` points of a cloud, evenly spread over it.

    Args:
        count: number of vehicles N.
        spacing: minimum distance of two vehicles, m; the unit of the file is irrelevant.
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
    return rescaled(choose_leader(chosen, ALL_AS_HIGH), spacing)


def read_cloud(file: Path) -> Points:
    """Return the points in a file, shape (M, 3), in the unit of the file.

    ``.ply`` (text or binary, of either byte order), ``.npy`` (shape (M, 3 or more)); any other file is read as text
    with x, y, z in the first three columns, separated by blanks, commas or semicolons; ``#`` begins a comment, and a
    first line without numbers is a heading. Messages never quote the content of a file: a pattern may be requested over
    a topic by a user without read permission.

    Raises:
        PatternError: the file cannot be read, is not a regular file, is larger than 16 MB or malformed, or a point in
            it
            is not finite.
    """
    readers = {".ply": _read_ply, ".npy": _read_npy}
    try:
        points = readers.get(file.suffix.lower(), _read_table)(files.read_bytes(file, MAX_CLOUD_FILE))
    except (OSError, ContentError) as error:
        raise PatternError(f"cloud {file}: {getattr(error, 'strerror', None) or error}") from error
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
    except Exception:  # any exception of the parser, of which numpy declares few
        raise ContentError("is not an .npy file") from None
    whole = all(0 <= length <= MAX_CLOUD_FILE for length in shape)
    if not whole or len(shape) != 2 or shape[1] < 3 or kind.kind not in "fiu":
        raise ContentError("has an array of another type or size; (points, 3) of numbers is needed")
    if math.prod(shape) * kind.itemsize > len(data) - stream.tell():
        raise ContentError(f"ends before its {shape[0]} points")
    try:
        values = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception:
        raise ContentError("is not an .npy file") from None
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
    """Return a reader of the lines of a text; invalid UTF-8 becomes a character that is not part of a number."""
    return io.TextIOWrapper(io.BytesIO(data), encoding="utf-8", errors="replace")


def _read_ply(data: bytes) -> Points:
    """Return the vertices of a PLY file, its first element (G. Turk, The PLY polygon file format, 1994)."""
    head, mark, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not mark:
        raise ContentError("not a PLY file: it does not begin with 'ply' and a header up to 'end_header'")
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
    """Return the positions of ``count`` vertices, one per non-empty line."""
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
    """Return byte order, number of vertices, and names and types of their properties."""
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
                raise ContentError("another element precedes the vertices; they must come first")
            case ["property", kind, name] if kind in _PLY_TYPES:
                properties.append((name, _PLY_TYPES[kind]))
            case ["property", *_]:
                raise ContentError(f"line {number_of_line}: this property of a vertex is not allowed; only numbers are")
            case _:
                continue
    if order is None or count < 0:
        raise ContentError(f"header has no {'vertices' if order is not None else 'known format'}")
    return order, count, properties
