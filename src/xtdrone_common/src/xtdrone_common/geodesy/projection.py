"""Azimuthal equidistant projection of latitude and longitude on a sphere, as in PX4's geo library, and its origin.

J. P. Snyder, "Map Projections: A Working Manual", USGS 1987, chapter 25. The functions are of plain floats, for kernels
to compile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

EARTH_RADIUS = 6371000.0  # m, the sphere that PX4 projects from
GRAVITY = 9.80665  # m/s^2, standard gravity (CONSTANTS_ONE_G of PX4's geo library)


def project(latitude: float, longitude: float, origin_latitude: float, origin_longitude: float) -> tuple[float, float]:
    """Return (north, east), m, of a position relative to the origin.

    Args:
        latitude: degrees.
        longitude: degrees.
        origin_latitude: degrees.
        origin_longitude: degrees.
    """
    phi, phi0 = math.radians(latitude), math.radians(origin_latitude)
    turn = math.radians(longitude - origin_longitude)
    # the haversine is accurate at short distances, where the textbook's arc cosine is not
    half_north, half_east = math.sin(0.5 * (phi - phi0)), math.sin(0.5 * turn)
    chord = half_north * half_north + math.cos(phi0) * math.cos(phi) * half_east * half_east
    angle = 2.0 * math.asin(math.sqrt(min(max(chord, 0.0), 1.0)))  # rounding may exceed the range
    scale = EARTH_RADIUS
    if angle > 1e-12:
        scale *= angle / math.sin(angle)
    # cos(phi0) sin(phi) - sin(phi0) cos(phi) cos(turn), rewritten without cancellation
    north = scale * (math.sin(phi - phi0) + 2.0 * math.sin(phi0) * math.cos(phi) * half_east * half_east)
    east = scale * math.cos(phi) * math.sin(turn)
    return north, east


def reproject(north: float, east: float, origin_latitude: float, origin_longitude: float) -> tuple[float, float]:
    """Return (latitude, longitude), degrees, of a position ``north``, ``east`` (m) of the origin (degrees)."""
    x, y = north / EARTH_RADIUS, east / EARTH_RADIUS
    angle = math.hypot(x, y)
    if angle < 1e-15:
        return origin_latitude, origin_longitude
    phi0 = math.radians(origin_latitude)
    sin_angle, cos_angle = math.sin(angle), math.cos(angle)
    sine = cos_angle * math.sin(phi0) + x * sin_angle * math.cos(phi0) / angle
    phi = math.asin(min(max(sine, -1.0), 1.0))
    turn = math.atan2(y * sin_angle, angle * math.cos(phi0) * cos_angle - x * math.sin(phi0) * sin_angle)
    return math.degrees(phi), origin_longitude + math.degrees(turn)


def is_place(latitude: float, longitude: float, altitude: float) -> bool:
    """Return whether latitude and longitude (degrees) are in range and the altitude is finite."""
    return abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and math.isfinite(altitude)


@dataclass(frozen=True)
class Datum:
    """Origin of a local frame (WGS84): latitude and longitude in degrees, altitude in metres AMSL."""

    latitude: float
    longitude: float
    altitude: float

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Return (latitude, longitude), degrees, of a point ``x``, ``y`` in the local frame, m ENU."""
        return reproject(y, x, self.latitude, self.longitude)

    def local(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Return (east, north), m, of a latitude and longitude in degrees."""
        north, east = project(latitude, longitude, self.latitude, self.longitude)
        return east, north
