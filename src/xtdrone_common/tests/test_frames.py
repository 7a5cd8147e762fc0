"""Properties of the frame conversions on seeded random vectors and attitudes, and a closed-form table."""

from __future__ import annotations

import math
import random

import pytest

from xtdrone_common import frames, rotation

SQRT_HALF = math.sqrt(0.5)
VECTORS = [tuple(random.Random(seed).uniform(-100.0, 100.0) for _ in range(3)) for seed in range(20)]


def random_attitude(seed: int) -> tuple[float, float, float, float]:
    source = random.Random(seed)
    values = [source.gauss(0.0, 1.0) for _ in range(4)]
    norm = math.sqrt(sum(v * v for v in values))
    return tuple(v / norm for v in values)


ATTITUDES = [random_attitude(seed) for seed in range(20)]


def same_rotation(a, b) -> bool:
    return abs(abs(sum(x * y for x, y in zip(a, b, strict=True))) - 1.0) < 1e-12


@pytest.mark.parametrize("v", VECTORS)
@pytest.mark.parametrize(
    ("there", "back"), [(frames.enu_to_ned, frames.ned_to_enu), (frames.flu_to_frd, frames.frd_to_flu)]
)
def test_changes_of_frame_invert_each_other_and_keep_right_hands(v, there, back):
    assert back(*there(*v)) == v
    x, y, z = there(1, 0, 0), there(0, 1, 0), there(0, 0, 1)
    cross = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    assert cross == z


def test_axes():
    assert frames.enu_to_ned(1.0, 2.0, 3.0) == (2.0, 1.0, -3.0)
    assert frames.flu_to_frd(1.0, 2.0, 3.0) == (1.0, -2.0, -3.0)


@pytest.mark.parametrize("v", VECTORS)
@pytest.mark.parametrize("q", ATTITUDES)
def test_attitude_conversion_turns_the_same_physical_vector(q, v):
    """An FRD vector rotated by the NED attitude equals its FLU form rotated by the ENU attitude."""
    ned = frames.rotate(q, v)
    enu = frames.rotate(frames.attitude_ned_to_enu(*q), frames.frd_to_flu(*v))
    assert frames.ned_to_enu(*ned) == pytest.approx(enu, abs=1e-9)


@pytest.mark.parametrize("q", ATTITUDES)
def test_attitude_conversion_is_its_own_inverse(q):
    assert frames.attitude_enu_to_ned(*frames.attitude_ned_to_enu(*q)) == pytest.approx(q, abs=1e-15)


@pytest.mark.parametrize(
    ("heading_ned_deg", "yaw_enu_deg"), [(0, 90), (90, 0), (180, -90), (-90, 180), (45, 45), (135, -45), (-135, -135)]
)
def test_heading_table(heading_ned_deg, yaw_enu_deg):
    heading, yaw = math.radians(heading_ned_deg), math.radians(yaw_enu_deg)
    difference = rotation.wrap_pi_by_remainder(frames.yaw_ned_to_enu(heading) - yaw)
    assert difference == pytest.approx(0.0, abs=1e-12)
    q = frames.attitude_ned_to_enu(*frames.quaternion_from_rpy(0.0, 0.0, heading))
    assert same_rotation(q, frames.quaternion_from_rpy(0.0, 0.0, yaw))


@pytest.mark.parametrize("seed", range(5))
def test_attitude_has_the_opposite_sign_of_mavros(seed):
    # MAVROS multiplies by its static rotations, NED to ENU (roll pi, yaw pi/2) and FRD to FLU (roll pi)
    q = random_attitude(seed)
    of_mavros = rotation.multiply(
        rotation.multiply(rotation.from_euler(math.pi, 0.0, math.pi / 2), q), rotation.from_euler(math.pi, 0.0, 0.0)
    )
    assert [-value for value in frames.attitude_ned_to_enu(*q)] == pytest.approx(list(of_mavros))


def test_level_and_heading_north_is_a_quarter_turn_in_enu():
    assert frames.attitude_ned_to_enu(1.0, 0.0, 0.0, 0.0) == (SQRT_HALF, 0.0, 0.0, SQRT_HALF)


@pytest.mark.parametrize(("roll", "pitch", "yaw"), [(0.3, -0.4, 1.2), (-1.0, 1.2, -3.0), (0.0, 0.0, 0.0)])
def test_angles_in_ned_become_angles_in_enu(roll, pitch, yaw):
    """Roll keeps its sign, pitch changes it (nose up is negative in FLU), yaw is measured from east."""
    q = frames.attitude_ned_to_enu(*frames.quaternion_from_rpy(roll, pitch, yaw))
    assert frames.rpy_from_quaternion(q) == pytest.approx((roll, -pitch, frames.yaw_ned_to_enu(yaw)), abs=1e-12)


@pytest.mark.parametrize("q", ATTITUDES)
def test_angles_and_quaternions_agree(q):
    assert same_rotation(frames.quaternion_from_rpy(*frames.rpy_from_quaternion(q)), q)


def test_pitch_of_a_quarter_turn_does_not_leave_the_domain_of_asin():
    q = (SQRT_HALF + 1e-12, 0.0, SQRT_HALF + 1e-12, 0.0)
    assert frames.rpy_from_quaternion(q)[1] == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("v", VECTORS)
@pytest.mark.parametrize("q", ATTITUDES[:5])
def test_rotation_keeps_length_and_is_inverted(q, v):
    turned = frames.rotate(q, v)
    assert math.hypot(*turned) == pytest.approx(math.hypot(*v))
    assert frames.rotate_inverse(q, turned) == pytest.approx(v, abs=1e-9)


@pytest.mark.parametrize("angle", [0.0, 3.0, -3.0, 7.0, -7.0, 100.0, math.pi, -math.pi])
@pytest.mark.parametrize("wrap", [rotation.wrap_pi, rotation.wrap_pi_by_remainder])
def test_wrapped_angle_is_in_range_and_congruent(wrap, angle):
    wrapped = wrap(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)


def test_geodetic_offsets():
    """A small step along each axis matches the ellipsoid's radii of curvature at 47.4 deg (textbook formulas)."""
    a, e2 = 6378137.0, 0.00669437999014
    latitude = math.radians(47.4)
    w = math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
    meridian, normal = a * (1.0 - e2) / w**3, a / w
    origin = (47.4, 8.5, 488.0)
    step = 1e-4
    north = frames.geodetic_to_enu((47.4 + step, 8.5, 488.0), origin)
    east = frames.geodetic_to_enu((47.4, 8.5 + step, 488.0), origin)
    up = frames.geodetic_to_enu((47.4, 8.5, 500.0), origin)
    assert north == pytest.approx((0.0, math.radians(step) * (meridian + 488.0), 0.0), abs=1e-3)
    assert east == pytest.approx((math.radians(step) * (normal + 488.0) * math.cos(latitude), 0.0, 0.0), abs=1e-3)
    assert up == pytest.approx((0.0, 0.0, 12.0), abs=1e-6)


def test_equator_and_pole_in_earth_centred_coordinates():
    assert frames.geodetic_to_ecef(0.0, 0.0, 0.0) == pytest.approx((6378137.0, 0.0, 0.0))
    assert frames.geodetic_to_ecef(90.0, 0.0, 0.0) == pytest.approx((0.0, 0.0, 6356752.314245), abs=1e-6)
