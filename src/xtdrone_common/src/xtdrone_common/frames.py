"""Frame conversions between ROS (ENU, FLU) and the autopilot (NED, FRD), on plain floats.

Local frames: ENU is x east, y north, z up; NED is x north, y east, z down. Body frames: FLU is x forward, y left,
z up (``base_link``); FRD is x forward, y right, z down. Both conversions are self-inverse.

Quaternions are (w, x, y, z) in all functions of this module and rotate body vectors to the local frame; ROS messages
order them x, y, z, w and MAVLink w, x, y, z. Positions are in metres, angles in radians unless a name says otherwise.
No function uses numpy: for three floats plain Python is ten times faster.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, degrees, hypot, pi, radians, sin, sqrt

from xtdrone_common import rotation
from xtdrone_common.rotation import Quaternion, Vector, wrap_pi_by_remainder

_HALF_SQRT = sqrt(0.5)
_WGS84_A = 6378137.0  # m, equatorial radius
_WGS84_F = 1.0 / 298.257223563
_WGS84_E2 = _WGS84_F * (2.0 - _WGS84_F)
_LATITUDE_STEPS = 6  # iterations; each reduces the error by a factor of 300


def enu_to_ned(x: float, y: float, z: float) -> Vector:
    """Convert a vector from ENU to NED."""
    return y, x, -z


def ned_to_enu(x: float, y: float, z: float) -> Vector:
    """Convert a vector from NED to ENU."""
    return y, x, -z


def flu_to_frd(x: float, y: float, z: float) -> Vector:
    """Convert a vector from FLU to FRD."""
    return x, -y, -z


def frd_to_flu(x: float, y: float, z: float) -> Vector:
    """Convert a vector from FRD to FLU."""
    return x, -y, -z


def _permuted(covariance: Sequence[float], order: Sequence[int], signs: Sequence[float]) -> list[float]:
    return [
        signs[i] * signs[j] * covariance[6 * order[i] + order[j]] for i in range(6) for j in range(6)
    ]  # fmt: skip


def covariance_enu_to_ned(covariance: Sequence[float]) -> list[float]:
    """Convert a 6x6 covariance (x, y, z, rotations about x, y, z; row by row) between ENU and NED (self-inverse)."""
    return _permuted(covariance, (1, 0, 2, 4, 3, 5), (1.0, 1.0, -1.0, 1.0, 1.0, -1.0))


def covariance_flu_to_frd(covariance: Sequence[float]) -> list[float]:
    """Convert a 6x6 covariance (x, y, z, rotations about x, y, z; row by row) between FLU and FRD (self-inverse)."""
    return _permuted(covariance, range(6), (1.0, -1.0, -1.0, 1.0, -1.0, -1.0))


def upper_triangle(covariance: Sequence[float]) -> list[float]:
    """Return the upper triangle of a 6x6 matrix, both row by row, as in MAVLink (21 values)."""
    return [covariance[6 * i + j] for i in range(6) for j in range(i, 6)]


def from_upper_triangle(values: Sequence[float]) -> list[float]:
    """Return the symmetric 6x6 matrix, row by row, of the upper triangle ``values`` (21)."""
    starts = (0, 6, 11, 15, 18, 20)
    return [values[starts[min(i, j)] + abs(i - j)] for i in range(6) for j in range(6)]


def yaw_enu_to_ned(yaw: float) -> float:
    """Return the NED heading (clockwise from north) of an ENU yaw (counter-clockwise from east), in [-pi, pi)."""
    return wrap_pi_by_remainder(0.5 * pi - yaw)


def yaw_ned_to_enu(yaw: float) -> float:
    """Return the ENU yaw of a NED heading, in [-pi, pi)."""
    return wrap_pi_by_remainder(0.5 * pi - yaw)


def attitude_ned_to_enu(w: float, x: float, y: float, z: float) -> Quaternion:
    """Return the FLU-to-ENU attitude of a FRD-to-NED attitude.

    The result is the product q_ned_to_enu q q_flu_to_frd, with the sign for which a level vehicle heading north has
    (0.707, 0, 0, 0.707). The conversion is self-inverse.
    """
    return _HALF_SQRT * (w + z), _HALF_SQRT * (x + y), _HALF_SQRT * (x - y), _HALF_SQRT * (w - z)


def attitude_enu_to_ned(w: float, x: float, y: float, z: float) -> Quaternion:
    """Return the FRD-to-NED attitude of a FLU-to-ENU attitude."""
    return attitude_ned_to_enu(w, x, y, z)


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Rotate ``v`` from the body frame to the local frame by the unit attitude ``q``."""
    return rotation.rotate(q, *v)


