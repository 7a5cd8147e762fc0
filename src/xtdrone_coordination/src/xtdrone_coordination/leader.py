"""The leader of a formation: it chooses slots and topology for all. Made to be inherited, free of ROS.

The leader is vehicle 0. It flies where the user steers it; when a pattern is chosen it assigns the slots so that the
followers fly the least total distance, and tells everybody slots and topology.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xtdrone_control.communication.core import OWN_COMMANDS, PX4_MODES
from xtdrone_coordination import avoidance
from xtdrone_coordination.assignment import Assignment, assign
from xtdrone_coordination.consensus import Vector
from xtdrone_coordination.follower import RATE, check_choice, check_number
from xtdrone_coordination.patterns import Offsets, PatternError, Patterns, least_separation, with_leader
from xtdrone_coordination.swarm import SwarmState
from xtdrone_coordination.topology import check_adjacency, cut_off, deaf, veteran_topology

NO_PATTERN = "waiting"  # XTDrone's keyboard sends it for the digit 0
_MAX_RUNS = 8  # of numbers in a message
_MOST_WEIGHT = 2**31 - 1
STEERING_TICKS = RATE // 2  # a steering velocity older than half a second is over


class CommandError(ValueError):
    """A command to the leader that is neither a pattern nor a flight command, or cannot be flown now."""


@dataclass(frozen=True)
class LeaderOptions:
    """Settings of the leader.

    Attributes:
        avoid: ``off``: the leader holds its course and the others give way, as in XTDrone; ``own``: it avoids too.
        Kp_avoid: gain of its avoidance, 0 or more.
        avoid_radius: b, m, above 0; a pattern with slots closer than this is warned of.
        min_height: m; a pattern is refused when its lowest slot would lie below this height (local z) while it goes
            below the leader.
        vel_max: limit of the avoidance it adds, m/s, above 0.
    """

    avoid: Literal["off", "own"] = "off"
    Kp_avoid: float = 1.0
    avoid_radius: float = avoidance.RADIUS
    min_height: float = 0.5
    vel_max: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what makes no sense.

        Raises:
            ValueError: a setting is out of its range.
        """
        check_choice("avoid", self.avoid, ("off", "own"))
        check_number("Kp_avoid", self.Kp_avoid, zero=True)
        check_number("min_height", self.min_height, zero=True)
        check_number("avoid_radius", self.avoid_radius)
        check_number("vel_max", self.vel_max)


