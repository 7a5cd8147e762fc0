"""Reader and writer of octomap's serialised octrees: the data of octomap_msgs/Octomap, and the files .bt and .ot.

Every inner node of the binary format is two bits for each of its eight children, lowest first: 0 unknown, 1 free,
2 occupied, 3 an inner node, which follows; inner nodes are stored depth first. Every node of the full format is its
log-odds (float32) and a byte that flags which children follow. Eight equal leaves are merged into one. The formats are
those of octomap's OcTree.cpp and OccupancyOcTreeBase.hxx (BSD), version 1.6 and later.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.files import read_bytes
from xtdrone_common.settings import SettingError
from xtdrone_planning.kernel import kernel
from xtdrone_planning.octree.octree_kernels import HALF
from xtdrone_planning.octree.octree_map import NEVER, morton

Array = NDArray[np.float64]

DEPTH = 16
ENDINGS = (".bt", ".ot")
"""Of octomap's files: with free and occupied leaves, and with log-odds."""

_IN_BLOCK = 4  # levels of a block
_ABOVE = DEPTH - _IN_BLOCK
_WORDS = 1 + 8 + 64 + 512  # inner nodes of a block, at most
_NEVER = int(NEVER)
_FREE, _OCCUPIED, _INNER = 1, 2, 3
_BINARY_LINE, _FULL_LINE = "# Octomap OcTree binary file", "# Octomap OcTree file"
_LARGEST = 1 << 30  # bytes of a file
_MOST_VOXELS = 200_000_000  # of the leaves read; guards against damaged or hostile files


class OctreeError(ValueError):
    """Data that are not an octomap octree; the message names the problem and what is allowed."""


class Octree(NamedTuple):
    """A serialised octree.

    Attributes:
        data: after the header of a file; also of the message.
        size: number of nodes; 0: empty.
        resolution: side of a voxel, m.
        binary: whether leaves are only free or occupied.
    """

    data: bytes
    size: int
    resolution: float
    binary: bool


