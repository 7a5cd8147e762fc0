"""Ranging sensors of a fleet's vehicles: lidars and UWB antennas, with the names of their topics, frames and links."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic

from xtdrone_common.fleet import Vehicle
from xtdrone_sim.vehicles.mounts.body_sensors import Mount, UwbMount
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount
from xtdrone_sim.vehicles.vehicle_model import VehicleModel, load_vehicle


@dataclass(frozen=True)
class FleetSensor(Generic[Mount]):
    """A sensor of one vehicle.

    Attributes:
        vehicle: name, e.g. ``iris_0``.
        carrier: name of the vehicle's link that carries it.
        mount: its position and properties.
    """

    vehicle: str
    carrier: str
    mount: Mount

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
        return f"{self.vehicle}::{self.carrier}"


def sensors_of(
    fleet: Sequence[Vehicle], carried: Callable[[VehicleModel], Sequence[tuple[str, Mount]]]
) -> tuple[FleetSensor[Mount], ...]:
    """Return all sensors of a kind of a fleet, vehicle by vehicle.

    Args:
        fleet: the vehicles.
        carried: returns the sensors of a model, each with the name of the link that carries it.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    models = {kind: carried(load_vehicle(kind)) for kind in dict.fromkeys(vehicle.model for vehicle in fleet)}
    return tuple(FleetSensor(vehicle.name, link, mount) for vehicle in fleet for link, mount in models[vehicle.model])


Lidar = FleetSensor[LidarMount]
Antenna = FleetSensor[UwbMount]


def lidars_of(fleet: Sequence[Vehicle]) -> tuple[Lidar, ...]:
    """Return all lidars of a fleet, vehicle by vehicle.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    return sensors_of(fleet, lambda model: [(mount.link, mount) for mount in model.lidars])


def antennas_of(fleet: Sequence[Vehicle]) -> tuple[Antenna, ...]:
    """Return all UWB sensors of a fleet, vehicle by vehicle.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    return sensors_of(fleet, lambda model: [(model.urdf.root, mount) for mount in model.uwb])
