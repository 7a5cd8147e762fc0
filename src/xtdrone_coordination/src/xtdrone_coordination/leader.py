"""The leader of a formation: slots and topology of all vehicles. Designed for inheritance, without ROS.

The leader is vehicle 0, steered by the user. When a pattern is chosen, it assigns the slots so that the followers fly
the minimum total distance, and publishes slots and topology.
"""

from __future__ import annotations

import logging
import math
import reprlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from xtdrone_common.settings import Settings, setting
from xtdrone_control.communication.commands import OWN_COMMANDS, PX4_MODES
from xtdrone_coordination.follower import RATE
from xtdrone_coordination.known_swarm_state import SwarmState, number_list
from xtdrone_coordination.laws import formation_avoidance
from xtdrone_coordination.laws.consensus import Vector
from xtdrone_coordination.laws.topology import check_adjacency, unreachable, veteran_topology, without_neighbours
from xtdrone_coordination.patterns import Offsets, PatternError, Patterns, least_separation, with_leader

_LARGE = 200  # followers; smaller problems are passed to the solver unchanged, so that ties are resolved as before


@dataclass(frozen=True)
class Assignment:
    """A solved assignment.

    Attributes:
        slots: shape (M,); follower i (row i of ``current``) flies to ``target[slots[i]]``.
        cost: total straight-line distance, m.
    """

    slots: NDArray[np.intp]
    cost: float


def assign(current: ArrayLike, target: ArrayLike) -> Assignment:
    """Return the assignment of minimum total Euclidean distance.

    Args:
        current: positions of the followers, shape (M, 3), m.
        target: the slots in the same frame, shape (M, 3), m.

    Raises:
        ValueError: shapes differ or are not (M, 3), or a value is not finite.
    """
    here, there = np.asarray(current, dtype=float), np.asarray(target, dtype=float)
    if here.ndim != 2 or here.shape[1] != 3 or here.shape != there.shape:
        raise ValueError(f"assignment: shapes {here.shape} and {there.shape}, both must be (M, 3)")
    if not (np.isfinite(here).all() and np.isfinite(there).all()):
        raise ValueError("assignment: all positions must be finite")
    distance = _distances(here, there)
    rows, columns = linear_sum_assignment(distance if len(here) < _LARGE else _reduce(distance))
    return Assignment(columns, float(distance[rows, columns].sum()))


