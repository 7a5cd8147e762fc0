"""UWB sensors of a fleet, and the neighbours that each measures."""

from __future__ import annotations

from collections.abc import Sequence

from xtdrone_control.fleet import Vehicle
from xtdrone_sim.vehicles.mounts.body_sensors import UwbMount
from xtdrone_sim.vehicles.mounts.fleet_sensor import FleetSensor, sensors_of

Antenna = FleetSensor[UwbMount]


def antennas_of(fleet: Sequence[Vehicle]) -> tuple[Antenna, ...]:
    """Return all UWB sensors of a fleet, vehicle by vehicle.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    return sensors_of(fleet, lambda model: [(model.urdf.root, mount) for mount in model.uwb])


def neighbours_of(own: int, antennas: Sequence[Antenna]) -> tuple[int, ...]:
    """Return the antennas that an antenna measures: for each other vehicle, the one of the same name, else its first.

    Args:
        own: index of the measuring antenna.
        antennas: of a fleet, vehicle by vehicle.

    Returns:
        Indices, in the fleet's order.
    """
    chosen: dict[str, int] = {}
    for k, antenna in enumerate(antennas):
        if antenna.vehicle == antennas[own].vehicle:
            continue
        if antenna.vehicle not in chosen or antenna.mount.name == antennas[own].mount.name:
            chosen[antenna.vehicle] = k
    return tuple(chosen.values())
