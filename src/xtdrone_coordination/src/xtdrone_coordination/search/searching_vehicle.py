"""A searching vehicle: its telemetry, its mission and its state."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from itertools import pairwise

from xtdrone_control.autopilot.navigator import plan
from xtdrone_control.autopilot.navigator.plan import Items
from xtdrone_control.geodesy.datum import Datum

from .actions import Position
from .people.candidates import Candidate, Evidence
from .planning.coverage_path import Point, Waypoint
from .planning.plans import waypoint_item

_ENDS = (plan.RETURN, plan.LAND)
_NO_PATH = (plan.TAKEOFF, plan.LAND, plan.VTOL_TAKEOFF, plan.VTOL_LAND)
_AIRBORNE = 1.5  # m over home


class State(enum.Enum):
    """State of a vehicle; the values are published."""

    WAITING = "waiting"
    TAKING_OFF = "taking off"
    SEARCHING = "searching"
    SECOND_LOOK = "second look"
    REJOINING = "back to its lane"
    FOLLOWING = "following"
    HOLDING = "holding"
    RETURNING = "returning"
    LANDED = "landed"
    LOST = "lost"


BUSY = (State.WAITING, State.TAKING_OFF, State.SEARCHING, State.SECOND_LOOK, State.REJOINING, State.FOLLOWING)
DONE = (State.LANDED, State.LOST)
OFFBOARD_STATES = (State.SECOND_LOOK, State.REJOINING, State.FOLLOWING)


class LookStage(enum.Enum):
    """Stage of a second look, or of the way back from it."""

    APPROACH = enum.auto()  # to the circle, at the vehicle's own height
    DESCEND = enum.auto()
    CIRCLE = enum.auto()
    CLIMB = enum.auto()
    GO_BACK = enum.auto()


@dataclass
class SecondLook:
    """A second look at a candidate.

    Attributes:
        candidate: the candidate.
        came_from: state before the look, resumed after it.
        left_at: where the vehicle left its path, m ENU.
        heading: of the vehicle there, rad from east.
        angle: of the vehicle on the circle around the candidate, rad from east.
        begun: time, s.
        takes_over: remaining time of the following that this look is to take over, s; None for a first look.
        stage: see :class:`LookStage`.
        turned: arc flown on the circle, rad.
        evidence: of the pictures so far.
    """

    candidate: Candidate
    came_from: State
    left_at: Point
    heading: float
    angle: float
    begun: float
    takes_over: float | None = None
    stage: LookStage = LookStage.APPROACH
    turned: float = 0.0
    evidence: Evidence = field(default_factory=Evidence)


@dataclass
class Following:
    """The following of a confirmed person.

    Attributes:
        candidate: the person.
        since, until: s.
        track: the person's id in the vehicle's camera.
        look: the second look that confirmed the person.
        seen: time of this vehicle's newest picture of the person, s.
    """

    candidate: Candidate
    since: float
    until: float
    track: int
    look: SecondLook
    seen: float = -math.inf


@dataclass
class ModeRequest:
    """The flight mode requested of a vehicle, and the attempts to reach it.

    Attributes:
        mode: empty: none is requested.
        next_try: time of the next attempt, s.
        reached: whether the vehicle has reached the mode.
        first_try: time of the first attempt, s; infinite before it.
        tries: number of attempts.
        refusal: reason given for the last rejected action, empty if none.
        left_since: when the vehicle left the mode, s; None: it has not.
    """

    mode: str = ""
    next_try: float = -math.inf
    reached: bool = False
    first_try: float = math.inf
    tries: int = 0
    refusal: str = ""
    left_since: float | None = None


class AssignedMission:
    """The mission of a vehicle and the progress along its path.

    Attributes:
        items: the mission items.
        path: waypoints with the indices of their items.
        current: index of the item being flown.
        reached: index of the last item reached, -1 for none.
        progress: item and position at the newest picture taken on the path; None before the first.
    """

    def __init__(self, datum: Datum) -> None:
        self.items: Items = ()
        self.path: list[tuple[int, Waypoint]] = []
        self.current = 0
        self.reached = -1
        self.progress: tuple[int, Point] | None = None
        self._datum = datum

    def load(self, items: Items) -> None:
        """Replace the mission items."""
        self.items = items
        self.path = _path(items, self._datum)

    @property
    def height(self) -> float:
        """Search height over home, m: the greatest of the mission."""
        heights = [self._height_of(index) for index, item in enumerate(self.items) if item.has_position]
        return max(heights, default=0.0)

    @property
    def takeoff_height(self) -> float:
        """Height at the end of the takeoff, m over home."""
        heights = [item.z for item in self.items if item.command == plan.TAKEOFF and item.relative]
        return min([*heights[:1], self.height])

    @property
    def lowest(self) -> float:
        """Least height of the path, m over home."""
        return min((self._height_of(index) for index, _ in self.path), default=self.height)

    def _height_of(self, index: int) -> float:
        item = self.items[index]
        return item.z if item.relative else item.z - self._datum.altitude

    @property
    def end(self) -> int:
        """Index of the item that ends the path."""
        ends = [i for i, item in enumerate(self.items) if item.command in _ENDS and i > 0]
        return ends[-1] if ends else len(self.items)

    @property
    def path_done(self) -> bool:
        """Whether the path is flown."""
        return bool(self.items) and (self.current >= self.end or self.reached >= len(self.items) - 1)

    @property
    def ended(self) -> bool:
        """Whether a mission without a return or landing at its end is flown."""
        return self.path_done and self.end >= len(self.items) and self.reached >= len(self.items) - 1

    @property
    def first_waypoint(self) -> int:
        """Index of the first item of the path, 0 without a path."""
        return self.path[0][0] if self.path else 0

    @property
    def unseen_path(self) -> list[Waypoint]:
        """Part of the path no picture has been taken on; empty or a single waypoint if there is none."""
        if self.progress is None:
            return [waypoint for _, waypoint in self.path]
        current, (x, y) = self.progress
        left = [waypoint for index, waypoint in self.path if index >= current]
        if left and len(left) < len(self.path):
            left.insert(0, Waypoint(x, y, left[0].heading))
        return left

    def extended(self, part: list[Waypoint], *, restart: bool) -> tuple[Items, int]:
        """Return the mission with a part of another vehicle's path appended, and the item to continue with.

        Args:
            part: waypoints to append.
            restart: for a landed vehicle: drop the own path, keep the items before it and fly ``part`` alone.
        """
        first = self.path[0][0] if self.path else len(self.items)
        added = tuple(waypoint_item(waypoint, self.height, self._datum) for waypoint in part)
        before = self.items[: first if restart else self.end]
        return (*before, *added, *self.items[self.end :]), 0 if restart else min(self.current, self.end)


class Vehicle:
    """Telemetry, mission and state of a vehicle. Times are s, positions m in the map frame (ENU).

    Attributes:
        name: as ``typhoon_h480_0``.
        index: in the fleet, from 0.
        state, since: current state and when it was entered.
        position, yaw: None before the first pose; rad from east.
        home: position before takeoff.
        pose_heard: when the last pose arrived.
        mode, armed, connected, heard: of the last mavros/state, and when it arrived.
        mission: its mission and the progress along it.
        request: the flight mode requested of it.
        rejected_pushes: consecutive mission uploads the autopilot rejected.
        arm_requested: whether it was requested to arm in this flight.
        picture, picture_heard: exposure time of the newest picture, and when it arrived.
        camera_works: whether its pictures are new ones.
        blind: whether its camera has failed during the search.
        look, following: see :class:`SecondLook`, :class:`Following`; None in other states.
        setpoint: of a second look.
    """

    def __init__(self, name: str, index: int, datum: Datum) -> None:
        self.name = name
        self.index = index
        self.state = State.WAITING
        self.since = -math.inf
        self.position: Position | None = None
        self.yaw = 0.0
        self.home: Position = (0.0, 0.0, 0.0)
        self.pose_heard = -math.inf
        self.mode = ""
        self.armed = False
        self.connected = False
        self.heard = -math.inf
        self.mission = AssignedMission(datum)
        self.request = ModeRequest()
        self.rejected_pushes = 0
        self.arm_requested = False
        self.picture = -math.inf
        self.picture_heard = -math.inf
        self.camera_works = True
        self.blind = False
        self.look: SecondLook | None = None
        self.following: Following | None = None
        self.setpoint: Position | None = None

    def enter(self, state: State, now: float) -> None:
        """Change the state."""
        self.state = state
        self.since = now

    def request_mode(self, mode: str, now: float, delay: float = 0.0) -> None:
        """Request a flight mode, from ``delay`` s on."""
        self.request = ModeRequest(mode, now + delay)

    @property
    def altitude(self) -> float:
        """Height over home, m."""
        assert self.position is not None
        return self.position[2] - self.home[2]

    @property
    def search_altitude(self) -> float:
        """Search height in the map frame, m."""
        return self.home[2] + self.mission.height

    def distance_to(self, point: Point) -> float:
        """Return the horizontal distance to a point, m."""
        assert self.position is not None
        return math.dist(self.position[:2], point)

    @property
    def airborne(self) -> bool:
        """Whether it is armed and off the ground."""
        return self.armed and self.position is not None and self.altitude > _AIRBORNE

    @property
    def available(self) -> bool:
        """Whether it can take on another task in this flight."""
        if self.blind:
            return False
        if self.state is State.RETURNING:
            return self.position is not None and self.altitude > 0.6 * self.mission.height
        return self.state in (State.SEARCHING, State.HOLDING)

    @property
    def remaining_distance(self) -> float:
        """Distance still to fly on the path, m."""
        left = [waypoint for index, waypoint in self.mission.path if index >= self.mission.current]
        places = [(w.x, w.y) for w in left]
        if self.position is not None and places:
            places.insert(0, self.position[:2])
        return sum(math.dist(a, b) for a, b in pairwise(places))

    @property
    def path_end(self) -> Point:
        """End of the path; the current position once the path is flown."""
        if self.mission.path and not self.mission.path_done:
            last = self.mission.path[-1][1]
            return last.x, last.y
        return (0.0, 0.0) if self.position is None else self.position[:2]


def _path(items: Items, datum: Datum) -> list[tuple[int, Waypoint]]:
    """Return the waypoints of a mission with the indices of their items."""
    places = [
        (i, *datum.local(item.x, item.y), item.yaw)
        for i, item in enumerate(items)
        if item.has_position and item.command not in _NO_PATH
    ]
    path = []
    for k, (i, x, y, yaw) in enumerate(places):
        if math.isfinite(yaw):
            heading = 0.5 * math.pi - yaw
        else:  # the vehicle looks in the direction of flight
            a, b = (places[k - 1], places[k]) if k else (places[0], places[min(1, len(places) - 1)])
            heading = math.atan2(b[2] - a[2], b[1] - a[1])
        path.append((i, Waypoint(x, y, heading)))
    return path
