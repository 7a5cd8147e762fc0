"""Changes of the local frame's origin by command, as in PX4 v1.14's Ekf::setEkfGlobalOrigin."""

from __future__ import annotations

from typing import Any

from xtdrone_control.autopilot.state import HEIGHT_RANGE, HEIGHT_VISION
from xtdrone_control.geodesy import projection

_LOWEST, _HIGHEST = -12_000.0, 100_000.0  # m AMSL: a deep-sea trench, the edge of space


def is_origin(latitude: float, longitude: float, altitude: float) -> bool:
    """Return whether a position (degrees, m AMSL) is valid as an origin."""
    return abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and _LOWEST < altitude < _HIGHEST


def move_origin(e: Any, latitude: float, longitude: float, altitude: float) -> None:
    """Set the origin of an ``ESTIMATOR`` record.

    With a valid global position, that position stays and the local position is reset to match the new origin. Without
    one, the local position stays and the origin defines the global position.

    Args:
        e: ``ESTIMATOR`` record.
        latitude: degrees.
        longitude: degrees.
        altitude: m AMSL.

    Raises:
        ValueError: the position is not valid as an origin.
    """
    if not is_origin(latitude, longitude, altitude):
        raise ValueError(f"origin: {latitude}, {longitude}, {altitude} m is not a position on Earth")
    origin = e["origin"]
    if origin["set"] and e["position_valid"]:
        x, y, _ = e["position"].tolist()
        vehicle = projection.reproject(x, y, float(origin["lat"]), float(origin["lon"]))
        north, east = projection.project(*vehicle, latitude, longitude)
        _shift(e, north - x, east - y, altitude - float(origin["alt"]))
    origin["lat"], origin["lon"], origin["alt"] = latitude, longitude, altitude
    origin["set"] = 1
    e["global_valid"] = int(e["position_valid"]) & int(e["heading_aligned"])


def _shift(e: Any, north: float, east: float, down: float) -> None:
    e["position"] += (north, east, down)
    e["last_position"] += (north, east)
    e["vision_offset"] -= (north, east)
    for source in (HEIGHT_RANGE, HEIGHT_VISION):  # barometer and GPS measure AMSL and need no correction
        e["height_offset"][source] += down
    e["terrain"] += down
    e["shifts"]["xy"] = (north, east)
    e["shifts"]["z"] = down
    for counter, count in (("xy", 1), ("z", 1), ("any", 2)):
        e["resets"][counter] += count
