"""Losses: what happens to the work of a vehicle that is lost or whose camera has failed."""

from __future__ import annotations

from ..reports import rounded_xy
from ..searching_vehicle import State, Vehicle
from ..states.common_supervision import MissionControl
from ..states.following import FollowingPerson
from .reallocation import Reallocation


class Losses:
    """Gives vehicles up, and hands their work over to the others."""

    def __init__(self, control: MissionControl, reallocation: Reallocation, following: FollowingPerson) -> None:
        self._control = control
        self._reallocation = reallocation
        self._following = following

    def lose(self, vehicle: Vehicle, reason: str) -> None:
        """Give a vehicle up and reassign its work."""
        position = None if vehicle.position is None else rounded_xy(vehicle.position)
        self._control.report("lost_vehicle", vehicle, reason=reason, position=position)
        self._release_work(vehicle)
        vehicle.enter(State.LOST, self._control.now)
        vehicle.request.mode = ""

    def camera_failed(self, vehicle: Vehicle) -> None:
        """Return a vehicle whose camera has failed and reassign its work."""
        assert vehicle.position is not None
        vehicle.blind = True
        self._control.report("camera_silent", vehicle, position=rounded_xy(vehicle.position))
        self._release_work(vehicle)
        self._control.return_home(vehicle, "its camera has failed")

    def _release_work(self, vehicle: Vehicle) -> None:
        """Hand a vehicle's following, second look and path over to the others."""
        control, following = self._control, vehicle.following
        if following is not None:
            self._following.end(vehicle, "the camera has failed" if vehicle.blind else "the vehicle is lost")
            self._following.release(following.candidate, vehicle)
            control.hand_over(following.candidate, following.until - control.now)
        look, vehicle.look = vehicle.look, None
        if look is not None and look.candidate.status == "looked at":
            look.candidate.status = "seen"
            control.hand_over(look.candidate, look.takes_over)
        self._reallocation.take_from(vehicle)
