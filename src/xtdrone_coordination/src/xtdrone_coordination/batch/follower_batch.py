"""All followers of a process computed together, bit-identical to each computed alone.

Methods that a class inherits unchanged (control law, neighbours, avoidance of :class:`Follower`) are computed for all
followers by compiled kernels; an overridden method is called for each of its followers, and the rest remains with the
kernels. The law of an :class:`ArrayFollower` is called once for all followers of the same class and options. A subclass
that overrides more, such as :meth:`Follower.update`, is updated on its own.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xtdrone_coordination.array_follower import ArrayFollower, OwnRows, PeerRows, as_rows
from xtdrone_coordination.follower import STOPPED, Follower, FollowerOptions, StarFollower
from xtdrone_coordination.known_swarm_state import NEVER, ArraySwarm
from xtdrone_coordination.laws.consensus import Vector
from xtdrone_coordination.laws.topology import check_adjacency, weights_of_row
from xtdrone_coordination.network import Near, Network
from xtdrone_coordination.patterns.slot_offsets_and_spacing import slots_of_all

from . import turn_kernels
from .neighbourhood import UNUSABLE, make_grid

_OVERRIDABLE = ("avoidance", "neighbours", "control_law")
_INTERNAL = (
    "update",
    "law_output",
    "evaluate_law",
    "checked_vector",
    "report_missing",
    "_known_peers",
    "_limit",
)
_ATTRIBUTES = ("offsets", "weights", "avoidance_vector", "options", "swarm", "id")
_STAR: Mapping[int, float] = {0: 1.0}


class FollowerBatch:
    """The followers of one process.

    ``offsets``, ``weights`` and ``options`` of a follower may be replaced at any time, also by its own methods, but not
    changed in place. A method assigned to a single follower (``follower.avoidance = ...``) is respected, unless it is
    later replaced by another one.

    Attributes:
        followers: the followers, in the given order.
        swarm: their common state of the swarm; None with a network.
        network: provides each follower's state of the swarm; None without one.
    """

    def __init__(
        self, followers: Sequence[Follower], swarm: ArraySwarm | None = None, *, network: Network | None = None
    ) -> None:
        """Create a batch of followers that share one state of the swarm, or receive it over a network.

        Args:
            followers: Followers, at least one, with different numbers.
            swarm: the ``swarm`` of all followers.
            network: instead of it, a network whose ``known`` is the ``swarm`` of each follower.

        Raises:
            ValueError: no followers, duplicate numbers, or a follower with another swarm; both or neither of ``swarm``
                and ``network``.
        """
        if not followers:
            raise ValueError("followers: none given, at least one is needed")
        ids = [follower.id for follower in followers]
        if len(set(ids)) != len(ids):
            raise ValueError(f"followers: numbers {ids} are not all different")
        self._state = _state_of(followers, swarm, network)
        self._count = self._state.count
        self.followers = tuple(followers)
        self.swarm = swarm
        self.network = network
        self._classify()

    def _classify(self) -> None:
        """Determine for each follower what is computed by kernels and what by its own methods."""
        self._sizes = [len(vars(follower)) for follower in self.followers]
        self._options = [follower.options for follower in self.followers]
        self._alone = [follower for follower in self.followers if _overrides_internals(follower)]
        self._rows = [follower for follower in self.followers if not _overrides_internals(follower)]
        self._own = [_own_methods(follower) for follower in self._rows]
        self._overridden = [k for k, own in enumerate(self._own) if own]
        self._own_neighbours = any("neighbours" in own for own in self._own)
        self._stars = [_is_star(follower) for follower in self._rows]
        self._laws = _groups_of_laws(self._rows)
        self._allocate()
        self._read_offsets([follower.offsets for follower in self._rows])
        self._read_weights([follower.weights for follower in self._rows])

    def _allocate(self) -> None:
        """Create the arrays of the kernels."""
        rows = len(self._rows)
        self._records = np.zeros(rows, dtype=turn_kernels.FOLLOWER)
        self._states = np.zeros(rows, dtype=turn_kernels.STATE)
        self._reported = np.zeros(rows, dtype=np.int64)
        for k in range(rows):
            self._read_settings(k)
        self._radio: Near | None = None
        searching = self._records["stock_avoidance"] | self._records["gives_way"]
        self._widest = float(self._records["radius"][searching].max(initial=0.0))
        self._grid, self._buckets = make_grid(self._count)
        self._commands = np.zeros((self._count, 3))
        self._given = np.zeros(self._count, dtype=bool)
        self._rejected: dict[int, Any] = {}  # results of array laws that are not arrays of numbers, by row

    def _read_settings(self, k: int) -> None:
        """Copy class and options of a follower to its record."""
        follower, own, record = self._rows[k], self._own[k], self._records[k]
        options = follower.options
        record["id"] = follower.id
        record["timeout"] = options.timeout_ticks
        record["gain"] = options.Kp
        record["damping"] = options.damping
        record["limit"] = options.limit
        record["avoidance_gain"] = options.Kp_avoid
        record["radius"] = options.avoid_radius
        record["clearance"] = options.clearance
        record["acceleration_form"] = options.mode == "accel"
        record["normalise"] = not options.raw_weights
        record["stock_law"] = "control_law" not in own
        record["stock_avoidance"] = options.avoid == "own" and "avoidance" not in own
        record["gives_way"] = options.avoid != "off" and options.mode == "vel" and options.clearance > 0.0
        record["overridden"] = bool(own)

    # inputs

    def on_pattern(self, offsets: ArrayLike) -> None:
        """Store the slots of all followers in order of their numbers, shape (N-1, 3), m ENU from the leader.

        Raises:
            PatternError: another size, not finite, or slots too close to each other.
        """
        slots = slots_of_all(offsets, self._count)
        for follower in self.followers:
            if _overrides(follower, "on_pattern"):
                follower.on_pattern(offsets)
            else:
                follower.offsets = slots

    def on_topology(self, adjacency: ArrayLike) -> None:
        """Store the adjacency matrix in all followers, shape (N, N) or its values row by row.

        Raises:
            ValueError: another size, negative weights, or a non-zero diagonal.
        """
        matrix = check_adjacency(adjacency, self._count)
        for follower in self.followers:
            if _overrides(follower, "on_topology"):
                follower.on_topology(adjacency)
            else:
                follower.weights = weights_of_row(matrix[follower.id])

    def restart(self) -> None:
        """Restart all followers, see :meth:`Follower.restart`."""
        for follower in self.followers:
            follower.restart()

    # output

    def update(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the commands of all followers, as :meth:`Follower.update` of each.

        Returns:
            Commands, shape (N, 3), m/s or m/s^2 ENU, and whether there is a command for each vehicle, shape (N,). Both
            are overwritten by the next update.
        """
        self._read_changes()
        phases = turn_kernels.ALL
        if self._overridden:
            self._run(turn_kernels.SENSE)
            self._call_own_methods()
            phases -= turn_kernels.SENSE
        if self._laws:
            self._run(phases - turn_kernels.COMMAND)
            for (cls, options), rows in self._laws.items():
                self._apply_laws(cls, options, rows)
            phases = turn_kernels.COMMAND
        reported = self._run(phases)
        if reported:
            self._report(self._reported[:reported].tolist())
        for follower in self._alone:
            command = follower.update()
            self._given[follower.id] = command is not None
            self._commands[follower.id] = (0.0, 0.0, 0.0) if command is None else command
        return self._commands, self._given

    def commands(self) -> list[Vector | None]:
        """Return the commands of the followers as a list of the results of :meth:`Follower.update`."""
        commands, given = (array.tolist() for array in self.update())
        return [tuple(commands[follower.id]) if given[follower.id] else None for follower in self.followers]

    def _run(self, phases: int) -> int:
        state, network = self._state, self.network
        if network is not None and phases & turn_kernels.SENSE:
            self._radio = network.near(self._widest)
        return turn_kernels.turn(
            phases,
            self._now,
            state.position_rows,
            state.velocity_rows,
            state.heard,
            self._records,
            self._states,
            self._links,
            self._slots,
            self._grid,
            self._buckets,
            self._commands,
            self._given,
            self._reported,
            None if network is None else network.air,
            self._radio,
        )

    def _call_own_methods(self) -> None:
        """Call the overridden methods of one follower after the other, and store their results for the kernels."""
        if self.network is not None:
            self.network.look_up(*self._queries)
        status = self._states["status"].tolist()
        avoidance = self._states["avoidance"].tolist()
        for k in self._overridden:
            if status[k] != turn_kernels.READY:
                continue
            follower, own, state = self._rows[k], self._own[k], self._states[k]
            options = follower.options
            follower.problem_log.begin_update()
            if "avoidance" in own:
                follower.avoidance_vector = follower.checked_vector(follower.avoidance(), "avoidance")
                state["avoidance"] = follower.avoidance_vector
            else:
                x, y, z = avoidance[k]
                follower.avoidance_vector = (x, y, z)
            if "control_law" in own:
                position, offsets = follower.swarm.positions[follower.id], follower.offsets
                assert position is not None
                assert offsets is not None
                state["law"] = follower.law_output(position, offsets)
            elif "neighbours" in own:
                self._mappings[k] = follower.neighbours()
            if follower.options is not options:  # the phases after its law use the new ones, as in Follower.update
                self._read_settings(k)
                self._buckets[0] = UNUSABLE
        if self._own_neighbours:
            self._make_links()

    def _apply_laws(self, cls: type[ArrayFollower], options: FollowerOptions, rows: NDArray[np.int64]) -> None:
        """Replace the stock law's results by those of a class's array law."""
        states = self._states[rows]
        rows = rows[(states["status"] == turn_kernels.READY) & (states["problems"] & turn_kernels.ALONE == 0)]
        if not len(rows):
            return
        result = cls.control_laws(options, self._own_rows(rows), self._peer_rows(rows))
        vectors = as_rows(result, len(rows))
        if vectors is None:
            self._states["law"][rows] = np.nan
            self._rejected.update((k, result) for k in rows.tolist())
        else:
            self._states["law"][rows] = vectors

    def _own_rows(self, rows: NDArray[np.int64]) -> OwnRows:
        ids, slots = self._records["id"][rows], self._records["slots"][rows]
        position, velocity, _ = self._known(ids, ids)
        return OwnRows(ids, position, velocity, self._slots[slots, ids], self._states["law"][rows])

    def _peer_rows(self, rows: NDArray[np.int64]) -> PeerRows:
        records = self._records[rows]
        first = records["first_link"]
        sizes = records["last_link"] - first
        row = np.repeat(np.arange(len(rows)), sizes)
        links = self._links[np.arange(len(row)) + np.repeat(first - np.cumsum(sizes) + sizes, sizes)]
        peers, listeners = links["peer"], records[row]
        position, velocity, heard = self._known(listeners["id"], peers)
        recent = (heard != NEVER) & (self._now - heard <= listeners["timeout"])
        offset = self._slots[listeners["slots"], peers]
        return PeerRows(*(array[recent] for array in (row, peers, links["weight"], position, velocity, offset)))

    def _known(
        self, listeners: NDArray[np.int64], others: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Return positions, velocities and ticks of reception of ``others`` as known to their listeners."""
        if self.network is None:
            state = self._state
            return state.position_rows[others], state.velocity_rows[others], state.heard[others]
        samples = self.network.samples(listeners, others)
        return samples.positions, np.where(np.isnan(samples.velocities), 0.0, samples.velocities), samples.came

    @property
    def _now(self) -> int:
        return self._state.ticks if self.network is None else self.network.turn

    def _report(self, rows: Sequence[int]) -> None:
        """Copy changed avoidance to the followers and report their problems, as their own update would."""
        all_problems = self._states["problems"].tolist()
        avoidance = self._states["avoidance"].tolist()
        for k in rows:
            follower, problems = self._rows[k], all_problems[k]
            overridden, stopped = bool(self._own[k]), bool(problems & turn_kernels.HAS_STOPPED)
            if not overridden and not stopped:
                x, y, z = avoidance[k]
                follower.avoidance_vector = (x, y, z)
            if stopped or not overridden:
                follower.problem_log.begin_update()
            if stopped:
                follower.problem_log.report(STOPPED)
            if problems & turn_kernels.MISSING:
                timeout = follower.options.timeout_ticks
                missing = [j for j in self._mappings[k] if not follower.swarm.fresh(j, timeout)]
                follower.report_missing(missing, alone=bool(problems & turn_kernels.ALONE))
            if problems & turn_kernels.BAD_LAW:
                name = "control_laws" if _flies_by_arrays(follower) else "control_law"
                follower.checked_vector(self._rejected.pop(k, tuple(self._states["law"][k].tolist())), name)

    # settings, pattern and topology of the followers, as arrays

    def _read_changes(self) -> None:
        """Copy the attributes of a follower that were replaced since the last update."""
        options = [follower.options for follower in self.followers]
        sizes = [len(vars(follower)) for follower in self.followers]  # a method assigned to a follower adds one
        if sizes != self._sizes or not all(map(operator.is_, options, self._options)):
            self._classify()
            return
        offsets = [follower.offsets for follower in self._rows]
        if not all(map(operator.is_, offsets, self._offsets)):
            self._read_offsets(offsets)
        weights = [follower.weights for follower in self._rows]
        if not all(map(operator.is_, weights, self._weights)):
            self._read_weights(weights)

    def _read_offsets(self, offsets: list[list[Vector] | None]) -> None:
        self._offsets = offsets  # keeps them alive, so that their addresses remain unique
        tables = {id(table): table for table in offsets if table is not None}
        numbers = {address: number for number, address in enumerate(tables)}
        self._slots = np.array(list(tables.values()), dtype=float).reshape(-1, self._count, 3)
        self._records["slots"] = [numbers.get(id(table), -1) for table in offsets]
        # The followers may have been restarted: avoidance and problems are reported again.
        self._states["previous_problems"] = -1
        self._states["avoidance"][self._records["stock_avoidance"]] = np.nan

    def _read_weights(self, weights: list[Mapping[int, float]]) -> None:
        self._weights = weights
        self._mappings = [_STAR if star else row for star, row in zip(self._stars, weights, strict=True)]
        self._make_links()

    def _make_links(self) -> None:
        """Store the neighbours of all rows as consecutive links."""
        bounds = np.zeros(len(self._mappings) + 1, dtype=np.int64)
        np.cumsum([len(row) for row in self._mappings], out=bounds[1:])
        self._records["first_link"], self._records["last_link"] = bounds[:-1], bounds[1:]
        links = np.zeros(bounds[-1], dtype=turn_kernels.LINK)
        links["peer"] = np.fromiter(chain.from_iterable(self._mappings), np.int64)
        links["weight"] = np.fromiter(chain.from_iterable(row.values() for row in self._mappings), np.float64)
        peers = links["peer"]
        wrong = (peers < 0) | (peers >= self._count)
        if wrong.any():
            raise IndexError(f"weights: vehicle {peers[wrong][0]} does not exist, 0 to {self._count - 1}")
        self._links = links
        self._queries = self._expected_queries()

    def _expected_queries(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return listeners and others of the states read by overridden methods: their own and their neighbours'."""
        records = self._records
        ids, overridden = records["id"], records["overridden"]
        lengths = records["last_link"] - records["first_link"]
        listening = np.repeat(overridden, lengths)
        listeners = np.repeat(ids, lengths)[listening]
        return (
            np.concatenate((ids[overridden], listeners)),
            np.concatenate((ids[overridden], self._links["peer"][listening])),
        )


def _state_of(followers: Sequence[Follower], swarm: ArraySwarm | None, network: Network | None) -> ArraySwarm:
    """Return the arrays in which the kernels find the swarm; with a network they are filled for each follower."""
    if (swarm is None) == (network is None):
        raise ValueError("followers: either a swarm or a network must be given")
    for follower in followers:
        if network is not None and follower.swarm is not network.known(follower.id):
            raise ValueError(
                f"follower {follower.id}: its swarm is not what the network brings to vehicle {follower.id}"
            )
        if swarm is not None and follower.swarm is not swarm:
            raise ValueError(f"follower {follower.id}: its swarm is not the one of the batch")
    if swarm is not None:
        return swarm
    assert network is not None
    return ArraySwarm(network.count)


def _overrides(follower: Follower, name: str) -> bool:
    """Return whether the class or the object itself overrides a method of Follower or ArrayFollower."""
    base = ArrayFollower if isinstance(follower, ArrayFollower) else Follower
    return getattr(getattr(follower, name), "__func__", None) is not getattr(base, name)


def _flies_by_arrays(follower: Follower) -> bool:
    return isinstance(follower, ArrayFollower) and "control_laws" in follower.law_forms


def _groups_of_laws(rows: Sequence[Follower]) -> dict[tuple[type[ArrayFollower], FollowerOptions], NDArray[np.int64]]:
    """Return the rows with a law in arrays, by class and options."""
    groups: dict[tuple[type[ArrayFollower], FollowerOptions], list[int]] = {}
    for k, follower in enumerate(rows):
        if isinstance(follower, ArrayFollower) and _flies_by_arrays(follower):
            groups.setdefault((type(follower), follower.options), []).append(k)
    return {key: np.array(numbers) for key, numbers in groups.items()}


def _is_star(follower: Follower) -> bool:
    return getattr(follower.neighbours, "__func__", None) is StarFollower.neighbours


def _own_methods(follower: Follower) -> frozenset[str]:
    """Return the overridable methods that must be called for this follower."""
    own = {name for name in _OVERRIDABLE if _overrides(follower, name)}
    if _flies_by_arrays(follower):
        own.discard("control_law")
    if _is_star(follower):
        own.discard("neighbours")
    if follower.options.avoid == "topic":
        own.add("avoidance")  # received per follower
    return frozenset(own)


def _overrides_internals(follower: Follower) -> bool:
    """Return whether methods or attributes not designed to be overridden are overridden."""
    return any(_overrides(follower, name) for name in _INTERNAL) or any(
        hasattr(type(follower), name) for name in _ATTRIBUTES
    )
