"""Lidars of a fleet."""

from __future__ import annotations

from collections.abc import Sequence

from xtdrone_control.fleet import Vehicle
from xtdrone_sim.vehicles.mounts.fleet_sensor import FleetSensor, sensors_of
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount

Lidar = FleetSensor[LidarMount]


def lidars_of(fleet: Sequence[Vehicle]) -> tuple[Lidar, ...]:
    """Return all lidars of a fleet, vehicle by vehicle.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    return sensors_of(fleet, lambda model: [(mount.link, mount) for mount in model.lidars])
