"""Holding and returning."""

from __future__ import annotations

from ..actions import LAND, LOITER, RTL
from ..searching_vehicle import State, Vehicle
from .common_supervision import VehicleState


class Holding(VehicleState):
    """Holds its position in AUTO.LOITER."""

    def begin(self, vehicle: Vehicle) -> None:
        """Stop a vehicle where it is."""
        vehicle.request_mode(LOITER, self._control.now)
        vehicle.enter(State.HOLDING, self._control.now)


class Returning(VehicleState):
    """Flies home in AUTO.RTL and lands."""

    def begin(self, vehicle: Vehicle, reason: str, *, commanded: bool) -> None:
        """Return a vehicle; ``commanded`` is false if its autopilot returns already."""
        if commanded:
            vehicle.request_mode(RTL, self._control.now)
        else:
            vehicle.request.mode = ""
        self._control.report("returning", vehicle, reason=reason)
        vehicle.enter(State.RETURNING, self._control.now)

    def _may_land(self, vehicle: Vehicle) -> bool:
        return True

    def _on_mode_left(self, vehicle: Vehicle) -> None:
        if vehicle.mode not in (RTL, LAND, LOITER):
            super()._on_mode_left(vehicle)
