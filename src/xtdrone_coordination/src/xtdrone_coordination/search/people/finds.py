"""Finds: what happens when a second look has confirmed a person."""

from __future__ import annotations

from collections.abc import Callable

from ..losses import Reallocation
from ..reports import Find, round_xy
from ..searching_vehicle import BUSY, LookStage, SecondLook, State, Vehicle
from ..states.common_supervision import MissionControl


class Finds:
    """Records confirmed people and stops the vehicles that are no longer needed.

    Attributes:
        people: confirmed people, in order.
    """

    def __init__(
        self, control: MissionControl, reallocation: Reallocation, cancel_takeoff: Callable[[Vehicle], bool]
    ) -> None:
        """Start without finds.

        Args:
            control: the mission control.
            reallocation: paths still to be reassigned.
            cancel_takeoff: keeps a vehicle on the ground that has not been requested to arm; returns whether it is.
        """
        self.people: list[Find] = []
        self._control = control
        self._reallocation = reallocation
        self._cancel_takeoff = cancel_takeoff

    def record(self, vehicle: Vehicle, look: SecondLook) -> None:
        """Record a confirmed person and stop the other vehicles if the settings say so."""
        candidate = look.candidate
        find = Find(vehicle.name, candidate.position, candidate.covariance, candidate.seen_at)
        self.people.append(find)
        self._control.report(
            "confirmed",
            vehicle,
            position=round_xy(find.position),
            covariance=list(find.covariance),
            found_time=round(find.time, 3),
            probability=round(look.evidence.mean, 3),
            pictures=look.evidence.pictures,
        )
        if self._control.settings.on_find != "continue":
            self._reallocation.pending.clear()
            for other in self._control.vehicles.values():
                if other is not vehicle and other.state in BUSY and other.state is not State.FOLLOWING:
                    self._stop(other)

    def _stop(self, vehicle: Vehicle) -> None:
        """Stop a vehicle's search: stay on the ground, climb back from a second look, or stand by."""
        look = vehicle.look
        if look is not None and look.candidate.status == "looked at":
            look.candidate.status = "seen"
        if self._cancel_takeoff(vehicle):
            return
        if vehicle.state is State.SECOND_LOOK:
            assert look is not None
            look.stage = LookStage.CLIMB
            vehicle.enter(State.REJOINING, self._control.now)
        elif vehicle.state is not State.REJOINING:
            self._control.stand_by(vehicle)
