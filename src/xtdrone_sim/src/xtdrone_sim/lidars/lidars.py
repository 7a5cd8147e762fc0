"""Lidars of a fleet and their failures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from xtdrone_control.fleet import Vehicle
from xtdrone_control.settings import check_choice, check_range
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

FAILURES = ("ok", "off", "frozen", "biased", "dropouts")
MOST_BIAS = 100.0  # m


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


@dataclass(frozen=True)
class Failure:
    """How a lidar or a UWB sensor fails.

    Attributes:
        kind: of ``FAILURES``.
        value: m of a bias, 0..1 of dropouts.
    """

    kind: str = "ok"
    value: float = 0.0

    def __str__(self) -> str:
        """Return kind and value, if it counts."""
        return f"{self.kind} {self.value:g}" if self.kind in ("biased", "dropouts") else self.kind

    @classmethod
    def checked(cls, kind: str, value: float) -> Failure:
        """Return a failure.

        Raises:
            ValueError: kind or value is not allowed.
        """
        check_choice("failure", kind, FAILURES)
        if kind == "biased":
            check_range("value", value, -MOST_BIAS, MOST_BIAS, "m")
        if kind == "dropouts":
            check_range("value", value, 0.0, 1.0)
        return cls(kind, value)


def lidars_of(fleet: Sequence[Vehicle]) -> tuple[Lidar, ...]:
    """Return all lidars of a fleet, vehicle by vehicle.

    Raises:
        ModelError: a vehicle type cannot be used.
    """
    mounts = {kind: load_vehicle(kind).lidars for kind in dict.fromkeys(vehicle.model for vehicle in fleet)}
    return tuple(Lidar(vehicle.name, mount) for vehicle in fleet for mount in mounts[vehicle.model])
