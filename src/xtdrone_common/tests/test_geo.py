"""The map projection."""

from __future__ import annotations

import math

import pytest

from xtdrone_common.geodesy import projection

_ORIGIN = (47.397742, 8.545594)


@pytest.mark.parametrize(("north", "east"), [(0.0, 0.0), (1e-3, -2e-3), (5.0, 7.0), (-3000.0, 20.0), (2e5, -3e5)])
def test_there_and_back(north, east):
    place = projection.reproject(north, east, *_ORIGIN)
    assert projection.project(*place, *_ORIGIN) == pytest.approx((north, east), abs=1e-6)


def test_a_degree_of_latitude():
    north, east = projection.project(48.397742, 8.545594, *_ORIGIN)
    assert north == pytest.approx(projection.EARTH_RADIUS * math.pi / 180)
    assert east == pytest.approx(0.0, abs=1e-6)


def test_east_shrinks_with_latitude():
    _, east = projection.project(_ORIGIN[0], _ORIGIN[1] + 1e-4, *_ORIGIN)
    assert east == pytest.approx(
        projection.EARTH_RADIUS * math.radians(1e-4) * math.cos(math.radians(_ORIGIN[0])), rel=1e-6
    )


def test_across_the_date_line():
    north, east = projection.project(10.0, -179.9, 10.0, 179.9)
    assert east == pytest.approx(projection.EARTH_RADIUS * math.radians(0.2) * math.cos(math.radians(10.0)), rel=1e-5)
    assert abs(north) < 10.0
