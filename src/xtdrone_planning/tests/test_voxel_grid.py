"""The local map: rays, the three states, motion of the box, and distances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from xtdrone_planning.mapping.field_lookup import distance_at, is_seen
from xtdrone_planning.mapping.voxel_grid import FREE_TO, HIT, LEAST, MISS, MOST, OCCUPIED_FROM, MapSettings, VoxelGrid

SMALL = MapSettings(resolution=0.2, side=8.0, height=2.0)


def rays(origin, ends):
    return np.tile(np.asarray(origin, float), (len(ends), 1)), np.asarray(ends, float)


def test_a_ray_frees_its_voxels_and_occupies_its_end():
    grid = VoxelGrid(SMALL)
    origins, ends = rays((0.1, 0.1, 0.1), [(2.1, 0.1, 0.1)])
    grid.insert(origins, ends, np.array([True]))
    line = grid.evidence[:, grid.index((0.1, 0.1, 0.1))[1], grid.index((0.1, 0.1, 0.1))[2]]
    begin, end = grid.index((0.1, 0.1, 0.1))[0], grid.index((2.1, 0.1, 0.1))[0]
    assert (line[begin:end] <= FREE_TO).all()
    assert line[end] >= OCCUPIED_FROM
    assert np.count_nonzero(grid.evidence) == end - begin + 1


def test_a_ray_passes_the_voxels_that_dense_samples_of_it_pass():
    rng = np.random.default_rng(3)
    for _ in range(50):
        grid = VoxelGrid(SMALL)
        ends = rng.uniform((-3.9, -3.9, -0.9), (3.9, 3.9, 0.9), (1, 3))
        origins = rng.uniform((-3.9, -3.9, -0.9), (3.9, 3.9, 0.9), (1, 3))
        grid.insert(origins, ends, np.array([False]))
        part = np.linspace(0.0, 1.0, 20001)[:, None]
        sampled = {tuple(v) for v in (np.floor((origins + part * (ends - origins)) / 0.2) - grid.corner).astype(int)}
        passed = {tuple(v) for v in np.argwhere(grid.evidence)}
        assert sampled <= passed
        assert len(passed - sampled) <= 1  # a corner that the samples have missed


def passed_one_by_one(grid, origin, end):
    """Return the voxels of a ray by the plain form of Amanatides and Woo's method."""
    place, length = np.asarray(origin) / 0.2 - grid.corner, (np.asarray(end) - origin) / 0.2
    cell = np.floor(place).astype(int)
    step = np.sign(length).astype(int)
    with np.errstate(divide="ignore", invalid="ignore"):
        entered = np.where(step == 0, np.inf, (cell + (step > 0) - place) / length)
        across = np.where(step == 0, np.inf, 1.0 / np.abs(length))
    found = set()
    while (cell >= 0).all() and (cell < grid.evidence.shape).all():
        found.add(tuple(cell.tolist()))
        axis = int(np.argmin(entered))
        if entered[axis] > 1.0:
            break
        cell[axis] += step[axis]
        entered[axis] += across[axis]
    return found


@pytest.mark.parametrize("count", [1, 31, 33, 200])
def test_rays_side_by_side_pass_the_voxels_of_each_followed_alone(count):
    rng = np.random.default_rng(count)
    grid = VoxelGrid(SMALL)
    before = rng.integers(-5, 8, grid.evidence.shape).astype(np.int16) * 40
    grid.evidence[:] = before
    origins = rng.uniform(-1.2, 1.2, (count, 3))  # some are outside of the box, as are most ends
    ends = origins + rng.choice((0.0, 1.0), (count, 3), p=(0.1, 0.9)) * rng.uniform(-9.0, 9.0, (count, 3))
    hits = rng.uniform(size=count) < 0.6
    grid.insert(origins, ends, hits)
    expected = before.copy()
    ended = {tuple(v) for v in (np.floor(ends[hits] / 0.2) - grid.corner).astype(int).tolist()}
    ended = {v for v in ended if all(0 <= a < n for a, n in zip(v, before.shape, strict=True))}
    passed = set().union(*(passed_one_by_one(grid, a, b) for a, b in zip(origins, ends, strict=True)))
    for voxel in passed - ended:
        expected[voxel] = max(LEAST, before[voxel] + MISS)
    for voxel in ended:
        expected[voxel] = min(MOST, before[voxel] + HIT)
    assert np.array_equal(grid.evidence, expected)


