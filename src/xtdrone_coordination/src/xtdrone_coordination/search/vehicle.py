"""One vehicle of a search, as the mission control knows it."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from itertools import pairwise

from xtdrone_control.autopilot.navigator import plan
from xtdrone_control.autopilot.navigator.plan import Items

from .coverage import Point, Waypoint
from .evidence import Candidate, Evidence
from .plans import Datum, waypoint_item

_ENDS = (plan.RETURN, plan.LAND)
_NO_PATH = (plan.TAKEOFF, plan.LAND, plan.VTOL_TAKEOFF, plan.VTOL_LAND)
_IN_THE_AIR = 1.5  # m over home

Place = tuple[float, float, float]


class State(enum.Enum):
    """What a vehicle does."""

    WAITING = "waiting"
    STARTING = "taking off"
    SEARCHING = "searching"
    LOOKING = "second look"
    REJOINING = "back to its lane"
    FOLLOWING = "following"
    HOLDING = "holding"
    RETURNING = "returning"
    LANDED = "landed"
    LOST = "lost"


class Stage(enum.Enum):
    """Where a second look, or the way back from it, has come to."""

    OVER = enum.auto()  # to the circle, at the vehicle's own height
    DOWN = enum.auto()
    CIRCLE = enum.auto()
    UP = enum.auto()
    BACK = enum.auto()


@dataclass
class Look:
    """A second look at a candidate.

    Attributes:
        candidate: at whom.
        came_from: what the vehicle did before, and goes on with after it.
        left: where, m ENU.
        heading: how it looked there, rad from east.
        angle: where on the circle around the candidate it is, rad from east.
        turned: how far it has come on it, rad.
        begun: time, s.
        takes_over: seconds that are left of a following which this look is to take over; None for a first find.
    """

    candidate: Candidate
    came_from: State
    left: Point
    heading: float
    angle: float
    begun: float
    takes_over: float | None = None
    stage: Stage = Stage.OVER
    turned: float = 0.0
    evidence: Evidence = field(default_factory=Evidence)


@dataclass
class Following:
    """The following of a find.

    Attributes:
        candidate: whom.
        since, until: s.
        track: his id with the vehicle that follows.
        look: which found him.
        seen: time of the newest picture of this vehicle that showed him, s.
    """

    candidate: Candidate
    since: float
    until: float
    track: int
    look: Look
    seen: float = -math.inf


class Vehicle:
    """What is known of a vehicle and what is wanted of it.

    Attributes:
        name: as ``typhoon_h480_0``.
        index: place in the fleet.
        state: what it does.
        position: m, map; None before the first pose.
        yaw: rad from east.
        home: where it stood first.
        mode, armed, connected: of mavros/state; ``heard`` is when it came, s.
        items: its mission.
        seq: the item it flies.
        reached: the item that it reached last, -1 for none.
        progress: item and place at the newest picture that was taken on its path.
        picture: time of the newest picture, s, and ``picture_heard`` when it came.
        wanted: the mode it is to be in, empty while nothing is asked of it.
        arm_asked: whether it was asked to arm.
        camera_works: whether its pictures are new ones.
        blind: its camera is silent.
    """

    def __init__(self, name: str, index: int, datum: Datum) -> None:
        """Know nothing of it."""
        self.name = name
        self.index = index
        self.state = State.WAITING
        self.position: Place | None = None
        self.yaw = 0.0
        self.home: Place = (0.0, 0.0, 0.0)
        self.pose_heard = -math.inf
        self.mode = ""
        self.armed = False
        self.connected = False
        self.heard = -math.inf
        self.items: Items = ()
        self.path: list[tuple[int, Waypoint]] = []
        self.seq = 0
        self.reached = -1
        self.progress: tuple[int, Point] | None = None
        self.picture = -math.inf
        self.picture_heard = -math.inf
        self.since = -math.inf
        self.wanted = ""
        self.in_mode = False
        self.asked = -math.inf
        self.ask_at = -math.inf
        self.tries = 0
        self.refusal = ""
        self.wrong_since: float | None = None
        self.pushes = 0
        self.camera_works = True
        self.blind = False
        self.arm_asked = False
        self.look: Look | None = None
        self.following: Following | None = None
        self.setpoint: Place | None = None
        self._datum = datum

    # its mission

    def take_mission(self, items: Items) -> None:
        """Take note of its mission."""
        self.items = items
        self.path = _path(items, self._datum)

    @property
    def height(self) -> float:
        """Its search height over home, m: the greatest of its mission."""
        heights = [
            item.z if item.relative else item.z - self._datum.altitude for item in self.items if item.has_position
        ]
        return max(heights, default=0.0)

    @property
    def takeoff_height(self) -> float:
        """How high over home its takeoff leads, m."""
        heights = [item.z for item in self.items if item.command == plan.TAKEOFF and item.relative]
        return min([*heights[:1], self.height])

    @property
    def lowest(self) -> float:
        """The least height over home of its path, m."""
        chosen = {index for index, _ in self.path}
        heights = [
            item.z if item.relative else item.z - self._datum.altitude
            for index, item in enumerate(self.items)
            if index in chosen
        ]
        return min(heights, default=self.height)

    @property
    def end(self) -> int:
        """Index of the item that ends its path."""
        ends = [i for i, item in enumerate(self.items) if item.command in _ENDS and i > 0]
        return ends[-1] if ends else len(self.items)

    @property
    def path_done(self) -> bool:
        """Whether there is nothing of its path left."""
        return bool(self.items) and (self.seq >= self.end or self.reached >= len(self.items) - 1)

    @property
    def rest(self) -> list[Waypoint]:
        """What of its path no picture has been taken of; fewer than two waypoints are nothing."""
        if self.progress is None:
            return [waypoint for _, waypoint in self.path]
        seq, (x, y) = self.progress
        rest = [waypoint for index, waypoint in self.path if index >= seq]
        if rest and len(rest) < len(self.path):
            rest.insert(0, Waypoint(x, y, rest[0].heading))
        return rest

    @property
    def load(self) -> float:
        """How far it has still to fly on its path, m."""
        left = [waypoint for index, waypoint in self.path if index >= self.seq]
        places = [(w.x, w.y) for w in left]
        if self.position is not None and places:
            places.insert(0, self.position[:2])
        return sum(math.dist(a, b) for a, b in pairwise(places))

    @property
    def path_end(self) -> Point:
        """Where its path ends; where it is, if that is flown."""
        if self.path and not self.path_done:
            last = self.path[-1][1]
            return last.x, last.y
        return (0.0, 0.0) if self.position is None else self.position[:2]

    def with_part(self, part: list[Waypoint], *, anew: bool) -> tuple[Items, int]:
        """Return its mission with a part of somebody's path at its end, and the item to go on with.

        Args:
            part: of the path.
            anew: it has landed: the mission is the part alone, after what comes before its path.
        """
        first = self.path[0][0] if self.path else len(self.items)
        added = tuple(waypoint_item(waypoint, self.height, self._datum) for waypoint in part)
        before = self.items[: first if anew else self.end]
        return (*before, *added, *self.items[self.end :]), 0 if anew else min(self.seq, self.end)

    # what it does

    @property
    def flies(self) -> bool:
        """Whether it is armed and off the ground."""
        return self.armed and self.position is not None and self.position[2] - self.home[2] > _IN_THE_AIR

    @property
    def useful(self) -> bool:
        """Whether more can be asked of it in this flight."""
        if self.blind:
            return False
        if self.state is State.RETURNING:
            return self.position is not None and self.position[2] - self.home[2] > 0.6 * self.height
        return self.state in (State.SEARCHING, State.HOLDING)

    def want(self, mode: str, now: float, delay: float = 0.0) -> None:
        """Let it be brought into a mode, from ``delay`` s on."""
        self.wanted, self.in_mode, self.tries, self.refusal = mode, False, 0, ""
        self.ask_at = now + delay
        self.asked = math.inf
        self.wrong_since = None

    def enter(self, state: State, now: float) -> None:
        """Change what it does."""
        self.state = state
        self.since = now


def _path(items: Items, datum: Datum) -> list[tuple[int, Waypoint]]:
    """Return the waypoints of a mission with their items' indices."""
    places = [
        (i, *datum.local(item.x, item.y), item.yaw)
        for i, item in enumerate(items)
        if item.has_position and item.command not in _NO_PATH
    ]
    path = []
    for k, (i, x, y, yaw) in enumerate(places):
        if math.isfinite(yaw):
            heading = 0.5 * math.pi - yaw
        else:  # it looks where it flies
            a, b = (places[k - 1], places[k]) if k else (places[0], places[min(1, len(places) - 1)])
            heading = math.atan2(b[2] - a[2], b[1] - a[1])
        path.append((i, Waypoint(x, y, heading)))
    return path
