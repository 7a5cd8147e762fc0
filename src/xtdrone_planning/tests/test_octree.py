"""The global octree: the effect of rays, bounded memory, and octomap's formats."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_planning.octree.octree_format import Octree, OctreeError, count_nodes, decode, encode, file_of, read_file
from xtdrone_planning.octree.octree_map import NEVER, OctreeMap, OctreeSettings, blocks_of, in_block, log_odds, morton
from xtdrone_planning.octree.octree_messages import seen_from_above

HALF = 1 << 15


def map_of(origin, ends, hits, times=1, **options) -> OctreeMap:
    found = OctreeMap(OctreeSettings(**{"memory": 20.0, **options}))
    for _ in range(times):
        found.insert(np.tile(np.asarray(origin, float), (len(ends), 1)), np.asarray(ends, float), np.asarray(hits))
    return found


def values_of(octree: OctreeMap) -> dict[tuple[int, ...], int]:
    """Return the log-odds of all known voxels by their position relative to the origin."""
    places, values = octree.blocks()
    block, voxel = np.nonzero(values != NEVER)
    cells = 16 * places[block] + in_block()[voxel] - HALF
    return dict(zip(map(tuple, cells.tolist()), values[block, voxel].tolist(), strict=True))


def random_map(seed: int, **options) -> OctreeMap:
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-9.0, 9.0, (200, 3)) * (1.0, 1.0, 0.3)
    return map_of((0.05, -0.03, 0.11), ends, rng.random(200) < 0.7, **options)


@given(st.lists(st.tuples(*[st.floats(-20.0, 20.0)] * 3), max_size=30), st.sampled_from([0.1, 0.37]), st.booleans())
@settings(max_examples=12, deadline=None)
def test_an_octree_of_points_has_their_voxels_and_no_other(points, resolution, binary):
    points = np.array(points, float).reshape(-1, 3)
    read = decode(encode(*blocks_of(points, resolution), resolution, binary)).middles()
    found = set(map(tuple, np.rint(read / resolution - 0.5).astype(int).tolist()))
    assert found == set(map(tuple, np.floor(points / resolution).astype(int).tolist()))
    assert len(read) == len(found)


def test_points_beyond_the_octree_are_left_out():
    points = np.array([[0.05, 0.05, 0.05], [4000.0, 0.0, 0.0], [0.0, -4000.0, 0.0]])
    assert decode(encode(*blocks_of(points, 0.1), 0.1, True)).middles() == pytest.approx(points[:1])


def test_log_odds_are_octomaps():
    assert [log_odds(p) for p in (0.7, 0.4, 0.12, 0.97)] == [85, -41, -199, 348]


def test_a_ray_passes_the_voxels_that_dense_samples_of_it_pass_and_ends_occupied():
    rng = np.random.default_rng(3)
    for _ in range(30):
        origin, end = rng.uniform(-8.0, 8.0, (2, 3))
        known = values_of(map_of(origin, [end], [True]))
        part = np.linspace(0.0, 1.0, 20001)[:, None]
        sampled = set(map(tuple, np.floor((origin + part * (end - origin)) / 0.2).astype(int).tolist()))
        assert sampled <= known.keys()
        assert len(known.keys() - sampled) <= 1  # a corner that the samples have missed
        last = tuple(np.floor(end / 0.2).astype(int).tolist())
        assert known.pop(last) == 85
        assert set(known.values()) <= {-41}


def test_one_measurement_changes_a_voxel_once_and_a_hit_outweighs_rays_that_pass():
    known = values_of(map_of((0.1, 0.1, 0.1), [(1.1, 0.1, 0.1), *[(3.1, 0.1, 0.1)] * 20], [True, *[True] * 20]))
    assert known[5, 0, 0] == known[15, 0, 0] == 85
    assert known[4, 0, 0] == known[6, 0, 0] == -41


def test_evidence_is_clamped():
    known = values_of(map_of((0.1, 0.1, 0.1), [(1.1, 0.1, 0.1)], [True], times=30))
    assert known[5, 0, 0] == 348
    assert known[0, 0, 0] == -199


def test_a_full_map_keeps_what_it_knows_and_says_so():
    small = map_of((0.1, 0.1, 0.1), [(1.1, 0.1, 0.1)], [True], memory=1.0)
    assert not small.is_full
    ends = np.stack([300.0 * np.cos(np.arange(64)), 300.0 * np.sin(np.arange(64)), np.full(64, 5.0)], axis=1)
    small.insert(np.full((64, 3), 0.1), ends, np.ones(64, bool))
    assert small.is_full
    assert small.memory <= 1.0
    assert values_of(small)[5, 0, 0] > 0
    small.clear()
    assert not small.is_full
    assert not values_of(small)


def test_rays_that_are_not_finite_or_leave_the_octree_are_no_matter():
    far = map_of((0.1, 0.1, 0.1), [(math.nan, 0.0, 0.0), (math.inf, 1.0, 0.0), (8e3, 0.1, 0.1)], [True, True, True])
    assert all(-HALF <= n < HALF for cell in values_of(far) for n in cell)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.booleans())
def test_an_octree_is_read_as_it_was_written(seed: int, binary: bool):
    octree = random_map(seed)
    written = encode(*octree.blocks(), 0.2, binary)
    leaves = decode(written)
    occupied = {cell for cell, value in values_of(octree).items() if value >= 0}
    assert set(map(tuple, np.rint(leaves.middles() / 0.2 - 0.5).astype(int).tolist())) == occupied
    assert int((leaves.sides**3).sum()) == len(values_of(octree))


def recursive_binary(known: dict[int, int], level: int = 0, code: int = 0) -> tuple[int, bytes]:
    """Return state and data of a node, by the definition of the format: known has 1 (free) or 2 by Morton code."""
    if level == 16:
        return known.get(code, 0), b""
    below = {c for c in range(8) if any(k >> 3 * (15 - level) == code << 3 | c for k in known)}
    parts = [recursive_binary(known, level + 1, code << 3 | c) if c in below else (0, b"") for c in range(8)]
    states = [state for state, _ in parts]
    if level and len(set(states)) == 1 and states[0] != 3:
        return states[0], b""
    word = sum(state << 2 * c for c, state in enumerate(states))
    return 3, word.to_bytes(2, "little") + b"".join(data for state, data in parts if state == 3)


def test_the_binary_data_are_those_of_the_definition():
    octree = map_of((0.1, 0.1, 0.1), [(0.9, 0.5, -0.7), (-1.1, 0.1, 0.3)], [True, True])
    cells = np.array(list(values_of(octree)))
    states = [2 if value >= 0 else 1 for value in values_of(octree).values()]
    known = dict(zip(morton(cells + HALF).tolist(), states, strict=True))
    assert encode(*octree.blocks(), 0.2, binary=True).data == recursive_binary(known)[1]


def test_eight_equal_leaves_are_one():
    octree = OctreeMap(OctreeSettings(memory=1.0))
    corners = np.array([[x, y, z] for x in (0.1, 0.3) for y in (0.1, 0.3) for z in (0.1, 0.3)])
    octree.insert(corners, corners, np.ones(8, bool))
    for binary, bytes_each in ((True, 2), (False, 5)):
        written = encode(*octree.blocks(), 0.2, binary)
        assert written.size == count_nodes(written.data, binary) == 16  # the root, and one node in each of 15 levels
        assert len(written.data) == bytes_each * (15 if binary else 16)
        assert decode(written).sides.tolist() == [2]
        assert len(decode(written).middles()) == 8


def test_a_file_has_octomaps_header(tmp_path: Path):
    octree = random_map(5)
    written = encode(*octree.blocks(), 0.2, binary=True)
    path = tmp_path / "map.bt"
    path.write_bytes(file_of(written))
    header = path.read_bytes().split(b"\ndata\n")[0].decode().splitlines()
    assert header == ["# Octomap OcTree binary file", "id OcTree", f"size {written.size}", "res 0.20000000000000001"]
    assert np.array_equal(read_file(path).middles(), decode(written).middles())


@pytest.mark.parametrize(
    ("contents", "words"),
    [
        (b"\ndata\n", "'' is not allowed, a .bt or .ot file of octomap"),
        (b"solid cube", "'solid cube' is not allowed, a .bt or .ot file of octomap"),
        (b"# Octomap OcTree binary file\nid ColorOcTree\nsize 1\nres 0.1\ndata\n..", "id 'ColorOcTree' is not allowed"),
        (b"# Octomap OcTree binary file\nid OcTree\nsize many\nres 0.1\ndata\n..", "size or res in its header"),
        (b"# Octomap OcTree binary file\nid OcTree\nsize 9\nres 0.1\ndata\n\xff\xff", "truncated"),
        (b"# Octomap OcTree binary file\nid OcTree\nsize 9\nres 0.1\ndata\n" + b"\x03\x00" * 40, "too deep"),
        (b"# Octomap OcTree binary file\nid OcTree\nsize 9\nres 0.1\ndata\n\x02\x00", "too large"),
        (b"# Octomap OcTree binary file\nid OcTree\nsize 9\nres -1\ndata\n\x02\x00", "-1.0 is not allowed, above 0"),
    ],
)
def test_files_that_are_no_octrees_are_named(contents: bytes, words: str, tmp_path: Path):
    path = tmp_path / "map.bt"
    path.write_bytes(contents)
    with pytest.raises(OctreeError) as error:
        read_file(path)
    assert words in str(error.value)


def test_random_bytes_never_crash_the_reader():
    rng = np.random.default_rng(1)
    for _ in range(200):
        data = rng.integers(0, 256, rng.integers(0, 60), np.uint8).tobytes()
        for binary in (True, False):
            try:
                decode(Octree(data, 1, 0.1, binary))
            except OctreeError:
                continue


def test_seen_from_above_a_column_is_occupied_if_one_of_its_voxels_is():
    octree = map_of((0.1, 0.1, 1.1), [(2.1, 0.1, 1.1), (0.1, 2.1, 3.1)], [True, True])
    cells, first = seen_from_above(*octree.blocks(), 0.2, (0.5, 2.0))

    def at(x, y):
        return cells[math.floor(y / 0.2) - first[1], math.floor(x / 0.2) - first[0]]

    assert at(2.1, 0.1) == 100
    assert at(1.1, 0.1) == 0
    assert at(0.1, 2.1) == -1  # too high
    assert at(-1.0, -1.0) == -1
    assert np.count_nonzero(cells == 100) == 1


def test_a_map_at_no_place_is_empty():
    empty = OctreeMap(OctreeSettings(memory=1.0))
    assert encode(*empty.blocks(), 0.2, binary=True) == (b"", 0, 0.2, True)
    assert not len(decode(encode(*empty.blocks(), 0.2, binary=True)).sides)
    assert seen_from_above(*empty.blocks(), 0.2, (0.0, 1.0))[0].size == 0
