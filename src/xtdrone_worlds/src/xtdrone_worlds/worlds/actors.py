"""Motion of people who stand, follow a script or walk to a commanded position, in closed form.

The state of an actor follows from its last command and from simulated time alone, so it is independent, to the last
bit, of the division of time into steps. Actors walk through obstacles; ``physics.bodies.solid_people`` makes them
collide with vehicles and robots.

Frame: map, ENU, m. Yaw counter-clockwise from east, rad.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from xtdrone_common.rotation import Vector, yaw_of
from xtdrone_common.settings import check_range
from xtdrone_worlds.worlds import people_meshes
from xtdrone_worlds.worlds.sdf import SdfActor, Trajectory

TURN_RATE = 1.5  # rad/s, in place
TURNS_IN_PLACE = math.radians(10.0)  # rad; a larger change of heading is made before the actor walks
FASTEST = 10.0  # m/s, largest commanded speed
FARTHEST = 1e5  # m, largest distance of a commanded position from the origin, by axis
STANDING = -1.0  # value of ``phase`` while standing


class ActorState(NamedTuple):
    """State of an actor.

    Attributes:
        position: point between its feet, m, map.
        yaw: rad.
        phase: phase of its walk, cycles; ``STANDING`` while it stands.
    """

    position: Vector
    yaw: float
    phase: float


class _Way(Protocol):
    ends_us: float  # simulated time from which on it stands forever; infinite: never

    def at(self, time_us: int) -> ActorState:
        """Return the state at a simulated time, microseconds."""


class _Stand:
    def __init__(self, state: ActorState) -> None:
        self._state = state._replace(phase=STANDING)
        self.ends_us = -math.inf

    def at(self, time_us: int) -> ActorState:
        return self._state


class _Walk:
    """A turn in place if necessary, then a straight walk to a position, then standing."""

    def __init__(
        self, start: ActorState, begin_us: int, target: tuple[float, float], speed: float, stride: float
    ) -> None:
        x, y, self._z = start.position
        self._start, self._begin_us, self._target = start, begin_us, target
        self._speed, self._stride = speed, stride
        self._distance = math.hypot(target[0] - x, target[1] - y)
        heading = math.atan2(target[1] - y, target[0] - x) if self._distance > 0.0 else start.yaw
        self._turn = math.remainder(heading - start.yaw, math.tau)
        self._turning = abs(self._turn) / TURN_RATE if abs(self._turn) > TURNS_IN_PLACE else 0.0
        self._first_phase = max(start.phase, 0.0) if self._turning == 0.0 else 0.0
        self.ends_us = begin_us + 1e6 * (self._turning + self._distance / speed)

    def at(self, time_us: int) -> ActorState:
        passed = (time_us - self._begin_us) * 1e-6
        turned = math.copysign(min(abs(self._turn), TURN_RATE * passed), self._turn)
        yaw = math.remainder(self._start.yaw + turned, math.tau)
        way = self._speed * max(passed - self._turning, 0.0)
        x, y, _ = self._start.position
        if way >= self._distance:
            return ActorState((*self._target, self._z), yaw, STANDING)
        if passed < self._turning:
            return ActorState((x, y, self._z), yaw, STANDING)
        share = way / self._distance
        place = (x + share * (self._target[0] - x), y + share * (self._target[1] - y), self._z)
        return ActorState(place, yaw, self._first_phase + way / self._stride)


class _Script:
    """Timed waypoints connected by straight lines."""

    def __init__(self, trajectory: Trajectory, begin_us: int, stride: float) -> None:
        waypoints = trajectory.waypoints
        self._begin_us = begin_us + round(trajectory.delay_start * 1e6)
        self._loop, self._stride = trajectory.loop, stride
        self._times_us = np.array([round(waypoint.time * 1e6) for waypoint in waypoints])
        last_us = int(self._times_us[-1])
        self.ends_us = math.inf if self._loop and last_us > 0 else self._begin_us + last_us
        self._places = np.array([waypoint.pose.position for waypoint in waypoints])
        self._yaws = [yaw_of(waypoint.pose.orientation) for waypoint in waypoints]
        legs = np.linalg.norm(np.diff(self._places[:, :2], axis=0), axis=1)
        self._ways = np.concatenate([[0.0], np.cumsum(legs)])

    def at(self, time_us: int) -> ActorState:
        last_us = int(self._times_us[-1])
        passed_us, rounds = time_us - self._begin_us, 0
        if self._loop and last_us > 0 and passed_us > 0:
            rounds, passed_us = divmod(passed_us, last_us)
        if passed_us >= last_us:
            return self._waypoint(-1)
        k = int(np.searchsorted(self._times_us, passed_us, side="right")) - 1
        if k < 0:
            return self._waypoint(0)
        share = (passed_us - int(self._times_us[k])) / int(self._times_us[k + 1] - self._times_us[k])
        x, y, z = (self._places[k] + share * (self._places[k + 1] - self._places[k])).tolist()
        turn = math.remainder(self._yaws[k + 1] - self._yaws[k], math.tau)
        yaw = math.remainder(self._yaws[k] + share * turn, math.tau)
        leg = float(self._ways[k + 1] - self._ways[k])
        walked = rounds * float(self._ways[-1]) + float(self._ways[k]) + share * leg
        return ActorState((x, y, z), yaw, walked / self._stride if leg > 0.0 else STANDING)

    def _waypoint(self, k: int) -> ActorState:
        x, y, z = self._places[k].tolist()
        return ActorState((x, y, z), self._yaws[k], STANDING)


class Actors:
    """All actors of a world.

    Attributes:
        names: names in the order of the world.
    """

    def __init__(self, actors: Sequence[SdfActor], strides: Sequence[float]) -> None:
        """Start the initial behaviour of all actors at time 0.

        Args:
            actors: actors of the world.
            strides: length of a walk cycle of each actor, m, above 0.
        """
        self.names = [actor.name for actor in actors]
        self._actors, self._strides = list(actors), list(strides)
        self._told: Callable[[int], None] = lambda _: None
        self.restart(0)

    def restart(self, time_us: int) -> None:
        """Restart the initial behaviour of all actors, including removed ones, at a simulated time, microseconds."""
        self._gone: set[int] = set()
        self._told = lambda _: None
        self._ways = [
            _first_way(actor, time_us, stride) for actor, stride in zip(self._actors, self._strides, strict=True)
        ]

    def states(self, time_us: int) -> list[ActorState]:
        """Return the states of all actors at a simulated time, microseconds, not before their last commands."""
        return [way.at(time_us) for way in self._ways]

    def present(self, time_us: int) -> list[tuple[str, ActorState]]:
        """Return the names and states of the actors that have not been removed; see ``states``."""
        named = zip(self.names, self.states(time_us), strict=True)
        return [one for number, one in enumerate(named) if number not in self._gone]

    def remove(self, number: int) -> None:
        """Remove an actor until the next restart."""
        self._gone.add(number)
        self._told(number)

    def is_present(self, number: int) -> bool:
        """Return whether an actor has not been removed."""
        return number not in self._gone

    def rests(self, number: int, time_us: int) -> bool:
        """Return whether an actor stands from a simulated time, microseconds, until its next command."""
        return time_us >= self._ways[number].ends_us

    def watch(self, told: Callable[[int], None]) -> None:
        """Call a function with the number of each actor that gets a command or is removed, until the next restart."""
        self._told = told

    def send(self, number: int, x: float, y: float, speed: float, time_us: int) -> None:
        """Send an actor to a position, replacing its current motion; it stands after its arrival.

        Args:
            number: index of the actor in the order of the world.
            x, y: target, m, map.
            speed: m/s; 0: stop here; negative: at the actor's own speed.
            time_us: current simulated time, microseconds.

        Raises:
            ValueError: the position or speed is not allowed; the motion stays unchanged.
        """
        check_range(f"{self.names[number]}: x", x, -FARTHEST, FARTHEST, "m")
        check_range(f"{self.names[number]}: y", y, -FARTHEST, FARTHEST, "m")
        check_range(f"{self.names[number]}: v", speed, -FASTEST, FASTEST, "m/s")
        here = self._ways[number].at(time_us)
        speed = self._actors[number].speed if speed < 0.0 else speed
        if speed == 0.0:
            self._ways[number] = _Stand(here)
        else:
            self._ways[number] = _Walk(here, time_us, (x, y), speed, self._strides[number])
        self._told(number)

    def place(self, number: int, position: Vector, yaw: float) -> None:
        """Place an actor at a position, where it stands; this replaces its current motion.

        Args:
            number: index of the actor in the order of the world.
            position: point between its feet, m, map.
            yaw: rad.
        """
        self._ways[number] = _Stand(ActorState(position, yaw, STANDING))
        self._told(number)


def actors_of(actors: Sequence[SdfActor]) -> Actors:
    """Return the actors of a world, with the strides of their skins.

    Raises:
        ValueError: a skin is unknown.
    """
    skins = people_meshes.skins([actor.skin for actor in actors])
    return Actors(actors, [people_meshes.read(skin).stride for skin in skins])


def _first_way(actor: SdfActor, time_us: int, stride: float) -> _Way:
    trajectory = actor.trajectory
    if trajectory is not None and trajectory.auto_start:
        return _Script(trajectory, time_us, stride)
    pose = actor.pose if trajectory is None else trajectory.waypoints[0].pose
    return _Stand(ActorState(pose.position, yaw_of(pose.orientation), STANDING))
