"""On the ground and taking off."""

from __future__ import annotations

from ..actions import MISSION, Arm, SetReturnHeight
from ..searching_vehicle import State, Vehicle
from .common_supervision import RETRY_PERIOD, VehicleState, because

_CLIMBED = 0.8  # part of the takeoff height from which on a vehicle searches


class Waiting(VehicleState):
    """Waits for connection, position and mission."""

    def check(self, vehicle: Vehicle) -> None:
        """Start a vehicle that is ready; give up one that is not ready in time."""
        control, mission = self._control, vehicle.mission
        ready = vehicle.connected and vehicle.position is not None and mission.path
        if ready and not control.ending:
            control.act(SetReturnHeight(vehicle.name, mission.height))
            vehicle.request_mode(MISSION, control.now)
            vehicle.enter(State.TAKING_OFF, control.now)
        elif control.now - vehicle.since > control.settings.start_timeout:
            missing = "connection" if not vehicle.connected else "position" if vehicle.position is None else "mission"
            control.lose(vehicle, f"has no {missing} after {control.settings.start_timeout:g} s")


class TakingOff(VehicleState):
    """Arms, takes off and points the camera by its mission."""

    def _flight_fault(self, vehicle: Vehicle) -> str:
        timeout = self._control.settings.start_timeout
        if self._control.now - vehicle.since > timeout:
            return f"not airborne after {timeout:g} s{because(vehicle.request.refusal)}"
        return ""

    def update(self, vehicle: Vehicle, dt: float) -> None:
        """Arm the vehicle; search once it has climbed and flies its path."""
        control, request, mission = self._control, vehicle.request, vehicle.mission
        if not vehicle.armed:
            if request.reached and control.now >= request.next_try:
                control.act(Arm(vehicle.name))
                vehicle.arm_requested = True
                request.next_try = control.now + RETRY_PERIOD
            return
        control.started()
        if mission.current >= mission.first_waypoint and vehicle.altitude >= _CLIMBED * mission.takeoff_height:
            vehicle.enter(State.SEARCHING, control.now)
