"""State machine of a formation's flight through obstacles, without ROS: form up, follow the leader, re-form, land."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from xtdrone_interaction.crossing.crossing_mission import Crossing

FORMED_ERROR = 0.3  # m; the formation is complete when every follower is closer than this to its slot
STAGES = ("taking off", "forming", "crossing", "forming again", "landing", "over")

_FORMED_HOLD = 2.0  # s
_FORM_LIMIT = 60.0  # s


class Member(Crossing):
    """Flight of one vehicle of a formation, which lands with the formation."""

    def _prepare(self, now: float) -> list[str]:
        if self.outcome and not self.reports.armed:  # another vehicle has failed
            self.phase = "failed"
            return []
        return super()._prepare(now)

    def _take_off(self, now: float) -> list[str]:
        commands = super()._take_off(now)
        return [command for command in commands if command != "GOAL"]  # sent by the formation

    def _cross(self, now: float) -> list[str]:
        if not self.reports.armed:
            self.phase, self.outcome = "failed", "the vehicle has disarmed in flight"
            return []
        if self.outcome:
            self.phase = "landing"
            return self._repeat("AUTO.LAND", now)
        return []


@dataclass
class FormationCrossing:
    """The flight of all.

    Attributes:
        members: the vehicles, the leader first.
        limit: timeout of the flight to the goal, s.
        stage: one of ``STAGES``.
    """

    members: Sequence[Member]
    limit: float
    stage: str = "taking off"
    _since: float = math.nan  # of the stage
    _formed_since: float = math.nan
    _slots_sent: bool = False

    def step(self, now: float, errors: Sequence[float] | None) -> list[str]:
        """Run one update; return the messages to send: "pattern" or "goal" to the leader, "slots" to the followers.

        Args:
            now: s.
            errors: distances of the followers from their slots, m; None before they are assigned.
        """
        if self.stage == "landing":
            self.stage = "over" if all(member.is_over for member in self.members) else self.stage
            return []
        if any(member.is_over for member in self.members):
            return self._land(now, "another vehicle has failed")
        return {
            "taking off": self._take_off,
            "forming": self._form,
            "crossing": self._cross,
            "forming again": self._form_again,
        }.get(self.stage, lambda *_: [])(now, errors)

    def _take_off(self, now: float, _: Sequence[float] | None) -> list[str]:
        if any(member.phase != "crossing" for member in self.members):
            return []
        return self._begin("forming", now, "pattern")

    def _form(self, now: float, errors: Sequence[float] | None) -> list[str]:
        if now - self._since > _FORM_LIMIT:
            return self._land(now, f"not in formation within {_FORM_LIMIT:g} s")
        if errors is None:
            return []
        if not self._slots_sent:
            self._slots_sent = True
            return ["slots"]
        if not self._is_formed(now, errors):
            return []
        for member in self.members:
            member.begun = now
        return self._begin("crossing", now, "goal")

    def _cross(self, now: float, _: Sequence[float] | None) -> list[str]:
        leader = self.members[0]
        if leader.reports.planner == leader.task.arrived:
            for member in self.members:
                member.ended = now
            return self._begin("forming again", now)
        if leader.reports.planner == leader.task.unreachable:
            return self._land(now, f"{leader.name}: {leader.task.unreachable}")
        if now - self._since > self.limit:
            return self._land(now, f"the leader has not arrived within {self.limit:g} s")
        return []

    def _form_again(self, now: float, errors: Sequence[float] | None) -> list[str]:
        if errors is not None and self._is_formed(now, errors):
            return self._land(now, "arrived")
        if now - self._since > _FORM_LIMIT:
            return self._land(now, f"not in formation again within {_FORM_LIMIT:g} s")
        return []

    def _is_formed(self, now: float, errors: Sequence[float]) -> bool:
        """Return whether all followers have been in their slots long enough; False if positions are unknown."""
        if not all(error < FORMED_ERROR for error in errors):
            self._formed_since = math.nan
        elif math.isnan(self._formed_since):
            self._formed_since = now
        return now - self._formed_since >= _FORMED_HOLD

    def _land(self, now: float, outcome: str) -> list[str]:
        for member in self.members:
            member.outcome = member.outcome or outcome
        return self._begin("landing", now)

    def _begin(self, stage: str, now: float, *sent: str) -> list[str]:
        self.stage, self._since, self._formed_since = stage, now, math.nan
        return list(sent)
