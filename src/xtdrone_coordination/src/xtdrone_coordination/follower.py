"""The follower of a formation: one vehicle's consensus and avoidance. Made to be inherited.

A follower of your own overrides what it wants to change and keeps the rest::

    class MyFollower(Follower):
        def control_law(self, position, peers):
            x, y, z = super().control_law(position, peers)
            return x, y, 0.5 * z

    if __name__ == "__main__":
        sys.exit(run_follower(MyFollower))      # xtdrone_coordination.ros

No ROS here: a node hands in what it hears with the ``on_...`` methods and publishes what :meth:`Follower.update`
returns; a simulator in one process does the same without a master.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xtdrone_coordination import avoidance
from xtdrone_coordination.consensus import Peer, Vector, acceleration_law, clip, critical_damping, velocity_law
from xtdrone_coordination.patterns import check_offsets, with_leader
from xtdrone_coordination.rows import OwnRows, PeerRows
from xtdrone_coordination.swarm import SwarmState, as_vector
from xtdrone_coordination.topology import check_adjacency

RATE = 30  # Hz
STOPPED = "its own position has stopped: standing still"

_ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class FollowerOptions:
    """Settings of a follower.

    Attributes:
        mode: ``vel``: the output is a velocity, m/s; ``accel``: an acceleration, m/s^2.
        Kp: gain of the consensus law, 1/s (1/s^2 in accel mode), above 0.
        raw_weights: take the weights w_ij as they are, as in the paper's equation; else divide by the in-degree.
        vel_max: limit of the commanded speed, m/s, above 0.
        accel_max: limit of the commanded acceleration, m/s^2, above 0.
        avoid: ``own``: compute the avoidance here; ``topic``: use what another node computes, and the own one while
            that is silent; ``off``.
        Kp_avoid: gain of the avoidance, 0 or more.
        avoid_radius: b, m, above 0.
        clearance: m, below ``avoid_radius``; in vel mode, unless the avoidance is off, a follower does not fly towards
            a vehicle that is nearer than this; 0 leaves the paper's Algorithm 1 alone.
        pose_timeout: s; a position, or an avoidance from another node, older than this is not used any more, above 0.
    """

    mode: Literal["vel", "accel"] = "vel"
    Kp: float = 1.0
    raw_weights: bool = False
    vel_max: float = 1.0
    accel_max: float = 1.0
    avoid: Literal["own", "topic", "off"] = "own"
    Kp_avoid: float = 1.0
    avoid_radius: float = avoidance.RADIUS
    clearance: float = avoidance.CLEARANCE
    pose_timeout: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what makes no sense.

        Raises:
            ValueError: a setting is out of its range.
        """
        check_choice("mode", self.mode, ("vel", "accel"))
        check_choice("avoid", self.avoid, ("own", "topic", "off"))
        check_number("Kp_avoid", self.Kp_avoid, zero=True)
        check_number("clearance", self.clearance, zero=True)
        for name in ("Kp", "vel_max", "accel_max", "avoid_radius", "pose_timeout"):
            check_number(name, getattr(self, name))
        if self.clearance >= self.avoid_radius:
            raise ValueError(f"clearance: {self.clearance} m is not less than avoid_radius, {self.avoid_radius} m")

    @property
    def limit(self) -> float:
        """The limit that goes with the mode."""
        return self.vel_max if self.mode == "vel" else self.accel_max


