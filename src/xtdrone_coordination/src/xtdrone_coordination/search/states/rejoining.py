"""Rejoining: climb to the vehicle's own height and fly back to where it left its path."""

from __future__ import annotations

from ..actions import MISSION, PointCamera
from ..searching_vehicle import LookStage, SecondLook, State, Vehicle
from .common_supervision import PART_SEARCHED
from .offboard_heights_and_setpoints import OffboardState


class Rejoining(OffboardState):
    """Climbs, flies back and resumes the state before the second look."""

    def begin(self, vehicle: Vehicle, look: SecondLook) -> None:
        """Climb, then resume what the vehicle did before a look."""
        look.stage = LookStage.CLIMB
        vehicle.look = look
        vehicle.setpoint = vehicle.position
        vehicle.enter(State.REJOINING, self._control.now)

    def update(self, vehicle: Vehicle, dt: float) -> None:
        """Move the setpoint up, then back to the path."""
        look, position, setpoint = vehicle.look, vehicle.position, vehicle.setpoint
        assert look is not None
        assert position is not None
        assert setpoint is not None
        height = vehicle.search_altitude
        x, y = setpoint[:2] if look.stage is LookStage.CLIMB else look.left_at
        self._move_setpoint(vehicle, (x, y, height), look.heading, dt)
        if look.stage is LookStage.CLIMB:
            if abs(position[2] - height) < 0.7:
                look.stage = LookStage.GO_BACK
                if look.came_from is not State.SEARCHING:
                    self._resume(vehicle, look)
        elif vehicle.distance_to(look.left_at) < 2.0:
            self._resume(vehicle, look)

    def _resume(self, vehicle: Vehicle, look: SecondLook) -> None:
        control = self._control
        vehicle.look = None
        if control.found or control.ending:
            control.stand_by(vehicle)
        elif look.came_from is State.SEARCHING:
            control.act(PointCamera(vehicle.name, control.settings.gimbal_pitch))
            vehicle.request_mode(MISSION, control.now)
            vehicle.enter(State.SEARCHING, control.now)
        else:
            control.return_home(vehicle, PART_SEARCHED)
