"""Mission control of a cooperative search: decides what each vehicle does from its telemetry and images. No ROS.

Call the ``on_...`` methods as messages arrive and :meth:`SearchMission.step` at a steady rate; carry out the actions it
returns and report their results to :meth:`SearchMission.on_result`.

Each vehicle flies its own mission at its own height. Several images of a person make a candidate: a vehicle leaves
its path, descends and circles it, and the images taken on the circle confirm or reject it. The vehicle then follows
the person, or goes back to where it left its path. Paths of lost vehicles, or of vehicles with a failed camera, are
reallocated to the others (``losses``). ``states`` has the behaviour in each state, ``finds`` the consequences of a
confirmed person, ``conclusion`` the end of the search, ``reports`` the events.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon

from xtdrone_autopilot.navigator.plan import Items
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.geodesy.projection import Datum

from .conclusion import Conclusion
from .coverage_map import CoverageMap
from .losses import Losses, Reallocation
from .people.association import Association
from .people.candidates import Candidate, Sighting
from .people.dispatch import Dispatch
from .people.finds import Finds
from .reports import Event, make_event, progress_report
from .search_settings import MissionSettings
from .searching_vehicle import DONE, Action, Position, PushMission, SecondLook, State, Vehicle
from .states.common_supervision import VehicleState, because
from .states.flown_by_autopilot import Holding, Returning, Searching, TakingOff, Waiting
from .states.following import FollowingPerson
from .states.offboard_heights_and_setpoints import Rejoining
from .states.second_look import TakingSecondLook

_MAX_PUSHES = 8


class SearchMission:
    """Mission control: coordinates the vehicles; implements ``states.common_supervision.MissionControl``.

    Attributes:
        settings: see :class:`MissionSettings`.
        vehicles: Vehicles by name.
        candidates: all possible persons seen so far.
        coverage: part of the region seen so far.
        now: time of the current step, s.
    """

    def __init__(
        self, names: Sequence[str], region: Polygon, camera: Pinhole, settings: MissionSettings, datum: Datum
    ) -> None:
        """Create the vehicles, waiting.

        Args:
            names: Names of the vehicles, at least one.
            region: Region to search, m ENU.
            camera: intrinsics, the same for all vehicles.
            settings: see :class:`MissionSettings`.
            datum: origin of the map frame.
        """
        self.settings = settings
        self.vehicles = {name: Vehicle(name, i, datum) for i, name in enumerate(names)}
        self.candidates: list[Candidate] = []
        self.coverage = CoverageMap(region, camera, ground=settings.ground, pixels=settings.person_pixels)
        self.now = 0.0
        self._association = Association(self.candidates, region, settings, self.report)
        self._reallocation = Reallocation(self)
        self._dispatch = Dispatch(self, self.candidates)
        self._second_look = TakingSecondLook(self, camera)
        self._rejoining = Rejoining(self)
        self._following = FollowingPerson(self, self._rejoining)
        self._holding = Holding(self)
        self._returning = Returning(self)
        self._states: dict[State, VehicleState] = {
            State.WAITING: Waiting(self),
            State.TAKING_OFF: TakingOff(self),
            State.SEARCHING: Searching(self),
            State.SECOND_LOOK: self._second_look,
            State.REJOINING: self._rejoining,
            State.FOLLOWING: self._following,
            State.HOLDING: self._holding,
            State.RETURNING: self._returning,
        }
        self._losses = Losses(self, self._reallocation, self._following)
        self._finds = Finds(self, self._reallocation, self._cancel_takeoff)
        self._conclusion = Conclusion(
            self,
            self._reallocation,
            self._following,
            self.coverage,
            self.candidates,
            self._finds.people,
            self._cancel_takeoff,
        )
        self._actions: list[Action] = []
        self._events: list[Event] = []

    # inputs

    def on_state(self, name: str, mode: str, armed: bool, connected: bool, now: float) -> None:
        """Store a vehicle's mavros/state."""
        vehicle = self.vehicles[name]
        vehicle.mode, vehicle.armed, vehicle.connected, vehicle.heard = mode, armed, connected, now

    def on_pose(self, name: str, position: Position, yaw: float, now: float) -> None:
        """Store a vehicle's position, m, map, and yaw, rad from east."""
        vehicle = self.vehicles[name]
        if vehicle.position is None or (not vehicle.armed and vehicle.state is State.WAITING):
            vehicle.home = position
        vehicle.position, vehicle.yaw, vehicle.pose_heard = position, yaw, now

    def on_mission(self, name: str, items: Items) -> None:
        """Store the mission of a vehicle that has not started yet."""
        vehicle = self.vehicles[name]
        if vehicle.state is State.WAITING:
            vehicle.mission.load(items)

    def on_item(self, name: str, current: int) -> None:
        """Store the index of the mission item a vehicle is flying."""
        self.vehicles[name].mission.current = current

    def on_reached(self, name: str, index: int) -> None:
        """Store the index of the mission item a vehicle has reached."""
        self.vehicles[name].mission.reached = index

    def on_camera(self, name: str, works: bool) -> None:
        """Store whether a vehicle's camera works; images of one that does not are ignored."""
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
        """Process the detections of an image.

        Args:
            name: Name of the vehicle.
            time: Time of the exposure, s.
            position: (3,) of the camera, m, map.
            rotation: (3, 3) from the optical frame to the map frame.
            sightings: tracks of the camera; those with probability 0 are not in this image.
            now: s.
        """
        vehicle = self.vehicles[name]
        if time <= vehicle.picture or not vehicle.camera_works:
            return  # a stuck camera repeats an image, with its old stamp or a new one
        vehicle.picture, vehicle.picture_heard = time, now
        if not vehicle.airborne or vehicle.state is State.TAKING_OFF:
            return  # the mission has not pointed the camera yet
        self.coverage.add_picture(position, rotation)
        assert vehicle.position is not None
        if vehicle.state is State.SEARCHING:
            vehicle.mission.progress = (vehicle.mission.current, vehicle.position[:2])
        tracked = {sighting.id: sighting.probability for sighting in sightings}
        shown: dict[Candidate, float] = {}
        for sighting in sightings:
            candidate = self._association.observe(vehicle, time, sighting, tracked)
            if candidate is not None:
                shown[candidate] = max(shown.get(candidate, 0.0), sighting.probability)
        following, look = vehicle.following, vehicle.look
        if following is not None and tracked.get(following.candidate.track.get(name, 0), 0.0) > 0.0:
            following.seen = time
        if look is not None and vehicle.state is State.SECOND_LOOK:
            self._second_look.observe(look, time, position, rotation, shown.get(look.candidate))

    def on_result(self, action: Action, accepted: bool, reason: str = "") -> None:
        """Store the result of an action; repeat a rejected mission upload, and finally give the vehicle up."""
        vehicle = self.vehicles[action.vehicle]
        if not accepted:
            vehicle.request.refusal = reason
        if not isinstance(action, PushMission):
            return
        if accepted:
            vehicle.rejected_pushes = 0
        elif vehicle.state is not State.LOST:
            vehicle.rejected_pushes += 1
            if vehicle.rejected_pushes >= _MAX_PUSHES:
                self.lose(vehicle, f"rejects its mission{because(reason)}")
            else:
                self.act(action)

    # outputs

    @property
    def finished(self) -> bool:
        """Whether the search is over; no more actions are requested."""
        return self._conclusion.finished

    def step(self, now: float) -> list[Action]:
        """Decide, and return the actions to carry out now.

        Args:
            now: ROS time, s; not less than before.
        """
        dt = now - self.now if self._conclusion.begun is not None else 0.0
        self.now = now
        if self._conclusion.begun is None:
            self._conclusion.begun = now
            for vehicle in self.vehicles.values():
                vehicle.enter(State.WAITING, now)
        if not self.finished:
            for vehicle in self.vehicles.values():
                self._check(vehicle)
            for vehicle in self.vehicles.values():
                if vehicle.state not in DONE:
                    self._states[vehicle.state].update(vehicle, dt)
            self._reallocation.update()
            self._dispatch.update()
            self._conclusion.update()
        actions, self._actions = self._actions, []
        return actions

    def events(self) -> list[Event]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def progress(self) -> dict[str, Any]:
        """Return the progress, see :func:`reports.progress_report`."""
        started = self._conclusion.started is not None
        return progress_report(
            self.vehicles, self.coverage, self.now, started=started, ending=self.ending, finished=self.finished
        )

    # interface of the vehicle states

    @property
    def ending(self) -> bool:
        """Whether all vehicles have been sent home."""
        return self._conclusion.ending

    @property
    def found(self) -> bool:
        """Whether a find has ended the search."""
        return bool(self._finds.people) and self.settings.on_find != "continue"

    def act(self, action: Action) -> None:
        """Request an action."""
        self._actions.append(action)

    def report(self, event: str, vehicle: Vehicle | None = None, /, **fields: object) -> None:
        """Report an event."""
        self._events.append(make_event(event, self.now, vehicle, fields))

    def started(self) -> None:
        """Note that a vehicle has armed."""
        if self._conclusion.started is None:
            self._conclusion.started = self.now
            self.report("started", vehicles=list(self.vehicles))

    def begin_look(self, vehicle: Vehicle, candidate: Candidate, takes_over: float | None) -> None:
        """Send a vehicle to a second look."""
        self._second_look.begin(vehicle, candidate, takes_over)

    def hand_over(self, candidate: Candidate, takes_over: float | None) -> bool:
        """Send another vehicle to a candidate; return whether one is available."""
        return self._dispatch.hand_over(candidate, takes_over)

    def record_find(self, vehicle: Vehicle, look: SecondLook) -> None:
        """Record a confirmed person and stop the other vehicles if the settings say so."""
        self._finds.record(vehicle, look)

    def begin_following(self, vehicle: Vehicle, look: SecondLook) -> None:
        """Follow the person a second look has confirmed."""
        self._following.begin(vehicle, look)

    def return_home(self, vehicle: Vehicle, reason: str, *, commanded: bool = True) -> None:
        """Return a vehicle; ``commanded`` is false if its autopilot returns already."""
        self._returning.begin(vehicle, reason, commanded=commanded)

    def stand_by(self, vehicle: Vehicle) -> None:
        """Hold or return a vehicle that is no longer needed."""
        if self.settings.on_find == "hold" and not self.ending:
            self._holding.begin(vehicle)
        else:
            self.return_home(vehicle, "a person was found" if self._finds.people else "the search is over")

    def land(self, vehicle: Vehicle) -> None:
        """Note that a vehicle is on the ground."""
        vehicle.enter(State.LANDED, self.now)
        vehicle.request.mode = ""
        vehicle.arm_requested = False

    # losses

    def _check(self, vehicle: Vehicle) -> None:
        if vehicle.state not in DONE:
            self._states[vehicle.state].check(vehicle)
        if vehicle.state in DONE or vehicle.blind or not self._states[vehicle.state].needs_camera:
            return
        if self.now - max(vehicle.picture_heard, vehicle.since) > self.settings.camera_timeout:
            self.camera_failed(vehicle)

    def lose(self, vehicle: Vehicle, reason: str) -> None:
        """Give a vehicle up and reassign its work."""
        self._losses.lose(vehicle, reason)

    def camera_failed(self, vehicle: Vehicle) -> None:
        """Return a vehicle whose camera has failed and reassign its work."""
        self._losses.camera_failed(vehicle)

    def _cancel_takeoff(self, vehicle: Vehicle) -> bool:
        """Keep a vehicle on the ground that has not been requested to arm; return whether it is."""
        if vehicle.state not in (State.WAITING, State.TAKING_OFF) or vehicle.armed or vehicle.arm_requested:
            return False
        self._actions = [action for action in self._actions if action.vehicle != vehicle.name]
        self.land(vehicle)
        return True
