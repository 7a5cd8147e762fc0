"""Conclusion: when and why the search ends, the return of all vehicles, and the final report."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from .coverage_map import CoverageMap
from .losses import Reallocation
from .people.candidates import Candidate
from .reports import Find, outcome_report, possible_report
from .searching_vehicle import BUSY, DONE, State, Vehicle
from .states.common_supervision import MissionControl
from .states.following import FollowingPerson


class Conclusion:
    """Ends the search.

    Attributes:
        begun: time of the first step, s; None before it.
        started: time at which the first vehicle armed, s; None before it.
        ending: whether all vehicles have been sent home.
        finished: whether the search is over.
    """

    def __init__(
        self,
        control: MissionControl,
        reallocation: Reallocation,
        following: FollowingPerson,
        coverage: CoverageMap,
        candidates: Sequence[Candidate],
        finds: Sequence[Find],
        cancel_takeoff: Callable[[Vehicle], bool],
    ) -> None:
        """Start with a search that has not begun.

        Args:
            control: the mission control.
            reallocation: paths still to be reassigned.
            following: ends the following of people.
            coverage: part of the region seen so far.
            candidates: all possible persons seen so far.
            finds: confirmed people, in order.
            cancel_takeoff: keeps a vehicle on the ground that has not been requested to arm; returns whether it is.
        """
        self.begun: float | None = None
        self.started: float | None = None
        self.ending = False
        self.finished = False
        self._control = control
        self._reallocation = reallocation
        self._following = following
        self._coverage = coverage
        self._candidates = candidates
        self._finds = finds
        self._cancel_takeoff = cancel_takeoff
        self._ended = 0.0
        self._reason = ""
        self._failed = False

    def update(self) -> None:
        """End the search when nothing is left to do, and finish it when all have landed."""
        if not self.ending and (reason := self._end_reason()):
            self._end(reason)
        if not self.ending:
            return
        control = self._control
        waited = control.now - self._ended
        late = [vehicle.name for vehicle in control.vehicles.values() if vehicle.state not in DONE]
        if late and waited <= control.settings.return_timeout:
            return
        if late:
            self._reason += f"; not landed after {waited:.0f} s: {', '.join(late)}"
        self._finish()

    def _end_reason(self) -> str:
        """Return why the search ends now, empty if it continues."""
        control = self._control
        begun = self.begun if self.started is None else self.started
        assert begun is not None
        if control.now - begun > control.settings.time_limit:
            return f"the time limit of {control.settings.time_limit:g} s is over"
        states = [vehicle.state for vehicle in control.vehicles.values()]
        busy = (State.FOLLOWING, State.SECOND_LOOK) if control.found else BUSY
        if any(state in busy for state in states) or self._reallocation.pending:
            return ""
        if control.found:
            return "following has ended"
        if all(state is State.LOST for state in states):
            self._failed = True
            return "all vehicles are lost"
        if all(vehicle.blind or vehicle.state is State.LOST for vehicle in control.vehicles.values()):
            self._failed = True
            return "no camera works"
        return "all paths are flown"

    def _end(self, reason: str) -> None:
        """Send all vehicles home."""
        self.ending = True
        self._ended = self._control.now
        self._reason = reason
        self._reallocation.pending.clear()
        for vehicle in self._control.vehicles.values():
            if vehicle.state in (*DONE, State.RETURNING):
                continue
            if vehicle.following is not None:
                self._following.end(vehicle, reason)
            vehicle.look = None
            if not self._cancel_takeoff(vehicle):
                self._control.return_home(vehicle, reason)

    def _finish(self) -> None:
        self.finished = True
        control = self._control
        control.report(
            "finished",
            **outcome_report(self._finds[0] if self._finds else None, self._failed, self._coverage),
            possible=possible_report(self._candidates, control.settings.candidate_hits),
            lost=[name for name, vehicle in control.vehicles.items() if vehicle.state is State.LOST],
            reason=self._reason,
        )
