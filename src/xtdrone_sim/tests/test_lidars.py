"""Lidars: valid descriptions, rays, skew against the formula, noise, failures and messages."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.lidars.ray_patterns import PatternError, rays_of, read_pattern
from xtdrone_sim.lidars.scan_measurement import begin_us, cast_scan, end_us, measure_scan
from xtdrone_sim.lidars.scene_history import SceneHistory
from xtdrone_sim.rays.scene import Hits, RayScene, SceneAt
from xtdrone_sim.tf.vehicle_frames import RobotFrames
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import MountError
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount, read_lidars
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.shapes.visual import Box, Visual
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel

LINK = "iris_0::base_link"
IRIS = load_vehicle("iris").urdf
WALL = SdfModel(
    "wall", Pose((10.0, 0.0, 500.0)), links=(SdfLink("link", visuals=(Visual(Box((2.0, 4000.0, 1000.0))),)),)
)
"""Its near side is the plane x = 9 m."""


def history(pose_at, times, longest_us: int = 1_000_000) -> SceneHistory:
    """Return scenes with the iris at ``pose_at(time in s)``, at times in s."""
    scenes = SceneHistory(longest_us)
    for time in times:
        scenes.add(round(time * 1e6), SceneAt({LINK: pose_at(time)}, {}))
    return scenes


def scan_of(mount: LidarMount, pose_at, number: int = 0):
    """Return the rays and hits of a scan of the iris before the wall, with a scene every 20 ms."""
    begin, end = begin_us(mount, number), end_us(mount, number)
    scenes = history(pose_at, np.arange(0, end + 20_000, 20_000) * 1e-6)
    scene = RayScene([WALL], parse_fleet("iris:1"))
    motion = scenes.motion(scene, LINK, begin, end)
    assert motion is not None
    return cast_scan(mount, number, motion, scene.number("iris_0"))


# declaration


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"samples": 0}, "samples: 0 is not allowed, a whole number from 1 to 1000000"),
        ({"samples": "many"}, "samples: 'many' is not allowed, a whole number"),
        ({"samples": 1_000_000, "kind": "spinning"}, "samples: 1000000 is not allowed, at most 62500 with 16 channels"),
        ({"rate": 51}, "rate: 51 is not allowed, 0.1 to 50 Hz"),
        ({"rate": math.nan}, "rate: nan is not allowed"),
        ({"kind": "sonar"}, "kind: 'sonar' is not allowed, scan, spinning or pattern"),
        ({"range_max": 0.1}, "range_max: 0.1 is not allowed, more than range_min, which is 0.2"),
        ({"angle_min": 1.0, "angle_max": 0.0}, "angle_max: 0.0 is not allowed, more than angle_min, which is 1"),
        ({"dropouts": 1.5}, "dropouts: 1.5 is not allowed, 0 to 1"),
        ({"noise": -0.1}, "noise: -0.1 is not allowed, 0 to 10 m"),
        ({"position": [0, 0]}, "position: [0, 0] is not allowed, 3 numbers, -10 to 10 m"),
        ({"skew": "no"}, "skew: 'no' is not allowed, true or false"),
        ({"link": "nose"}, "link 'nose' does not exist"),
        ({"colour": "red"}, "is not allowed, a mapping with name, frame_id"),
        ({"name": "up down"}, "name: 'up down' is not allowed, letters, digits and underscores"),
        ({"pattern": "none.csv"}, "none.csv is not a file; rosette, or a CSV file, is allowed"),
    ],
)
def test_what_a_description_refuses(change, words):
    with pytest.raises(MountError) as refused:
        read_lidars([{"name": "scan"}, {"name": "other", **change}], IRIS, Path())
    assert str(refused.value).startswith("lidars, number 2")
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("lidars", "words"),
    [
        ("scan", "lidars: 'scan' is not allowed, a list"),
        ([7], "lidars, number 1: 7 is not allowed, a mapping"),
        ([{"rate": 5}], "lidars, number 1: field 'name' is missing"),
        ([{"name": "a"}, {"name": "a"}], "lidars: name 'a' is given 2 times"),
        ([{"name": "a", "frame_id": "x"}, {"name": "b", "frame_id": "x"}], "lidars: frame_id 'x' is given 2 times"),
    ],
)
def test_what_a_list_refuses(lidars, words):
    with pytest.raises(MountError, match=words.replace("(", r"\(")):
        read_lidars(lidars, IRIS, Path())


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["t,a,z", "0,nan,90"], "line 2: '0,nan,90' is not allowed, three numbers"),
        (["t,a,z", "0,0,90", "1,2"], "line 3: '1,2' is not allowed"),
        (["t,a,z", "0,0,181"], "line 2: '0,0,181' is not allowed"),
        (["t,a,z"], "0 rays are not allowed, 1 to 1000000"),
    ],
)
def test_what_a_pattern_file_refuses(tmp_path, lines, words):
    path = tmp_path / "pattern.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(PatternError, match=words):
        read_pattern(path)


def test_variants_have_upstreams_topics_and_their_frames_are_on_tf():
    lidars = {name: [m.name for m in load_vehicle(name).lidars] for name in ("iris_2d_lidar", "iris_3d_gpu_lidar")}
    assert lidars == {"iris_2d_lidar": ["scan", "distance"], "iris_3d_gpu_lidar": ["velodyne_points"]}
    frames = {frame.child: frame for frame in RobotFrames("iris_0", load_vehicle("iris_2d_lidar")).fixed}
    assert frames["iris_0/laser_2d"].parent == "iris_0/base_link"
    assert frames["iris_0/laser_2d"].pose.position == (0.0, 0.0, 0.06)


# rays


def test_a_scan_includes_both_ends_and_a_turn_its_beginning_only():
    scan = rays_of(LidarMount(samples=5, angle_min=-1.0, angle_max=1.0), 0)
    np.testing.assert_allclose(np.arctan2(scan.directions[:, 1], scan.directions[:, 0]), [-1.0, -0.5, 0.0, 0.5, 1.0])
    np.testing.assert_allclose(scan.times, [0.0, 0.02, 0.04, 0.06, 0.08])
    turn = rays_of(LidarMount(kind="spinning", samples=4, channels=2, vertical_min=-0.1, vertical_max=0.3), 0)
    azimuth = np.arctan2(turn.directions[:, 1], turn.directions[:, 0])
    np.testing.assert_allclose(azimuth[2:], np.repeat([-0.5, 0.0, 0.5], 2) * math.pi, atol=1e-12)
    np.testing.assert_allclose(np.arcsin(turn.directions[:, 2]), [-0.1, 0.3] * 4)
    assert turn.rings.tolist() == [0, 1] * 4
    np.testing.assert_allclose(turn.times, np.repeat([0.0, 0.025, 0.05, 0.075], 2))


def test_a_rosette_fills_its_field_of_view_and_does_not_repeat():
    mount = LidarMount(kind="pattern", samples=20_000, half_angle=0.6)
    some = [rays_of(mount, number).directions for number in range(10)]
    off = np.concatenate([np.arccos(np.clip(d[:, 0], -1.0, 1.0)) for d in some])
    assert off.max() == pytest.approx(0.6, abs=1e-3)
    seen = [len(np.unique(np.round(np.concatenate(some[:k])[:, 1:] / 0.02), axis=0)) for k in (1, 10)]
    assert seen[1] > 0.95 * math.pi * math.sin(0.6) ** 2 / 0.02**2
    assert seen[1] > 1.2 * seen[0]
    np.testing.assert_array_equal(rays_of(mount, 3).directions, some[3])


def test_a_pattern_file_goes_on_where_the_last_scan_ended(tmp_path):
    path = tmp_path / "pattern.csv"
    path.write_text("Time/s,Azimuth/deg,Zenith/deg\n0,0,90\n0.1,90,90\n0.2,0,0\n")
    mount = LidarMount(kind="pattern", samples=2, pattern=str(path))
    every = np.concatenate([rays_of(mount, number).directions for number in range(3)])
    ahead, left, up = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]
    np.testing.assert_allclose(every, [ahead, left, up] * 2, atol=1e-12)


# skew


def test_a_standing_lidar_sees_a_wall_where_it_is():
    mount = LidarMount(samples=101, angle_min=-1.0, angle_max=1.0, position=(0.5, 0.0, 0.1))
    rays, hits = scan_of(mount, lambda time: Pose((0.0, 0.0, 2.0)))
    np.testing.assert_allclose(hits.ranges, 8.5 / rays.directions[:, 0], atol=1e-9)


def test_a_scan_in_flight_is_skewed_as_the_formula_says():
    """The lidar flies towards a wall at v and turns at w: r(t) cos(a + w t) = d - v t."""
    speed, rate, mount = 3.0, 0.8, LidarMount(samples=201, angle_min=-0.8, angle_max=0.8)
    rays, hits = scan_of(mount, lambda t: Pose((speed * t, 0.0, 2.0), from_euler(0.0, 0.0, rate * t)), number=3)
    times = 0.3 + rays.times
    azimuth = np.linspace(-0.8, 0.8, 201) + rate * times
    np.testing.assert_allclose(hits.ranges, (9.0 - speed * times) / np.cos(azimuth), atol=1e-4)
    still, level = scan_of(replace(mount, skew=False), lambda t: Pose((speed * t, 0.0, 2.0)), number=3)
    np.testing.assert_allclose(level.ranges, (9.0 - 0.9) / still.directions[:, 0], atol=1e-9)
    assert not still.times.any()


def test_between_two_scenes_an_acceleration_is_off_by_half_a_millimetre_at_most():
    mount = LidarMount(samples=200, angle_min=0.0, angle_max=0.0)
    rays, hits = scan_of(mount, lambda t: Pose((5.0 * t * t, 0.0, 2.0)))
    error = np.abs(hits.ranges - (9.0 - 5.0 * rays.times**2))
    assert 0.0004 < error.max() < 0.00051


def test_a_history_without_the_link_has_no_motion_and_old_scenes_are_forgotten():
    scenes = history(lambda t: Pose((t, 0.0, 1.0)), np.arange(0.0, 5.0, 0.02), longest_us=100_000)
    assert scenes.first_us is not None
    assert 4_700_000 <= scenes.first_us <= 4_880_000
    assert scenes.motion(RayScene([]), "iris_1::base_link", 4_900_000, 4_980_000) is None
    scenes.add(4_980_000, SceneAt({}, {}))  # not later than the last: ignored
    assert scenes.motion(RayScene([]), LINK, 4_900_000, 4_980_000) is not None
    scenes.clear()
    assert scenes.last_us is None


# measuring


def flat(n: int = 20_000, distance: float = 10.0) -> Hits:
    return Hits(np.full(n, distance), np.ones(n, int), np.ones(n))


def test_noise_has_its_deviation_and_depends_on_seed_vehicle_name_and_scan_only():
    mount = LidarMount(samples=20_000, noise=0.05)
    rays = rays_of(mount, 0)
    one = measure_scan(mount, "iris_0", 4, rays, flat())
    assert one.ranges.mean() == pytest.approx(10.0, abs=4 * 0.05 / math.sqrt(20_000))
    assert one.ranges.std() == pytest.approx(0.05, rel=0.03)
    np.testing.assert_array_equal(measure_scan(mount, "iris_0", 4, rays, flat()).ranges, one.ranges)
    others = [
        (mount, "iris_1", 4),
        (mount, "iris_0", 5),
        (replace(mount, seed=1), "iris_0", 4),
        (replace(mount, name="b"), "iris_0", 4),
    ]
    for changed, vehicle, number in others:
        other = measure_scan(changed, vehicle, number, rays, flat())
        assert abs(np.corrcoef(one.ranges, other.ranges)[0, 1]) < 0.05


def test_dropouts_bias_resolution_and_limits():
    mount = LidarMount(samples=20_000, dropouts=0.2, range_max=10.4)
    rays = rays_of(mount, 0)
    lost = np.isinf(measure_scan(mount, "iris_0", 0, rays, flat(), lost=0.5).ranges).mean()
    assert lost == pytest.approx(1.0 - 0.8 * 0.5, abs=0.02)
    coarse = replace(mount, dropouts=0.0, resolution=0.25)
    assert set(measure_scan(coarse, "iris_0", 0, rays, flat(distance=10.1)).ranges) == {10.0}
    assert set(measure_scan(coarse, "iris_0", 0, rays, flat(distance=9.0), bias=1.0).ranges) == {10.0}
    assert set(measure_scan(coarse, "iris_0", 0, rays, flat(distance=10.0), bias=1.0).ranges) == {math.inf}
    near = measure_scan(coarse, "iris_0", 0, rays, flat(distance=0.1))
    assert set(near.ranges) == {-math.inf}
    assert not near.intensities.any()


# messages


def test_messages_have_the_scan_s_times_and_limits_and_points_only_where_there_is_a_return():
    pytest.importorskip("rospy")
    from xtdrone_sim.lidars.lidar_messages import POINT, scan_message
    from xtdrone_sim.vehicles.mounts.fleet_sensor import Lidar

    mount = LidarMount(kind="scan", samples=5, angle_min=-1.0, angle_max=1.0, rate=3.0, frame_id="laser")
    rays = rays_of(mount, 2)
    hits = Hits(np.array([10.0, 0.1, 31.0, 20.0, 12.5]), np.ones(5, int), np.array([1.0, 1.0, 1.0, 0.5, 0.25]))
    message = scan_message(Lidar("iris_0", mount.link, mount), 2, measure_scan(mount, "iris_0", 2, rays, hits))
    assert message.header.frame_id == "iris_0/laser"
    assert message.header.stamp.to_nsec() == 666_667_000
    assert message.ranges == [10.0, -math.inf, math.inf, 20.0, 12.5]
    assert message.intensities == [100.0, 0.0, 0.0, 50.0, 25.0]
    assert (message.angle_increment, message.range_min, message.range_max) == (0.5, 0.2, 30.0)
    assert message.time_increment * 5 == pytest.approx(message.scan_time)
    turn = replace(mount, kind="spinning", channels=2, samples=2, vertical_min=-0.5, vertical_max=0.5)
    rays = rays_of(turn, 0)
    hits = Hits(np.array([10.0, np.inf, 20.0, 30.0]), np.ones(4, int), np.ones(4))
    cloud = scan_message(Lidar("iris_0", turn.link, turn), 0, measure_scan(turn, "iris_0", 0, rays, hits))
    points = np.frombuffer(cloud.data, POINT)
    assert (cloud.width, cloud.height, cloud.point_step, cloud.row_step) == (3, 1, 22, 66)
    assert [(field.name, field.offset) for field in cloud.fields][-2:] == [("ring", 16), ("time", 18)]
    assert points["ring"].tolist() == [0, 0, 1]
    np.testing.assert_allclose(points["time"], [0.0, 1.0 / 6.0, 1.0 / 6.0], rtol=1e-6)
    at = np.stack([points["x"], points["y"], points["z"]], axis=1)
    np.testing.assert_allclose(np.linalg.norm(at, axis=1), [10.0, 20.0, 30.0], rtol=1e-6)
    np.testing.assert_allclose(
        at[0], 10.0 * np.array([np.cos(0.5) * np.cos(1.0), -np.cos(0.5) * np.sin(1.0), -np.sin(0.5)]), rtol=1e-6
    )