def rotate_inverse(q: Quaternion, v: Vector) -> Vector:
    """Rotate ``v`` from the local frame to the body frame by the unit attitude ``q``."""
    return rotation.rotate_inverse(q, *v)


def to_xyzw(q: Sequence[float]) -> Quaternion:
    """Return a quaternion (w, x, y, z) in the order of ROS messages and Bullet, (x, y, z, w)."""
    return q[1], q[2], q[3], q[0]


quaternion_from_rpy = rotation.from_euler
rpy_from_quaternion = rotation.to_euler
yaw_from_quaternion = rotation.yaw_of


def geodetic_to_ecef(latitude: float, longitude: float, altitude: float) -> Vector:
    """Return the ECEF position (m) of WGS84 latitude, longitude (deg) and height above the ellipsoid (m)."""
    sin_lat, cos_lat = sin(radians(latitude)), cos(radians(latitude))
    normal = _WGS84_A / sqrt(1.0 - _WGS84_E2 * sin_lat * sin_lat)
    horizontal = (normal + altitude) * cos_lat
    return (
        horizontal * cos(radians(longitude)),
        horizontal * sin(radians(longitude)),
        (normal * (1.0 - _WGS84_E2) + altitude) * sin_lat,
    )


def geodetic_to_enu(position: Vector, origin: Vector) -> Vector:
    """Return ``position`` relative to ``origin``, m ENU; both are (latitude deg, longitude deg, height m), WGS84."""
    px, py, pz = geodetic_to_ecef(*position)
    ox, oy, oz = geodetic_to_ecef(*origin)
    dx, dy, dz = px - ox, py - oy, pz - oz
    sin_lat, cos_lat = sin(radians(origin[0])), cos(radians(origin[0]))
    sin_lon, cos_lon = sin(radians(origin[1])), cos(radians(origin[1]))
    outward = cos_lon * dx + sin_lon * dy
    return cos_lon * dy - sin_lon * dx, cos_lat * dz - sin_lat * outward, cos_lat * outward + sin_lat * dz


def ecef_to_geodetic(x: float, y: float, z: float) -> Vector:
    """Return WGS84 latitude, longitude (deg) and height above the ellipsoid (m) of an ECEF position (m).

    Accurate to below a micrometre except near the centre of the earth.
    """
    horizontal = hypot(x, y)
    latitude = atan2(z, horizontal * (1.0 - _WGS84_E2))
    for _ in range(_LATITUDE_STEPS):
        sin_lat = sin(latitude)
        normal = _WGS84_A / sqrt(1.0 - _WGS84_E2 * sin_lat * sin_lat)
        latitude = atan2(z + _WGS84_E2 * normal * sin_lat, horizontal)
    sin_lat, cos_lat = sin(latitude), cos(latitude)
    height = horizontal * cos_lat + z * sin_lat - _WGS84_A * sqrt(1.0 - _WGS84_E2 * sin_lat * sin_lat)
    return degrees(latitude), degrees(atan2(y, x)), height


def enu_to_geodetic(position: Vector, origin: Vector) -> Vector:
    """Return (latitude deg, longitude deg, height m), WGS84, of ``position`` (m, ENU) relative to ``origin``."""
    east, north, up = position
    ox, oy, oz = geodetic_to_ecef(*origin)
    sin_lat, cos_lat = sin(radians(origin[0])), cos(radians(origin[0]))
    sin_lon, cos_lon = sin(radians(origin[1])), cos(radians(origin[1]))
    outward = cos_lat * up - sin_lat * north
    return ecef_to_geodetic(
        ox + cos_lon * outward - sin_lon * east,
        oy + sin_lon * outward + cos_lon * east,
        oz + cos_lat * north + sin_lat * up,
    )
