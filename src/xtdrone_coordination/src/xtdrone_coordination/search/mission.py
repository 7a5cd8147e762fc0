"""Mission control of a cooperative search: what each vehicle does, from what it and its camera tell.

Numbers in, actions and events out; no ROS. Call the ``on_...`` methods as things come, :meth:`SearchMission.step` at a
steady rate, carry out the actions that it returns and tell what came of them by :meth:`SearchMission.on_result`.

Each vehicle flies its own mission at a height of its own. A candidate, seen in several pictures, is looked at again:
the vehicle leaves its path, goes down and circles him; what the pictures of the circle say decides. Then it goes back
to where it left, or follows. What a lost vehicle, or one with a silent camera, leaves over is flown by the others.

Events are dictionaries with ``event``, ``time`` (s) and, where it concerns one, ``vehicle``:

=============  =========================================================================================================
started        ``vehicles``: the first of them is armed
candidate      ``position``, ``probability``, ``hits``: several pictures of a vehicle have shown somebody
second_look    ``position``; ``takes_over``: whether it is to take over a following
confirmed      ``position``, ``covariance`` (xx, xy, yx, yy; m^2), ``found_time`` (of the picture), ``probability``
rejected       ``position``, ``probability``, ``pictures``, ``hits``
following      ``position``, ``track``
follow_ended   ``reason``, ``duration``
lost_vehicle   ``reason``, ``position``
camera_silent  ``position``
reassigned     ``to``: metres of the path by vehicle; empty when nobody can take it
returning      ``reason``
finished       ``outcome`` (found, not found, failed), ``vehicle``, ``position``, ``covariance``, ``found_time``,
               ``covered_area``, ``region_area`` (m^2), ``covered_fraction``, ``possible`` (candidates that were not
               confirmed), ``lost``, ``reason``
=============  =========================================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from xtdrone_control.autopilot.navigator.plan import Items
from xtdrone_control.pinhole import Pinhole
from xtdrone_control.settings import check_choice, check_range

from .coverage import Point, Waypoint, length
from .covered import Covered, shows
from .evidence import AHEAD, Candidate, Sighting, nearest
from .plans import Datum
from .sharing import share_out
from .vehicle import Following, Look, Place, Stage, State, Vehicle

ON_FIND = ("hold", "return", "continue")
MISSION, OFFBOARD, LOITER, RTL, LAND = "AUTO.MISSION", "OFFBOARD", "AUTO.LOITER", "AUTO.RTL", "AUTO.LAND"

_GRACE = 2.5  # s; mavros/state follows the 1 Hz heartbeat
_ASK_AGAIN = 2.0  # s between requests that were not obeyed
_MOST_TRIES = 8
_OFFBOARD_DELAY = 0.3  # s in which the first setpoint gets through before the mode is asked for
_CLEAR = 6.0  # m; nobody changes his height nearer than this to one that is in between
_NEAREST_CIRCLE, _WIDEST_CIRCLE = 3.0, 25.0  # m, radius of a second look
_FASTEST_TURN = 0.35  # rad/s around a candidate
_WALK = 1.5  # m/s that somebody may move while nobody sees him
_LEAD = 4.0  # m that a setpoint goes ahead of its vehicle at most
_FALLEN = 0.3  # part of the height of takeoff or second look below which a vehicle no longer flies
_STEPS = ("waiting", "taking off", "searching", "second look", "following", "returning", "finished")
_BUSY = (State.WAITING, State.STARTING, State.SEARCHING, State.LOOKING, State.REJOINING, State.FOLLOWING)
_OFFBOARD_STATES = (State.LOOKING, State.REJOINING, State.FOLLOWING)


@dataclass(frozen=True)
class MissionSettings:
    """How the mission control decides.

    Attributes:
        on_find: what the others do once somebody is found: ``hold``, ``return`` or ``continue``.
        gimbal_pitch: at which cameras look down, deg, -90 to -5.
        person_pixels: height in the picture from which on a place counts as covered, px, 1 to 200.
        candidate_hits: pictures of one vehicle that make a candidate, 1 to 100.
        candidate_probability: and their least mean probability, 0 to 1.
        same_place: what is nearer than this to a candidate is he, m, 0.5 to 50.
        margin: how far outside the region candidates count, m, 0 to 100.
        look_height: of the second look, m over the ground, 3 to 50; lower than any path by at least 1 m.
        look_step: how much higher each further vehicle looks, m, 0 to 5.
        look_pitch: of the camera at a second look, deg, -90 to -5; the radius of its circle follows from it.
        look_speed: setpoints move so fast, m/s, 0.5 to 10.
        look_arc: least way on the circle before somebody is confirmed, deg, 0 to 360.
        look_time: after so long without a decision a candidate is rejected, s, 5 to 600.
        look_apart: second looks are at least so far apart, m, 5 to 500.
        confirm_log_odds: sum of the log-odds of the pictures that confirms, 1 to 100.
        confirm_hits: and how many of them must show him, 1 to 100.
        confirm_probability: and the least mean probability over all of them, 0 to 1.
        reject_log_odds: the sum that rejects, -100 to -1.
        follow_time: how long the person is followed, s, 0 to 36000.
        lose_time: a person not seen for so long is lost, s, 1 to 600.
        silent_time: a vehicle that tells nothing for so long is lost, s, 2 to 60.
        camera_timeout: a camera without pictures for so long is silent, s, 1 to 600.
        start_timeout: a vehicle that is not in the air so long after the beginning is lost, s, 5 to 3600.
        return_timeout: for so long the landing of all is waited for, s, 1 to 3600.
        time_limit: after so long the search is over, s, 1 to 36000.
        ground: height of the ground in the map frame, m, -1000 to 10000.
    """

    on_find: str = "hold"
    gimbal_pitch: float = -60.0
    person_pixels: float = 12.0
    candidate_hits: int = 4
    candidate_probability: float = 0.62
    same_place: float = 6.0
    margin: float = 5.0
    look_height: float = 9.5
    look_step: float = 0.5
    look_pitch: float = -50.0
    look_speed: float = 3.0
    look_arc: float = 60.0
    look_time: float = 60.0
    look_apart: float = 30.0
    confirm_log_odds: float = 8.0
    confirm_hits: int = 5
    confirm_probability: float = 0.55
    reject_log_odds: float = -8.0
    follow_time: float = 60.0
    lose_time: float = 8.0
    silent_time: float = 3.0
    camera_timeout: float = 5.0
    start_timeout: float = 90.0
    return_timeout: float = 180.0
    time_limit: float = 1800.0
    ground: float = 0.0

    def __post_init__(self) -> None:
        """Check them.

        Raises:
            ValueError: one is not allowed; the message names it and what is.
        """
        check_choice("on_find", self.on_find, ON_FIND)
        for name, (low, high, unit) in _RANGES.items():
            check_range(name, getattr(self, name), low, high, unit)


_RANGES: dict[str, tuple[float, float, str]] = {
    "gimbal_pitch": (-90.0, -5.0, "deg"),
    "person_pixels": (1.0, 200.0, "px"),
    "candidate_hits": (1, 100, ""),
    "candidate_probability": (0.0, 1.0, ""),
    "same_place": (0.5, 50.0, "m"),
    "margin": (0.0, 100.0, "m"),
    "look_height": (3.0, 50.0, "m"),
    "look_step": (0.0, 5.0, "m"),
    "look_pitch": (-90.0, -5.0, "deg"),
    "look_speed": (0.5, 10.0, "m/s"),
    "look_arc": (0.0, 360.0, "deg"),
    "look_time": (5.0, 600.0, "s"),
    "look_apart": (5.0, 500.0, "m"),
    "confirm_log_odds": (1.0, 100.0, ""),
    "confirm_hits": (1, 100, ""),
    "confirm_probability": (0.0, 1.0, ""),
    "reject_log_odds": (-100.0, -1.0, ""),
    "follow_time": (0.0, 36000.0, "s"),
    "lose_time": (1.0, 600.0, "s"),
    "silent_time": (2.0, 60.0, "s"),
    "camera_timeout": (1.0, 600.0, "s"),
    "start_timeout": (5.0, 3600.0, "s"),
    "return_timeout": (1.0, 3600.0, "s"),
    "time_limit": (1.0, 36000.0, "s"),
    "ground": (-1000.0, 10000.0, "m"),
}


@dataclass(frozen=True)
class SetMode:
    """Ask a vehicle for a mode."""

    vehicle: str
    mode: str


@dataclass(frozen=True)
class Arm:
    """Ask a vehicle to arm."""

    vehicle: str


@dataclass(frozen=True)
class Push:
    """Give a vehicle a mission and let it go on with item ``current``."""

    vehicle: str
    items: Items
    current: int


@dataclass(frozen=True)
class GoTo:
    """Setpoint: m, map; yaw in rad from east."""

    vehicle: str
    position: Place
    yaw: float


@dataclass(frozen=True)
class Follow:
    """Let a vehicle follow a track; -1 ends it."""

    vehicle: str
    track: int


@dataclass(frozen=True)
class Aim:
    """Point a vehicle's camera ahead, by a pitch in deg, negative down."""

    vehicle: str
    pitch: float


