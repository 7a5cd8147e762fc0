"""The follower of a formation: consensus and avoidance of one vehicle. Designed for inheritance.

A follower of your own overrides the methods to be changed and inherits the rest::

    class MyFollower(Follower):
        def control_law(self, position, peers):
            x, y, z = super().control_law(position, peers)
            return x, y, 0.5 * z

    if __name__ == "__main__":
        sys.exit(run_follower(MyFollower))      # xtdrone_coordination.ros

This module does not depend on ROS: a node passes received messages to the ``on_...`` methods and publishes the result
of :meth:`Follower.update`; a simulator in one process does the same without a master.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

from numpy.typing import ArrayLike

from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_coordination.known_swarm_state import SwarmState, as_vector
from xtdrone_coordination.laws import formation_avoidance
from xtdrone_coordination.laws.consensus import Peer, Vector, acceleration_law, clip, critical_damping, velocity_law
from xtdrone_coordination.laws.formation_avoidance import Near
from xtdrone_coordination.laws.topology import check_adjacency, weights_of_row
from xtdrone_coordination.patterns.slot_offsets_and_spacing import slots_of_all

RATE = 30  # Hz
STOPPED = "its own position is no longer received: hovering"

_ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class FollowerOptions(Settings):
    """Settings of a follower; a ``clearance`` not below ``avoid_radius`` is rejected."""

    mode: Literal["vel", "accel"] = setting(
        "vel", choices=("vel", "accel"), text="output: a velocity, m/s, or an acceleration, m/s^2"
    )
    Kp: float = setting(1.0, above=0.0, text="gain of the consensus law, 1/s (1/s^2 in accel mode)")
    raw_weights: bool = setting(
        False, text="use the weights w_ij unchanged, as in the paper's equation, instead of dividing by the in-degree"
    )
    vel_max: float = setting(1.0, above=0.0, unit="m/s", text="limit of the commanded speed")
    accel_max: float = setting(1.0, above=0.0, unit="m/s^2", text="limit of the commanded acceleration")
    avoid: Literal["own", "topic", "off"] = setting(
        "own",
        choices=("own", "topic", "off"),
        text="own: computed by this follower; topic: published by another node, or its own while none is received; "
        "off: no avoidance",
    )
    Kp_avoid: float = setting(1.0, low=0.0, text="gain of the avoidance")
    avoid_radius: float = setting(formation_avoidance.RADIUS, above=0.0, unit="m", text="radius b of the avoidance")
    clearance: float = setting(
        formation_avoidance.CLEARANCE,
        low=0.0,
        unit="m",
        text="distance within which a follower does not fly towards another vehicle, in vel mode with avoidance; 0 "
        "gives the paper's Algorithm 1 unchanged",
    )
    pose_timeout: float = setting(
        1.0, above=0.0, unit="s", text="age at which positions, and avoidance from another node, are no longer used"
    )

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            SettingError: a setting is out of its range.
        """
        super().__post_init__()
        if self.clearance >= self.avoid_radius:
            raise SettingError("clearance", self.clearance, f"below avoid_radius, {self.avoid_radius} m")

    @cached_property
    def limit(self) -> float:
        """Limit of the output: m/s in vel mode, m/s^2 in accel mode."""
        return self.vel_max if self.mode == "vel" else self.accel_max

    @property
    def damping(self) -> float:
        """Damping gamma of the acceleration form, s."""
        return critical_damping(self.Kp)

    @cached_property
    def timeout_ticks(self) -> int:
        """The ``pose_timeout`` in ticks of the control loop."""
        return math.ceil(self.pose_timeout * RATE)


