"""XTDrone's models that are not simulated here: the reason why a name is unknown."""

from __future__ import annotations

_REASONS = {
    "rover": "a ground vehicle",
    "rover_with_lidar_stereo": "a ground vehicle with lidar and stereo cameras",
    "catvehicle": "a ground vehicle",
    "plane": "a fixed-wing aircraft",
    "plane_gimbal": "a fixed-wing aircraft",
    "standard_vtol": "a VTOL aircraft",
    "tiltrotor": "a VTOL aircraft",
    "tailsitter": "a VTOL aircraft",
}


def not_simulated(name: str) -> str:
    """Return the reason why XTDrone's model ``name`` is not available, as a clause; "" for any other name."""
    return f"{_REASONS[name]} is not simulated" if name in _REASONS else ""
