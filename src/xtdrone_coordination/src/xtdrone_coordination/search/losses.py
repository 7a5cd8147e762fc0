"""Losses: the work of a vehicle that is lost or whose camera has failed, and its reallocation.

An unflown path is cut into parts for the other vehicles so that all of them finish together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

from .planning.coverage_path import Point, Waypoint, length
from .reports import round_xy
from .searching_vehicle import MISSION, PushMission, State, Vehicle
from .states.common_supervision import MissionControl
from .states.following import FollowingPerson

_MIN_PART = 10.0  # m; a shorter part is not worth the flight to it


class Reallocation:
    """Paths to be flown by other vehicles.

    Attributes:
        pending: paths by the name of the vehicle they were taken from.
    """

    def __init__(self, control: MissionControl) -> None:
        self.pending: list[tuple[str, list[Waypoint]]] = []
        self._control = control

    def take_from(self, vehicle: Vehicle) -> None:
        """Remove the unseen path of a vehicle from its plan and queue it for the others."""
        mission = vehicle.mission
        path = [] if mission.path_done or self._control.found else mission.unseen_path
        if len(path) > 1:
            self.pending.append((vehicle.name, path))
            mission.path = []  # so that the loss of the vehicle on its way home does not reallocate it again

    def update(self) -> None:
        """Assign pending paths to the vehicles that can take over; wait if some are still on the ground."""
        control = self._control
        if not self.pending or control.ending:
            return
        vehicles = control.vehicles
        available = self._available()
        if not available and any(v.state in (State.WAITING, State.TAKING_OFF) for v in vehicles.values()):
            return
        for name, path in self.pending:
            parts: dict[str, list[Waypoint]] = {}
            if available:
                ends = {vehicle.name: vehicle.path_end for vehicle in available}
                parts = share_out(path, ends, {vehicle.name: vehicle.remaining_distance for vehicle in available})
            for taker, part in parts.items():
                self._assign(vehicles[taker], part)
            metres = {taker: round(length(part), 1) for taker, part in parts.items()}
            control.report("reassigned", vehicles[name], to=metres)
        self.pending.clear()

    def _available(self) -> list[Vehicle]:
        """Return the vehicles that can take over: those airborne, or else those that have landed."""
        seeing = [vehicle for vehicle in self._control.vehicles.values() if not vehicle.blind]
        airborne = [v for v in seeing if v.available or v.state in (State.SECOND_LOOK, State.REJOINING)]
        return airborne or [v for v in seeing if v.state is State.LANDED and v.connected]

    def _assign(self, vehicle: Vehicle, part: list[Waypoint]) -> None:
        mission, now = vehicle.mission, self._control.now
        landed = vehicle.state is State.LANDED
        items, current = mission.extend(part, restart=landed)
        mission.load(items)
        mission.current, mission.reached = current, -1
        if landed:
            mission.progress = None
        self._control.act(PushMission(vehicle.name, items, current))
        if landed:
            vehicle.enter(State.WAITING, now)
        elif vehicle.state is State.RETURNING:
            vehicle.request_mode(MISSION, now)
            vehicle.enter(State.SEARCHING, now)
        elif vehicle.look is not None and vehicle.look.came_from is State.RETURNING:
            vehicle.look.came_from = State.SEARCHING


def share_out(
    path: Sequence[Waypoint], ends: Mapping[str, Point], loads: Mapping[str, float]
) -> dict[str, list[Waypoint]]:
    """Cut a path into parts that even out the loads, and assign them.

    Args:
        path: Path of at least two waypoints.
        ends: end of the remaining path of each available vehicle, m ENU.
        loads: remaining distance of each available vehicle, m.

    Returns:
        Consecutive parts of the path by vehicle, in path order; vehicles without a part are left out. Where the path
        is cut, one part ends and the next begins, with the heading of the leg.
    """
    whole = sum(_leg(a, b) for a, b in pairwise(path))
    portions = _portions(whole, loads)
    parts: dict[str, list[Waypoint]] = {}
    left = list(path)
    while portions:
        start = (left[0].x, left[0].y)
        name = min(portions, key=lambda n: (math.dist(ends[n], start), n))
        portion = portions.pop(name)
        parts[name], left = cut(left, portion) if portions else (left, [])
    return parts


def cut(path: Sequence[Waypoint], at: float) -> tuple[list[Waypoint], list[Waypoint]]:
    """Return the first ``at`` m of a path, and the remainder."""
    first = [path[0]]
    for i, (a, b) in enumerate(pairwise(path), 1):
        leg = _leg(a, b)
        if at <= leg and leg > 0.0:
            share = at / leg
            place = Waypoint(a.x + share * (b.x - a.x), a.y + share * (b.y - a.y), b.heading)
            return [*first, place], [place, *path[i:]]
        at -= leg
        first.append(b)
    return first, [path[-1]]


def _leg(a: Waypoint, b: Waypoint) -> float:
    return math.dist((a.x, a.y), (b.x, b.y))


def _portions(whole: float, loads: Mapping[str, float]) -> dict[str, float]:
    """Return the lengths that bring all loads to one level, leaving out vehicles that would get too little."""
    names = sorted(loads, key=lambda name: (loads[name], name))
    while names:
        level = (whole + sum(loads[name] for name in names)) / len(names)
        if len(names) == 1 or level - loads[names[-1]] >= _MIN_PART:
            return {name: level - loads[name] for name in names}
        names.pop()
    return {}


class Losses:
    """Gives vehicles up, and hands their work over to the others."""

    def __init__(self, control: MissionControl, reallocation: Reallocation, following: FollowingPerson) -> None:
        self._control = control
        self._reallocation = reallocation
        self._following = following

    def lose(self, vehicle: Vehicle, reason: str) -> None:
        """Give a vehicle up and reassign its work."""
        position = None if vehicle.position is None else round_xy(vehicle.position)
        self._control.report("lost_vehicle", vehicle, reason=reason, position=position)
        self._release_work(vehicle)
        vehicle.enter(State.LOST, self._control.now)
        vehicle.request.mode = ""

    def camera_failed(self, vehicle: Vehicle) -> None:
        """Return a vehicle whose camera has failed and reassign its work."""
        assert vehicle.position is not None
        vehicle.blind = True
        self._control.report("camera_silent", vehicle, position=round_xy(vehicle.position))
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
