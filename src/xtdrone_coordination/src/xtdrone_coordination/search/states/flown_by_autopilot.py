"""States in which the autopilot flies by itself: waiting, taking off, searching, holding and returning."""

from __future__ import annotations

import math

from ..searching_vehicle import LAND, LOITER, MISSION, RTL, Arm, SetReturnHeight, State, Vehicle
from .common_supervision import PART_SEARCHED, RETRY_PERIOD, VehicleState, because

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
