"""Common to the states flown in OFFBOARD: heights and setpoints, and the climb back to the path."""

from __future__ import annotations

import math

from ..searching_vehicle import MISSION, GoTo, LookStage, PointCamera, Position, SecondLook, State, Vehicle
from .common_supervision import PART_SEARCHED, VehicleState
from .flown_by_autopilot import FALLEN

_CLEARANCE = 6.0  # m; no height change within this horizontal distance of a vehicle in between
_LEAD = 4.0  # m; maximum distance of a setpoint ahead of its vehicle


class OffboardState(VehicleState):
    """State in which the mission control publishes setpoints."""

    def _least_altitude(self, vehicle: Vehicle) -> float:
        return FALLEN * min(self._look_height(vehicle), vehicle.mission.height)

    def _look_height(self, vehicle: Vehicle) -> float:
        """Return the height of a vehicle's second look, m over the ground: below all paths, different for each."""
        settings, vehicles = self._control.settings, self._control.vehicles
        lowest = (v.mission.lowest for v in vehicles.values() if v.mission.path)
        ceiling = min(lowest, default=settings.look_height + 1.0) - 1.0
        count = max(len(vehicles) - 1, 1)
        low = min(settings.look_height, ceiling)
        return low + vehicle.index * min(settings.look_step, max(ceiling - low, 0.0) / count)

    def _move_setpoint(self, vehicle: Vehicle, target: Position, yaw: float, dt: float) -> None:
        """Move the setpoint towards a target at ``look_speed``; keep the height while another vehicle is in between."""
        assert vehicle.position is not None
        here = vehicle.setpoint or vehicle.position
        if not self._may_change_height(vehicle, target[2]):
            target = (target[0], target[1], here[2])
        way = [b - a for a, b in zip(here, target, strict=True)]
        distance = math.hypot(*way)
        if distance > 0.0 and math.dist(here, vehicle.position) < _LEAD:
            share = min(self._control.settings.look_speed * dt / distance, 1.0)
            here = (here[0] + share * way[0], here[1] + share * way[1], here[2] + share * way[2])
        vehicle.setpoint = here
        self._control.act(GoTo(vehicle.name, here, yaw))

    def _may_change_height(self, vehicle: Vehicle, height: float) -> bool:
        """Return whether no other vehicle is nearby between a vehicle's height and ``height``, m, map."""
        assert vehicle.position is not None
        x, y, z = vehicle.position
        low, high = min(z, height) - 1.0, max(z, height) + 1.0
        if abs(z - height) < 0.5:
            return True
        return not any(
            other is not vehicle
            and other.airborne
            and other.position is not None
            and math.hypot(other.position[0] - x, other.position[1] - y) < _CLEARANCE
            and low < other.position[2] < high
            for other in self._control.vehicles.values()
        )


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