@dataclass(frozen=True)
class ReturnHeight:
    """Set the least height of a vehicle's return, m over home, so that returns cross at different heights."""

    vehicle: str
    height: float


Action = SetMode | Arm | Push | GoTo | Follow | Aim | ReturnHeight
Event = dict[str, Any]


@dataclass
class _Find:
    vehicle: str
    position: Point
    covariance: tuple[float, float, float, float]
    time: float


class SearchMission:
    """The mission control.

    Attributes:
        vehicles: by name.
        candidates: everybody that was seen.
        covered: what of the region was seen.
        finished: whether the search is over; then nothing is asked of anybody.
    """

    def __init__(
        self, names: Sequence[str], region: Polygon, camera: Pinhole, settings: MissionSettings, datum: Datum
    ) -> None:
        """Wait for the vehicles.

        Args:
            names: the vehicles, at least one.
            region: what is searched, m ENU.
            camera: of all vehicles.
            settings: see :class:`MissionSettings`.
            datum: where the map frame's origin is.
        """
        self.settings = settings
        self.vehicles = {name: Vehicle(name, i, datum) for i, name in enumerate(names)}
        self.candidates: list[Candidate] = []
        self.covered = Covered(region, camera, ground=settings.ground, pixels=settings.person_pixels)
        self.finished = False
        self._camera = camera
        self._region = region.buffer(settings.margin)
        shapely.prepare(self._region)
        self._now = 0.0
        self._last = 0.0
        self._begin: float | None = None
        self._started_at: float | None = None
        self._finds: list[_Find] = []
        self._rests: list[tuple[str, list[Waypoint]]] = []
        self._ending: float | None = None
        self._reason = ""
        self._failed = False
        self._actions: list[Action] = []
        self._events: list[Event] = []

    # what comes

    def on_state(self, name: str, mode: str, armed: bool, connected: bool, now: float) -> None:
        """Take a vehicle's mavros/state."""
        vehicle = self.vehicles[name]
        vehicle.mode, vehicle.armed, vehicle.connected, vehicle.heard = mode, armed, connected, now

    def on_pose(self, name: str, position: Place, yaw: float, now: float) -> None:
        """Take a vehicle's place: m, map; rad from east."""
        vehicle = self.vehicles[name]
        if vehicle.position is None or (not vehicle.armed and vehicle.state is State.WAITING):
            vehicle.home = position
        vehicle.position, vehicle.yaw, vehicle.pose_heard = position, yaw, now

    def on_mission(self, name: str, items: Items) -> None:
        """Take the mission that a vehicle has."""
        vehicle = self.vehicles[name]
        if vehicle.state is State.WAITING:
            vehicle.take_mission(items)

    def on_item(self, name: str, current: int) -> None:
        """Take the index of the mission item that a vehicle flies."""
        self.vehicles[name].seq = current

    def on_reached(self, name: str, index: int) -> None:
        """Take the index of the mission item that a vehicle has reached."""
        self.vehicles[name].reached = index

    def on_camera(self, name: str, works: bool) -> None:
        """Take whether a vehicle's camera works: the pictures of one that does not show nothing new."""
        self.vehicles[name].camera_works = works

    def on_picture(
        self,
        name: str,
        time: float,
        position: NDArray[np.float64],
        rotation: NDArray[np.float64],
        sightings: Sequence[Sighting],
        now: float,
    ) -> None:
        """Take what the detector says of a picture.

        Args:
            name: the vehicle.
            time: of the exposure, s.
            position: (3,) of the camera, m, map.
            rotation: (3, 3) from the optical frame to the map frame.
            sightings: what the camera tracks; those with probability 0 this picture did not show.
            now: s.
        """
        vehicle = self.vehicles[name]
        if time <= vehicle.picture or not vehicle.camera_works:
            return  # a camera that hangs tells the same picture again, with the old time or a new one
        vehicle.picture, vehicle.picture_heard = time, now
        if not vehicle.flies or vehicle.state is State.STARTING:
            return  # its mission has not pointed the camera yet
        self.covered.see(position, rotation)
        assert vehicle.position is not None
        if vehicle.state is State.SEARCHING:
            vehicle.progress = (vehicle.seq, vehicle.position[:2])
        tracked = {sighting.id: sighting.probability for sighting in sightings}
        shown: dict[int, float] = {}
        for sighting in sightings:
            candidate = self._candidate(vehicle, time, sighting, tracked)
            if candidate is not None:
                shown[id(candidate)] = max(shown.get(id(candidate), 0.0), sighting.probability)
        following = vehicle.following
        if following is not None and tracked.get(following.candidate.track.get(name, 0), 0.0) > 0.0:
            following.seen = time
        look = vehicle.look
        if look is None or look.stage not in (Stage.DOWN, Stage.CIRCLE) or vehicle.state is not State.LOOKING:
            return
        if id(look.candidate) in shown:
            look.evidence.hit(shown[id(look.candidate)])
        elif look.takes_over is None or time - look.candidate.seen_at <= AHEAD:  # else he may be anywhere near
            x, y = look.candidate.place(time)
            if shows(self._camera, position, rotation, np.array([[x, y, self.settings.ground]]))[0]:
                look.evidence.miss()

    def _candidate(
        self, vehicle: Vehicle, time: float, sighting: Sighting, tracked: Collection[int]
    ) -> Candidate | None:
        """Return whom a picture shows, None for what it does not show or nobody looks for.

        Args:
            vehicle: whose camera.
            time: of the exposure, s.
            sighting: one thing of the picture.
            tracked: all tracks that the camera has.
        """
        x, y = sighting.position
        if not sighting.probability > 0.0 or not (math.isfinite(x) and math.isfinite(y)):
            return None
        following = vehicle.following
        if following is not None and sighting.id == following.track:
            found: Candidate | None = following.candidate  # the camera's track knows better than his place
        else:
            found = nearest(self.candidates, sighting.position, time, self.settings.same_place)
            if found is None or found.status == "seen":
                found = self._sought(vehicle, time, sighting) or found
        if found is None:
            if not shapely.contains_xy(self._region, x, y):
                return None
            found = Candidate(sighting.position, sighting.velocity, sighting.covariance, time)
            self.candidates.append(found)
        beside = following is not None and found is following.candidate and sighting.id != following.track
        if beside and following is not None and following.track in tracked:
            return found
        found.see(vehicle.name, time, sighting, tracked)
        hits = found.hits[vehicle.name]
        if hits == self.settings.candidate_hits and sum(found.hits.values()) == hits and found.status == "seen":
            probability = round(found.probability, 3)
            self._tell("candidate", vehicle, position=_xy(found.position), probability=probability, hits=hits)
        return found

    def _sought(self, vehicle: Vehicle, time: float, sighting: Sighting) -> Candidate | None:
        """Return whom a vehicle is to follow in another's place, if a sighting may be he: he walks on unseen."""
        look, settings = vehicle.look, self.settings
        if look is None or look.takes_over is None or sighting.probability < settings.candidate_probability:
            return None
        unseen = max(time - look.candidate.seen_at, 0.0)
        reach = min(settings.same_place + _WALK * unseen, settings.look_apart)
        apart = math.dist(look.candidate.place(time), sighting.position)
        return look.candidate if apart <= reach else None

    def on_result(self, action: Action, accepted: bool, reason: str = "") -> None:
        """Take what came of an action; only refusals matter."""
        vehicle = self.vehicles[action.vehicle]
        if accepted:
            if isinstance(action, Push):
                vehicle.pushes = 0
            return
        vehicle.refusal = reason
        if isinstance(action, Push) and vehicle.state is not State.LOST:
            vehicle.pushes += 1
            if vehicle.pushes >= _MOST_TRIES:
                self._lose(vehicle, f"takes no mission{_because(reason)}")
            else:
                self._actions.append(action)

    # a turn

    def step(self, now: float) -> list[Action]:
        """Decide; return what is to be done now.

        Args:
            now: s, ROS time; not less than before.
        """
        self._now = now
        if self._begin is None:
            self._begin = self._last = now
        if not self.finished:
            for vehicle in self.vehicles.values():
                if vehicle.state not in (State.LOST, State.LANDED):
                    self._check(vehicle)
            for vehicle in self.vehicles.values():
                self._advance(vehicle, now - self._last)
            self._share_rests()
            self._choose_looks()
            self._conclude()
        self._last = now
        actions, self._actions = self._actions, []
        return actions

    def events(self) -> list[Event]:
        """Return what has happened since the last call."""
        events, self._events = self._events, []
        return events

    def progress(self) -> dict[str, Any]:
        """Return how far the search is: phase, a line of text, each vehicle's state, the part that is covered."""
        phase = self._phase()
        flying = sum(vehicle.flies for vehicle in self.vehicles.values())
        return {
            "sim_time": round(self._now, 3),
            "phase": phase,
            "step": _STEPS.index(phase),
            "steps": len(_STEPS) - 1,
            "text": f"covered {100.0 * self.covered.fraction:.0f} %, {flying} of {len(self.vehicles)} flying",
            "vehicles": {name: vehicle.state.value for name, vehicle in self.vehicles.items()},
            "covered_fraction": round(self.covered.fraction, 4),
        }

    def _phase(self) -> str:
        if self.finished:
            return "finished"
        if self._ending is not None:
            return "returning"
        states = {vehicle.state for vehicle in self.vehicles.values()}
        for state, phase in ((State.FOLLOWING, "following"), (State.LOOKING, "second look")):
            if state in states:
                return phase
        if State.SEARCHING in states or State.REJOINING in states:
            return "searching"
        return "waiting" if self._started_at is None else "taking off"

    def _tell(self, event: str, vehicle: Vehicle | None = None, /, **fields: Any) -> None:
        told: Event = {"event": event, "time": round(self._now, 3)}
        if vehicle is not None:
            told["vehicle"] = vehicle.name
        self._events.append({**told, **fields})

    # what is wrong with a vehicle

    def _check(self, vehicle: Vehicle) -> None:
        """Look whether a vehicle is lost, and bring it into the mode that is wanted."""
        if vehicle.state is State.WAITING:
            self._check_waiting(vehicle)
            return
        fault = self._fault(vehicle)
        if fault:
            self._lose(vehicle, fault)
            return
        if vehicle.state is State.STARTING and self._now - vehicle.since > self.settings.start_timeout:
            self._lose(vehicle, f"is not in the air after {self.settings.start_timeout:g} s{_because(vehicle.refusal)}")
            return
        self._keep_mode(vehicle)
        if vehicle.state in (State.SEARCHING, State.LOOKING, State.FOLLOWING):
            quiet = self._now - max(vehicle.picture_heard, vehicle.since)
            if quiet > self.settings.camera_timeout and not vehicle.blind:
                self._blind(vehicle)

    def _check_waiting(self, vehicle: Vehicle) -> None:
        assert self._begin is not None
        ready = vehicle.connected and vehicle.position is not None and vehicle.path
        if ready and self._ending is None:
            self._actions.append(ReturnHeight(vehicle.name, vehicle.height))
            vehicle.want(MISSION, self._now)
            vehicle.enter(State.STARTING, self._now)
        elif self._now - max(self._begin, vehicle.since) > self.settings.start_timeout:
            missing = "connection" if not vehicle.connected else "position" if vehicle.position is None else "mission"
            self._lose(vehicle, f"has no {missing} after {self.settings.start_timeout:g} s")

    def _fault(self, vehicle: Vehicle) -> str:
        """Return why a vehicle counts as lost, empty if it does not."""
        now, settings = self._now, self.settings
        assert vehicle.position is not None
        if now - vehicle.heard > settings.silent_time:
            return f"tells nothing for {settings.silent_time:g} s"
        if not vehicle.connected:
            return "its autopilot has lost the connection"
        if now - vehicle.pose_heard > settings.silent_time:
            return f"tells no position for {settings.silent_time:g} s"
        if vehicle.state is State.STARTING:
            return ""
        height = vehicle.position[2] - vehicle.home[2]
        if not vehicle.armed:
            over = vehicle.state is State.RETURNING or (vehicle.state is State.SEARCHING and vehicle.path_done)
            if over and height < 0.3 * max(vehicle.height, 5.0):
                self._land(vehicle)
                return ""
            return f"is disarmed at {height:.1f} m"
        low = -math.inf  # below which it has fallen
        if vehicle.state is State.SEARCHING and not vehicle.path_done:
            low = _FALLEN * vehicle.takeoff_height  # of a path that may begin with a climb
        elif vehicle.state in _OFFBOARD_STATES:
            low = _FALLEN * min(self.look_height(vehicle), vehicle.height)
        if height < low:
            return f"has fallen to {height:.1f} m"
        return ""

    def _land(self, vehicle: Vehicle) -> None:
        vehicle.enter(State.LANDED, self._now)
        vehicle.wanted = ""
        vehicle.arm_asked = False

    def _keep_mode(self, vehicle: Vehicle) -> None:
        if not vehicle.wanted:
            return
        if vehicle.mode == vehicle.wanted and vehicle.heard > vehicle.asked:
            vehicle.in_mode, vehicle.wrong_since = True, None
            return
        if vehicle.in_mode:
            self._left_mode(vehicle)
        elif self._now >= vehicle.ask_at:
            if vehicle.tries >= _MOST_TRIES:
                self._lose(vehicle, f"does not go to {vehicle.wanted}{_because(vehicle.refusal)}")
                return
            self._actions.append(SetMode(vehicle.name, vehicle.wanted))
            vehicle.tries += 1
            vehicle.asked = min(vehicle.asked, self._now)
            vehicle.ask_at = self._now + _ASK_AGAIN

    def _left_mode(self, vehicle: Vehicle) -> None:
        """Judge a mode that a vehicle has entered by itself."""
        mode = vehicle.mode
        if vehicle.state is State.SEARCHING and vehicle.path_done:
            if mode in (RTL, LAND):
                self._returns(vehicle, "its part is searched")
            else:
                self._return(vehicle, "its part is searched")
            return
        if vehicle.state is State.RETURNING and mode in (RTL, LAND, LOITER):
            return
        if vehicle.wrong_since is None:
            vehicle.wrong_since = self._now
        elif self._now - vehicle.wrong_since > _GRACE:
            self._lose(vehicle, f"has gone to {mode or 'no mode'} by itself")

    def _lose(self, vehicle: Vehicle, reason: str) -> None:
        place = None if vehicle.position is None else _xy(vehicle.position)
        self._tell("lost_vehicle", vehicle, reason=reason, position=place)
        self._drop(vehicle)
        vehicle.enter(State.LOST, self._now)
        vehicle.wanted = ""

    def _blind(self, vehicle: Vehicle) -> None:
        assert vehicle.position is not None
        vehicle.blind = True
        self._tell("camera_silent", vehicle, position=_xy(vehicle.position))
        self._drop(vehicle)
        self._return(vehicle, "its camera is silent")

    def _drop(self, vehicle: Vehicle) -> None:
        """Let others have what a vehicle was at."""
        following = vehicle.following
        if following is not None:
            self._end_following(vehicle, "the camera is silent" if vehicle.blind else "the vehicle is lost")
            self._give_up(following.candidate, vehicle)
            self._send(following.candidate, following.until - self._now)
        look, vehicle.look = vehicle.look, None
        if look is not None and look.candidate.status == "looked at":
            look.candidate.status = "seen"
            self._send(look.candidate, look.takes_over)
        rest = [] if vehicle.path_done or self._found else vehicle.rest
        if len(rest) > 1:
            self._rests.append((vehicle.name, rest))
            vehicle.path = []  # it is others' now, whatever becomes of this vehicle on its way home

    @property
    def _found(self) -> bool:
        """Whether the search has ended because somebody was found."""
        return bool(self._finds) and self.settings.on_find != "continue"

    # what a vehicle does next

    def _advance(self, vehicle: Vehicle, dt: float) -> None:
        if vehicle.state is State.STARTING:
            self._start(vehicle)
        elif vehicle.state is State.SEARCHING:
            ended = vehicle.path_done and vehicle.end >= len(vehicle.items)  # a mission without a return
            if ended and vehicle.reached >= len(vehicle.items) - 1:
                self._return(vehicle, "its part is searched")
        elif vehicle.state is State.LOOKING:
            self._look(vehicle, dt)
        elif vehicle.state is State.REJOINING:
            self._rejoin(vehicle, dt)
        elif vehicle.state is State.FOLLOWING:
            self._follow(vehicle)

    def _start(self, vehicle: Vehicle) -> None:
        assert vehicle.position is not None
        if not vehicle.armed:
            if vehicle.in_mode and self._now >= vehicle.ask_at:
                self._actions.append(Arm(vehicle.name))
                vehicle.arm_asked = True
                vehicle.ask_at = self._now + _ASK_AGAIN
            return
        if self._started_at is None:
            self._started_at = self._now
            self._tell("started", vehicles=list(self.vehicles))
        first = vehicle.path[0][0] if vehicle.path else 0
        if vehicle.seq >= first and vehicle.position[2] - vehicle.home[2] >= 0.8 * vehicle.takeoff_height:
            vehicle.enter(State.SEARCHING, self._now)

    def _return(self, vehicle: Vehicle, reason: str) -> None:
        vehicle.want(RTL, self._now)
        self._tell("returning", vehicle, reason=reason)
        vehicle.enter(State.RETURNING, self._now)

    def _returns(self, vehicle: Vehicle, reason: str) -> None:
        """Take note that a vehicle returns by its own mission."""
        vehicle.wanted = ""
        self._tell("returning", vehicle, reason=reason)
        vehicle.enter(State.RETURNING, self._now)

    # the second look

    def _choose_looks(self) -> None:
        """Send vehicles to candidates that they have seen often enough."""
        if self._ending is not None or self._found:
            return
        for candidate in self.candidates:
            if candidate.status not in ("seen", "rejected") or len(candidate.looked_by) > 1:
                continue
            able = [
                vehicle
                for vehicle in self.vehicles.values()
                if vehicle.useful
                and vehicle.name not in candidate.looked_by
                and candidate.hits.get(vehicle.name, 0) >= self.settings.candidate_hits
                and candidate.mean(vehicle.name) >= self.settings.candidate_probability
            ]
            if able and self._apart(candidate):
                self._begin_look(min(able, key=lambda v: self._distance(v, candidate)), candidate, None)

    def _distance(self, vehicle: Vehicle, candidate: Candidate) -> float:
        assert vehicle.position is not None
        return math.dist(vehicle.position[:2], candidate.place(self._now))

    def _apart(self, candidate: Candidate) -> bool:
        """Return whether nobody is low down near a candidate."""
        place = candidate.place(self._now)
        return all(
            vehicle.state not in _OFFBOARD_STATES
            or vehicle.position is None
            or math.dist(vehicle.position[:2], place) > self.settings.look_apart
            for vehicle in self.vehicles.values()
        )

    def _begin_look(self, vehicle: Vehicle, candidate: Candidate, takes_over: float | None) -> None:
        assert vehicle.position is not None
        x, y, _ = vehicle.position
        place = candidate.place(self._now)
        came_from = vehicle.state
        angle = math.atan2(y - place[1], x - place[0])
        vehicle.look = Look(candidate, came_from, (x, y), vehicle.yaw, angle, self._now, takes_over)
        candidate.status = "looked at"
        candidate.looked_by.add(vehicle.name)
        vehicle.setpoint = vehicle.position
        vehicle.want(OFFBOARD, self._now, _OFFBOARD_DELAY)
        vehicle.enter(State.LOOKING, self._now)
        self._tell("second_look", vehicle, position=_xy(place), takes_over=takes_over is not None)

    def look_height(self, vehicle: Vehicle) -> float:
        """Return how high a vehicle circles, m over the ground: below everybody's path, each at its own height."""
        settings = self.settings
        ceiling = min((v.lowest for v in self.vehicles.values() if v.path), default=settings.look_height + 1.0) - 1.0
        count = max(len(self.vehicles) - 1, 1)
        low = min(settings.look_height, ceiling)
        return low + vehicle.index * min(settings.look_step, max(ceiling - low, 0.0) / count)

    def _look(self, vehicle: Vehicle, dt: float) -> None:
        look = vehicle.look
        assert look is not None
        settings = self.settings
        height = self.look_height(vehicle)
        radius = height / math.tan(math.radians(-settings.look_pitch))
        radius = min(max(radius, _NEAREST_CIRCLE), _WIDEST_CIRCLE)
        if look.stage is Stage.CIRCLE:
            step = min(settings.look_speed / radius, _FASTEST_TURN) * dt
            look.angle += step
            look.turned += step
        x, y = look.candidate.place(self._now)
        target_z = settings.ground + height if look.stage is not Stage.OVER else vehicle.home[2] + vehicle.height
        target = (x + radius * math.cos(look.angle), y + radius * math.sin(look.angle), target_z)
        self._go(vehicle, target, look.angle + math.pi, dt)
        assert vehicle.position is not None
        off = math.dist(vehicle.position[:2], target[:2])
        if look.stage is Stage.OVER and off < 3.0:
            look.stage = Stage.DOWN
            self._actions.append(Aim(vehicle.name, settings.look_pitch))
        elif look.stage is Stage.DOWN and abs(vehicle.position[2] - target[2]) < 1.0:
            look.stage = Stage.CIRCLE
        self._judge(vehicle, look)

    def _judge(self, vehicle: Vehicle, look: Look) -> None:
        settings, evidence = self.settings, look.evidence
        sure = evidence.log_odds >= settings.confirm_log_odds and evidence.hits >= settings.confirm_hits
        if sure and evidence.mean >= settings.confirm_probability and look.turned >= math.radians(settings.look_arc):
            self._confirm(vehicle, look)
        elif evidence.log_odds <= settings.reject_log_odds or self._now - look.begun > settings.look_time:
            self._reject(vehicle, look)

    def _reject(self, vehicle: Vehicle, look: Look) -> None:
        candidate, evidence = look.candidate, look.evidence
        candidate.status = "rejected"
        self._tell(
            "rejected",
            vehicle,
            position=_xy(candidate.position),
            probability=round(evidence.mean, 3),
            pictures=evidence.pictures,
            hits=evidence.hits,
        )
        look.stage = Stage.UP
        vehicle.enter(State.REJOINING, self._now)
        if look.takes_over is not None:
            self._send(candidate, look.takes_over)

    def _rejoin(self, vehicle: Vehicle, dt: float) -> None:
        """Climb to the vehicle's own height, go back to where it left, and on with what it did."""
        look = vehicle.look
        assert look is not None
        assert vehicle.position is not None
        height = vehicle.home[2] + vehicle.height
        assert vehicle.setpoint is not None
        x, y = vehicle.setpoint[:2] if look.stage is Stage.UP else look.left
        self._go(vehicle, (x, y, height), look.heading, dt)
        if look.stage is Stage.UP:
            if abs(vehicle.position[2] - height) < 0.7:
                look.stage = Stage.BACK
                if look.came_from is not State.SEARCHING:
                    self._resume(vehicle, look)
        elif math.dist(vehicle.position[:2], look.left) < 2.0:
            self._resume(vehicle, look)

    def _resume(self, vehicle: Vehicle, look: Look) -> None:
        vehicle.look = None
        if self._found or self._ending is not None:
            self._stand_by(vehicle)
        elif look.came_from is State.SEARCHING:
            self._actions.append(Aim(vehicle.name, self.settings.gimbal_pitch))
            vehicle.want(MISSION, self._now)
            vehicle.enter(State.SEARCHING, self._now)
        else:
            self._return(vehicle, "its part is searched")

    def _go(self, vehicle: Vehicle, target: Place, yaw: float, dt: float) -> None:
        """Move the setpoint towards a place, not faster than a look is flown, and not through others' heights."""
        assert vehicle.position is not None
        here = vehicle.setpoint or vehicle.position
        if not self._clear(vehicle, target[2]):
            target = (target[0], target[1], here[2])
        way = [b - a for a, b in zip(here, target, strict=True)]
        distance = math.hypot(*way)
        if distance > 0.0 and math.dist(here, vehicle.position) < _LEAD:
            share = min(self.settings.look_speed * dt / distance, 1.0)
            here = (here[0] + share * way[0], here[1] + share * way[1], here[2] + share * way[2])
        vehicle.setpoint = here
        self._actions.append(GoTo(vehicle.name, here, yaw))

    def _clear(self, vehicle: Vehicle, height: float) -> bool:
        """Return whether nobody is near at a height between a vehicle's and another (m, map)."""
        assert vehicle.position is not None
        x, y, z = vehicle.position
        low, high = min(z, height) - 1.0, max(z, height) + 1.0
        if abs(z - height) < 0.5:
            return True
        return not any(
            other is not vehicle
            and other.flies
            and other.position is not None
            and math.hypot(other.position[0] - x, other.position[1] - y) < _CLEAR
            and low < other.position[2] < high
            for other in self.vehicles.values()
        )

    # the find

    def _confirm(self, vehicle: Vehicle, look: Look) -> None:
        candidate = look.candidate
        candidate.status, candidate.found = "confirmed", True
        vehicle.look = None
        if look.takes_over is None:
            find = _Find(vehicle.name, candidate.position, candidate.covariance, candidate.seen_at)
            self._finds.append(find)
            self._tell(
                "confirmed",
                vehicle,
                position=_xy(find.position),
                covariance=list(find.covariance),
                found_time=round(find.time, 3),
                probability=round(look.evidence.mean, 3),
                pictures=look.evidence.pictures,
            )
            self._stop_others(vehicle)
        duration = self.settings.follow_time if look.takes_over is None else look.takes_over
        track = candidate.track[vehicle.name]
        vehicle.following = Following(candidate, self._now, self._now + duration, track, look)
        vehicle.enter(State.FOLLOWING, self._now)
        vehicle.setpoint = None
        self._actions.append(Follow(vehicle.name, track))
        self._tell("following", vehicle, position=_xy(candidate.position), track=track)

    def _stop_others(self, finder: Vehicle) -> None:
        if self.settings.on_find == "continue":
            return
        self._rests.clear()
        for vehicle in self.vehicles.values():
            if vehicle is finder or vehicle.state not in _BUSY or vehicle.state is State.FOLLOWING:
                continue
            if vehicle.look is not None and vehicle.look.candidate.status == "looked at":
                vehicle.look.candidate.status = "seen"
            if self._on_the_ground(vehicle):
                self._land(vehicle)
            elif vehicle.state is State.LOOKING:
                assert vehicle.look is not None
                vehicle.look.stage = Stage.UP
                vehicle.enter(State.REJOINING, self._now)
            elif vehicle.state is not State.REJOINING:
                self._stand_by(vehicle)

    def _on_the_ground(self, vehicle: Vehicle) -> bool:
        """Return whether a vehicle has not been asked to arm yet: then it stays where it is."""
        if vehicle.state not in (State.WAITING, State.STARTING) or vehicle.armed or vehicle.arm_asked:
            return False
        self._actions = [action for action in self._actions if action.vehicle != vehicle.name]
        return True

    def _stand_by(self, vehicle: Vehicle) -> None:
        """Let a vehicle that is no longer needed hold or return."""
        if self.settings.on_find == "hold" and self._ending is None:
            vehicle.want(LOITER, self._now)
            vehicle.enter(State.HOLDING, self._now)
        else:
            self._return(vehicle, "somebody was found" if self._finds else "the search is over")

    def _follow(self, vehicle: Vehicle) -> None:
        """Watch over a following."""
        following = vehicle.following
        assert following is not None
        candidate = following.candidate
        if self._now >= following.until:
            self._end_following(vehicle, "time")
            if self._found:
                self._return(vehicle, "the following is over")
            else:
                self._go_back(vehicle, following.look)
            return
        if self._now - max(following.seen, following.since) > self.settings.lose_time:
            left = following.until - self._now
            self._end_following(vehicle, "lost")
            self._give_up(candidate, vehicle)
            if self._send(candidate, left):
                self._go_back(vehicle, following.look)
            else:  # nobody else can
                vehicle.enter(following.look.came_from, self._now)
                self._begin_look(vehicle, candidate, left)
            return
        track = candidate.track.get(vehicle.name, following.track)
        if track != following.track:  # the camera lost him and has found him again
            following.track = track
            self._actions.append(Follow(vehicle.name, track))

    def _end_following(self, vehicle: Vehicle, reason: str) -> None:
        following, vehicle.following = vehicle.following, None
        assert following is not None
        self._actions.append(Follow(vehicle.name, -1))
        self._tell("follow_ended", vehicle, reason=reason, duration=round(self._now - following.since, 3))

    def _give_up(self, candidate: Candidate, vehicle: Vehicle) -> None:
        """Let somebody else look for whom a vehicle has followed."""
        candidate.status = "seen"
        candidate.looked_by = {vehicle.name}

    def _go_back(self, vehicle: Vehicle, look: Look) -> None:
        """Let a vehicle go up to its own height, and from there on with what it did before it found somebody."""
        look.stage = Stage.UP
        vehicle.look = look
        vehicle.setpoint = vehicle.position
        vehicle.enter(State.REJOINING, self._now)

    def _send(self, candidate: Candidate, takes_over: float | None) -> bool:
        """Send the nearest vehicle that has not been there to a candidate; return whether there is one."""
        if self._ending is not None:
            return False
        able = [
            vehicle for vehicle in self.vehicles.values() if vehicle.useful and vehicle.name not in candidate.looked_by
        ]
        if able:
            self._begin_look(min(able, key=lambda v: self._distance(v, candidate)), candidate, takes_over)
        return bool(able)

    # the rest of a path

    def _share_rests(self) -> None:
        if not self._rests or self._ending is not None:
            return
        takers = self._takers()
        if not takers and any(v.state in (State.WAITING, State.STARTING) for v in self.vehicles.values()):
            return  # they take it when they are up
        for name, rest in self._rests:
            parts = {}
            if takers:
                ends = {vehicle.name: vehicle.path_end for vehicle in takers}
                parts = share_out(rest, ends, {vehicle.name: vehicle.load for vehicle in takers})
            for taker, part in parts.items():
                self._give(self.vehicles[taker], part)
            metres = {taker: round(length(part), 1) for taker, part in parts.items()}
            self._tell("reassigned", self.vehicles[name], to=metres)
        self._rests.clear()

    def _takers(self) -> list[Vehicle]:
        """Return who can fly more: those in the air, otherwise those that have landed."""
        seeing = [vehicle for vehicle in self.vehicles.values() if not vehicle.blind]
        flying = [v for v in seeing if v.useful or v.state in (State.LOOKING, State.REJOINING)]
        return flying or [v for v in seeing if v.state is State.LANDED and v.connected]

    def _give(self, vehicle: Vehicle, part: list[Waypoint]) -> None:
        landed = vehicle.state is State.LANDED
        items, current = vehicle.with_part(part, anew=landed)
        vehicle.take_mission(items)
        vehicle.seq, vehicle.reached = current, -1
        vehicle.progress = vehicle.progress if not landed else None
        self._actions.append(Push(vehicle.name, items, current))
        if landed:
            vehicle.enter(State.WAITING, self._now)
        elif vehicle.state is State.RETURNING:
            vehicle.want(MISSION, self._now)
            vehicle.enter(State.SEARCHING, self._now)
        elif vehicle.look is not None and vehicle.look.came_from is State.RETURNING:
            vehicle.look.came_from = State.SEARCHING

    # the end

    def _conclude(self) -> None:
        assert self._begin is not None
        vehicles = list(self.vehicles.values())
        if self._ending is None:
            if self._now - (self._begin if self._started_at is None else self._started_at) > self.settings.time_limit:
                self._end(f"the time limit of {self.settings.time_limit:g} s is over")
            elif not any(self._at_it(vehicle) for vehicle in vehicles) and not self._rests:
                self._end(self._why())
        if self._ending is None:
            return
        waited = self._now - self._ending
        home = all(vehicle.state in (State.LANDED, State.LOST) for vehicle in vehicles)
        if home or waited > self.settings.return_timeout:
            if not home:
                late = [v.name for v in vehicles if v.state not in (State.LANDED, State.LOST)]
                self._reason += f"; not landed after {waited:.0f} s: {', '.join(late)}"
            self._finish()

    def _at_it(self, vehicle: Vehicle) -> bool:
        """Return whether a vehicle still has something to do before all return."""
        if self._found:
            return vehicle.state in (State.FOLLOWING, State.LOOKING)
        return vehicle.state in _BUSY

    def _why(self) -> str:
        if self._found:
            return "the following is over"
        if all(vehicle.state is State.LOST for vehicle in self.vehicles.values()):
            self._failed = True
            return "all vehicles are lost"
        if all(vehicle.blind or vehicle.state is State.LOST for vehicle in self.vehicles.values()):
            self._failed = True
            return "no camera tells anything"
        return "all paths are flown"

    def _end(self, reason: str) -> None:
        """Let everybody return."""
        self._ending = self._now
        self._reason = reason
        self._rests.clear()
        for vehicle in self.vehicles.values():
            if vehicle.state in (State.LOST, State.LANDED, State.RETURNING):
                continue
            if vehicle.following is not None:
                self._end_following(vehicle, reason)
            vehicle.look = None
            if self._on_the_ground(vehicle):
                self._land(vehicle)
            else:
                self._return(vehicle, reason)

    def _finish(self) -> None:
        self.finished = True
        find = self._finds[0] if self._finds else None
        possible = [
            {
                "position": _xy(candidate.position),
                "probability": round(candidate.probability, 3),
                "hits": sum(candidate.hits.values()),
                "vehicles": sorted(candidate.hits),
                "status": candidate.status,
            }
            for candidate in self.candidates
            if not candidate.found and sum(candidate.hits.values()) >= self.settings.candidate_hits
        ]
        self._tell(
            "finished",
            outcome="found" if find else "failed" if self._failed else "not found",
            vehicle=find.vehicle if find else None,
            position=_xy(find.position) if find else None,
            covariance=list(find.covariance) if find else None,
            found_time=round(find.time, 3) if find else None,
            covered_area=round(self.covered.area, 1),
            region_area=round(self.covered.region_area, 1),
            covered_fraction=round(self.covered.fraction, 4),
            possible=possible,
            lost=[name for name, vehicle in self.vehicles.items() if vehicle.state is State.LOST],
            reason=self._reason,
        )


def _xy(place: Sequence[float]) -> list[float]:
    return [round(float(place[0]), 3), round(float(place[1]), 3)]


def _because(reason: str) -> str:
    return f": {reason}" if reason else ""