def _distances(here: NDArray[np.float64], there: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances of all pairs, shape (M, M)."""
    if len(here) < _LARGE:
        return np.asarray(np.linalg.norm(here[:, None] - there[None], axis=-1))
    squares = np.zeros((len(here), len(there)))
    for a, b in zip(here.T, there.T, strict=True):  # one axis at a time, for a third of the memory
        difference = a[:, None] - b
        difference *= difference
        squares += difference
    return np.sqrt(squares, out=squares)


def _reduce(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances minus the least of each row, then of each column; the optimal assignments stay the same.

    The solver starts without dual prices and is faster with zeros to assign.
    """
    reduced = distance - distance.min(axis=1, keepdims=True)
    reduced -= reduced.min(axis=0)
    return reduced


NO_PATTERN = "waiting"  # XTDrone's keyboard sends it for the digit 0
_MOST_WEIGHT = 2**31 - 1
STEERING_TICKS = RATE // 2  # a steering velocity expires after half a second


class CommandError(ValueError):
    """A command that is neither a pattern nor a flight command, or cannot be flown now."""


@dataclass(frozen=True)
class LeaderOptions(Settings):
    """Settings of the leader."""

    avoid: Literal["off", "own"] = setting(
        "off",
        choices=("off", "own"),
        text="avoidance of the leader: none (it keeps its course and the others avoid it, as in XTDrone), or its own",
    )
    Kp_avoid: float = setting(1.0, low=0.0, text="gain of its avoidance")
    avoid_radius: float = setting(
        formation_avoidance.RADIUS,
        above=0.0,
        unit="m",
        text="radius b of the avoidance; patterns with slots closer than this cause a warning",
    )
    min_height: float = setting(
        0.5,
        low=0.0,
        unit="m",
        text="minimum height (local z) of the lowest slot; patterns that reach below the leader and this height are "
        "rejected",
    )
    vel_max: float = setting(1.0, above=0.0, unit="m/s", text="limit of its avoidance")


class Leader:
    """The leader.

    Override :meth:`assignment`, :meth:`topology` or :meth:`avoidance`. A subclass with state of its own resets it in
    :meth:`restart`.

    Attributes:
        count: number of vehicles N.
        patterns: the available patterns.
        swarm: positions of all vehicles.
        options: the settings.
        pattern: name of the current pattern, empty before the first.
        offsets: assigned slots in follower order, shape (N-1, 3), m ENU from the leader; None before the first.
        adjacency: topology, shape (N, N), whole numbers; None before the first pattern.
        distance: total distance of the latest assignment, m.
        yaw: heading of vehicle 0, rad ENU; used by its own avoidance only.
        dt: period of the control loop, s.
    """

    def __init__(
        self,
        count: int,
        patterns: Patterns | None = None,
        *,
        swarm: SwarmState | None = None,
        options: LeaderOptions | None = None,
        warn: Callable[[str], None] | None = None,
    ) -> None:
        """Create a leader without a pattern.

        Args:
            count: number of vehicles N, at least 2.
            patterns: Patterns to choose from; by default XTDrone's and the generated ones.
            swarm: shared state of the swarm; its own if none is given.
            options: settings; the defaults if none are given.
            warn: receives warnings; the Python logger of this module if none is given.

        Raises:
            PatternError: ``count`` is less than 2.
        """
        self.count = count
        self.patterns = patterns or Patterns(count)
        self.swarm = swarm or SwarmState(count)
        self.options = options or LeaderOptions()
        self._warn = warn or logging.getLogger(__name__).warning
        self._reset()

    def _reset(self) -> None:
        self.pattern = ""
        self.offsets: Offsets | None = None
        self.adjacency: NDArray[np.int32] | None = None
        self.distance = 0.0
        self.yaw = 0.0
        self._steering: tuple[Vector, float] | None = None  # FLU velocity, yaw rate; not yet output
        self._course: tuple[Vector, float] = ((0.0, 0.0, 0.0), 0.0)  # the latest one
        self._course_age = STEERING_TICKS + 1
        self._avoiding = False

    dt = 1.0 / RATE

    @property
    def time(self) -> float:
        """Time of this turn since the first one after the start or a restart, s: a multiple of ``dt``."""
        return self.swarm.ticks / RATE

    # to be overridden

    def restart(self) -> None:
        """Reset to the initial state, including the swarm's state.

        Called when simulated time is reset. A subclass with state of its own overrides it and calls this one too.
        """
        self._reset()
        self.swarm.restart()

    def assignment(self, current: Offsets, target: Offsets) -> Assignment | ArrayLike:
        """Return the slot of each follower; the default minimises the total distance.

        Args:
            current: positions of the followers relative to the leader, shape (N-1, 3), m ENU.
            target: the slots, shape (N-1, 3), m ENU.

        Returns:
            A permutation of 0 to N-2 as a list or an array: the follower of row i of ``current`` flies to
            ``target[slots[i]]``; or an :class:`Assignment`.
        """
        return assign(current, target)

    def topology(self, offsets: Offsets) -> ArrayLike:
        """Return the adjacency matrix, shape (N, N), for assigned slots; the default is the veteran rule.

        Weights are whole numbers, as in the topology message. Followers without neighbours get the leader as neighbour,
        with a warning.

        Args:
            offsets: slots of all vehicles in order of their numbers, the leader's zero row first, shape (N, 3).
        """
        return veteran_topology(offsets)

    def avoidance(self) -> Vector:
        """Return the leader's own avoidance, m/s ENU, before its gain; zero by default settings."""
        if self.options.avoid == "own":
            return formation_avoidance.avoid(0, self.swarm.positions, self.options.avoid_radius)
        return 0.0, 0.0, 0.0

    # inputs

    def on_command(self, text: str) -> str | None:
        """Choose the pattern named by a command, or return the command, to be forwarded to vehicle 0 once.

        Raises:
            CommandError: neither a pattern nor a flight command, a pattern with wrong arguments (such as a missing
                file), or one that would reach below ``min_height``.
        """
        if text in ("", "stop controlling", NO_PATTERN):
            return None
        if text in self.patterns:
            try:
                self.choose(text)
            except PatternError as error:
                raise CommandError(f"leader: {error}") from error
            return None
        mission = text.startswith("mission") and len(text) == len("mission?")
        if text in OWN_COMMANDS or text in PX4_MODES or text.startswith("AUTO.") or mission:
            self._course_age = STEERING_TICKS + 1  # another command ends the course
            return text
        raise CommandError(
            f"leader: {text!r} is not a pattern of {self.count} vehicles ({self.patterns.describe()}) "
            f"and not a flight command ({', '.join(OWN_COMMANDS)}, a PX4 mode as OFFBOARD or AUTO.LAND)"
        )

    def choose(self, name: str) -> None:
        """Assign the slots of a pattern, unless it is the current one.

        Raises:
            PatternError: there is no such pattern.
            CommandError: it would reach below ``min_height``, or an overridden method returned an unusable result.
        """
        target = self.patterns.offsets(name)
        if name == self.pattern:
            return
        self._check_height(name, target)
        current = self.current()
        solved = self._check_assignment(self.assignment(current, target), current, target)
        offsets = target[solved.slots]
        adjacency = self._check_topology(name, offsets)
        separation = least_separation(target)
        if separation < self.options.avoid_radius:
            self._warn(
                f"leader: pattern {name!r} has slots {separation:.2f} m apart, less than the avoidance radius "
                f"{self.options.avoid_radius} m: vehicles will not stay in their slots"
            )
        self.pattern, self.offsets, self.distance = name, offsets, solved.cost
        self.adjacency = adjacency

    def on_steering(self, velocity: Vector, yaw_rate: float) -> None:
        """Store a steering command for vehicle 0: FLU velocity m/s, yaw rate rad/s."""
        self._steering = self._course = (velocity, yaw_rate)
        self._course_age = 0

    # outputs

    def update(self) -> tuple[Vector, float] | None:
        """Return the FLU velocity (m/s) and yaw rate (rad/s) to command vehicle 0 in this tick; None without a command.

        Each steering command is returned once. While the leader itself avoids, course plus avoidance is returned every
        tick; if no course remains afterwards, one zero command follows, which means hover.
        """
        steering, self._steering = self._steering, None
        self._course_age += 1
        ax, ay, az = (self.options.Kp_avoid * a for a in self.avoidance())
        length = math.sqrt(ax * ax + ay * ay + az * az)
        was_avoiding, self._avoiding = self._avoiding, length > 0.0
        course = self._course if self._course_age <= STEERING_TICKS else ((0.0, 0.0, 0.0), 0.0)
        if not self._avoiding:
            return course if was_avoiding else steering
        k = min(1.0, self.options.vel_max / length)
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        (x, y, z), yaw_rate = course
        return (x + k * (cos * ax + sin * ay), y + k * (cos * ay - sin * ax), z + k * az), yaw_rate

    def current(self) -> Offsets:
        """Return the positions of the followers relative to the leader, shape (N-1, 3), m ENU.

        Measured positions if all are known, else the slots assigned last, else the spawn grid.
        """
        known = [p for p in self.swarm.positions if p is not None]
        if len(known) == self.count:
            points = np.array(known)
            return points[1:] - points[0]
        return self.patterns.offsets("origin") if self.offsets is None else self.offsets.copy()

    def _check_assignment(self, given: Assignment | ArrayLike, current: Offsets, target: Offsets) -> Assignment:
        """Return the result of :meth:`assignment` as an Assignment."""
        slots = given.slots if isinstance(given, Assignment) else given
        followers = np.arange(self.count - 1)
        try:
            allowed = np.array_equal(np.sort(np.asarray(slots), axis=None), followers)
        except (TypeError, ValueError):  # nested lists of different lengths, values without an order
            allowed = False
        if not allowed:
            raise CommandError(
                f"leader: overridden assignment gave {reprlib.repr(slots)}, which is not a permutation of the slots "
                f"0 to {self.count - 2}"
            )
        whole = np.asarray(slots, dtype=np.intp).reshape(-1)
        if isinstance(given, Assignment):
            return Assignment(whole, given.cost)
        return Assignment(whole, float(np.linalg.norm(current - target[whole], axis=1).sum()))

    def _check_topology(self, name: str, offsets: Offsets) -> NDArray[np.int32]:
        """Return the topology for the assigned slots of a pattern; warn of followers cut off from the leader."""
        try:
            given = np.array(self.topology(with_leader(offsets)), dtype=float)
            adjacency = check_adjacency(given, self.count)
        except (TypeError, ValueError) as error:
            raise CommandError(f"leader: overridden topology: {error}") from error
        if (adjacency % 1.0).any() or adjacency.max() > _MOST_WEIGHT:
            raise CommandError(
                f"leader: overridden topology has a weight of {_unsendable(adjacency):g}; weights travel as whole "
                f"numbers, 0 to {_MOST_WEIGHT}"
            )
        alone = without_neighbours(given)
        if alone:
            self._warn(
                f"leader: topology of pattern {name!r} has no neighbours for {number_list(alone)} of {self.count} "
                "vehicles: vehicle 0 is added"
            )
        lost = unreachable(adjacency)
        if lost:
            self._warn(
                f"leader: topology of pattern {name!r} cuts off {number_list(lost)} of {self.count} vehicles: they "
                "have no path to vehicle 0, direct or through others, and will not keep their slots"
            )
        return adjacency.astype(np.int32)

    def _check_height(self, name: str, target: Offsets) -> None:
        own, lowest = self.swarm.positions[0], float(target[:, 2].min())
        if own is None or lowest >= 0.0:
            return
        needed = self.options.min_height - lowest
        if own[2] < needed:
            raise CommandError(
                f"leader: pattern {name!r} reaches {-lowest:g} m below the leader, which is at {own[2]:.1f} m: "
                f"climb to {needed:g} m first"
            )


def _unsendable(adjacency: NDArray[np.float64]) -> float:
    """Return the first weight that is not a whole number or is too large."""
    return float(adjacency[(adjacency % 1.0 != 0.0) | (adjacency > _MOST_WEIGHT)][0])


__all__ = ["CommandError", "Leader", "LeaderOptions", "PatternError", "number_list"]
