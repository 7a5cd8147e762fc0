import numpy as np
import pytest

from xtdrone_common.cameras.pinhole import Pinhole


def test_the_typhoons_camera_has_upstreams_focal_length():
    camera = Pinhole.of_view(640, 360, 2.0)
    assert camera.fx == pytest.approx(205.4696, abs=1e-3)
    assert (camera.cx, camera.cy) == (320.0, 180.0)


def test_projection_and_rays_are_inverse():
    camera = Pinhole.of_view(640, 360, 2.0)
    points = np.random.default_rng(0).uniform([-5, -3, 0.5], [5, 3, 40], (100, 3))
    assert camera.rays(camera.project(points)) == pytest.approx(points / points[:, 2:])


def test_points_behind_the_camera_are_not_visible():
    assert np.isnan(Pinhole.of_view(640, 360, 2.0).project(np.array([[0.0, 0.0, -1.0]]))).all()
