"""Point-mass world for the mission control: vehicles that execute its actions, cameras that see people.

It models only what the mission control relies on: missions flown item by item at 5 m/s, modes, a state once a second, a
picture every half second.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from shapely.geometry import Polygon

from xtdrone_autopilot.navigator import plan
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_coordination.search import searching_vehicle as control
from xtdrone_coordination.search.coverage_map import shows
from xtdrone_coordination.search.mission_control import SearchMission
from xtdrone_coordination.search.people.candidates import Sighting
from xtdrone_coordination.search.planning.plans import DatumSettings, SearchOptions, mission_items, plan_search
from xtdrone_coordination.search.search_settings import MissionSettings
from xtdrone_coordination.search.searching_vehicle import State

CAMERA = Pinhole.of_view(640, 360, 2.0)
DATUM = DatumSettings()
DT = 0.1
REGION = Polygon([(15, -40), (135, -40), (135, 40), (15, 40)])


@dataclass
class Thing:
    """A person, or an object that looks like one.

    Attributes:
        at: position at a time, m ENU.
        probability: of the detector, by the distance from the camera, m.
    """

    at: Callable[[float], tuple[float, float]]
    probability: Callable[[float], float] = lambda distance: 0.9


def person(x: float, y: float, vx: float = 0.0, vy: float = 0.0) -> Thing:
    return Thing(lambda t: (x + vx * t, y + vy * t))


def decoy(x: float, y: float) -> Thing:
    """Return an object that looks like a person only from a distance."""
    return Thing(lambda t: (x, y), lambda distance: 0.8 if distance > 13.0 else 0.0)


@dataclass
class Body:
    """One vehicle."""

    home: tuple[float, float]
    items: plan.Items
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    mode: str = "AUTO.LOITER"
    armed: bool = False
    seq: int = 0
    goal: tuple[float, float, float] | None = None
    goal_yaw: float = 0.0
    follows: int = -1
    dead: bool = False
    no_camera: bool = False
    no_offboard: bool = False
    return_height: float = 30.0
    pitch: float = -60.0
    tracks: dict[int, int] = field(default_factory=dict)

    def move(self, target: tuple[float, float, float], speed: float) -> bool:
        """Fly towards a target; return whether it is reached."""
        way = np.subtract(target, (self.x, self.y, self.z))
        distance = float(np.linalg.norm(way))
        share = min(1.0, speed * DT / distance) if distance > 0.0 else 0.0
        self.x, self.y, self.z = (float(a + share * b) for a, b in zip((self.x, self.y, self.z), way, strict=True))
        return distance <= speed * DT + 0.5

    def turn(self, yaw: float) -> None:
        error = math.remainder(yaw - self.yaw, 2.0 * math.pi)
        self.yaw += max(-0.8 * DT, min(0.8 * DT, error))

    def step(self) -> None:
        if not self.armed:
            return
        if self.mode == "AUTO.MISSION":
            self._mission()
        elif self.mode == "OFFBOARD" and self.goal is not None and self.follows < 0:
            self.move(self.goal, 6.0)
            self.turn(self.goal_yaw)
        elif self.mode == "AUTO.RTL":
            self._return()

    def _mission(self) -> None:
        item = self.items[self.seq] if self.seq < len(self.items) else None
        if item is None:
            return
        if item.command == plan.RETURN:
            self.mode = "AUTO.RTL"
        elif item.command == plan.TAKEOFF:
            self.seq += self.move((self.x, self.y, item.z), 2.0)
        elif item.has_position:
            x, y = DATUM.local(item.x, item.y)
            heading = math.radians(90.0 - item.params[3])
            self.turn(heading)
            there = self.move((x, y, item.z), 5.0)
            self.seq += there and abs(math.remainder(heading - self.yaw, 2.0 * math.pi)) < 0.2
        else:
            self.seq += 1

    def _return(self) -> None:
        over_home = math.hypot(self.x - self.home[0], self.y - self.home[1]) < 0.5
        if over_home:
            if self.move((*self.home, 0.0), 2.0):
                self.z, self.armed, self.seq = 0.0, False, 0
        elif self.z < self.return_height - 0.3:
            self.move((self.x, self.y, self.return_height), 2.0)
        else:
            self.move((*self.home, self.z), 5.0)


class World:
    """Vehicles, people and the mission control.

    Attributes:
        at: functions to call once, by time, s.
        events: all events so far.
        nearest: least distance between two flying vehicles, m.
    """

    def __init__(
        self,
        count: int = 3,
        things: list[Thing] | None = None,
        at: Mapping[float, Callable[[World], Any]] | None = None,
        options: SearchOptions | None = None,
        **settings: Any,
    ) -> None:
        self.time = 0.0
        self.things = things or []
        self.at = dict(at or {})
        homes = {f"typhoon_h480_{i}": (3.0 * (i % 3), 3.0 * (i // 3)) for i in range(count)}
        options = options or SearchOptions()
        self.plans = plan_search(REGION, homes, CAMERA, options)
        self.bodies = {
            name: Body(homes[name], mission_items(self.plans[name], options, DATUM), *homes[name]) for name in homes
        }
        self.control = SearchMission(list(homes), REGION, CAMERA, MissionSettings(**settings), DATUM)
        self.events: list[dict[str, Any]] = []
        self.nearest = math.inf
        for name, body in self.bodies.items():
            self.control.on_mission(name, body.items)

    def __getitem__(self, index: int) -> Body:
        return self.bodies[f"typhoon_h480_{index}"]

    def state(self, index: int) -> State:
        return self.control.vehicles[f"typhoon_h480_{index}"].state

    def named(self, event: str) -> list[dict[str, Any]]:
        return [entry for entry in self.events if entry["event"] == event]

    def run(self, until: Callable[[World], Any] = lambda world: world.control.finished, limit: float = 900.0) -> None:
        """Run until a condition holds; fail at a time limit, s."""
        while not until(self):
            assert self.time < limit, (self.time, self.control.progress(), self.events)
            self.step()

    def step(self) -> None:
        tick = round(self.time / DT)
        for when in [when for when in self.at if when <= self.time]:
            self.at.pop(when)(self)
        for i, (name, body) in enumerate(self.bodies.items()):
            if body.dead:
                continue
            body.step()
            self._follow(body)
            self.control.on_pose(name, (body.x, body.y, body.z), body.yaw, self.time)
            self.control.on_item(name, body.seq)
            if tick % 10 == i:
                self.control.on_state(name, body.mode, body.armed, True, self.time)
            if tick % 5 == i % 5 and not body.no_camera:
                self._picture(name, body)
        for action in self.control.step(self.time):
            self._execute(action)
        self.events += self.control.events()
        self.time = (tick + 1) * DT
        flying = [np.array([b.x, b.y, b.z]) for b in self.bodies.values() if b.z > 2.0 and not b.dead]
        for i, one in enumerate(flying):
            for other in flying[:i]:
                self.nearest = min(self.nearest, float(np.linalg.norm(one - other)))

    def _follow(self, body: Body) -> None:
        if body.follows < 0 or body.mode != "OFFBOARD":
            return
        thing = next(k for k, track in body.tracks.items() if track == body.follows)
        x, y = self.things[thing].at(self.time)
        away = math.atan2(body.y - y, body.x - x)
        body.move((x + 5.0 * math.cos(away), y + 5.0 * math.sin(away), body.z), 3.0)
        body.turn(away + math.pi)

    def _picture(self, name: str, body: Body) -> None:
        down, c, s = math.radians(-body.pitch), math.cos(body.yaw), math.sin(body.yaw)
        ahead = np.array([c * math.cos(down), s * math.cos(down), -math.sin(down)])
        right = np.array([s, -c, 0.0])
        rotation = np.column_stack([right, np.cross(ahead, right), ahead])
        position = np.array([body.x, body.y, body.z])
        sightings = []
        for k, thing in enumerate(self.things):
            place = np.array([*thing.at(self.time), 0.0])
            if not shows(CAMERA, position, rotation, place[None], 8.0)[0]:
                continue
            probability = thing.probability(float(np.linalg.norm(place - position)))
            if probability > 0.0:
                track = body.tracks.setdefault(k, k + 1)
                velocity = np.subtract(thing.at(self.time + 1.0), thing.at(self.time))
                where = (float(place[0]) + 0.2, float(place[1]))
                sightings.append(
                    Sighting(track, where, (float(velocity[0]), float(velocity[1])), probability=probability)
                )
        self.control.on_picture(name, self.time, position, rotation, sightings, self.time)

    def _execute(self, action: control.Action) -> None:
        body = self.bodies[action.vehicle]
        if body.dead:
            self.control.on_result(action, False, "no answer")
            return
        match action:
            case control.RequestMode(mode=mode):
                if mode == "OFFBOARD" and body.no_offboard:
                    self.control.on_result(action, False, "no setpoints")
                    return
                body.mode = mode
            case control.Arm():
                body.armed = True
            case control.PushMission(items=items, current=current):
                body.items, body.seq = items, current
            case control.GoTo(position=position, yaw=yaw):
                body.goal, body.goal_yaw = position, yaw
            case control.Follow(track=track):
                body.follows = track
                body.pitch = -50.0 if track > 0 else body.pitch
            case control.PointCamera(pitch=pitch):
                body.pitch = pitch
            case control.SetReturnHeight(height=height):
                body.return_height = height
        self.control.on_result(action, True)
