"""Searching: the autopilot flies the mission."""

from __future__ import annotations

import math

from ..actions import LAND, RTL
from ..searching_vehicle import Vehicle
from .common_supervision import PART_SEARCHED, VehicleState

FALLEN = 0.3  # part of the lowest planned height below which a vehicle has fallen


class Searching(VehicleState):
    """Flies its path in AUTO.MISSION."""

    needs_camera = True

    def update(self, vehicle: Vehicle, dt: float) -> None:
        """Return a vehicle whose mission has ended without a return."""
        if vehicle.mission.ended:
            self._control.return_home(vehicle, PART_SEARCHED)

    def _least_altitude(self, vehicle: Vehicle) -> float:
        mission = vehicle.mission
        return -math.inf if mission.path_done else FALLEN * mission.takeoff_height  # the path may begin with a climb

    def _may_land(self, vehicle: Vehicle) -> bool:
        return vehicle.mission.path_done

    def _on_mode_left(self, vehicle: Vehicle) -> None:
        if vehicle.mission.path_done:
            self._control.return_home(vehicle, PART_SEARCHED, commanded=vehicle.mode not in (RTL, LAND))
        else:
            super()._on_mode_left(vehicle)