class Follower:
    """One follower.

    Override :meth:`control_law`, :meth:`neighbours` or :meth:`avoidance`. They may return tuples, lists or arrays. What
    else a subclass remembers, options of its own choice too, it forgets in :meth:`restart`.

    For swarms of a thousand in one process a law without a memory may be written in arrays, as :meth:`control_laws`, in
    place of :meth:`control_law` or beside it.

    Attributes:
        id: this vehicle's number, 1 to count-1.
        count: number of vehicles N.
        swarm: positions and velocities of all vehicles.
        options: the settings; may be replaced at any time, not changed in place.
        offsets: N slots relative to the leader (its own zero first), m ENU; None until a pattern came.
        weights: weights w_ij of those it listens to, by their number; the leader alone until a topology came.
        avoidance_vector: what :meth:`avoidance` gave last, before its gain; a node publishes it.
        info: where news go that are no warnings; the Python logger of this module unless it is replaced.
    """

    uses_velocities = False
    """Set it in a subclass whose law reads velocities, so that they are subscribed in vel mode too."""

    _in_arrays = False  # whether control_laws counts in a batch
    _by_itself = True  # whether control_law counts outside of it

    def __init_subclass__(cls, **named: object) -> None:
        """See which of the two forms of the law is the last word of a subclass."""
        super().__init_subclass__(**named)
        last = next(vars(base) for base in cls.__mro__ if {"control_law", "control_laws"} & set(vars(base)))
        cls._by_itself = "control_law" in last
        cls._in_arrays = "control_laws" in last and last is not vars(Follower)

    def __init__(
        self,
        id: int,
        count: int,
        *,
        swarm: SwarmState | None = None,
        options: FollowerOptions | None = None,
        warn: Callable[[str], None] | None = None,
    ) -> None:
        """Create a follower that knows nothing yet.

        Args:
            id: its number, 1 to count-1; 0 is the leader.
            count: number of vehicles N, at least 2.
            swarm: shared state of the swarm; its own if none is given.
            options: settings; the defaults if none are given.
            warn: where warnings go; the Python logger of this module if none is given.

        Raises:
            ValueError: ``id`` is out of range.
        """
        if not 1 <= id < count:
            raise ValueError(
                f"follower id: {id} is not allowed, 1 to {count - 1} of {count} vehicles (0 is the leader)"
            )
        self.id = id
        self.count = count
        self.swarm = swarm or SwarmState(count)
        self.options = options or FollowerOptions()
        self._warn = warn or logging.getLogger(__name__).warning
        self.info: Callable[[str], None] = logging.getLogger(__name__).info
        self._know_nothing()

    def _know_nothing(self) -> None:
        self.offsets: list[Vector] | None = None
        self.weights: Mapping[int, float] = {0: 1.0}
        self.avoidance_vector: Vector = _ZERO
        self._heard_avoidance: Vector = _ZERO
        self._avoidance_tick: int | None = None  # when it came
        self._topic_is_silent = False  # and has been warned of
        self._problems: set[str] = set()  # of the last update
        self._said: set[str] = set()  # of the update before

    @property
    def _gamma(self) -> float:
        """The damping of the acceleration form, s."""
        return critical_damping(self.options.Kp)

    @property
    def _timeout(self) -> int:
        """The ``pose_timeout`` in ticks."""
        return math.ceil(self.options.pose_timeout * RATE)

    # to be overridden

    def restart(self) -> None:
        """Know nothing again, nor does the swarm: the state after construction.

        Called when the simulation starts anew (time was set back), and when the leader takes its pattern back. A
        subclass with a state of its own overrides it, and calls this one too.
        """
        self._know_nothing()
        self.swarm.restart()

    def control_law(self, position: Vector, peers: Sequence[Peer]) -> Vector:
        """Return this vehicle's velocity (m/s) or acceleration (m/s^2), ENU, before avoidance and limits.

        The default is the paper's equation 2, or its second-order form in accel mode.

        Args:
            position: own position, m ENU.
            peers: those it listens to, with what it knows of them.
        """
        assert self.offsets is not None
        offset = self.offsets[self.id]
        gain, normalise = self.options.Kp, not self.options.raw_weights
        if self.options.mode == "vel":
            return velocity_law(position, offset, peers, gain, normalise=normalise)
        velocity = self.swarm.velocities[self.id] or _ZERO
        return acceleration_law(position, velocity, offset, peers, gain, self._gamma, normalise=normalise)

    @classmethod
    def control_laws(cls, options: FollowerOptions, own: OwnRows, peers: PeerRows) -> ArrayLike:
        """Return what :meth:`control_law` does, for many followers of this class at once; the default is the stock law.

        A subclass that overrides this alone flies by it everywhere. One that overrides both flies by this one where
        all followers of a process are computed together, and by the other in a node of its own: they have to agree.

        Args:
            options: settings, the same of all these followers.
            own: the followers, M rows.
            peers: those they listen to, with what they know of them.

        Returns:
            Shape (M, 3), m/s or m/s^2 ENU.
        """
        return own.stock

    def neighbours(self) -> Mapping[int, float]:
        """Return the weight of each vehicle to listen to, by its number; the default is the leader's topology."""
        return self.weights

    def avoidance(self) -> Vector:
        """Return the avoidance, ENU, before the gain Kp_avoid; the default is the paper's Algorithm 1."""
        if self.options.avoid == "own":
            return avoidance.avoid(self.id, self.swarm.positions, self.options.avoid_radius)
        if self.options.avoid == "topic":
            return self._avoidance_of_topic()
        return _ZERO

    # inputs

    def on_pattern(self, offsets: ArrayLike) -> None:
        """Take the slots of all followers in order of their numbers, shape (N-1, 3), m ENU from the leader.

        Raises:
            PatternError: another size, not finite, or slots too close to each other.
        """
        self.offsets = slots_of(offsets, self.count)

    def on_topology(self, adjacency: ArrayLike) -> None:
        """Take the adjacency matrix, shape (N, N) or its values row by row; row i: whom vehicle i listens to.

        Raises:
            ValueError: another size, negative weights, or a vehicle that listens to itself.
        """
        self.weights = weights_in(check_adjacency(adjacency, self.count)[self.id])

    def on_avoidance(self, vector: Vector) -> None:
        """Accept the avoidance that another node computed for this vehicle (``avoid: topic``), ENU, before its gain.

        One that is not three finite numbers is ignored.
        """
        checked = as_vector(vector)
        if checked is not None:
            self._heard_avoidance = checked
            self._avoidance_tick = self.swarm.ticks

    # output

    def update(self) -> Vector | None:
        """Return what to command now, m/s or m/s^2 ENU; None before it knows its place and its slot.

        It stands still (zero) when its own position or those of all its neighbours have not come for ``pose_timeout``,
        and when an overridden method gives something else than three finite numbers.
        """
        own = self.swarm.positions[self.id]
        if own is None or self.offsets is None:
            return None
        self._said, self._problems = self._problems, set()
        if not self.swarm.fresh(self.id, self._timeout):
            self._tell(STOPPED)
            return _ZERO
        self.avoidance_vector = self._checked(self.avoidance(), "avoidance")
        return self._limited(self._wanted(own, self.offsets))

    def _avoidance_of_topic(self) -> Vector:
        """Return the avoidance that was heard while it is fresh, else the own one; tell of each change once."""
        came = self._avoidance_tick
        silent = came is None or self.swarm.ticks - came > self._timeout
        if silent and not self._topic_is_silent:
            self._warn(
                f"follower {self.id}: no avoidance on its topic within {self.options.pose_timeout:g} s: "
                "using its own until one comes"
            )
        elif self._topic_is_silent and not silent:
            self.info(f"follower {self.id}: avoidance on its topic again: using it")
        self._topic_is_silent = silent
        if silent:
            return avoidance.avoid(self.id, self.swarm.positions, self.options.avoid_radius)
        return self._heard_avoidance

    def _wanted(self, own: Vector, offsets: list[Vector]) -> Vector:
        """Return what the law gives, zero when it listens to nobody or gives something unusable."""
        peers, silent = self._peers(offsets)
        if silent:
            self._tell_silent(silent, alone=not peers)
        if not peers:
            return _ZERO
        if self._by_itself:
            return self._checked(self.control_law(own, peers), "control_law")
        return self._checked(self._law_of_one(own, peers, offsets), "control_laws")

    def _law_of_one(self, position: Vector, peers: Sequence[Peer], offsets: list[Vector]) -> Vector:
        """Return what control_laws gives for this follower."""
        own = OwnRows(
            ids=np.array([self.id]),
            position=np.array([position]),
            velocity=np.array([self.swarm.velocities[self.id] or _ZERO]),
            offset=np.array([offsets[self.id]]),
            stock=np.array([Follower.control_law(self, position, peers)]),
        )
        numbers, weights, positions, velocities, slots = zip(*peers, strict=True)
        links = PeerRows(
            row=np.zeros(len(peers), dtype=np.int64),
            ids=np.array(numbers),
            weight=np.array(weights, dtype=float),
            position=np.array(positions),
            velocity=np.array(velocities),
            offset=np.array(slots),
        )
        given = self.control_laws(self.options, own, links)
        rows = rows_of(given, 1)
        return given if rows is None else tuple(rows[0].tolist())  # type: ignore[return-value]  # who calls checks it

    def _limited(self, wanted: Vector) -> Vector:
        """Add the avoidance to the consensus, that within the limit first, so that a far slot cannot drown it."""
        limit, k = self.options.limit, self.options.Kp_avoid
        x, y, z = clip(wanted, limit)
        ax, ay, az = self.avoidance_vector
        command = clip((x + k * ax, y + k * ay, z + k * az), limit)
        if self.options.avoid == "off" or self.options.mode == "accel":
            return command
        return avoidance.give_way(
            self.id, self.swarm.positions, command, self.options.avoid_radius, self.options.clearance
        )

    def _peers(self, offsets: list[Vector]) -> tuple[list[Peer], list[int]]:
        """Return the neighbours whose positions are known and fresh, and the numbers of the others."""
        peers, silent = [], []
        positions, velocities = self.swarm.positions, self.swarm.velocities
        for j, weight in self.neighbours().items():
            position = positions[j]
            if position is None or not self.swarm.fresh(j, self._timeout):
                silent.append(j)
            else:
                peers.append(Peer(j, weight, position, velocities[j] or _ZERO, offsets[j]))
        return peers, silent

    def _checked(self, value: Vector, name: str) -> Vector:
        vector = as_vector(value)
        if vector is None:
            self._tell(f"overridden {name} gave {value!r}, three finite numbers are allowed: taken as zero")
            return _ZERO
        return vector

    def _tell_silent(self, silent: Sequence[int], *, alone: bool) -> None:
        names = ", ".join(str(j) for j in silent)
        self._tell(f"no position of vehicle {names}" + (": standing still" if alone else ""))

    def _tell(self, problem: str) -> None:
        """Warn when the problem is a new one."""
        self._problems.add(problem)
        if problem not in self._said:
            self._warn(f"follower {self.id}: {problem}")


