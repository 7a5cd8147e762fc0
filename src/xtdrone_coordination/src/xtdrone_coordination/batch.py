"""All followers of a process computed together, to the last bit as each would be by itself.

What a class leaves as it is (:class:`Follower`'s control law, neighbours, avoidance) is computed for all at once by
compiled kernels; a method that a subclass overrides is called for each of its followers, and the rest is still the
kernels'. A law in arrays (:meth:`Follower.control_laws`) is called once for all followers that have the same class and
options. A subclass that reaches deeper, as into :meth:`Follower.update`, is updated by itself, and works as well.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xtdrone_coordination import kernels
from xtdrone_coordination.consensus import Vector
from xtdrone_coordination.follower import (
    STOPPED,
    Follower,
    FollowerOptions,
    StarFollower,
    rows_of,
    slots_of,
    weights_in,
)
from xtdrone_coordination.network import Near, Network
from xtdrone_coordination.rows import OwnRows, PeerRows
from xtdrone_coordination.swarm import NEVER, ArraySwarm
from xtdrone_coordination.topology import check_adjacency


class FollowerBatch:
    """The followers of one process.

    ``offsets``, ``weights`` and ``options`` of a follower may be replaced at any time, by its own methods too, but not
    changed in place. A method that is given to one follower alone (``follower.avoidance = ...``) counts too, as long as
    it is not replaced by another later.

    Attributes:
        followers: as they were given.
        swarm: what they know; None with a network.
        network: what brings each of them what it knows; None without one.
    """

    def __init__(
        self, followers: Sequence[Follower], swarm: ArraySwarm | None = None, *, network: Network | None = None
    ) -> None:
        """Take followers that have the same state of the swarm, or each what a network brings to its vehicle.

        Args:
            followers: at least one, with different numbers.
            swarm: the state of the swarm that all of them have as theirs.
            network: in its place, one of which each follower has its ``known`` as its ``swarm``.

        Raises:
            ValueError: no followers, a number twice, or a follower that has another swarm; not one of ``swarm`` and
                ``network``.
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
        self._look_at_all()

    def _look_at_all(self) -> None:
        """Take what the followers are: their classes, methods and options, and what they know of the formation."""
        self._sizes = [len(vars(follower)) for follower in self.followers]
        self._options = [follower.options for follower in self.followers]
        self._whole = [follower for follower in self.followers if _reaches_deep(follower)]
        self._rows = [follower for follower in self.followers if not _reaches_deep(follower)]
        self._own = [_own_parts(follower) for follower in self._rows]
        self._asked = [k for k, own in enumerate(self._own) if own]
        self._listening = any("neighbours" in own for own in self._own)
        self._stars = [_is_star(follower) for follower in self._rows]
        self._laws = _groups_of_laws(self._rows)
        self._make_arrays()
        self._pick_up()

    def _make_arrays(self) -> None:
        count, rows = self._count, len(self._rows)
        self._kinds = np.zeros((rows, kernels.KINDS), dtype=np.int64)
        self._settings = np.zeros((rows, kernels.SETTINGS))
        for k in range(rows):
            self._take_settings(k)
        self._radio: Near | None = None
        looking = self._kinds[:, [kernels.OWN_AVOIDANCE, kernels.GIVE_WAY]].any(axis=1)
        self._widest = float(self._settings[looking, kernels.RADIUS].max(initial=0.0))
        self._cells = np.zeros((count, 5), dtype=np.int32)
        self._table = np.zeros(1 << (4 * count).bit_length(), dtype=np.int32)
        self._notes = np.zeros((kernels.NOTES, rows), dtype=np.int64)
        self._vectors = np.zeros((2, rows, 3))
        self._commands = np.zeros((count, 3))
        self._given = np.zeros(count, dtype=bool)
        self._useless: dict[int, Any] = {}  # what a law in arrays gave in place of numbers, for each row

    def _take_settings(self, k: int) -> None:
        """Write a row's class and options where the kernels take them."""
        follower, own = self._rows[k], self._own[k]
        options, kinds = follower.options, self._kinds[k]
        kinds[kernels.ID] = follower.id
        kinds[kernels.ACCEL] = options.mode == "accel"
        kinds[kernels.NORMALISE] = not options.raw_weights
        kinds[kernels.OWN_AVOIDANCE] = options.avoid == "own" and "avoidance" not in own
        kinds[kernels.GIVE_WAY] = options.avoid != "off" and options.mode == "vel" and options.clearance > 0.0
        kinds[kernels.OWN_LAW] = "control_law" not in own
        kinds[kernels.TIMEOUT] = follower._timeout
        kinds[kernels.ASKED] = bool(own)
        self._settings[k] = (
            options.Kp,
            follower._gamma,
            options.limit,
            options.Kp_avoid,
            options.avoid_radius,
            options.clearance,
        )

    # inputs

    def on_pattern(self, offsets: ArrayLike) -> None:
        """Give all followers their slots in order of their numbers, shape (N-1, 3), m ENU from the leader.

        Raises:
            PatternError: another size, not finite, or slots too close to each other.
        """
        slots = slots_of(offsets, self._count)
        for follower in self.followers:
            if _overrides(follower, "on_pattern"):
                follower.on_pattern(offsets)
            else:
                follower.offsets = slots

    def on_topology(self, adjacency: ArrayLike) -> None:
        """Give all followers the adjacency matrix, shape (N, N) or its values row by row.

        Raises:
            ValueError: another size, negative weights, or a vehicle that listens to itself.
        """
        matrix = check_adjacency(adjacency, self._count)
        for follower in self.followers:
            if _overrides(follower, "on_topology"):
                follower.on_topology(adjacency)
            else:
                follower.weights = weights_in(matrix[follower.id])

    def restart(self) -> None:
        """Let all followers know nothing again, nor does the swarm; of a network, until something comes again."""
        for follower in self.followers:
            follower.restart()

    # output

    def update(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return what to command now, as :meth:`Follower.update` of each says.

        Returns:
            Commands, shape (N, 3), m/s or m/s^2 ENU; and for whom there is one, shape (N,). Both are overwritten by
            the next update.
        """
        self._notice_changes()
        phases = kernels.ALL
        if self._asked:
            self._run(kernels.SENSE)
            self._ask()
            phases -= kernels.SENSE
        if self._laws:
            self._run(phases - kernels.COMMAND)
            for (cls, options), rows in self._laws.items():
                self._apply_laws(cls, options, rows)
            phases = kernels.COMMAND
        reported = self._run(phases)
        if reported:
            self._report(self._notes[kernels.REPORTED, :reported].tolist())
        for follower in self._whole:
            command = follower.update()
            self._given[follower.id] = command is not None
            self._commands[follower.id] = (0.0, 0.0, 0.0) if command is None else command
        return self._commands, self._given

    def commands(self) -> list[Vector | None]:
        """Return what each follower commands now, as a list of what their :meth:`Follower.update` gives."""
        commands, given = (array.tolist() for array in self.update())
        return [tuple(commands[follower.id]) if given[follower.id] else None for follower in self.followers]

    def _run(self, phases: int) -> int:
        state, network = self._state, self.network
        if network is not None and phases & kernels.SENSE:
            self._radio = network.near(self._widest)
        return kernels.turn(
            phases,
            self._now,
            state.position_rows,
            state.velocity_rows,
            state.heard,
            self._kinds,
            self._settings,
            self._slots,
            self._start,
            self._peer,
            self._weight,
            self._cells,
            self._table,
            self._notes,
            self._vectors,
            self._commands,
            self._given,
            None if network is None else network.air,
            self._radio,
        )

    def _ask(self) -> None:
        """Call what subclasses override, for one follower after the other, and put it where the kernels take it."""
        if self.network is not None:
            self.network.look_up(*self._links)
        status = self._notes[kernels.STATUS].tolist()
        avoidance = self._vectors[0].tolist()
        for k in self._asked:
            if status[k] != kernels.READY:
                continue
            follower, own = self._rows[k], self._own[k]
            before = follower.options
            follower._said, follower._problems = follower._problems, set()
            if "avoidance" in own:
                self._vectors[0, k] = follower.avoidance_vector = follower._checked(follower.avoidance(), "avoidance")
            else:
                x, y, z = avoidance[k]
                follower.avoidance_vector = (x, y, z)
            if "control_law" in own:
                position, offsets = follower.swarm.positions[follower.id], follower.offsets
                assert position is not None
                assert offsets is not None
                self._vectors[1, k] = follower._wanted(position, offsets)
            elif "neighbours" in own:
                self._mappings[k] = follower.neighbours()
            if follower.options is not before:  # what comes after its law is by the new ones, as it would be by itself
                self._take_settings(k)
                self._table[0] = kernels.ALL_PAIRS
        if self._listening:
            self._take_mappings()

    def _apply_laws(self, cls: type[Follower], options: FollowerOptions, rows: NDArray[np.int64]) -> None:
        """Put what a class's law in arrays gives in place of the stock law's results."""
        listening = (self._notes[kernels.STATUS, rows] == kernels.READY) & (
            self._notes[kernels.PROBLEMS, rows] & kernels.ALONE == 0
        )
        rows = rows[listening]
        if not len(rows):
            return
        own, peers = self._own_rows(rows), self._peer_rows(rows)
        given = cls.control_laws(options, own, peers)
        result = rows_of(given, len(rows))
        if result is None:
            self._vectors[1, rows] = np.nan
            for k in rows.tolist():
                self._useless[k] = given
        else:
            self._vectors[1, rows] = result

    def _own_rows(self, rows: NDArray[np.int64]) -> OwnRows:
        ids, slots = self._kinds[rows, kernels.ID], self._kinds[rows, kernels.SLOTS]
        position, velocity, _ = self._known(ids, ids)
        return OwnRows(ids, position, velocity, self._slots[slots, ids], self._vectors[1, rows])

    def _peer_rows(self, rows: NDArray[np.int64]) -> PeerRows:
        sizes = self._start[rows + 1] - self._start[rows]
        row = np.repeat(np.arange(len(rows)), sizes)
        links = np.arange(len(row)) + np.repeat(self._start[rows] - np.cumsum(sizes) + sizes, sizes)
        others, listeners = self._peer[links], rows[row]
        position, velocity, heard = self._known(self._kinds[listeners, kernels.ID], others)
        fresh = (heard != NEVER) & (self._now - heard <= self._kinds[listeners, kernels.TIMEOUT])
        offset = self._slots[self._kinds[listeners, kernels.SLOTS], others]
        return PeerRows(*(array[fresh] for array in (row, others, self._weight[links], position, velocity, offset)))

    def _known(
        self, listeners: NDArray[np.int64], others: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Return positions, velocities and ticks of arrival of what each listener knows of its counterpart."""
        if self.network is None:
            state = self._state
            return state.position_rows[others], state.velocity_rows[others], state.heard[others]
        samples = self.network.samples(listeners, others)
        return samples.positions, np.where(np.isnan(samples.velocities), 0.0, samples.velocities), samples.came

    @property
    def _now(self) -> int:
        return self._state.ticks if self.network is None else self.network.turn

    def _report(self, rows: Sequence[int]) -> None:
        """Give followers their new avoidance and let them say what is wrong, as their own update would."""
        signatures = self._notes[kernels.PROBLEMS].tolist()
        avoidance = self._vectors[0].tolist()
        for k in rows:
            follower, problems = self._rows[k], signatures[k]
            asked, stopped = bool(self._own[k]), bool(problems & kernels.HAS_STOPPED)
            if not asked and not stopped:
                x, y, z = avoidance[k]
                follower.avoidance_vector = (x, y, z)
            if stopped or not asked:
                follower._said, follower._problems = follower._problems, set()
            if stopped:
                follower._tell(STOPPED)
            if problems & kernels.SILENT:
                silent = [j for j in self._mappings[k] if not follower.swarm.fresh(j, follower._timeout)]
                follower._tell_silent(silent, alone=bool(problems & kernels.ALONE))
            if problems & kernels.BAD_LAW:
                name = "control_laws" if type(follower)._in_arrays else "control_law"
                follower._checked(self._useless.pop(k, tuple(self._vectors[1, k].tolist())), name)

    def _pick_up(self) -> None:
        """Take what the followers know of pattern and topology."""
        self._take_offsets([follower.offsets for follower in self._rows])
        self._take_weights([follower.weights for follower in self._rows])

    def _notice_changes(self) -> None:
        """Take what was replaced in a follower since the last update."""
        options = [follower.options for follower in self.followers]
        sizes = [len(vars(follower)) for follower in self.followers]  # with a method of its own a follower has more
        if sizes != self._sizes or not all(map(operator.is_, options, self._options)):
            self._look_at_all()
            return
        offsets = [follower.offsets for follower in self._rows]
        if not all(map(operator.is_, offsets, self._offsets)):
            self._take_offsets(offsets)
        weights = [follower.weights for follower in self._rows]
        if not all(map(operator.is_, weights, self._weights)):
            self._take_weights(weights)

    def _take_offsets(self, offsets: list[list[Vector] | None]) -> None:
        self._offsets = offsets  # keeps them alive, so that their addresses stay theirs
        tables = {id(table): table for table in offsets if table is not None}
        numbers = {address: number for number, address in enumerate(tables)}
        self._slots = np.array(list(tables.values()), dtype=float).reshape(-1, self._count, 3)
        self._kinds[:, kernels.SLOTS] = [numbers.get(id(table), -1) for table in offsets]
        # They may have been restarted: let them have their avoidance, and say their problems, as if for the first time.
        self._notes[kernels.PROBLEMS_BEFORE] = -1
        self._vectors[0, self._kinds[:, kernels.OWN_AVOIDANCE] == 1] = np.nan

    def _take_weights(self, weights: list[Mapping[int, float]]) -> None:
        self._weights = weights
        self._mappings = [_STAR if star else row for star, row in zip(self._stars, weights, strict=True)]
        self._take_mappings()

    def _take_mappings(self) -> None:
        """Put whom each row listens to one after the other into arrays."""
        self._start = np.zeros(len(self._mappings) + 1, dtype=np.int64)
        np.cumsum([len(row) for row in self._mappings], out=self._start[1:])
        self._peer = np.fromiter(chain.from_iterable(self._mappings), np.int64)
        self._weight = np.fromiter(chain.from_iterable(row.values() for row in self._mappings), np.float64)
        wrong = (self._peer < 0) | (self._peer >= self._count)
        if wrong.any():
            raise IndexError(
                f"weights: vehicle {self._peer[wrong][0]} is not allowed, 0 to {self._count - 1} are there"
            )
        self._links = self._asked_links()

    def _asked_links(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return what the laws of subclasses look up: who, and whom; themselves, and those that they listen to."""
        ids, asked, lengths = self._kinds[:, kernels.ID], self._kinds[:, kernels.ASKED] == 1, np.diff(self._start)
        listening = np.repeat(asked, lengths)
        listeners = np.repeat(ids, lengths)[listening]
        return np.concatenate((ids[asked], listeners)), np.concatenate((ids[asked], self._peer[listening]))


_PARTS = ("avoidance", "neighbours", "control_law")
_DEEPER = ("update", "_limited", "_wanted", "_law_of_one", "_peers", "_checked", "_tell", "_tell_silent")
_DATA = ("offsets", "weights", "avoidance_vector", "options", "swarm", "id")
_STAR: Mapping[int, float] = {0: 1.0}


def _state_of(followers: Sequence[Follower], swarm: ArraySwarm | None, network: Network | None) -> ArraySwarm:
    """Return where the kernels find what a follower knows; with a network, it is written anew for each of them."""
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
    """Return whether a method is another one than Follower's, by its class or by assignment to the object."""
    return getattr(getattr(follower, name), "__func__", None) is not getattr(Follower, name)


def _flies_by_arrays(follower: Follower) -> bool:
    """Return whether its class has a law in arrays, and nobody gave this follower another law."""
    return type(follower)._in_arrays and "control_law" not in vars(follower)


def _groups_of_laws(rows: Sequence[Follower]) -> dict[tuple[type[Follower], FollowerOptions], NDArray[np.int64]]:
    """Return the rows that fly by a law in arrays, by class and options."""
    groups: dict[tuple[type[Follower], FollowerOptions], list[int]] = {}
    for k, follower in enumerate(rows):
        if _flies_by_arrays(follower):
            groups.setdefault((type(follower), follower.options), []).append(k)
    return {key: np.array(numbers) for key, numbers in groups.items()}


def _is_star(follower: Follower) -> bool:
    return getattr(follower.neighbours, "__func__", None) is StarFollower.neighbours


def _own_parts(follower: Follower) -> frozenset[str]:
    """Return which of the methods made to be overridden must be called for this follower."""
    own = {name for name in _PARTS if _overrides(follower, name)}
    if _flies_by_arrays(follower):
        own.discard("control_law")
    if _is_star(follower):
        own.discard("neighbours")
    if follower.options.avoid == "topic":
        own.add("avoidance")  # it comes one by one
    return frozenset(own)


def _reaches_deep(follower: Follower) -> bool:
    """Return whether more is overridden than is made for it, so that only the follower itself knows what it does."""
    return any(_overrides(follower, name) for name in _DEEPER) or any(hasattr(type(follower), name) for name in _DATA)
