"""Clouds and depth pictures as rays, each at the pose of its time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_common.clouds import ScanError
from xtdrone_planning.mapping.range_images import DepthImages, DepthMapping, LidarImages, LidarMapping, RangeImage
from xtdrone_planning.mapping.voxel_grid import LocalMap, MapSettings

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2"), ("time", "<f4")])
LIDAR = LidarMapping(columns=64, channels=4, vertical_min=-0.2, vertical_max=0.2)


def cloud(azimuths, rings, ranges, times) -> np.ndarray:
    elevations = np.linspace(-0.2, 0.2, 4)[rings]
    points = np.zeros(len(azimuths), POINT)
    points["x"] = ranges * np.cos(elevations) * np.cos(azimuths)
    points["y"] = ranges * np.cos(elevations) * np.sin(azimuths)
    points["z"] = ranges * np.sin(elevations)
    points["ring"], points["time"] = rings, times
    return points


def full_turn(range_=5.0):
    azimuths = np.repeat(np.linspace(-math.pi, math.pi, 64, endpoint=False), 4)
    rings = np.tile(np.arange(4), 64)
    return cloud(azimuths, rings, np.full(256, range_), np.repeat(np.arange(64) / 64 * 0.1, 4))


def test_a_cloud_fills_its_range_image():
    image = LidarImages(LIDAR).image(full_turn())
    assert np.allclose(image.ranges, 5.0, atol=1e-5)
    assert image.times[0, 63] == pytest.approx(0.1 * 63 / 64)
    ranges, directions, _, hits = image.rays()
    assert hits.all()
    assert len(ranges) == 256
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-6)


def test_points_in_any_order_are_in_the_column_nearest_to_their_azimuth():
    rng = np.random.default_rng(4)
    azimuths, rings = rng.uniform(-math.pi, math.pi, 300), rng.integers(0, 6, 300)  # rings 4 and 5 are not there
    ranges, times = rng.uniform(1.0, 20.0, 300), rng.uniform(0.0, 0.1, 300)
    points = cloud(azimuths, np.minimum(rings, 3), ranges, times)
    points["ring"] = rings
    image = LidarImages(LIDAR).image(points)
    columns = np.rint((azimuths + math.pi) / (2.0 * math.pi / 64)).astype(int) % 64
    last = {(ring, column): n for n, (ring, column) in enumerate(zip(rings, columns, strict=True)) if ring < 4}
    assert np.isfinite(image.ranges).sum() == len(last)
    for pixel, n in last.items():
        assert image.ranges[pixel] == pytest.approx(ranges[n], rel=1e-6)
        assert image.times[pixel] == points["time"][n]
        assert math.atan2(*image.directions[pixel][1::-1]) == pytest.approx(azimuths[n], abs=1e-6)
    empty = np.isnan(image.ranges)
    even = np.arange(64) / 63 * points["time"][rings < 4].max()
    assert np.allclose(image.times[empty], np.broadcast_to(even, (4, 64))[empty])


def test_rays_in_the_order_of_columns_are_the_same_rays():
    points = full_turn()[np.r_[0:100, 130:256]]
    rows, columns = (LidarImages(LIDAR).image(points).rays(by_columns=by) for by in (False, True))
    order = np.lexsort((rows[1][:, 2], rows[2])), np.lexsort((columns[1][:, 2], columns[2]))
    assert (np.diff(columns[2]) >= 0.0).all()
    for a, b in zip(rows, columns, strict=True):
        assert np.array_equal(a[order[0]], b[order[1]])


def test_the_way_is_free_where_a_neighbourhood_has_no_returns_but_not_where_one_ray_is_missing():
    points = full_turn()
    lone = np.ones(len(points), bool)
    lone[4 * 20 + 1] = False
    assert LidarImages(LIDAR).image(points[lone]).rays()[3].all()
    gap = np.ones(len(points), bool)
    gap[4 * 30 : 4 * 33] = False
    _, _, _, hits = LidarImages(LIDAR).image(points[gap]).rays()
    assert (~hits).sum() == 4  # the middle column; those at its sides border on returns


def test_a_cloud_without_returns_frees_everything_around():
    ranges, _, _, hits = LidarImages(LIDAR).image(full_turn()[:0]).rays()
    assert not hits.any()
    assert (ranges == 30.0).all()


def test_points_too_near_or_not_finite_tell_nothing():
    points = full_turn()
    points["x"][:8] = math.nan
    points["y"][:8] = math.nan
    assert np.isfinite(LidarImages(LIDAR).image(points).ranges).sum() == 248
    assert np.isfinite(LidarImages(LIDAR).image(full_turn(0.1)).ranges).sum() == 0


def test_a_depth_picture_of_a_wall_is_a_plane():
    depths = np.full((48, 64), 4.0)
    image = DepthImages(DepthMapping(stride=4)).image(depths, (60.0, 60.0, 32.0, 24.0))
    ranges, directions, _, hits = image.rays()
    assert hits.all()
    assert np.allclose(directions[:, 0] * ranges, 4.0)
    assert directions[0, 1] > 0.0  # the first pixel is at the upper left
    assert directions[0, 2] > 0.0


def test_bad_intrinsics_are_named():
    with pytest.raises(ScanError, match=r"fx 0\.0"):
        DepthImages(DepthMapping()).image(np.ones((8, 8)), (0.0, 60.0, 4.0, 4.0))


def test_a_scan_in_flight_is_placed_ray_by_ray():
    """A vehicle passes a wall at 5 m/s while its lidar turns: the wall is straight in the map, in its true position."""
    local = LocalMap(MapSettings(side=16.0, height=2.0), 0.5)
    for n in range(40):
        local.poses.add(n * 10_000_000, np.array([0.05 * n, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    azimuths, times = np.linspace(0.6, 2.5, 200), np.linspace(0.0, 0.2, 200)
    ranges = 4.05 / np.sin(azimuths)  # to the wall y = 4.05 from anywhere on y = 0
    directions = np.stack([np.cos(azimuths), np.sin(azimuths), 0 * azimuths], axis=1)
    image = RangeImage(ranges[None], directions[None], times[None], 30.0, ordered=False)
    assert local.enter(image, 100_000_000, (0.0, 0.0, 0.0))
    occupied = local.grid.occupied()
    assert np.allclose(occupied[:, 1], 4.1)
    last = 0.5 + 0.05 * 20 + 4.05 / math.tan(2.5)
    assert occupied[:, 0].min() == pytest.approx(last, abs=0.2)


def test_a_scan_without_a_pose_is_not_entered():
    local = LocalMap(MapSettings(side=16.0, height=2.0), 0.5)
    image = LidarImages(LIDAR).image(full_turn())
    assert not local.enter(image, 0, (0.0, 0.0, 0.0))
    assert not local.grid.evidence.any()
