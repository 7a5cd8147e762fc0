"""Accuracy of maps: closed forms, points on surfaces, and the observable part."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from xtdrone_common.poses import Pose
from xtdrone_interaction.metrics.odometry_errors import Trajectory
from xtdrone_interaction.missions.map_report import join_clouds, read_map, unite
from xtdrone_interaction.missions.true_surfaces import Sight, TrueWorld, map_accuracy
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_sim.rays.surface_points import distances_from, points_on
from xtdrone_sim.rays.surfaces import of_shape, of_triangles
from xtdrone_worlds.shapes.visual import Box, Cylinder, Sphere

TURN = (np.cos(0.3), 0.0, np.sin(0.3) * 0.6, np.sin(0.3) * 0.8)
AT = Pose((4.0, -3.0, 30.0), TURN)
"""High above the ground, so that the ground is no matter."""


def plane(shift: float) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0.0, 4.0, 81), np.linspace(0.0, 3.0, 61))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, 10.0 + shift)], axis=1)


@pytest.mark.parametrize(("shift", "share"), [(0.0, 1.0), (0.07, 1.0), (0.13, 0.0)])
def test_a_plane_that_is_shifted_is_that_far_off(shift: float, share: float) -> None:
    square = of_triangles(
        np.array([[[0, 0, 10], [4, 0, 10], [4, 3, 10]], [[0, 0, 10], [4, 3, 10], [0, 3, 10]]], float), 0
    )
    found = plane(shift)
    accuracy = map_accuracy(distances_from(square, found, 5.0), found, plane(0.0))
    assert accuracy.error == pytest.approx(shift, abs=1e-12)
    assert accuracy.chamfer == pytest.approx(shift, abs=1e-12)
    assert accuracy.precision == accuracy.recall == accuracy.f_score == share


def test_half_a_plane_has_half_the_recall_and_full_precision() -> None:
    found = plane(0.0)
    found = found[found[:, 0] < 2.0 - 0.08]
    accuracy = map_accuracy(np.zeros(len(found)), found, plane(0.0))
    assert accuracy.precision == 1.0
    assert accuracy.recall == pytest.approx(0.5, abs=0.01)
    assert accuracy.f_score == pytest.approx(2.0 / 3.0, abs=0.01)


@pytest.mark.parametrize(
    "shape", [Box((2.0, 1.0, 0.6)), Cylinder(0.5, 3.0), Sphere(0.8)], ids=("box", "cylinder", "sphere")
)
def test_points_on_a_shape_are_on_it_and_even(shape: object) -> None:
    surface = of_shape(shape, AT, 0)
    low, high = np.array([-10.0, -10.0, 25.0]), np.array([10.0, 10.0, 35.0])
    points = points_on(surface, 4000, low, high, seed=1)
    assert len(points) == 4000
    assert distances_from(surface, points, 5.0).max() < 1e-9
    assert np.linalg.norm(points.mean(axis=0) - AT.position) < 0.05  # all are symmetric
    assert np.array_equal(points, points_on(surface, 4000, low, high, seed=1))
    inside = distances_from(surface, np.array([AT.position]), 5.0)[0]
    assert inside == pytest.approx({Box: 0.3, Cylinder: 0.5, Sphere: 0.8}[type(shape)])


def test_distances_from_shapes_and_triangles_are_those_of_dense_points() -> None:
    rng = np.random.default_rng(2)
    corners = rng.uniform(-2.0, 2.0, (6, 3, 3)) + AT.position
    surfaces = np.concatenate(
        [of_triangles(corners, 0), *(of_shape(shape, AT, 0) for shape in (Box((2.0, 1.0, 0.6)), Cylinder(0.5, 3.0)))]
    )
    dense = points_on(surfaces, 200_000, np.array([-20.0, -20.0, 1.0]), np.full(3, 50.0), seed=3)
    places = rng.uniform(-5.0, 5.0, (60, 3)) + AT.position
    nearest, _ = cKDTree(dense).query(places)
    exact = distances_from(surfaces, places, 50.0)
    assert (exact <= nearest + 1e-9).all()
    assert (exact >= nearest - 0.08).all()


def test_faces_are_drawn_by_their_area() -> None:
    surface = of_shape(Box((4.0, 2.0, 1.0)), Pose((0.0, 0.0, 30.0), (1.0, 0.0, 0.0, 0.0)), 0)
    points = points_on(surface, 14_000, np.array([-40.0, -40.0, 1.0]), np.full(3, 40.0), seed=0)
    for axis, size, area in ((0, 4.0, 2.0), (1, 2.0, 4.0), (2, 1.0, 8.0)):
        middle = 30.0 if axis == 2 else 0.0
        for side in (-0.5, 0.5):
            share = (np.abs(points[:, axis] - middle - side * size) < 1e-9).mean()
            assert share == pytest.approx(area / 28.0, abs=0.015)


def test_only_what_is_in_sight_counts() -> None:
    world = TrueWorld("indoor:seed=1")
    place = np.array([[22.0, 5.0, 1.2], [22.0, 5.0, 1.2]])
    way = Trajectory(np.array([0.0, 1.0]), place, np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
    level = world.visible([(way, Sight(8.0, -0.26, 0.26))], seed=0)
    around = world.visible([(way, Sight(8.0, -1.57, 1.57))], seed=0)
    assert 100 < len(level) < len(around)
    assert np.linalg.norm(around - place[0], axis=1).max() <= 8.0
    rays = level - place[0]
    assert np.abs(np.arcsin(rays[:, 2] / np.linalg.norm(rays, axis=1))).max() <= 0.26
    perfect = world.compare(around, [(way, Sight(8.0, -1.57, 1.57))])
    assert perfect is not None
    assert perfect["precision"] == perfect["recall"] == 1.0
    assert perfect["chamfer"] < 1e-9


# ---- maps of files and of bags


def test_a_saved_cloud_is_read_and_one_with_nan_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "map.xyz"
    file.write_text("1 2 3\n4 5 6\n", encoding="utf-8")
    assert read_map(file).tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    file.write_text("1 2 3\nnan 5 6\n", encoding="utf-8")
    with pytest.raises(RecordError, match=r"map.xyz: point \[nan, 5.0, 6.0\] is not allowed, finite numbers"):
        read_map(file)
    with pytest.raises(RecordError, match=r"one of the endings \.bt"):
        read_map(tmp_path / "map.stl")


def test_a_merged_map_is_no_part_of_the_union() -> None:
    maps = [(f"map.iris_{k}.bt", np.full((k + 1, 3), float(k))) for k in range(2)]
    merged = ("merged_map.bt", np.zeros((9, 3)))
    assert unite([*maps, merged])[0][1].tolist() == [[0.0] * 3, [1.0] * 3, [1.0] * 3]
    assert unite([maps[0], merged]) == []


def test_recorded_clouds_have_only_places() -> None:
    data = np.array([[0.01, 0.0, 0.0], [0.02, 0.0, 0.0], [1.0, 0.0, 0.0]], "<f4").tobytes()
    assert len(join_clouds([SimpleNamespace(point_step=12, data=data)], 0.1)) == 2
    with pytest.raises(RecordError, match="cloud: point_step 16 is not allowed, 12: x, y, z of float32"):
        join_clouds([SimpleNamespace(point_step=16, data=data)], 0.1)
