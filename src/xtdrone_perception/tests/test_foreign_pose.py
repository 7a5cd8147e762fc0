"""Poses from external programs: frames, optical axes, heights, and chains of transforms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import pose_of, quaternion_of, turned_about_z
from xtdrone_common.settings import SettingError
from xtdrone_perception.slam.transfer.foreign_pose import (
    STATIC,
    ChainWatch,
    ForeignFrame,
    PlaceSettings,
    TransformChain,
    read_starts,
)

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def quaternion(rotation: Rotation) -> np.ndarray:
    x, y, z, w = rotation.as_quat()
    return np.array([w, x, y, z])


def test_a_camera_that_looks_east_is_a_level_vehicle_that_heads_east() -> None:
    # the optical frame of a camera that looks along the world's x axis: z is x, x is -y, y is -z
    camera = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    found = ForeignFrame(PlaceSettings(), optical=True).vehicle(np.array([1.0, 2.0, 3.0]), quaternion(camera))
    assert found is not None
    assert np.allclose(found, pose_of((1.0, 2.0, 3.0), Rotation.identity()))


def test_the_turn_of_the_optical_frame_is_that_of_upstreams_program() -> None:
    # quaternion_from_euler(0, -pi/2, pi/2) of tf, about fixed axes, multiplied from the right
    upstream = Rotation.from_euler("xyz", [0.0, -math.pi / 2, math.pi / 2])
    camera = Rotation.from_rotvec([0.3, -0.7, 1.9])
    found = ForeignFrame(PlaceSettings(), optical=True).vehicle(np.zeros(3), quaternion(camera))
    assert found is not None
    assert np.allclose(found[:3, :3], (camera * upstream).as_matrix())


def test_start_heading_and_the_sensors_place_are_regarded() -> None:
    place = PlaceSettings(start=(10.0, 5.0, 1.0), heading=math.pi / 2, sensor_position=(0.2, 0.0, 0.1))
    # the vehicle is 3 m ahead of its start and turned left by a quarter: the sensor is 0.2 m to its left
    found = ForeignFrame(place, optical=False).vehicle(
        np.array([3.0, 0.2, 0.1]), quaternion(turned_about_z(math.pi / 2))
    )
    assert found is not None
    assert np.allclose(found[:3, 3], (10.0, 8.0, 1.0))
    assert np.allclose(quaternion_of(found), np.abs(quaternion(turned_about_z(math.pi))), atol=1e-12)


def test_a_program_in_the_plane_gets_its_height_from_elsewhere() -> None:
    found = ForeignFrame(PlaceSettings(start=(0.0, 0.0, 7.0)), optical=False).vehicle(np.ones(3), LEVEL, 1.4)
    assert found is not None
    assert found[:3, 3].tolist() == [1.0, 1.0, 1.4]


@pytest.mark.parametrize(
    "bad",
    [
        (np.array([math.nan, 0, 0]), LEVEL),
        (np.zeros(3), np.zeros(4)),
        (np.zeros(3), 2 * LEVEL),
        (np.zeros(3), math.nan * LEVEL),
    ],
)
def test_what_is_no_pose_is_none(bad: tuple[np.ndarray, np.ndarray]) -> None:
    assert ForeignFrame(PlaceSettings(), optical=False).vehicle(*bad) is None


def test_a_chain_of_transforms_is_composed_and_loops_end() -> None:
    chain = TransformChain()
    assert chain.pose("map", "base_link") is None
    first, second = pose_of((1.0, 0.0, 0.0), turned_about_z(1.0)), pose_of((0.0, 2.0, 0.0), turned_about_z(0.5))
    chain.add("/map", "odom", 5, first)
    chain.add("odom", "base_link", 9, second)
    found = chain.pose("/map", "base_link")
    assert found is not None
    assert found[0] == 9
    assert np.allclose(found[1], first @ second)
    assert chain.pose("world", "base_link") is None
    chain.add("base_link", "map", 10, second)
    assert chain.pose("world", "base_link") is None


def test_a_static_link_gives_the_chain_no_time_and_alone_no_pose() -> None:
    chain = TransformChain()
    mount, moving = pose_of((1.0, 0.0, 0.0), turned_about_z(1.0)), pose_of((0.0, 2.0, 0.0), turned_about_z(0.5))
    chain.add("map", "slam_map", STATIC, mount)
    assert chain.pose("map", "slam_map") is None
    for stamp_ns in (0, 7):
        chain.add("slam_map", "base_link", stamp_ns, moving)
        found = chain.pose("map", "base_link")
        assert found is not None
        assert found[0] == stamp_ns
        assert np.allclose(found[1], mount @ moving)


def test_repeated_poses_are_told_by_their_time_or_without_one_by_their_value() -> None:
    watch, here, there = ChainWatch(), np.eye(4), pose_of((0.0, 0.0, 1e-9), turned_about_z(0.0))
    told = [watch.is_new(found) for found in [(5, here), (5, there), (6, there), (0, there), (0, there), (0, here)]]
    assert told == [True, False, True, True, False, True]


@pytest.mark.parametrize("value", ["none", [[0, 0, 0]], [[0, 0], [1, 1]], [[0, 0, 0], [math.nan, 0, 0]]])
def test_starts_that_are_not_allowed_are_named(value: object) -> None:
    with pytest.raises(SettingError, match="a list of 2 lists of x, y, z"):
        read_starts(value, 2)
    assert read_starts([[0, 1, 2], [3, 4, 5.5]], 2) == [(0.0, 1.0, 2.0), (3.0, 4.0, 5.5)]