class Leader:
    """The leader.

    Override :meth:`assignment`, :meth:`topology` or :meth:`avoidance`. What else a subclass remembers it forgets in
    :meth:`restart`.

    Attributes:
        count: number of vehicles N.
        patterns: the patterns there are.
        swarm: positions of all vehicles.
        options: the settings.
        pattern: name of the present pattern, empty before the first.
        offsets: assigned slots in follower order, shape (N-1, 3), m ENU from the leader; None before the first.
        adjacency: topology, shape (N, N), whole numbers; None before the first pattern.
        distance: total distance of the last assignment, m.
        yaw: heading of vehicle 0, rad ENU; needed for its own avoidance only.
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
        """Create a leader that has chosen no pattern yet.

        Args:
            count: number of vehicles N, at least 2.
            patterns: XTDrone's and the generated ones if none are given.
            swarm: shared state of the swarm; its own if none is given.
            options: settings; the defaults if none are given.
            warn: where warnings go; the Python logger of this module if none is given.

        Raises:
            PatternError: ``count`` is less than 2.
        """
        self.count = count
        self.patterns = patterns or Patterns(count)
        self.swarm = swarm or SwarmState(count)
        self.options = options or LeaderOptions()
        self._warn = warn or logging.getLogger(__name__).warning
        self._know_nothing()

    def _know_nothing(self) -> None:
        self.pattern = ""
        self.offsets: Offsets | None = None
        self.adjacency: NDArray[np.int32] | None = None
        self.distance = 0.0
        self.yaw = 0.0
        self._steering: tuple[Vector, float] | None = None  # FLU velocity, yaw rate; not yet given out
        self._course: tuple[Vector, float] = ((0.0, 0.0, 0.0), 0.0)  # the last of them
        self._course_age = STEERING_TICKS + 1
        self._avoiding = False

    # to be overridden

    def restart(self) -> None:
        """Know nothing again, nor does the swarm: the state after construction.

        Called when the simulation starts anew (time was set back). A subclass with a state of its own overrides it,
        and calls this one too.
        """
        self._know_nothing()
        self.swarm.restart()

    def assignment(self, current: Offsets, target: Offsets) -> Assignment:
        """Return which slot each follower takes; the default minimises the total distance.

        Args:
            current: where the followers are relative to the leader, shape (N-1, 3), m ENU.
            target: the slots, shape (N-1, 3), m ENU.
        """
        return assign(current, target)

    def topology(self, offsets: Offsets) -> ArrayLike:
        """Return the adjacency matrix, shape (N, N), for assigned slots; the default is the veteran rule.

        Weights are whole numbers, as the message with the topology has them; a follower whose row is all zeros is given
        the leader to listen to, with a warning.

        Args:
            offsets: slots of all vehicles in order of their numbers, the leader's zero row first, shape (N, 3).
        """
        return veteran_topology(offsets)

    def avoidance(self) -> Vector:
        """Return the leader's own avoidance, m/s ENU, before its gain; zero by default settings."""
        if self.options.avoid == "own":
            return avoidance.avoid(0, self.swarm.positions, self.options.avoid_radius)
        return 0.0, 0.0, 0.0

    # inputs

    def on_command(self, text: str) -> str | None:
        """Take a command: choose the pattern of that name, or return it to be passed on to vehicle 0 once.

        Raises:
            CommandError: no pattern and no flight command, a pattern asked for wrongly (as a cloud's file that is not
                there), or one that would reach below ``min_height``.
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
            self._course_age = STEERING_TICKS + 1  # the course ends where another command begins
            return text
        raise CommandError(
            f"leader: {text!r} is no pattern of {self.count} vehicles ({self.patterns.describe()}) "
            f"and no flight command ({', '.join(OWN_COMMANDS)}, a PX4 mode as OFFBOARD or AUTO.LAND)"
        )

    def choose(self, name: str) -> None:
        """Assign the slots of a pattern; nothing happens if it is the present one.

        Raises:
            PatternError: there is no such pattern.
            CommandError: it would reach below ``min_height``, or an overridden method gave something unusable.
        """
        target = self.patterns.offsets(name)
        if name == self.pattern:
            return
        self._check_height(name, target)
        solved = self.assignment(self.current(), target)
        if not isinstance(solved, Assignment):
            raise CommandError(f"leader: overridden assignment gave {solved!r}, an Assignment is needed")
        slots = np.asarray(solved.slots)
        if sorted(slots.tolist()) != list(range(self.count - 1)):
            given = np.array2string(slots, threshold=20)
            raise CommandError(f"leader: overridden assignment gave {given}, which is no permutation")
        offsets = target[slots]
        adjacency = self._checked_topology(name, offsets)
        separation = least_separation(target)
        if separation < self.options.avoid_radius:
            self._warn(
                f"leader: pattern {name!r} has slots {separation:.2f} m apart, less than the avoidance radius "
                f"{self.options.avoid_radius} m: vehicles will not rest on their slots"
            )
        self.pattern, self.offsets, self.distance = name, offsets, solved.cost
        self.adjacency = adjacency

    def on_steering(self, velocity: Vector, yaw_rate: float) -> None:
        """Take a steering command for vehicle 0: FLU velocity m/s, yaw rate rad/s."""
        self._steering = self._course = (velocity, yaw_rate)
        self._course_age = 0

    # outputs

    def update(self) -> tuple[Vector, float] | None:
        """Return the FLU velocity (m/s) and yaw rate (rad/s) to command vehicle 0 in this tick; None to say nothing.

        Each steering command goes out once. While the leader itself avoids, its avoidance is added to the course and
        goes out every tick; when that ends without a course, one zero follows, which means hover.
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
        """Return where the followers are relative to the leader, shape (N-1, 3), m ENU.

        Measured positions if all are known, else the slots they were sent to last, else the spawn grid.
        """
        known = [p for p in self.swarm.positions if p is not None]
        if len(known) == self.count:
            points = np.array(known)
            return points[1:] - points[0]
        return self.patterns.offsets("origin") if self.offsets is None else self.offsets.copy()

    def _checked_topology(self, name: str, offsets: Offsets) -> NDArray[np.int32]:
        """Return the topology for a pattern's assigned slots, and name those whom it leaves alone."""
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
        alone = deaf(given)
        if alone:
            self._warn(
                f"leader: by the topology of pattern {name!r} {number_list(alone)} of {self.count} vehicles listen to "
                "nobody: they are given vehicle 0 to listen to"
            )
        lost = cut_off(adjacency)
        if lost:
            self._warn(
                f"leader: topology of pattern {name!r} cuts off {number_list(lost)} of {self.count} vehicles: they "
                "hear of vehicle 0 neither directly nor through others and will not keep their slots"
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
    """Return the first weight that is no whole number, or too great."""
    return float(adjacency[(adjacency % 1.0 != 0.0) | (adjacency > _MOST_WEIGHT)][0])


def number_list(numbers: Sequence[int]) -> str:
    """Return ascending vehicle numbers as a short text: runs of them, and of many runs the first few and a count."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], number]
        else:
            runs.append([number])
    said = ", ".join("-".join(str(n) for n in run) for run in runs[:_MAX_RUNS])
    return said if len(runs) <= _MAX_RUNS else f"{said}, ... ({len(numbers)} in all)"


__all__ = ["CommandError", "Leader", "LeaderOptions", "PatternError"]
