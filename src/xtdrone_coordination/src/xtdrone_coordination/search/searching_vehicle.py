"""A searching vehicle: its telemetry, its state and its current task."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from itertools import pairwise

from xtdrone_autopilot.navigator.plan import Items
from xtdrone_common.geodesy.projection import Datum

from .assigned_mission import AssignedMission
from .people.candidates import Candidate, Evidence
from .planning.coverage_path import Point

MISSION, OFFBOARD, LOITER, RTL, LAND = "AUTO.MISSION", "OFFBOARD", "AUTO.LOITER", "AUTO.RTL", "AUTO.LAND"

Position = tuple[float, float, float]


@dataclass(frozen=True)
class RequestMode:
    """Request a flight mode."""

    vehicle: str
    mode: str


@dataclass(frozen=True)
class Arm:
    """Arm a vehicle."""

    vehicle: str


@dataclass(frozen=True)
class PushMission:
    """Upload a mission and continue with item ``current``."""

    vehicle: str
    items: Items
    current: int


@dataclass(frozen=True)
class GoTo:
    """Publish a position setpoint; yaw in rad from east."""

    vehicle: str
    position: Position
    yaw: float


@dataclass(frozen=True)
class Follow:
    """Follow a track of the vehicle's camera; -1 stops."""

    vehicle: str
    track: int


@dataclass(frozen=True)
class PointCamera:
    """Point a vehicle's camera ahead at a pitch, deg, negative down."""

    vehicle: str
    pitch: float


@dataclass(frozen=True)
class SetReturnHeight:
    """Set the minimum height of a vehicle's return, m over home; different heights keep returning vehicles apart."""

    vehicle: str
    height: float


Action = RequestMode | Arm | PushMission | GoTo | Follow | PointCamera | SetReturnHeight


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
        heading: Heading of the vehicle there, rad from east.
        angle: Angle of the vehicle on the circle around the candidate, rad from east.
        begun: time, s.
        takes_over: remaining time of the following that this look is to take over, s; None for a first look.
        stage: see :class:`LookStage`.
        turned: arc flown on the circle, rad.
        evidence: Evidence of the images so far.
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
        seen: time of this vehicle's newest image of the person, s.
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


class Vehicle:
    """Telemetry, mission and state of a vehicle. Times are s, positions m in the map frame (ENU).

    Attributes:
        name: Name such as ``typhoon_h480_0``.
        index: Index in the fleet, from 0.
        state, since: current state and when it was entered.
        position, yaw: None before the first pose; rad from east.
        home: position before takeoff.
        pose_heard: when the last pose arrived.
        mode, armed, connected, heard: of the last mavros/state, and when it arrived.
        mission: its mission and the progress along it.
        request: the flight mode requested of it.
        rejected_pushes: consecutive mission uploads the autopilot rejected.
        arm_requested: whether it was requested to arm in this flight.
        image, picture_heard: exposure time of the newest image, and when it arrived.
        camera_works: whether its images are new ones.
        blind: whether its camera has failed during the search.
        look, following: see :class:`SecondLook`, :class:`Following`; None in other states.
        setpoint: Position setpoint of a second look.
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