class StarFollower(Follower):
    """A follower that listens to the leader alone, as XTDrone's plain follower does."""

    def neighbours(self) -> Mapping[int, float]:
        """Return the leader."""
        return {0: 1.0}


def rows_of(value: ArrayLike, count: int) -> NDArray[np.float64] | None:
    """Return ``value`` as an array of shape (count, 3), None if it is not that."""
    try:
        rows = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return rows if rows.shape == (count, 3) else None


def slots_of(offsets: ArrayLike, count: int) -> list[Vector]:
    """Return the slots of all ``count`` vehicles, the leader's own zero first, for those of the followers.

    Raises:
        PatternError: another size than (count-1, 3), not finite, or slots too close to each other.
    """
    checked = check_offsets(offsets, count, "formation pattern")
    return [(x, y, z) for x, y, z in with_leader(checked).tolist()]


def weights_in(row: NDArray[np.float64]) -> dict[int, float]:
    """Return the weights that are not zero in a row of a checked adjacency matrix, by their column."""
    columns = np.flatnonzero(row)
    return dict(zip(columns.tolist(), row[columns].tolist(), strict=True))


def check_choice(name: str, value: object, allowed: Sequence[str]) -> None:
    """Raise ValueError unless ``value`` is one of ``allowed``."""
    if value not in allowed:
        raise ValueError(f"{name}: {value!r} is not allowed, one of {', '.join(allowed)}")


def check_number(name: str, value: object, *, zero: bool = False) -> None:
    """Raise ValueError unless ``value`` is a finite number above 0 (or 0 too)."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name}: {value!r} is not a finite number")
    if value < 0 or (value == 0 and not zero):
        raise ValueError(f"{name}: {value} is not allowed, {'0 or more' if zero else 'above 0'}")
