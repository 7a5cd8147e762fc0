"""Base of the vehicle states: supervision common to all states, and the interface of the mission control."""

from __future__ import annotations

import math
from typing import ClassVar, Protocol

from ..people.candidates import Candidate
from ..search_settings import MissionSettings
from ..searching_vehicle import Action, RequestMode, SecondLook, Vehicle

_MODE_GRACE = 2.5  # s; mavros/state follows the 1 Hz heartbeat
RETRY_PERIOD = 2.0  # s between attempts to reach a mode or to arm
_MAX_TRIES = 8
_LANDED_FRACTION = 0.3  # of the search height, below which a vehicle that disarms on its return has landed

PART_SEARCHED = "its part is searched"


class MissionControl(Protocol):
    """Interface of the mission control that vehicle states use: shared data, reports and transitions.

    Attributes:
        settings: Settings of the search.
        vehicles: Vehicles by name.
        now: ROS time, s.
    """

    settings: MissionSettings
    vehicles: dict[str, Vehicle]
    now: float

    @property
    def ending(self) -> bool:
        """Whether all vehicles have been sent home."""
        ...

    @property
    def found(self) -> bool:
        """Whether a find has ended the search."""
        ...

    def act(self, action: Action) -> None:
        """Request an action."""
        ...

    def report(self, event: str, vehicle: Vehicle | None = None, /, **fields: object) -> None:
        """Report an event."""
        ...

    def started(self) -> None:
        """Note that a vehicle has armed."""
        ...

    def record_find(self, vehicle: Vehicle, look: SecondLook) -> None:
        """Record a confirmed person and stop the other vehicles if the settings say so."""
        ...

    def begin_look(self, vehicle: Vehicle, candidate: Candidate, takes_over: float | None) -> None:
        """Send a vehicle to a second look."""
        ...

    def begin_following(self, vehicle: Vehicle, look: SecondLook) -> None:
        """Follow the person a second look has confirmed."""
        ...

    def hand_over(self, candidate: Candidate, takes_over: float | None) -> bool:
        """Send another vehicle to a candidate; return whether one is available."""
        ...

    def stand_by(self, vehicle: Vehicle) -> None:
        """Hold or return a vehicle that is no longer needed."""
        ...

    def return_home(self, vehicle: Vehicle, reason: str, *, commanded: bool = True) -> None:
        """Return a vehicle; ``commanded`` is false if its autopilot returns already."""
        ...

    def lose(self, vehicle: Vehicle, reason: str) -> None:
        """Give a vehicle up and reassign its work."""
        ...

    def camera_failed(self, vehicle: Vehicle) -> None:
        """Return a vehicle whose camera has failed and reassign its work."""
        ...

    def land(self, vehicle: Vehicle) -> None:
        """Note that a vehicle is on the ground."""
        ...


class VehicleState:
    """Behaviour of the vehicles in one state. :meth:`check` supervises a vehicle, :meth:`update` flies it."""

    needs_camera: ClassVar[bool] = False

    def __init__(self, control: MissionControl) -> None:
        self._control = control

    def check(self, vehicle: Vehicle) -> None:
        """Detect the loss of a vehicle or its landing, and bring it into the requested mode."""
        fault = self._link_fault(vehicle)
        if not fault and not vehicle.armed and self._has_landed(vehicle):
            self._control.land(vehicle)
            return
        fault = fault or self._flight_fault(vehicle)
        if fault:
            self._control.lose(vehicle, fault)
        else:
            self._keep_mode(vehicle)

    def update(self, vehicle: Vehicle, dt: float) -> None:
        """Fly a vehicle for a step of ``dt`` s."""

    def _link_fault(self, vehicle: Vehicle) -> str:
        """Return why the link to a vehicle counts as lost, empty if it is alive."""
        now, silent_time = self._control.now, self._control.settings.silent_time
        if now - vehicle.heard > silent_time:
            return f"no state received for {silent_time:g} s"
        if not vehicle.connected:
            return "its autopilot is disconnected"
        if now - vehicle.pose_heard > silent_time:
            return f"no position received for {silent_time:g} s"
        return ""

    def _flight_fault(self, vehicle: Vehicle) -> str:
        """Return why a vehicle no longer flies, empty if it does."""
        if not vehicle.armed:
            return f"disarmed at {vehicle.altitude:.1f} m"
        if vehicle.altitude < self._least_altitude(vehicle):
            return f"fell to {vehicle.altitude:.1f} m"
        return ""

    def _least_altitude(self, vehicle: Vehicle) -> float:
        """Return the height over home below which the vehicle has fallen, m."""
        return -math.inf

    def _may_land(self, vehicle: Vehicle) -> bool:
        """Return whether the vehicle may land now."""
        return False

    def _has_landed(self, vehicle: Vehicle) -> bool:
        return self._may_land(vehicle) and vehicle.altitude < _LANDED_FRACTION * max(vehicle.mission.height, 5.0)

    def _keep_mode(self, vehicle: Vehicle) -> None:
        request, now = vehicle.request, self._control.now
        if not request.mode:
            return
        if vehicle.mode == request.mode and vehicle.heard > request.first_try:
            request.reached, request.left_since = True, None
        elif request.reached:
            self._on_mode_left(vehicle)
        elif now >= request.next_try:
            if request.tries >= _MAX_TRIES:
                self._control.lose(vehicle, f"does not enter {request.mode}{because(request.refusal)}")
                return
            self._control.act(RequestMode(vehicle.name, request.mode))
            request.tries += 1
            request.first_try = min(request.first_try, now)
            request.next_try = now + RETRY_PERIOD

    def _on_mode_left(self, vehicle: Vehicle) -> None:
        """React to a mode change that was not requested."""
        request, now = vehicle.request, self._control.now
        if request.left_since is None:
            request.left_since = now
        elif now - request.left_since > _MODE_GRACE:
            self._control.lose(vehicle, f"left {request.mode} for {vehicle.mode or 'no mode'}")


def because(reason: str) -> str:
    """Return a reason as the end of a sentence, empty if there is none."""
    return f": {reason}" if reason else ""
