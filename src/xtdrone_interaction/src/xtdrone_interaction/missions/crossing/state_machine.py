"""State machines of a flight through obstacles, without ROS: of each vehicle, and of a formation.

A vehicle's makes commands from its reports; that of a formation lets it form up, follow the leader, re-form and land.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from xtdrone_common.settings import Settings, setting


class Task(NamedTuple):
    """Task of a vehicle between takeoff and landing.

    Attributes:
        goal, state: topics below /T/ of the goal, and of the state of the node that flies to it.
        arrived, unreachable: states that end it.
    """

    goal: str
    state: str
    arrived: str
    unreachable: str


TASKS = {
    "goal": Task("planner/goal", "planner/state", "hovering at the goal", "goal unreachable"),
    "explore": Task("exploration/start", "exploration/state", "explored, home", "home unreachable"),
}

_SPACING = 2.0  # s between two identical commands
_SETTLED = 1.0  # s at the goal before landing
FORMED_ERROR = 0.3  # m; the formation is complete when every follower is closer than this to its slot
STAGES = ("taking off", "forming", "crossing", "forming again", "landing", "over")
_FORMED_HOLD = 2.0  # s
_FORM_LIMIT = 60.0  # s


@dataclass(frozen=True)
class CrossingSettings(Settings):
    """Private parameters of the director."""

    time_limit: float = setting(
        180.0, low=10.0, high=3600.0, unit="s", text="simulated time after which a vehicle that has not arrived lands"
    )
    task: str = setting("goal", choices=tuple(TASKS), text="fly to the goals, or first explore a floor")
    pattern: str = setting(
        "", text="formation in which the vehicles follow the first one to its goal; empty: each flies on its own"
    )
    out: str = setting("", text="folder for events.jsonl, empty for none")
    recorder: str = setting("", text="node that records the flight; time starts when it has subscribed, or after 30 s")


@dataclass
class Reports:
    """Latest reports of a vehicle.

    Attributes:
        armed, mode: of mavros/state.
        planner: text of the task's state topic; empty before the first.
    """

    armed: bool = False
    mode: str = ""
    planner: str = ""


@dataclass
class Crossing:
    """The flight of one vehicle.

    Attributes:
        name: of the vehicle.
        goal: x, y, z, m in map.
        limit: time limit, s.
        task: its task.
        phase: preparing, taking off, crossing, landing, landed or failed.
        outcome: arrived, or why not; empty until known.
        reports: latest reports of the vehicle.
        begun, ended: ROS times at which the goal was sent and reached, s; NaN before that.
    """

    name: str
    goal: tuple[float, float, float]
    limit: float
    task: Task = TASKS["goal"]
    phase: str = "preparing"
    outcome: str = ""
    reports: Reports = field(default_factory=Reports)
    begun: float = math.nan
    ended: float = math.nan
    _sent: dict[str, float] = field(default_factory=dict)
    _since: float = math.nan

    @property
    def is_over(self) -> bool:
        """Whether the vehicle has landed, or never took off."""
        return self.phase in ("landed", "failed")

    def step(self, now: float) -> list[str]:
        """Return the commands at ``now``, s: ARM, AUTO.TAKEOFF, GOAL or AUTO.LAND."""
        return {
            "preparing": self._prepare,
            "taking off": self._take_off,
            "crossing": self._cross,
            "landing": self._land,
        }.get(self.phase, lambda _: [])(now)

    def _prepare(self, now: float) -> list[str]:
        if self.reports.armed:
            self.phase = "taking off"
            return []
        if now > self.limit:
            self.phase, self.outcome = "failed", "the vehicle could not be armed"
            return []
        return self._repeat("ARM", now) if self.reports.planner and self.reports.mode else []

    def _take_off(self, now: float) -> list[str]:
        if (
            self.reports.mode == "AUTO.LOITER"
            and "AUTO.TAKEOFF" in self._sent
            and now - self._sent["AUTO.TAKEOFF"] > 1.0
        ):
            self.phase, self.begun = "crossing", now
            return ["GOAL"]
        if not self.reports.armed:
            self.phase, self.outcome = "failed", "the vehicle has disarmed"
            return []
        return [] if self.reports.mode == "AUTO.TAKEOFF" else self._repeat("AUTO.TAKEOFF", now)

    def _cross(self, now: float) -> list[str]:
        arrived = self.reports.planner == self.task.arrived
        self._since = (now if math.isnan(self._since) else self._since) if arrived else math.nan
        if arrived and math.isnan(self.ended):
            self.ended = now
        if arrived and now - self._since >= _SETTLED:
            self.outcome = "arrived"
        elif self.reports.planner == self.task.unreachable:
            self.outcome = self.task.unreachable
        elif not self.reports.armed:
            self.phase, self.outcome = "failed", "the vehicle has disarmed in flight"
            return []
        elif now - self.begun > self.limit:
            self.outcome = f"not arrived within {self.limit:g} s"
        if self.outcome:
            self.phase = "landing"
            return self._repeat("AUTO.LAND", now)
        return []

    def _land(self, now: float) -> list[str]:
        if not self.reports.armed:
            self.phase = "landed" if self.outcome == "arrived" else "failed"
            return []
        return [] if self.reports.mode == "AUTO.LAND" else self._repeat("AUTO.LAND", now)

    def _repeat(self, command: str, now: float) -> list[str]:
        if now - self._sent.get(command, -math.inf) < _SPACING:
            return []
        self._sent[command] = now
        return [command]


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