class Leaves(NamedTuple):
    """Leaves of a deserialised octree.

    Attributes:
        corners: (n, 3) lowest voxel of each, relative to the octree's centre.
        sides: (n,) voxels along an edge.
        occupied: (n,) whether the log-odds are at least 0.
        resolution: side of a voxel, m.
    """

    corners: NDArray[np.int64]
    sides: NDArray[np.int64]
    occupied: NDArray[np.bool_]
    resolution: float

    def middles(self) -> Array:
        """Return the centres of the occupied voxels, those of large leaves included, (n, 3) m."""
        chosen = np.flatnonzero(self.occupied)
        counts = self.sides[chosen] ** 3
        owner = np.repeat(chosen, counts)
        inside = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        side = self.sides[owner]
        offsets = np.stack([inside % side, inside // side % side, inside // (side * side)], axis=1)
        return np.asarray((self.corners[owner] + offsets + 0.5) * self.resolution, float)


# writing


class _Level(NamedTuple):
    """The inner nodes of one level, in Morton order.

    Attributes:
        codes: (n,) Morton codes.
        values: (n,) log-odds in hundredths, the highest of all leaves below.
        children: (n, 8) states of the children: 0 for unknown, ``_FREE``, ``_OCCUPIED`` or ``_INNER``.
        child_values: (n, 8) their log-odds.
    """

    codes: NDArray[np.int64]
    values: NDArray[np.int16]
    children: NDArray[np.uint8]
    child_values: NDArray[np.int16]


def encode(places: NDArray[np.int64], values: NDArray[np.int16], resolution: float, binary: bool) -> Octree:
    """Return the octree of some blocks of voxels.

    Args:
        places: (n, 3) of the blocks, in Morton order; see ``OctreeMap.blocks``.
        values: (n, 4096) log-odds in hundredths, ``NEVER`` where unknown.
        resolution: side of a voxel, m.
        binary: whether leaves are only free or occupied.
    """
    if not len(places):
        return Octree(b"", 0, resolution, binary)
    data = _binary(places, values) if binary else _full_data(_levels(places, values))
    return Octree(data, count_nodes(data, binary), resolution, binary)


def _binary(places: NDArray[np.int64], values: NDArray[np.int16]) -> bytes:
    """Return the binary data: nodes above blocks, with the data of each block after its parent's."""
    words = np.zeros((len(values), _WORDS), np.uint16)
    counts, states = np.zeros(len(values), np.int64), np.zeros(len(values), np.uint8)
    _block_words(values, words, counts, states)
    codes = morton(places)
    keys, parts = [], []
    inner = np.flatnonzero(states == _INNER)
    keys.append(_depth_first(codes[inner], _ABOVE))
    parts += [words[n, : counts[n]].astype("<u2").tobytes() for n in inner]
    for level in range(_ABOVE - 1, -1, -1):
        parents, owner = np.unique(codes >> 3, return_inverse=True)
        children = np.zeros((len(parents), 8), np.uint8)
        children[owner, codes & 7] = states
        is_one = (children == children[:, :1]).all(axis=1) & (children[:, 0] != _INNER) & (level > 0)
        codes, states = parents, np.where(is_one, children[:, 0], _INNER).astype(np.uint8)
        keys.append(_depth_first(codes[~is_one], level))
        pairs = children[~is_one].astype(np.uint16) << (2 * np.arange(8, dtype=np.uint16))
        parts += [word.tobytes() for word in pairs.sum(axis=1, dtype=np.uint16).astype("<u2")]
    order = np.argsort(np.concatenate(keys))
    return b"".join(parts[n] for n in order)


@kernel
def _block_words(values, words, counts, states):
    """Write the inner nodes of blocks depth first.

    Args:
        values: (n, 4096) int16, log-odds.
        words: (n, 585) uint16, filled: two bits for each child.
        counts: (n,) filled: number of words.
        states: (n,) uint8, filled: that of the block.
    """
    level = np.empty((5, 4096), np.uint8)  # states of voxels, of their parents, ...
    for n in range(len(values)):
        for v in range(4096):
            value = values[n, v]
            level[0, v] = 0 if value == _NEVER else (_OCCUPIED if value >= 0 else _FREE)
        size = 512
        for d in range(1, 5):
            for k in range(size):
                first = level[d - 1, 8 * k]
                for c in range(1, 8):
                    if level[d - 1, 8 * k + c] != first:
                        first = _INNER
                level[d, k] = first
            size //= 8
        states[n] = level[4, 0]
        count = 0
        if states[n] == _INNER:
            words[n, 0] = _word(level[3], 0)
            count = 1
            for a in range(8):
                if level[3, a] != _INNER:
                    continue
                words[n, count] = _word(level[2], a)
                count += 1
                for b in range(8 * a, 8 * a + 8):
                    if level[2, b] != _INNER:
                        continue
                    words[n, count] = _word(level[1], b)
                    count += 1
                    for c in range(8 * b, 8 * b + 8):
                        if level[1, c] == _INNER:
                            words[n, count] = _word(level[0], c)
                            count += 1
        counts[n] = count


@kernel
def _word(states, parent):
    """Return the states of a node's eight children as one word."""
    word = np.int64(0)
    for c in range(8):
        word |= np.int64(states[8 * parent + c]) << (2 * c)
    return word


def _levels(places: NDArray[np.int64], values: NDArray[np.int16]) -> list[_Level]:
    """Return the inner nodes of all levels, from the root to the parents of voxels."""
    codes, states = morton(places), _leaf_states(values)
    found: list[_Level] = []
    for level in range(DEPTH - 1, -1, -1):
        if level >= _ABOVE:
            children, below = states.reshape(-1, 8), values.reshape(-1, 8)
            inside = states.shape[1] // 8
            parents = (codes[:, None] * inside + np.arange(inside)).ravel()
        else:
            parents, owner = np.unique(codes >> 3, return_inverse=True)
            children = np.zeros((len(parents), 8), np.uint8)
            below = np.full((len(parents), 8), NEVER, np.int16)
            children[owner, codes & 7], below[owner, codes & 7] = states.ravel(), values.ravel()
        is_inner = ~_are_one(children, below)
        is_inner |= level == 0
        own_states, own_values = np.where(is_inner, _INNER, children[:, 0]).astype(np.uint8), below.max(axis=1)
        found.append(_Level(parents[is_inner], own_values[is_inner], children[is_inner], below[is_inner]))
        if level > _ABOVE:
            states, values = own_states.reshape(len(codes), -1), own_values.reshape(len(codes), -1)
        else:
            codes, states, values = parents, own_states, own_values
    return found[::-1]


def _leaf_states(values: NDArray[np.int16]) -> NDArray[np.uint8]:
    return np.where(values == NEVER, 0, np.where(values >= 0, _OCCUPIED, _FREE)).astype(np.uint8)


def _are_one(states: NDArray[np.uint8], values: NDArray[np.int16]) -> NDArray[np.bool_]:
    """Return (n,) whether all eight children (n, 8) are equal leaves or unknown."""
    equal = (states == states[:, :1]).all(axis=1) & (states[:, 0] != _INNER)
    return equal & (values == values[:, :1]).all(axis=1)


def _depth_first(codes: NDArray[np.int64], level: int) -> NDArray[np.int64]:
    """Return sort keys (n,) that order nodes of all levels depth first."""
    return (codes << 3 * (DEPTH - level)) * 32 + level


_NODE = np.dtype([("value", "<f4"), ("children", "u1")])


def _full_data(levels: list[_Level]) -> bytes:
    bits = [((level.children > 0) << np.arange(8)).sum(axis=1).astype(np.uint8) for level in levels]
    keys, nodes = [_depth_first(levels[0].codes, 0)], [_nodes(levels[0].values, bits[0])]
    for n, level in enumerate(levels, start=1):
        parent, child = np.nonzero(level.children)
        below = np.zeros(len(parent), np.uint8)
        if n < DEPTH:
            below[level.children[parent, child] == _INNER] = bits[n]  # both are in Morton order
        keys.append(_depth_first(level.codes[parent] << 3 | child, n))
        nodes.append(_nodes(level.child_values[parent, child], below))
    return np.concatenate(nodes)[np.argsort(np.concatenate(keys))].tobytes()


def _nodes(values: NDArray[np.int16], children: NDArray[np.uint8]) -> NDArray[np.void]:
    nodes = np.zeros(len(values), _NODE)
    nodes["value"], nodes["children"] = values / 100.0, children
    return nodes


def count_nodes(data: bytes, binary: bool) -> int:
    """Return the number of nodes of a serialised octree."""
    if not binary or not data:
        return len(data) // _NODE.itemsize
    words = np.frombuffer(data[: len(data) // 2 * 2], "<u2")
    return 1 + sum(int(np.count_nonzero(words >> 2 * child & 3)) for child in range(8))


def file_of(octree: Octree) -> bytes:
    """Return the contents of a .bt or .ot file."""
    first = _BINARY_LINE if octree.binary else _FULL_LINE
    header = f"{first}\nid OcTree\nsize {octree.size}\nres {octree.resolution:.17g}\ndata\n"
    return header.encode() + octree.data


def check_octree_file(name: str) -> None:
    """Check the setting ``file``: empty, or a name with an ending of octomap's files.

    Raises:
        SettingError: another ending.
    """
    if name and Path(name).suffix not in ENDINGS:
        raise SettingError("file", name, f"a name that ends in {' or '.join(ENDINGS)}")


# reading


def read_file(path: Path) -> Leaves:
    """Return the leaves of a .bt or .ot file.

    Raises:
        OctreeError: it is not such a file, or it is damaged.
        OSError: it cannot be read, or is larger than 1 GB.
    """
    contents = read_bytes(path, _LARGEST)
    header, found, data = contents.partition(b"\ndata\n")
    first, *lines = header.decode(errors="replace").splitlines() or [""]
    if not found or first not in (_BINARY_LINE, _FULL_LINE):
        raise OctreeError(f"{path}: {first[:60]!r} is not allowed, a .bt or .ot file of octomap")
    fields = dict(line.split(" ", 1) for line in lines if " " in line and not line.startswith("#"))
    try:
        size, resolution = int(fields["size"]), float(fields["res"])
    except (KeyError, ValueError) as error:
        raise OctreeError(f"{path}: size or res in its header cannot be read") from error
    if fields.get("id") != "OcTree":
        raise OctreeError(f"{path}: id {fields.get('id')!r} is not allowed, OcTree")
    return decode(Octree(data, size, resolution, first == _BINARY_LINE))


def decode(octree: Octree) -> Leaves:
    """Return the leaves of an octree.

    Raises:
        OctreeError: the data are damaged.
    """
    if not 0.0 < octree.resolution < math.inf:
        raise OctreeError(f"resolution: {octree.resolution} is not allowed, above 0 and finite, m")
    data = np.frombuffer(octree.data, np.uint8)
    capacity = 4 * len(data) + 8 if octree.binary else len(data) // _NODE.itemsize
    corners, sides = np.zeros((capacity, 3), np.int64), np.zeros(capacity, np.int64)
    occupied = np.zeros(capacity, np.bool_)
    values = np.zeros(0, np.float32)
    if not octree.binary:
        nodes = np.frombuffer(octree.data[: capacity * _NODE.itemsize], _NODE)
        data, values = nodes["children"].copy(), nodes["value"].copy()
    count = 0 if not octree.size else int(_read(data, values, octree.binary, corners, sides, occupied))
    if count < 0 or int((sides[:count][occupied[:count]] ** 3).sum()) > _MOST_VOXELS:
        raise OctreeError(f"octree of {len(octree.data)} bytes: truncated, too deep or too large")
    return Leaves(corners[:count], sides[:count], occupied[:count], octree.resolution)


@kernel
def _read(data, values, binary, corners, sides, occupied):
    """Fill the leaves of an octree; return their number, or -1 if the data are truncated or too deep.

    Args:
        data: uint8; binary: all bytes; otherwise the children of each node.
        values: float32, the log-odds of each node, unless binary.
        binary: which format.
        corners, sides, occupied: see ``Leaves``; filled.
    """
    stack = np.empty((8 * DEPTH + 8, 4), np.int64)  # lowest voxel and level of pending nodes, the next one last
    stack[0] = (-HALF, -HALF, -HALF, 0)
    waiting, place, count = 1, 0, 0
    while waiting:
        waiting -= 1
        x, y, z, level = stack[waiting]
        side = 1 << (DEPTH - level - 1)
        if (binary and place + 2 > len(data)) or (not binary and place >= len(data)):
            return -1
        if binary:
            word = np.int64(data[place]) | np.int64(data[place + 1]) << 8
            place += 2
        else:
            word = np.int64(0)
            for c in range(8):
                if data[place] >> c & 1:
                    word |= _INNER << (2 * c)
            if word == 0:
                corners[count, 0], corners[count, 1], corners[count, 2] = x, y, z
                sides[count], occupied[count] = 2 * side if level < DEPTH else 1, values[place] >= 0.0
                count += 1
                place += 1
                continue
            place += 1
        if level >= DEPTH:
            return -1
        for c in range(7, -1, -1):
            state = word >> (2 * c) & 3
            cx, cy, cz = x + side * (c & 1), y + side * (c >> 1 & 1), z + side * (c >> 2)
            if state == _INNER:
                stack[waiting] = (cx, cy, cz, level + 1)
                waiting += 1
            elif state:
                if count >= len(corners):
                    return -1
                corners[count, 0], corners[count, 1], corners[count, 2] = cx, cy, cz
                sides[count], occupied[count] = side, state == _OCCUPIED
                count += 1
    return count
