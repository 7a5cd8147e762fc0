"""Explorer of one vehicle. Inputs: floor map, frontiers, messages of the other vehicles. Output: goals for its planner.

::

    waiting -> exploring -> returning -> explored, home
                  |  ^
                  v  |
           waiting for others (other vehicles already fly to all remaining frontiers)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.exploration.floor_map import FloorMap
from xtdrone_planning.exploration.frontiers import Cell, Frontier, Ways, find_frontiers
from xtdrone_planning.exploration.regions import Regions
from xtdrone_planning.exploration.settings import ExplorationSettings
from xtdrone_planning.exploration.shared_regions import Share, Sharing
from xtdrone_planning.exploration.tours import divide

Array = NDArray[np.float64]

WAITING, EXPLORING, IDLE, RETURNING = "waiting", "exploring", "waiting for others", "returning"
HOME, STRANDED = "explored, home", "home unreachable"
AT_GOAL, UNREACHABLE = "hovering at the goal", "goal unreachable"
"""Planner states that the explorer acts on."""

_MOST_IN_TOUR = 8  # frontiers (the nearest)
_SAME = 0.6  # m: a frontier closer than this to the last target is the same frontier
_TAKEN = 2.0  # m: a frontier closer than this to another vehicle's target belongs to that vehicle
_NEW_GOAL = 0.3  # m by which a goal must differ from the last one
_DWELL = 1.0  # s at a viewpoint; a frontier that remains after that is given up
_SETTLE = 1.5  # s without a frontier after which the floor counts as explored
_STRANDED = 20.0  # s without a path home


@dataclass(frozen=True)
class Decision:
    """Result of one update.

    Attributes:
        state: its name, for reports.
        goal: (2,) m in map, new goal for the planner; None: no change.
        route: (n, 2) m in map, path to the target.
        messages: Messages to send to the other vehicles.
    """

    state: str
    goal: Array | None
    route: Array
    messages: list[Share]


class Explorer:
    """Explores with one vehicle.

    Attributes:
        floor: its map.
        sharing: its regions.
        frontiers: those found in the last update.
        unreachable: frontiers without a path to them, or that remained after they were viewed.
    """

    def __init__(self, settings: ExplorationSettings, name: str, fleet: Sequence[str]) -> None:
        """Start with an unknown floor.

        Args:
            settings: Settings of the exploration.
            name: Name of the vehicle.
            fleet: names of all exploring vehicles.
        """
        self._settings = settings
        self.floor = FloorMap(settings)
        self._regions = Regions(settings, self.floor)
        self.sharing = Sharing(name, fleet, self._regions.count, settings.lost_after)
        self._smallest = max(1, round(settings.smallest / settings.cell))
        self.frontiers: list[Frontier] = []
        self.state = WAITING
        self._home: Array | None = None
        self._target: Cell | None = None
        self._was_own = False  # whether the target lay in one of this vehicle's regions when it was chosen
        self._given_up = np.zeros(self.floor.own.shape, np.bool_)
        self._tried_again = False
        self._goal: Array | None = None
        self._stays = False  # whether the last update had a target but no new goal
        self._viewed_since: float | None = None
        self._bare_since: float | None = None
        self._cut_off_since: float | None = None

    @property
    def region_count(self) -> int:
        """Number of regions of the floor."""
        return self._regions.count

    @property
    def unreachable(self) -> int:
        """Number of unreachable frontiers, and whether any were given up."""
        return sum(frontier.view is None for frontier in self.frontiers) + bool(self._given_up.any())

    def start(self, home: Array) -> None:
        """Start exploring; fly to ``home``, (2,) m in map, at the end."""
        self._home = np.array(home[:2], float)
        self.state = EXPLORING

    def step(self, now: float, position: Array, planner: str) -> Decision:
        """Advance by a turn.

        Args:
            now: s.
            position: (2,) m in map.
            planner: the planner's state, as text, for the last goal.
        """
        floor, clearance = self.floor, self._settings.clearance
        floor.fly_through(position, 0.4)
        floor.merge()
        here = floor.index(position)
        ways = Ways(floor, here, clearance)
        self._give_up(now, position, planner)
        self.frontiers = find_frontiers(floor, ways, self._given_up, self._smallest)
        goal, route = None, np.empty((0, 2))
        if self._home is not None and self.state not in (HOME, STRANDED):
            target = self._choose(now, ways, position)
            if target is not None:
                route = self._places(ways.route(target))
                goal = self._next_goal(route, position)
            self._stays = target is not None and goal is None
            self._arrive(now, ways, position, planner)
        active: frozenset[int] = frozenset() if self.state == HOME else self._regions.active(self.frontiers)
        aim = position if self._target is None else floor.middle(self._target)
        messages = self.sharing.step(
            now, _pair(position), _pair(aim), active,
            lambda place, mine, theirs: self._regions.divide(
                here, floor.index(np.array(place)), mine, theirs, self.frontiers, clearance
            ),
        )  # fmt: skip
        return Decision(self.state, goal, route, messages)

    # targets

    def _choose(self, now: float, ways: Ways, position: Array) -> Cell | None:
        """Update state and target; return the cell to fly to."""
        reachable = [frontier for frontier in self.frontiers if frontier.view is not None]
        if not reachable and self._given_up.any() and not self._tried_again:
            self._tried_again = True
            self._given_up[:] = False  # each is tried a second time, at the end
        self._bare_since = None if reachable else (now if self._bare_since is None else self._bare_since)
        if self._bare_since is not None:
            self._target = None
            if self.state != RETURNING and now - self._bare_since < _SETTLE:
                return None
            self.state = RETURNING
            return self._home_cell(ways)
        chosen = self._choose_frontier(reachable, ways)
        self.state = EXPLORING if chosen is not None else IDLE
        self._target = None if chosen is None else chosen.centre
        return None if chosen is None else chosen.view

    def _choose_frontier(self, reachable: list[Frontier], ways: Ways) -> Frontier | None:
        """Return the frontier to view next: the current one while it exists, else the first of a tour."""
        if self._target is not None and (self._is_own(self._target) or not self._was_own):
            near = [(math.dist(f.centre, self._target), f.centre, f) for f in reachable]
            found = min(near, key=lambda entry: entry[:2])
            if found[0] * self.floor.cell <= _SAME:
                return found[2]
        others = self.sharing.targets()
        free = [f for f in reachable if all(self._apart(f, target) > _TAKEN for target in others)]
        own = [f for f in free if self._is_own(f.centre)]
        self._was_own = bool(own)
        if own:
            return self._first_of_tour(own)
        return min(free, key=lambda f: (f.way, f.centre)) if free else None

    def _is_own(self, cell: Cell) -> bool:
        return self._regions.of(cell) in self.sharing.own

    def _apart(self, frontier: Frontier, target: tuple[float, float]) -> float:
        return math.dist(self.floor.middle(frontier.centre).tolist(), target)

    def _first_of_tour(self, frontiers: list[Frontier]) -> Frontier:
        """Return the first frontier of a short open tour through the nearest ones."""
        near = sorted(frontiers, key=lambda f: (f.way, f.centre))[:_MOST_IN_TOUR]
        if len(near) < 2:
            return near[0]
        views = [frontier.view for frontier in near if frontier.view is not None]
        costs = np.zeros((len(near) + 1, len(near) + 1))
        costs[0, 1:] = [frontier.way for frontier in near]
        for n, view in enumerate(views, 1):
            found = Ways(self.floor, view, self._settings.clearance).costs
            costs[n, 1:] = [float(found[other]) for other in views]
        return near[divide(costs, 1)[0][1] - 1]

    def _home_cell(self, ways: Ways) -> Cell | None:
        assert self._home is not None
        home = self.floor.index(self._home)
        return home if math.isfinite(ways.costs[home]) else None

    # goals for the planner

    def _places(self, cells: list[Cell]) -> Array:
        return np.asarray((np.array(cells) + self.floor.first + 0.5) * self.floor.cell, float)

    def _next_goal(self, route: Array, position: Array) -> Array | None:
        """Return the point at most ``ahead`` m along a route, if it is a new goal."""
        steps = np.sqrt((np.diff(route, axis=0) ** 2).sum(axis=1))
        count = int(np.searchsorted(np.cumsum(steps), self._settings.ahead, side="right"))
        place = route[count]
        if self._goal is not None:
            away = float(np.sqrt(((place - self._goal) ** 2).sum()))
            is_last = count == len(route) - 1
            left = float(np.sqrt(((self._goal - position) ** 2).sum()))
            on_route = float(np.sqrt(((route - self._goal) ** 2).sum(axis=1)).min()) < _NEW_GOAL
            if away < _NEW_GOAL or (on_route and not is_last and left > 0.5 * self._settings.ahead):
                return None
        self._goal = place
        return place

    def _give_up(self, now: float, position: Array, planner: str) -> None:
        """Give up the target's frontier if it cannot be reached, or remains after it was viewed.

        It also counts as viewed when the planner stops less than ``_NEW_GOAL`` m from the viewpoint, because no closer
        goal is sent.
        """
        target = next((f for f in self.frontiers if f.centre == self._target), None)
        is_near = target is not None and (self._stays or target.way < 2.0 * self.floor.cell)
        is_there = planner == AT_GOAL and is_near
        if not is_there:
            self._viewed_since = None
        elif self._viewed_since is None:
            self._viewed_since = now
        viewed = self._viewed_since is not None and now - self._viewed_since >= _DWELL
        if target is not None and (viewed or planner == UNREACHABLE):
            self._given_up[target.cells[:, 0], target.cells[:, 1]] = True
            self._target = self._goal = self._viewed_since = None

    def _arrive(self, now: float, ways: Ways, position: Array, planner: str) -> None:
        """End at home, or here if there is no path home."""
        if self.state != RETURNING or self._home is None:
            self._cut_off_since = None
            return
        if planner == AT_GOAL and float(np.sqrt(((position - self._home) ** 2).sum())) < 0.5:
            self.state = HOME
        is_cut_off = self._home_cell(ways) is None or planner == UNREACHABLE
        self._cut_off_since = (self._cut_off_since or now) if is_cut_off else None
        if self._cut_off_since is not None and now - self._cut_off_since > _STRANDED:
            self.state = STRANDED


def _pair(place: Array) -> tuple[float, float]:
    return float(place[0]), float(place[1])
