"""Actions that the mission control requests of a vehicle. Positions are m in the map frame (ENU)."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_control.autopilot.navigator.plan import Items

MISSION, OFFBOARD, LOITER, RTL, LAND = "AUTO.MISSION", "OFFBOARD", "AUTO.LOITER", "AUTO.RTL", "AUTO.LAND"

Position = tuple[float, float, float]


@dataclass(frozen=True)
class SetMode:
    """Request a flight mode."""

    vehicle: str
    mode: str


@dataclass(frozen=True)
class Arm:
    """Arm a vehicle."""

    vehicle: str


@dataclass(frozen=True)
class PushMission:
    """Upload a mission and continue with item ``current``."""

    vehicle: str
    items: Items
    current: int


@dataclass(frozen=True)
class GoTo:
    """Publish a position setpoint; yaw in rad from east."""

    vehicle: str
    position: Position
    yaw: float


@dataclass(frozen=True)
class Follow:
    """Follow a track of the vehicle's camera; -1 stops."""

    vehicle: str
    track: int


@dataclass(frozen=True)
class PointCamera:
    """Point a vehicle's camera ahead at a pitch, deg, negative down."""

    vehicle: str
    pitch: float


@dataclass(frozen=True)
class SetReturnHeight:
    """Set the minimum height of a vehicle's return, m over home; different heights keep returning vehicles apart."""

    vehicle: str
    height: float


Action = SetMode | Arm | PushMission | GoTo | Follow | PointCamera | SetReturnHeight
