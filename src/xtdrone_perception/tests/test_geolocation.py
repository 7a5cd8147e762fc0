"""Positions on the ground against hand-computed geometry, and their covariance against random errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_common import frames
from xtdrone_common.cameras.camera_pose import camera_link_pose, mount_orientation, optical_pose
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_perception.tracking.geolocation import Geolocator, Noise, Person, View, cylinder_box, rotation_from_vector

PINHOLE = Pinhole.of_view(640, 360, 2.0)


def view(position=(0.0, 0.0, 20.0), pitch=-60.0, yaw=0.0) -> View:
    heading = frames.quaternion_from_rpy(0.0, 0.0, math.radians(yaw))
    link = camera_link_pose(position, heading, mount_orientation(0.0, math.radians(pitch), 0.0), (0, 0, 0))
    return View.of(PINHOLE, *optical_pose(link))


def test_the_middle_of_the_picture_meets_the_ground_where_the_camera_points():
    locator = Geolocator(ground=2.0)
    assert locator.point(view(yaw=90.0), (320, 180)) == pytest.approx((0.0, 18.0 / math.tan(math.pi / 3), 2.0))
    down = locator.point(view(pitch=-90.0), (320 + PINHOLE.fx, 180))
    assert down == pytest.approx((0.0, -18.0, 2.0))  # 45 degrees to the right, heading east: south


def test_rays_above_the_horizon_or_too_far_are_rejected():
    locator = Geolocator(farthest=100.0)
    level = view(pitch=0.0)
    assert locator.point(level, (320, 180)) is None
    assert locator.point(level, (320, 10)) is None
    assert locator.point(level, (320, 180 + PINHOLE.fy * math.tan(math.radians(3.5)))) is None  # 330 m away
    assert locator.point(level, (320, 180 + PINHOLE.fy * math.tan(math.radians(20)))) is not None
    assert locator.locate(level, (300.0, 150.0, 310.0, 175.0)) is None
    assert Geolocator().point(view(position=(0, 0, -1.0)), (320, 180)) is None  # below the ground


def test_box_of_a_cylinder_is_that_of_its_rims_points():
    angles = np.linspace(0.0, 2.0 * math.pi, 20001)
    for pitch, foot in ((-90.0, (1.0, -2.0, 0.0)), (-60.0, (9.0, 4.0, 0.3)), (-20.0, (30.0, -10.0, 1.0))):
        camera = view(pitch=pitch)
        rim = np.column_stack([foot[0] + 0.3 * np.cos(angles), foot[1] + 0.3 * np.sin(angles)])
        points = np.vstack([np.column_stack([rim, np.full(len(rim), foot[2] + z)]) for z in (0.0, 1.7)])
        pixels = PINHOLE.project((points - camera.position) @ camera.rotation)
        expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
        assert cylinder_box(camera, np.array(foot), 1.7, 0.3) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("pitch", [-90.0, -60.0, -30.0])
def test_a_person_of_average_size_is_located_exactly(pitch):
    camera = view(pitch=pitch, yaw=30.0)
    ahead = 20.0 / math.tan(math.radians(-pitch)) if pitch > -90.0 else 0.0
    foot = np.array([ahead * math.cos(math.radians(30.0)) + 1.0, ahead * 0.5 - 3.0, 0.0])
    found = Geolocator().locate(camera, tuple(cylinder_box(camera, foot, 1.7, 0.3)))
    assert found.position == pytest.approx(foot, abs=1e-3)


def test_lower_edge_of_the_box_is_not_the_foot_from_steep_above():
    camera = view(pitch=-80.0)
    foot = np.array([-8.0, 0.0, 0.0])  # behind the vehicle: in the picture the head is lower than the foot
    box = cylinder_box(camera, foot, 1.7, 0.3)
    naive = Geolocator().point(camera, (0.5 * (box[0] + box[2]), box[3]))
    assert math.dist(naive[:2], foot[:2]) > 0.7
    assert math.dist(Geolocator().locate(camera, tuple(box)).position[:2], foot[:2]) < 1e-3


def test_slope_of_the_ground():
    def ground(x: float, y: float) -> float:
        return 0.2 * x - 0.1 * y

    camera = view()
    foot = np.array([8.0, 3.0, ground(8.0, 3.0)])
    found = Geolocator(ground).locate(camera, tuple(cylinder_box(camera, foot, 1.7, 0.3)))
    assert found.position == pytest.approx(foot, abs=1e-3)
    normal = np.array([-0.2, 0.1, 1.0])
    assert normal @ (found.covariance - np.diag([0, 0, 0.01])) @ normal == pytest.approx(0.0, abs=1e-9)


def test_a_box_cut_off_by_the_picture_is_less_certain_but_unbiased():
    camera = view(pitch=-45.0)
    foot = Geolocator().point(camera, (320.0, 357.0))
    whole = cylinder_box(camera, foot, 1.7, 0.3)
    assert whole[3] > 361.0
    cut = (whole[0], whole[1], whole[2], 360.0)
    found = Geolocator().locate(camera, cut)
    assert found.position == pytest.approx(foot, abs=0.02)
    assert np.trace(found.covariance) > np.trace(Geolocator().locate(camera, tuple(whole)).covariance)


def test_a_perfect_picture_leaves_only_the_shared_covariance():
    camera = view()
    box = tuple(cylinder_box(camera, np.array([10.0, 2.0, 0.0]), 1.7, 0.3))
    sharp = Geolocator(noise=Noise(pixel=1e-3, tilt=0.0, heading=0.0, horizontal=0.5, vertical=0.0, ground=0.0))
    found = sharp.locate(camera, box)
    assert found.covariance[:2, :2] == pytest.approx(0.25 * np.eye(2), abs=1e-3)
    assert found.independent == pytest.approx(np.zeros((3, 3)), abs=1e-6)


@pytest.mark.parametrize(("pitch", "x", "y"), [(-90.0, 3.0, -2.0), (-60.0, 12.0, 5.0), (-35.0, 30.0, -4.0)])
def test_the_covariance_matches_the_errors(pitch, x, y):
    """Normalised squared errors are chi-squared with two degrees of freedom."""
    random = np.random.default_rng(7)
    noise, person = Noise(), Person()
    locator = Geolocator(person=person, noise=noise)
    told, squares = view(pitch=pitch), []
    for _ in range(250):
        turn = rotation_from_vector(random.normal(0.0, [noise.tilt, noise.tilt, noise.heading]))
        shift = random.normal(0.0, [noise.horizontal, noise.horizontal, noise.vertical])
        true = View(PINHOLE, told.position + shift, turn @ told.rotation)
        foot = np.array([x, y, random.normal(0.0, noise.ground)])
        height = random.normal(person.height, person.height_noise)
        radius = max(random.normal(person.radius, person.radius_noise), 0.1)
        box = cylinder_box(true, foot, height, radius) + random.normal(0.0, noise.pixel, 4)
        found = locator.locate(told, tuple(box))
        error = (found.position - foot)[:2]
        squares.append(error @ np.linalg.solve(found.covariance[:2, :2], error))
    # 99.9 % of means of 250 such squares lie within 2 +- 3.29 * 2 / sqrt(250); a tenth more for nonlinearity.
    assert 1.5 < np.mean(squares) < 2.6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ground": math.nan}, "ground: nan"),
        ({"farthest": 0.0}, "farthest: 0.0"),
        ({"person": {"height": -1.0}}, "height: -1.0"),
        ({"noise": {"pixel": 0.0}}, "pixel: 0.0"),
    ],
)
def test_invalid_values_are_rejected(arguments, message):
    kinds = {"person": Person, "noise": Noise}
    with pytest.raises(ValueError, match=message):
        Geolocator(**{name: kinds[name](**value) if name in kinds else value for name, value in arguments.items()})
