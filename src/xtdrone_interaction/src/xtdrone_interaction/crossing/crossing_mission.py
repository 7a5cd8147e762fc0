"""State machine of one vehicle's flight through obstacles, without ROS: commands from reports."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from xtdrone_control.settings import Settings, setting


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
