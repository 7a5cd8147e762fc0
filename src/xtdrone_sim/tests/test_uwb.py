"""UWB sensors: rejected descriptions, truth in closed form, statistics of the errors, line of sight."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler, rotate_inverse
from xtdrone_sim.rays.scene import RayScene, SceneAt
from xtdrone_sim.tf.vehicle_frames import RobotFrames
from xtdrone_sim.uwb.line_of_sight import Moment, Sights
from xtdrone_sim.uwb.ranging import Neighbours, find_neighbours, measure_ranges, neighbours_of
from xtdrone_sim.vehicles.mounts.body_sensors import UwbMount, read_uwb
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import MountError
from xtdrone_sim.vehicles.mounts.fleet_sensor import Antenna, antennas_of
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.shapes.visual import Box, Visual
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel

N = 20_000


def truth(n: int = N, distance: float = 12.0, blocked: bool = False) -> Neighbours:
    """Return n neighbours at the same position."""
    full = np.full(n, distance)
    return Neighbours(full, np.full(n, 3.1), np.full(n, 0.2), np.full(n, blocked), np.ones(n, bool))


# declaration


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"name": "uwb"}, "uwb: {'name': 'uwb'} is not allowed, a list"),
        ([3], "uwb, number 1: 3 is not allowed, a mapping"),
        ([{"rate": 51}], "uwb, number 1 rate: 51 is not allowed, 0.1 to 50 Hz"),
        ([{"noise": math.nan}], "uwb, number 1 noise: nan is not allowed, 0 to 10 m"),
        ([{"line_of_sight": "drop"}], "'drop' is not allowed, needed, biased or ignored"),
        ([{"bearing": 1}], "bearing: 1 is not allowed, true or false"),
        ([{"range": 5}], "is not allowed, a mapping with name, frame_id"),
        ([{"name": "/uwb"}], "name: '/uwb' is not allowed"),
        ([{}, {}], "uwb: name 'uwb' is given 2 times"),
        ([{}, {"name": "b", "frame_id": "uwb_frame"}], "uwb: frame_id 'uwb_frame' is given 2 times"),
    ],
)
def test_what_is_refused(entries, words):
    with pytest.raises(MountError) as refused:
        read_uwb(entries)
    assert words in str(refused.value)


def test_a_name_of_another_sensor_is_refused(tmp_path):
    file = tmp_path / "twice.yaml"
    file.write_text("extends: iris\nlidars: [{name: front}]\nuwb: [{name: front}]\n")
    with pytest.raises(ModelError, match="uwb: name 'front' is not allowed, an entry of lidars has it"):
        load_vehicle(str(file))


def test_variants_fly_as_the_iris_and_their_frames_are_on_tf():
    plain, other = load_vehicle("iris"), load_vehicle("iris_uwb_bearing")
    assert other.record == plain.record
    assert [mount.bearing for name in ("iris_uwb", "iris_uwb_bearing") for mount in load_vehicle(name).uwb] == [0, 1]
    (frame,) = [frame for frame in RobotFrames("a", other).fixed if frame.child == "a/uwb_frame"]
    assert (frame.parent, frame.pose) == ("a/base_link", Pose((0.0, 0.0, 0.08)))


def test_each_sensor_measures_one_of_each_other_vehicle():
    names = [("a", "front"), ("a", "rear"), ("b", "uwb"), ("b", "rear"), ("c", "uwb")]
    antennas = [Antenna(vehicle, "base_link", UwbMount(name=name)) for vehicle, name in names]
    assert neighbours_of(0, antennas) == (2, 4)  # there is no other front antenna
    assert neighbours_of(1, antennas) == (3, 4)
    assert neighbours_of(4, antennas) == (0, 2)
    assert [a.frame_id for a in antennas_of(parse_fleet("iris:1,iris_uwb:2"))] == [
        "iris_uwb_0/uwb_frame",
        "iris_uwb_1/uwb_frame",
    ]


# truth


def test_range_and_bearing_of_any_pose():
    generator = np.random.default_rng(3)
    for _ in range(50):
        q = from_euler(*generator.uniform(-3.0, 3.0, 3))
        sensor = Pose(tuple(generator.normal(0.0, 5.0, 3)), q)
        others = generator.normal(0.0, 5.0, (4, 3))
        seen = find_neighbours(sensor, others, 8.0)
        for k, other in enumerate(others):
            x, y, z = rotate_inverse(q, *(other - sensor.position))
            assert seen.ranges[k] == pytest.approx(math.dist(other, sensor.position))
            assert seen.azimuths[k] == pytest.approx(math.atan2(y, x))
            assert seen.elevations[k] == pytest.approx(math.atan2(z, math.hypot(x, y)))
            assert seen.heard[k] == (seen.ranges[k] <= 8.0)


def test_a_perfect_sensor_measures_the_truth():
    true = truth()
    seen = measure_ranges(UwbMount(noise=0.0, bearing_noise=0.0), "a", 0, true)
    for field in ("ranges", "heard"):
        np.testing.assert_array_equal(getattr(seen, field), getattr(true, field))
    for field in ("azimuths", "elevations"):
        np.testing.assert_allclose(getattr(seen, field), getattr(true, field), rtol=1e-12)


# errors


def test_noise_has_its_mean_and_deviation_and_repeats():
    mount = UwbMount(noise=0.2, bias=0.3, bearing_noise=0.1, seed=5)
    seen = measure_ranges(mount, "a", 7, truth())
    error = 1.0 / math.sqrt(N)  # of a mean, in standard deviations
    assert seen.ranges.mean() == pytest.approx(12.3, abs=4.0 * 0.2 * error)
    assert seen.ranges.std() == pytest.approx(0.2, rel=3.0 * error)
    turns = np.angle(np.exp(1j * (seen.azimuths - 3.1)))
    assert np.abs(seen.azimuths).max() <= math.pi
    for angles, mean in ((turns, 0.0), (seen.elevations, 0.2)):
        assert angles.mean() == pytest.approx(mean, abs=4.0 * 0.1 * error)
        assert angles.std() == pytest.approx(0.1, rel=3.0 * error)
    assert abs(np.corrcoef(seen.ranges, seen.azimuths)[0, 1]) < 4.0 * error
    np.testing.assert_array_equal(measure_ranges(mount, "a", 7, truth()).ranges, seen.ranges)
    for other in (measure_ranges(mount, "a", 8, truth()), measure_ranges(mount, "b", 7, truth())):
        assert abs(np.corrcoef(other.ranges, seen.ranges)[0, 1]) < 4.0 * error
    np.testing.assert_array_equal(seen.deviations(mount), 0.2)


def test_outliers_have_their_share_and_an_exponential_excess():
    seen = measure_ranges(UwbMount(noise=0.0, outliers=0.1, outlier_excess=2.0), "a", 0, truth())
    excess = seen.ranges[seen.ranges > 12.0] - 12.0
    assert len(excess) / N == pytest.approx(0.1, abs=4.0 * math.sqrt(0.1 * 0.9 / N))
    assert excess.mean() == pytest.approx(2.0, abs=4.0 * 2.0 / math.sqrt(len(excess)))
    # of an exponential distribution, median and mean have the ratio ln 2
    assert np.median(excess) == pytest.approx(2.0 * math.log(2.0), rel=0.1)


def test_dropouts_of_file_and_failure_are_independent():
    seen = measure_ranges(UwbMount(dropouts=0.2), "a", 0, truth(), lost=0.5)
    assert seen.heard.mean() == pytest.approx(0.4, abs=4.0 * math.sqrt(0.4 * 0.6 / N))
    assert not measure_ranges(UwbMount(), "a", 0, truth(10), lost=1.0).heard.any()
    assert measure_ranges(UwbMount(), "a", 0, truth(10)).heard.all()


def test_a_blocked_range_is_lost_longer_or_the_same():
    for sight, heard, mean, deviation in (
        ("needed", False, 12.0, 0.1),
        ("biased", True, 13.5, 0.5),
        ("ignored", True, 12.0, 0.1),
    ):
        mount = UwbMount(noise=0.1, line_of_sight=sight, blocked_bias=1.5, blocked_noise=math.sqrt(0.24))
        seen = measure_ranges(mount, "a", 0, truth(blocked=True))
        assert (seen.heard == heard).all()
        assert seen.ranges.mean() == pytest.approx(mean, abs=0.02)
        assert seen.ranges.std() == pytest.approx(deviation, rel=0.03)
    assert seen.deviations(mount)[0] == pytest.approx(0.5)


# line of sight


def test_walls_and_other_vehicles_block_the_sight_but_the_two_vehicles_do_not():
    """Of four vehicles in a row, the second and third see each other; beyond the fourth there is a low wall."""
    wall = SdfModel("wall", Pose((8.0, 0.0, 1.0)), links=(SdfLink("link", visuals=(Visual(Box((0.2, 6.0, 2.0))),)),))
    names = [f"iris_{k}" for k in range(4)]
    rays = RayScene([wall], parse_fleet("iris:4"))
    height = 1.5
    places = [(0.0, 0.0, height), (2.0, 0.0, height), (5.0, 0.0, height), (11.0, 0.0, height)]

    def scene(places):
        poses = zip(names, places, strict=True)
        return SceneAt({f"{name}::base_link": Pose(place) for name, place in poses}, {})

    before = scene(places)
    sights = Sights(rays, Moment(before, before, 0.0))
    positions = np.array(places)
    assert sights.blocked("iris_0", positions[0], names[1:], positions[1:]).tolist() == [False, True, True]
    assert sights.blocked("iris_2", positions[2], names[:2], positions[:2]).tolist() == [True, False]
    # Half-way between two scenes the second has left the row, and the fourth has risen over the wall.
    after = scene([places[0], (2.0, 2.0, height), places[2], (11.0, 0.0, 6.0)])
    moment = Moment(before, after, 0.5)
    positions = np.array([moment.pose(f"{name}::base_link").position for name in names])
    np.testing.assert_allclose(positions[[1, 3]], [(2.0, 1.0, height), (11.0, 0.0, 3.75)])
    sights = Sights(rays, moment)
    # at x = 8 the line from (0, 1.5) to (11, 3.75) is at 1.5 + 2.25 * 8 / 11 = 3.1 m, above the wall's 2 m
    assert sights.blocked("iris_0", positions[0], names[1:], positions[1:]).tolist() == [False, False, False]
    assert moment.pose("iris_9::base_link") is None
