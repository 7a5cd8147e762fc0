import math

import numpy as np
import pytest

from xtdrone_control.checks import check_choice, check_range
from xtdrone_control.pinhole import Pinhole


@pytest.mark.parametrize("value", [0.0, 1, 2.0])
def test_values_within_limits_are_returned_as_numbers(value):
    assert check_range("speed", value, 0.0, 2.0) == float(value)


@pytest.mark.parametrize("value", [-0.1, 2.1, math.nan, math.inf, True, "1", None])
def test_other_values_are_named_with_what_is_allowed(value):
    with pytest.raises(ValueError, match=r"^speed: .* is not allowed, 0 to 2 m/s$"):
        check_range("speed", value, 0.0, 2.0, "m/s")


def test_a_choice_names_what_there_is():
    assert check_choice("law", "vel", ("vel", "accel")) == "vel"
    with pytest.raises(ValueError, match=r"^law: 'pos' is not allowed, vel or accel$"):
        check_choice("law", "pos", ("vel", "accel"))


def test_the_typhoons_camera_has_upstreams_focal_length():
    camera = Pinhole.of_view(640, 360, 2.0)
    assert camera.fx == pytest.approx(205.4696, abs=1e-3)
    assert (camera.cx, camera.cy) == (320.0, 180.0)


def test_projection_and_rays_are_inverse():
    camera = Pinhole.of_view(640, 360, 2.0)
    points = np.random.default_rng(0).uniform([-5, -3, 0.5], [5, 3, 40], (100, 3))
    assert camera.rays(camera.project(points)) == pytest.approx(points / points[:, 2:])


def test_what_lies_behind_is_not_seen():
    assert np.isnan(Pinhole.of_view(640, 360, 2.0).project(np.array([[0.0, 0.0, -1.0]]))).all()
