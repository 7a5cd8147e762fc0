"""UWB sensors of a fleet, and who measures whom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from xtdrone_control.fleet import Vehicle
from xtdrone_sim.vehicles.mounts.uwb_mounts import UwbMount
from xtdrone_sim.vehicles.vehicle_model import load_vehicle


@dataclass(frozen=True)
class Antenna:
    """A UWB sensor of one vehicle.

    Attributes:
        vehicle: name, e.g. ``iris_uwb_0``.
        body: name of the vehicle's root link.
        mount: its position and properties.
    """

    vehicle: str
    body: str
    mount: UwbMount

    @property
    def topic(self) -> str:
        """Its topic."""
        return f"/{self.vehicle}/{self.mount.name}"

    @property
    def frame_id(self) -> str:
        """Its frame."""
        return f"{self.vehicle}/{self.mount.frame}"

    @property
    def link(self) -> str:
        """Gazebo's name of the link that carries it."""
        return f"{self.vehicle}::{self.body}"


def antennas_of(fleet: Sequence[Vehicle]) -> tuple[Antenna, ...]:
    """Return all UWB sensors of a fleet, vehicle by vehicle.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    models = {kind: load_vehicle(kind) for kind in dict.fromkeys(vehicle.model for vehicle in fleet)}
    return tuple(
        Antenna(vehicle.name, models[vehicle.model].urdf.root, mount)
        for vehicle in fleet
        for mount in models[vehicle.model].uwb
    )


def neighbours_of(own: int, antennas: Sequence[Antenna]) -> tuple[int, ...]:
    """Return the antennas that one measures: of each other vehicle that of the same name, else its first.

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