def test_within_one_measurement_a_hit_outweighs_rays_that_pass():
    grid = VoxelGrid(SMALL)
    origins, ends = rays((0.1, 0.1, 0.1), [(1.1, 0.1, 0.1), *[(3.1, 0.1, 0.1)] * 20])
    grid.insert(origins, ends, np.array([True] + [False] * 20))
    assert grid.evidence[grid.index((1.1, 0.1, 0.1))] == 85
    grid.insert(origins[1:], ends[1:], np.zeros(20, bool))
    assert grid.evidence[grid.index((1.1, 0.1, 0.1))] == 45  # counted once per measurement, however many rays


def test_the_box_moves_in_whole_voxels_and_keeps_what_it_knows():
    grid = VoxelGrid(SMALL)
    origins, ends = rays((0.1, 0.1, 0.1), [(2.1, -1.3, 0.5)])
    grid.insert(origins, ends, np.array([True]))
    before = grid.occupied()
    grid.recentre(np.array([2.7, 1.9, 0.3]))
    assert np.allclose(grid.occupied(), before)
    assert np.allclose(0.5 * (grid.origin + grid.upper), (2.7, 1.9, 0.3), atol=0.21)
    grid.recentre(np.array([100.0, 0.0, 0.0]))
    assert not grid.evidence.any()


@pytest.mark.parametrize(
    ("settings", "part"),
    [
        (SMALL, 0.002),
        (SMALL, 0.1),
        (replace(SMALL, height=8.0, farthest=1.0), 0.001),
        (MapSettings(resolution=0.05, side=8.0, height=1.0, farthest=8.0), 0.00003),  # squares beyond two bytes
    ],
)
def test_distances_equal_scipys(settings, part):
    rng = np.random.default_rng(1)
    grid = VoxelGrid(settings)
    grid.evidence[rng.uniform(size=grid.evidence.shape) < part] = 100
    grid.update_distance()
    voxels = distance_transform_edt(grid.evidence < OCCUPIED_FROM).astype(np.float32)
    reference = voxels * np.float32(settings.resolution)
    assert np.array_equal(grid.distance, np.minimum(reference, np.float32(settings.farthest)))


def test_without_obstacles_all_distances_are_the_farthest():
    grid = VoxelGrid(SMALL)
    grid.update_distance()
    assert (grid.distance == np.float32(3.0)).all()


def test_the_gradient_is_that_of_the_interpolated_distance():
    rng = np.random.default_rng(2)
    grid = VoxelGrid(SMALL)
    grid.evidence[rng.uniform(size=grid.evidence.shape) < 0.003] = 100
    grid.update_distance()
    step = 1e-4
    field = grid.distance.astype(float)

    def value(place):
        return distance_at(field, grid.corner, 0.2, *place)[0]

    for place in rng.uniform((-3.5, -3.5, -0.8), (3.5, 3.5, 0.8), (200, 3)):
        cell = (place / 0.2 - 0.5) % 1.0
        if (np.abs(cell - 0.5) > 0.49).any():
            continue  # the gradient jumps between cells
        slope = distance_at(field, grid.corner, 0.2, *place)[1:]
        numeric = [(value(place + step * axis) - value(place - step * axis)) / (2 * step) for axis in np.eye(3)]
        assert np.allclose(slope, numeric, atol=1e-6)


@pytest.mark.parametrize(("layer", "seen"), [(0, True), (1, True), (2, False)])
def test_a_disc_is_seen_through_gaps_of_one_layer(layer, seen):
    grid = VoxelGrid(SMALL)
    k = grid.index((0.0, 0.0, 0.1))[2]
    grid.evidence[:, :, k - layer] = -40
    assert is_seen(grid.evidence, grid.corner, 0.2, 0.05, 0.05, 0.1, 0.4) == seen
    grid.evidence[grid.index((0.3, 0.05, 0.1))] = 100
    assert not is_seen(grid.evidence, grid.corner, 0.2, 0.05, 0.05, 0.1, 0.4)
