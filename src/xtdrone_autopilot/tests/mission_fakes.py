"""Missions for tests, in metres around the origin of the fake autopilot."""

from __future__ import annotations

import math
from typing import Any

from autopilot_fakes import ORIGIN, Flight

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_common import modes
from xtdrone_common.geodesy import projection

NAN = math.nan


def at(
    north: float, east: float, height: float = 10.0, command: int = plan.WAYPOINT, *params: float, **more: Any
) -> PlanItem:
    """Return an item at an offset (m) from the origin, ``height`` m above home; given params are set, yaw is NaN."""
    given = (*params, *(0.0, 0.0, 0.0, NAN)[len(params) :])
    latitude, longitude = projection.reproject(north, east, ORIGIN[0], ORIGIN[1])
    return PlanItem(command, 6, (given[0], given[1], given[2], given[3]), latitude, longitude, height, **more)


def do(command: int, *params: float) -> PlanItem:
    """Return an item without a position; given params are set."""
    given = (*params, *(0.0,) * (7 - len(params)))
    return PlanItem(command, 2, (given[0], given[1], given[2], given[3]), given[4], given[5], given[6])


class MissionFlight(Flight):
    """A vehicle that reaches a commanded position at once."""

    def load(self, *items: PlanItem, kind: int = plan.MISSION) -> None:
        """Store a mission in the vehicle."""
        self.commander.navigator.set_plan(kind, items)

    def start(self) -> None:
        """Arm on the ground in AUTO.MISSION."""
        assert self.commander.request(modes.AUTO_MISSION) == 0
        assert self.commander.arm_disarm(True) == 0

    def hover(self, height: float = 10.0) -> None:
        """Put the armed vehicle into the air in AUTO.LOITER."""
        self.commander.arm_disarm(True)
        self.place(0.0, 0.0, -height)
        self.run(0.1)
        self.commander.request(modes.POSCTL)
        self.commander.request(modes.AUTO_LOITER)
        self.texts()

    def goal(self) -> list[float]:
        """Return the cascade's position setpoint, rounded to cm."""
        return [round(v, 2) + 0.0 for v in self.setpoint["goal_position"].tolist()]

    @property
    def current(self) -> int:
        return self.commander.navigator.plans.current

    @property
    def reached(self) -> int:
        return self.commander.navigator.mission.reached

    def tick(self) -> None:
        """Move the vehicle to its setpoint and run the navigator once."""
        self.follow()
        self.run(0.1)
