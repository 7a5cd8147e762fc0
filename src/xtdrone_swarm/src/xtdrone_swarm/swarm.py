"""A swarm in one process, without ROS: the Leader and Follower classes of the ROS flight, on simplified vehicles.

::

    swarm = Swarm(9)
    swarm.choose("cube")
    swarm.run_until(settled=0.15)
    print(swarm.errors().max())

One turn is one period of the 30 Hz loop, at exactly the times of the lockstep. In turn k every vehicle knows the state
at that time and the leader's decisions of turn k-1; its commands act from then on, as in a ROS flight on the simplified
simulator.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from xtdrone_coordination.follower import RATE, Follower, FollowerOptions
from xtdrone_coordination.laws.topology import unreachable
from xtdrone_coordination.leader import Leader, LeaderOptions, number_list
from xtdrone_coordination.network import NetworkOptions, make_network
from xtdrone_coordination.patterns import Patterns
from xtdrone_lockstep.protocol import Schedule
from xtdrone_swarm.followers import FollowerGroup
from xtdrone_swarm.simplified.simplified_vehicles import SimplifiedVehicles, spawn_places
from xtdrone_swarm.simplified.vehicle_parameters import Model
from xtdrone_swarm.swarm_vehicles import ACCELERATION, VELOCITY, Array, Choice, FlightRecord, Vehicles

MOST_VEHICLES = 10_000  # in one swarm; the topology is a matrix of N x N
SETTLED = 0.15  # m
_SAID = 3  # followers' warnings logged in one turn, at most
_REPEATED = 10.0  # s until a follower's warning is logged again: over a poor network it recurs constantly

_Options = TypeVar("_Options", FollowerOptions, LeaderOptions, NetworkOptions)
_LOG = logging.getLogger(__name__)


class Swarm:
    """A leader, its followers and their vehicles.

    Attributes:
        vehicles: the controlled vehicles.
        leader: leader algorithm of vehicle 0.
        followers: follower algorithms of vehicles 1 to N-1.
        record: the flight so far; None if it is not recorded.
    """

    def __init__(
        self,
        count: int = 9,
        *,
        follower: type[Follower] = Follower,
        leader: type[Leader] = Leader,
        kind: str = "iris",
        model: Model | str | None = None,
        vehicles: Vehicles | None = None,
        places: ArrayLike | None = None,
        altitude: float = 10.0,
        airborne: bool = True,
        patterns: Patterns | None = None,
        pattern_file: str | Path | None = None,
        follower_options: FollowerOptions | Mapping[str, Any] | None = None,
        leader_options: LeaderOptions | Mapping[str, Any] | None = None,
        network: NetworkOptions | Mapping[str, Any] | None = None,
        seed: int = 0,
        record: bool = True,
    ) -> None:
        """Create a swarm at time 0, without a pattern.

        Args:
            count: number of vehicles N including the leader, 2 to MOST_VEHICLES.
            follower: class of the followers.
            leader: class of the leader.
            kind: vehicle type, a name in ``config/vehicles``.
            model: see ``model.load_model``.
            vehicles: N vehicles to use instead of simplified ones; ``kind``, ``model``, ``places``, ``altitude`` and
                ``airborne`` are then ignored.
            places: initial positions, shape (N, 3), m ENU; None: the spawn grid at ``altitude`` (on the ground unless
                ``airborne``).
            altitude: m, above 0.
            airborne: start armed, in OFFBOARD and holding position; otherwise disarmed, see :meth:`vehicle`.
            patterns: available patterns; None: XTDrone's, the generated ones and those of ``pattern_file``.
            pattern_file: YAML file with user-defined patterns.
            follower_options: settings, or a mapping of those that differ from the defaults.
            leader_options: likewise.
            network: communication between the vehicles, likewise; None: ideal.
            seed: seed of all random numbers, 0 or more.
            record: whether to keep the flight in :attr:`record`.

        Raises:
            ValueError: a value is not allowed; includes PatternError and ModelError.
            TypeError: ``follower`` or ``leader`` is not a class that inherits Follower or Leader.
        """
        _check_class("follower", follower, Follower)
        _check_class("leader", leader, Leader)
        if isinstance(count, bool) or not isinstance(count, int):
            raise ValueError(f"number of vehicles: {count!r} is not a whole number")
        if count > MOST_VEHICLES:
            raise ValueError(f"number of vehicles: {count} is not allowed, 2 to {MOST_VEHICLES}")
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise ValueError(f"seed: {seed!r} is not allowed, a whole number of 0 or more")
        if patterns is not None and patterns.count != count:
            raise ValueError(f"patterns: they are for {patterns.count} vehicles, there are {count}")
        if patterns is not None and pattern_file is not None:
            raise ValueError(f"patterns: they are given, and {str(pattern_file)!r} too; one of the two is allowed")
        patterns = patterns or Patterns(count, pattern_file)
        if vehicles is None:
            if not (math.isfinite(altitude) and altitude > 0.0):
                raise ValueError(f"altitude: {altitude} m is not allowed, above 0")
            if places is None:
                places = spawn_places(count)
                places[:, 2] = altitude if airborne else 0.0
            vehicles = SimplifiedVehicles(count, kind=kind, model=model, places=places, airborne=airborne)
        if len(vehicles.names) != count:
            raise ValueError(f"vehicles: {len(vehicles.names)} are given, the swarm has {count}")
        self.vehicles = vehicles
        options = _options(FollowerOptions, follower_options)
        self._kind = VELOCITY if options.mode == "vel" else ACCELERATION
        radio = None if network is None else make_network(count, _options(NetworkOptions, network), seed)
        self._warnings: list[str] = []  # in the current turn
        make = partial(follower, options=options, warn=self._warnings.append)
        self._followers = FollowerGroup(count, make, radio)
        self.followers = self._followers.followers
        self.leader = leader(
            count,
            patterns,
            swarm=self._followers.state,
            options=_options(LeaderOptions, leader_options),
            warn=_LOG.warning,
        )
        self._schedule = Schedule(RATE, vehicles.step_us)
        self._recording = record
        self._begin()

    def _begin(self) -> None:
        self.record = FlightRecord(len(self.vehicles.names)) if self._recording else None
        self._said = ""
        self._warnings.clear()
        self._said_at: dict[str, float] = {}  # when followers' warnings were logged
        self._message: tuple[Array, NDArray[np.int32]] | None = (
            None  # pattern and topology, on their way to the followers
        )
        self._passed: list[str] = []
        self._course: tuple[tuple[float, float, float], float] | None = None
        self._followers.hear(self.vehicles.position, self.vehicles.velocity)

    def restart(self) -> None:
        """Reset to the start; equal inputs then reproduce the flight bit for bit."""
        self.vehicles.restart()
        self.leader.restart()
        self._followers.restart()
        self._begin()

    def close(self) -> None:
        """Release the vehicles' resources."""
        self.vehicles.close()

    # state

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.vehicles.time_us * 1e-6

    @property
    def positions(self) -> Array:
        """Estimated positions of the vehicles, a copy of shape (N, 3), m ENU."""
        return self.vehicles.position.copy()

    @property
    def velocities(self) -> Array:
        """Estimated velocities of the vehicles, a copy of shape (N, 3), m/s ENU."""
        return self.vehicles.velocity.copy()

    @property
    def true_positions(self) -> Array:
        """True positions of the vehicles, a copy of shape (N, 3), m ENU."""
        return self.vehicles.true_position.copy()

    def errors(self) -> Array:
        """Return the followers' distances from their slots, shape (N-1,), m; infinite before the first pattern."""
        if self.leader.offsets is None:
            return np.full(len(self.followers), np.inf)
        points = self.vehicles.true_position
        return np.asarray(np.linalg.norm(points[1:] - points[0] - self.leader.offsets, axis=1))

    def least_distance(self) -> float:
        """Return the current minimum distance between any two vehicles, m."""
        points = self.vehicles.true_position
        return float(cKDTree(points).query(points, k=2)[0][:, 1].min())

    def cut_off(self) -> list[int]:
        """Return the vehicles without a connection to the leader, direct or through others, ascending.

        Connections are those of the topology; with a network, only those within its range now. Before the first pattern
        the list is empty.
        """
        adjacency, network = self.leader.adjacency, self._followers.network
        if adjacency is None:
            return []
        return unreachable(adjacency) if network is None else network.unreachable(np.nonzero(adjacency))

    # commands

    def choose(self, pattern: str) -> None:
        """Choose a pattern: slots and topology are announced in the next turn and flown from the turn after it.

        Raises:
            PatternError: the pattern does not exist.
            CommandError: the pattern cannot be flown now.
        """
        self.leader.choose(pattern)

    def command(self, text: str) -> None:
        """Send the leader a command as on ``/xtdrone/leader/cmd``: a pattern's name, or a command for vehicle 0.

        Raises:
            CommandError: ``text`` is neither, or cannot be flown now.
        """
        passed = self.leader.on_command(text)
        if passed is not None:
            self._course = None
            self._passed.append(passed)

    def steer(self, velocity: ArrayLike, yaw_rate: float = 0.0) -> None:
        """Fly the leader at a velocity until the next call, as if it were repeated on ``/xtdrone/leader/cmd_vel_flu``.

        Args:
            velocity: shape (3,), m/s FLU: forward, left, up.
            yaw_rate: rad/s, counter-clockwise.

        Raises:
            ValueError: the values are not finite numbers.
        """
        values = np.asarray(velocity, dtype=float)
        if values.shape != (3,) or not np.isfinite(values).all() or not math.isfinite(yaw_rate):
            raise ValueError(
                f"steering: velocity {velocity!r}, yaw rate {yaw_rate!r}: three finite numbers in m/s, and one in rad/s"
            )
        x, y, z = values.tolist()
        self._course = ((x, y, z), float(yaw_rate))

    def vehicle(self, index: int, text: str) -> str:
        """Send a vehicle a command as on ``/xtdrone/T/cmd``: ARM, DISARM, HOVER or a PX4 mode such as AUTO.LAND.

        Returns:
            The reason for a rejection; "" if the command is accepted.
        """
        if index == 0:
            self._course = None
        return self.vehicles.command(index, text)

    # time

    def step(self) -> None:
        """Run one turn: advance the time to it, then update leader and followers."""
        vehicles, leader = self.vehicles, self.leader
        vehicles.advance(self._schedule.after_us(vehicles.time_us))
        self._steer_on()
        if self._message is not None:
            offsets, adjacency = self._message
            self._message = None
            self._followers.on_pattern(offsets)
            self._followers.on_topology(adjacency)
        self._followers.hear(vehicles.position, vehicles.velocity)
        self._lead()
        commands, given = self._followers.update()
        vehicles.steer(self._kind, commands, given)
        self._followers.tick()
        if self._warnings:
            self._warn()
        if self.record is not None:
            self.record.add(self.time, vehicles.true_position)
        if leader.pattern != self._said:
            self._announce()

    def run(self, seconds: float) -> None:
        """Run turns for a number of simulated seconds.

        Raises:
            ValueError: ``seconds`` is negative or not finite.
        """
        if not 0.0 <= seconds < math.inf:
            raise ValueError(f"seconds: {seconds} is not allowed, 0 or more")
        end_us = self.vehicles.time_us + round(seconds * 1e6)
        while self.vehicles.time_us < end_us:
            self.step()

    def run_until(self, settled: float = SETTLED, hold: float = 5.0, limit: float = 60.0) -> bool:
        """Run turns until all followers have stayed in their slots for some time.

        Args:
            settled: maximum distance from a slot, m.
            hold: required duration, s.
            limit: maximum duration of the run, s.

        Returns:
            Whether the followers have settled.

        Raises:
            ValueError: a value is negative or not a number.
        """
        for name, value in (("settled", settled), ("hold", hold), ("limit", limit)):
            if not value >= 0.0:
                raise ValueError(f"{name}: {value} is not allowed, 0 or more")
        start, inside = self.time, math.inf
        while self.time - start < limit:
            self.step()
            inside = min(inside, self.time) if self.errors().max() <= settled else math.inf
            if self.time - inside >= hold:
                return True
        return False

    # pictures

    def film(
        self,
        path: str | Path,
        *,
        seconds: float | None = None,
        start: float | None = None,
        end: float | None = None,
        fps: float = 25.0,
        speed: float = 1.0,
        each_turn: Callable[[Swarm], object] | None = None,
        progress: bool = True,
        **options: Any,
    ) -> Path:
        """Write a film of the recorded flight, or continue the flight and film it.

        Args:
            path: file with the suffix .mp4, .gif or .png (the last state, with trails).
            seconds: duration to fly and film, s; None: film the recorded flight.
            start: first time of the recorded flight to show, s; None: its beginning.
            end: last time likewise; None: its end.
            fps: frames per second.
            speed: simulated seconds per second of the film.
            each_turn: called with the swarm before each turn, for example to choose a pattern at some time.
            progress: whether to show a progress bar.
            options: options of the picture: slots, edges, trails (s), size (pixels); see ``view.SwarmView``.

        Returns:
            The path.

        Raises:
            FilmError: the film cannot be written, or the flight is not recorded; a ValueError.
        """
        from xtdrone_swarm.view.view_of_swarm import film_swarm  # imports Matplotlib only for drawing

        return film_swarm(
            self,
            path,
            seconds=seconds,
            start=start,
            end=end,
            fps=fps,
            speed=speed,
            each_turn=each_turn,
            progress=progress,
            **options,
        )

    def watch(
        self,
        *,
        speed: float = 1.0,
        seconds: float = math.inf,
        each_turn: Callable[[Swarm], object] | None = None,
        **options: Any,
    ) -> None:
        """Fly in a live window until it is closed: scroll zooms, drag turns, h shows the keys.

        Args:
            speed: simulated seconds per second of wall time; infinite for as fast as possible.
            seconds: simulated time after which the swarm stops, s.
            each_turn: called with the swarm before each turn, for example to choose a pattern at some time.
            options: options of the picture: slots, edges, trails (s), size (pixels); see ``view.SwarmView``.

        Raises:
            WindowError: no display is available.
            ValueError: speed or seconds are not above 0.
        """
        from xtdrone_swarm.view.view_of_swarm import watch_swarm  # imports Matplotlib only for drawing

        watch_swarm(self, speed=speed, seconds=seconds, each_turn=each_turn, **options)

    # a turn's parts

    def _steer_on(self) -> None:
        """Repeat the steering command as the keyboard node does; a zero command only once because it means HOVER."""
        if self._course is None:
            return
        self.leader.on_steering(*self._course)
        if not any(self._course[0]) and not self._course[1]:
            self._course = None

    def _lead(self) -> None:
        """Forward the leader's commands to vehicle 0."""
        for text in self._passed:
            refusal = self.vehicles.command(0, text)
            if refusal:
                _LOG.warning(refusal)
        self._passed.clear()
        yaw = float(self.vehicles.yaw[0])
        self.leader.yaw = yaw
        course = self.leader.update()
        if course is None:
            return
        (x, y, z), yaw_rate = course
        c, s = math.cos(yaw), math.sin(yaw)
        self.vehicles.steer_one(0, VELOCITY, (c * x - s * y, s * x + c * y, z), yaw_rate)

    def _warn(self) -> None:
        """Log the followers' warnings; of many in one turn, the first ones and the number of the others."""
        now = self.time
        texts = [text for text in self._warnings if now - self._said_at.get(text, -math.inf) >= _REPEATED]
        self._said_at.update(dict.fromkeys(texts, now))
        self._warnings.clear()
        for text in texts[:_SAID]:
            _LOG.warning("%.3f s: %s", now, text)
        if len(texts) > _SAID:
            _LOG.warning("%.3f s: %d more such warnings of followers", now, len(texts) - _SAID)

    def _name_those_out_of_range(self) -> None:
        """Warn of vehicles connected by the topology but cut off by the network's range at the current positions."""
        assert self.leader.adjacency is not None
        lost = sorted(set(self.cut_off()) - set(unreachable(self.leader.adjacency)))
        if lost:
            _LOG.warning(
                "pattern %s: the network's range cuts off %s of %d vehicles from the leader",
                self.leader.pattern,
                number_list(lost),
                len(self.vehicles.names),
            )

    def _announce(self) -> None:
        """Announce pattern and topology; the offsets are rounded to 32-bit floats, as in the ROS messages."""
        leader = self.leader
        self._said = leader.pattern
        assert leader.offsets is not None
        assert leader.adjacency is not None
        if self._followers.network is not None:
            self._name_those_out_of_range()
        self._message = leader.offsets.astype(np.float32).astype(float), leader.adjacency
        if self.record is not None:
            self.record.choices.append(
                Choice(self.time, leader.pattern, leader.offsets.copy(), leader.adjacency.copy())
            )


def _check_class(name: str, given: object, base: type) -> None:
    if not (isinstance(given, type) and issubclass(given, base)):
        raise TypeError(f"{name}: {given!r} is not a class that inherits {base.__name__}")


def _options(cls: type[_Options], given: _Options | Mapping[str, Any] | None) -> _Options:
    if isinstance(given, cls):
        return given
    if given is None:
        return cls()
    if not isinstance(given, Mapping):
        raise TypeError(f"{cls.__name__}: {given!r} is not allowed, {cls.__name__} or a mapping of its settings")
    unknown = set(given) - set(cls.__dataclass_fields__)
    if unknown:
        raise ValueError(
            f"{cls.__name__}: {', '.join(sorted(map(str, unknown)))} is not known; there are "
            f"{', '.join(cls.__dataclass_fields__)}"
        )
    return cls(**given)
