"""The geoid against published heights of the model, and laws of interpolation on a sphere."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xtdrone_common.geodesy.geoid import undulation

# latitude, longitude, height in m: NGA's test points of EGM96 (OUTPUT.DAT of the program F477), and Timbuktu by
# GeographicLib's GeoidEval with egm96-5 (its manual page).
PUBLISHED = [
    (38.6281550, 269.7791550, -31.628),
    (-14.6212170, 305.0211140, -2.969),
    (46.8743190, 102.4487290, -43.575),
    (-23.6174460, 133.8747120, 15.871),
    (38.6254730, 359.9995000, 50.066),
    (-0.4667440, 0.0023000, 17.329),
    (16.7758, -3.0094, 28.7068),
]


@pytest.mark.parametrize(("latitude", "longitude", "height"), PUBLISHED)
def test_it_is_that_of_the_model(latitude, longitude, height):
    assert undulation(latitude, longitude) == pytest.approx(height, abs=0.05)


def test_at_px4s_home_the_offset_is_that_of_mavros():
    assert undulation(47.397742, 8.545594) == pytest.approx(47.3, abs=0.1)


@given(st.floats(-90.0, 90.0), st.floats(-720.0, 720.0))
def test_it_is_bounded_and_the_same_after_a_turn(latitude, longitude):
    height = undulation(latitude, longitude)
    assert -108.0 < height < 87.0
    assert undulation(latitude, longitude + 360.0) == pytest.approx(height, abs=1e-6)


@given(st.floats(-89.9, 89.9), st.floats(0.0, 360.0))
def test_it_has_no_steps(latitude, longitude):
    height = undulation(latitude, longitude)
    assert undulation(latitude + 1e-6, longitude) == pytest.approx(height, abs=1e-4)
    assert undulation(latitude, longitude + 1e-6) == pytest.approx(height, abs=1e-4)


@pytest.mark.parametrize(("pole", "height"), [(90.0, 13.61), (-90.0, -29.53)])
def test_the_poles_are_one_place_each(pole, height):
    assert {round(undulation(pole, longitude), 3) for longitude in range(0, 360, 30)} == {height}


@pytest.mark.parametrize("place", [(90.1, 0.0), (float("nan"), 0.0), (0.0, float("inf"))])
def test_no_position_is_rejected(place):
    with pytest.raises(ValueError, match="not allowed"):
        undulation(*place)
