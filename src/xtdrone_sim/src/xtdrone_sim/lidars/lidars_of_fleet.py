"""Lidars of a fleet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from xtdrone_control.fleet import Vehicle
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount
from xtdrone_sim.vehicles.vehicle_model import load_vehicle


@dataclass(frozen=True)
class Lidar:
    """A lidar of one vehicle.

    Attributes:
        vehicle: name, e.g. ``iris_0``.
        mount: its position and properties.
    """

    vehicle: str
    mount: LidarMount

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
        """Gazebo's name of its link."""
        return f"{self.vehicle}::{self.mount.link}"


def lidars_of(fleet: Sequence[Vehicle]) -> tuple[Lidar, ...]:
    """Return all lidars of a fleet, vehicle by vehicle.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    mounts = {kind: load_vehicle(kind).lidars for kind in dict.fromkeys(vehicle.model for vehicle in fleet)}
    return tuple(Lidar(vehicle.name, mount) for vehicle in fleet for mount in mounts[vehicle.model])