class Follower:
    """One follower.

    Override :meth:`control_law`, :meth:`neighbours` or :meth:`avoidance`; they may return tuples, lists or arrays. A
    subclass with state of its own, replaced options included, resets it in :meth:`restart`.

    For thousands of vehicles in one process, a law without memory may be written in arrays instead: see
    :class:`~xtdrone_coordination.array_follower.ArrayFollower`.

    Attributes:
        id: number of this vehicle, 1 to count-1.
        count: number of vehicles N.
        swarm: positions and velocities of all vehicles.
        options: the settings; may be replaced at any time, not changed in place.
        offsets: N slots relative to the leader (its own zero first), m ENU; None before the first pattern.
        weights: weights w_ij of its neighbours by number; the leader alone before the first topology.
        avoidance_vector: latest checked result of :meth:`avoidance`, before its gain; published by a node.
        problem_log: the problems of this update and the previous one.
        dt: period of the control loop, s: the time from one call of an overridden method to the next.
        warn: receives warnings.
        info: receives messages that are not warnings; by default the Python logger of this module.
    """

    uses_velocities = False
    """Set it in a subclass whose law uses velocities, so that nodes subscribe to them in vel mode too."""

    def __init__(
        self,
        id: int,
        count: int,
        *,
        swarm: SwarmState | None = None,
        options: FollowerOptions | None = None,
        warn: Callable[[str], None] | None = None,
    ) -> None:
        """Create a follower without pattern, topology or positions.

        Args:
            id: its number, 1 to count-1; 0 is the leader.
            count: number of vehicles N, at least 2.
            swarm: shared state of the swarm; its own if none is given.
            options: settings; the defaults if none are given.
            warn: receives warnings; the Python logger of this module if none is given.

        Raises:
            ValueError: ``id`` is out of range.
            TypeError: the class has ``control_laws`` and is not an ``ArrayFollower``.
        """
        if not 1 <= id < count:
            raise ValueError(
                f"follower id: {id} is not allowed, 1 to {count - 1} of {count} vehicles (0 is the leader)"
            )
        if hasattr(self, "control_laws") and type(self).evaluate_law is Follower.evaluate_law:
            raise TypeError(
                f"class {type(self).__name__} defines control_laws, a method of ArrayFollower: inherit "
                "xtdrone_coordination.array_follower.ArrayFollower"
            )
        self.id = id
        self.count = count
        self.swarm = swarm or SwarmState(count)
        self.options = options or FollowerOptions()
        self.warn = warn or logging.getLogger(__name__).warning
        self.info: Callable[[str], None] = logging.getLogger(__name__).info
        self._reset()

    def _reset(self) -> None:
        self.offsets: list[Vector] | None = None
        self.weights: Mapping[int, float] = {0: 1.0}
        self.avoidance_vector: Vector = _ZERO
        self.problem_log = ProblemLog(lambda problem: self.warn(f"follower {self.id}: {problem}"))
        self._received_avoidance: Vector = _ZERO
        self._avoidance_tick: int | None = None  # of its reception
        self._topic_timed_out = False  # and a warning has been issued
        self._found: tuple[float, Near] | None = None  # radius and near vehicles, during an update

    dt = 1.0 / RATE

    @property
    def time(self) -> float:
        """Time of this turn since the first one after the start or a restart, s: a multiple of ``dt``."""
        return self.swarm.ticks / RATE

    # to be overridden

    def control_law(self, position: Vector, peers: Sequence[Peer]) -> Vector:
        """Return this vehicle's velocity (m/s) or acceleration (m/s^2), ENU, before avoidance and limits.

        The default is the paper's equation 2, or its second-order form in accel mode.

        Args:
            position: own position, m ENU.
            peers: neighbours with known, recent positions; at least one.
        """
        assert self.offsets is not None
        offset = self.offsets[self.id]
        gain, normalise = self.options.Kp, not self.options.raw_weights
        if self.options.mode == "vel":
            return velocity_law(position, offset, peers, gain, normalise=normalise)
        velocity = self.swarm.velocities[self.id] or _ZERO
        return acceleration_law(position, velocity, offset, peers, gain, self.options.damping, normalise=normalise)

    def neighbours(self) -> Mapping[int, float]:
        """Return the weights w_ij of the neighbours by number; the default is the topology sent by the leader."""
        return self.weights

    def avoidance(self) -> Vector:
        """Return the avoidance, ENU, before the gain Kp_avoid; the default is the paper's Algorithm 1."""
        if self.options.avoid == "own":
            return self._own_avoidance()
        if self.options.avoid == "topic":
            return self._avoidance_of_topic()
        return _ZERO

    def restart(self) -> None:
        """Reset to the initial state, including the swarm's state.

        Called when simulated time is reset and when the leader withdraws its pattern. A subclass with state of its
        own overrides it and calls this one too.
        """
        self._reset()
        self.swarm.restart()

    # inputs

    def on_pattern(self, offsets: ArrayLike) -> None:
        """Store the slots of all followers in order of their numbers, shape (N-1, 3), m ENU from the leader.

        Raises:
            PatternError: another size, not finite, or slots too close to each other.
        """
        self.offsets = slots_of_all(offsets, self.count)

    def on_topology(self, adjacency: ArrayLike) -> None:
        """Store this vehicle's row of the adjacency matrix, shape (N, N) or its values row by row.

        Raises:
            ValueError: another size, negative weights, or a non-zero diagonal.
        """
        self.weights = weights_of_row(check_adjacency(adjacency, self.count)[self.id])

    def on_avoidance(self, vector: Vector) -> None:
        """Store the avoidance computed by another node (``avoid: topic``), ENU, before its gain.

        Anything but three finite numbers is ignored.
        """
        checked = as_vector(vector)
        if checked is not None:
            self._received_avoidance = checked
            self._avoidance_tick = self.swarm.ticks

    # output

    def update(self) -> Vector | None:
        """Return the command, m/s or m/s^2 ENU; None before its own position and a pattern are known.

        The command is zero while its own position, or those of all neighbours, are older than ``pose_timeout``, and
        where an overridden method returns anything but three finite numbers.
        """
        own = self.swarm.positions[self.id]
        if own is None or self.offsets is None:
            return None
        self.problem_log.begin_update()
        if not self.swarm.fresh(self.id, self.options.timeout_ticks):
            self.problem_log.report(STOPPED)
            return _ZERO
        radius = self.options.avoid_radius
        if self.options.avoid != "off":
            self._found = radius, formation_avoidance.near_vehicles(self.id, self.swarm.positions, radius)
        try:
            self.avoidance_vector = self.checked_vector(self.avoidance(), "avoidance")
            return self._limit(self.law_output(own, self.offsets))
        finally:
            self._found = None

    def law_output(self, own: Vector, offsets: list[Vector]) -> Vector:
        """Return the checked result of the law, m/s or m/s^2 ENU; zero without a neighbour of recent position."""
        peers, missing = self._known_peers(offsets)
        if missing:
            self.report_missing(missing, alone=not peers)
        return self.evaluate_law(own, peers) if peers else _ZERO

    def evaluate_law(self, position: Vector, peers: Sequence[Peer]) -> Vector:
        """Return the checked result of :meth:`control_law`."""
        return self.checked_vector(self.control_law(position, peers), "control_law")

    def _known_peers(self, offsets: list[Vector]) -> tuple[list[Peer], list[int]]:
        """Return the neighbours with recent positions, and the numbers of the others."""
        peers, missing = [], []
        swarm, timeout = self.swarm, self.options.timeout_ticks
        positions, velocities = swarm.positions, swarm.velocities
        for j, weight in self.neighbours().items():
            position = positions[j]
            if position is None or not swarm.fresh(j, timeout):
                missing.append(j)
            else:
                peers.append(Peer(j, weight, position, velocities[j] or _ZERO, offsets[j]))
        return peers, missing

    def _limit(self, desired: Vector) -> Vector:
        """Return law plus avoidance within the limit; the law is limited first so that it cannot outweigh avoidance."""
        limit, k = self.options.limit, self.options.Kp_avoid
        x, y, z = clip(desired, limit)
        ax, ay, az = self.avoidance_vector
        command = clip((x + k * ax, y + k * ay, z + k * az), limit)
        clearance = self.options.clearance
        if self.options.avoid == "off" or self.options.mode == "accel" or clearance <= 0.0:
            return command
        return formation_avoidance.give_way_to(self._near(), command, self.options.avoid_radius, clearance)

    def _own_avoidance(self) -> Vector:
        return formation_avoidance.avoid_near(self.id, self._near(), self.options.avoid_radius)

    def _near(self) -> Near:
        """Return the vehicles within the avoidance's radius; an update searches for them once."""
        radius = self.options.avoid_radius
        if self._found is not None and self._found[0] == radius:
            return self._found[1]
        return formation_avoidance.near_vehicles(self.id, self.swarm.positions, radius)

    def _avoidance_of_topic(self) -> Vector:
        """Return the received avoidance while it is recent, else its own; log each change once."""
        received = self._avoidance_tick
        timed_out = received is None or self.swarm.ticks - received > self.options.timeout_ticks
        if timed_out and not self._topic_timed_out:
            self.warn(
                f"follower {self.id}: no avoidance on its topic within {self.options.pose_timeout:g} s: "
                "using its own until one is received"
            )
        elif self._topic_timed_out and not timed_out:
            self.info(f"follower {self.id}: avoidance on its topic again: using it")
        self._topic_timed_out = timed_out
        return self._own_avoidance() if timed_out else self._received_avoidance

    # checks and reports; also called when many followers are computed together

    def checked_vector(self, value: object, name: str) -> Vector:
        """Return the result of method ``name`` as a vector; zero, with a report, if it is not three finite numbers."""
        vector = as_vector(value)
        if vector is None:
            self.problem_log.report(f"overridden {name} returned {value!r}, not three finite numbers: using zero")
            return _ZERO
        return vector

    def report_missing(self, missing: Sequence[int], *, alone: bool) -> None:
        """Report the neighbours without a recent position; ``alone`` if these are all of them."""
        names = ", ".join(str(j) for j in missing)
        self.problem_log.report(f"no position of vehicle {names}" + (": hovering" if alone else ""))


class StarFollower(Follower):
    """A follower whose only neighbour is the leader, as XTDrone's plain follower."""

    def neighbours(self) -> Mapping[int, float]:
        """Return the leader."""
        return {0: 1.0}


@dataclass
class ProblemLog:
    """Warns of a problem in the first of consecutive updates in which it occurs.

    Attributes:
        warn: receives the warnings.
        current: problems of this update.
        previous: problems of the update before.
    """

    warn: Callable[[str], None] = field(repr=False)
    current: set[str] = field(default_factory=set)
    previous: set[str] = field(default_factory=set)

    def begin_update(self) -> None:
        """Begin an update without problems."""
        self.previous, self.current = self.current, set()

    def report(self, problem: str) -> None:
        """Record a problem of this update, with a warning unless the previous update had it too."""
        self.current.add(problem)
        if problem not in self.previous:
            self.warn(problem)
