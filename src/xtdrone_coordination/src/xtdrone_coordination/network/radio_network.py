"""Range, delay, loss and bandwidth of the radios of a swarm.

In every turn of the control loop each vehicle broadcasts its position and velocity, its *sample* of that turn. A sample
may be delayed, lost or not sent at all; a vehicle knows the newest received sample of each other one. A follower uses
this knowledge as its ``swarm``, so any subclass of :class:`~xtdrone_coordination.follower.Follower` runs unchanged::

    network = Network(9, NetworkOptions(range=20.0, delay=0.1, loss=0.3), seed=4)
    followers = [Follower(i, 9, swarm=network.known(i)) for i in range(1, 9)]
    ...
    network.step(positions, velocities)             # once a turn, 30 Hz
    commands = [follower.update() for follower in followers]

The leader's pattern and topology are not modelled: they reach all vehicles at once, as over a separate link with
acknowledgements.

All random draws are functions of seed, turn, sender and receiver, so results do not depend on the order of queries.
Results are computed on demand: a turn costs of the order of N, and a query of the order of its result. Of the order of
N^2 are ``known(i).positions`` of all vehicles, each a list of N, and the sharing of a finite ``bandwidth`` when most
vehicles are within range of most others.

An ideal network needs no object of this class: :func:`make_network` then returns None.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xtdrone_control.network import channel
from xtdrone_control.network.network_options import RATE, NetworkOptions, transition_probabilities
from xtdrone_coordination.known_swarm_state import SwarmState, as_vector
from xtdrone_coordination.laws.consensus import Vector
from xtdrone_coordination.laws.topology import check_adjacency

from . import near_vehicles

_State = tuple[Vector | None, Vector | None, int]
_FEW = 12  # vehicles: up to this number, single look-ups are as fast as one of all


class Samples(NamedTuple):
    """Received states of vehicles, one row each.

    Attributes:
        positions: shape (E, 3), m ENU; NaN where unknown.
        velocities: shape (E, 3), m/s ENU; NaN where unknown.
        came: turn of reception, -1 where unknown.
    """

    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    came: NDArray[np.int64]


class Near(NamedTuple):
    """The vehicles known to be near each vehicle.

    Attributes:
        start: index of the first entry of each vehicle, shape (N + 1,).
        others: numbers of the other vehicles, ascending for each vehicle.
        positions: their received positions, shape (E, 3), m ENU.
    """

    start: NDArray[np.int64]
    others: NDArray[np.int64]
    positions: NDArray[np.float64]


class Network:
    """The radios of N vehicles.

    Attributes:
        count: number of vehicles N.
        options: the settings.
        seed: Seed of all random draws.
        turn: number of the current turn, from 0; -1 before the first.
        air: the state in arrays, for the kernels.
    """

    def __init__(self, count: int, options: NetworkOptions | None = None, seed: int = 0) -> None:
        """Create a network before the first turn.

        Args:
            count: number of vehicles N, at least 1.
            options: settings; by default an ideal network.
            seed: 0 or more.

        Raises:
            ValueError: ``count`` or ``seed`` is out of range.
        """
        if count < 1:
            raise ValueError(f"network: {count} vehicles are not allowed, 1 or more")
        if seed < 0:
            raise ValueError(f"network seed: {seed} is not allowed, 0 or more")
        self.count = count
        self.options = options or NetworkOptions()
        self.seed = seed
        self._known = [KnownSwarm(self, i) for i in range(count)]
        self._start()

    def _start(self) -> None:
        options, count = self.options, self.count
        memory = math.ceil(options.memory * RATE)
        rows = memory + math.ceil((options.delay + options.jitter) * RATE) + options.queue + 2
        seed = np.random.SeedSequence(self.seed).generate_state(1, np.uint64)[0]
        fail, recover = transition_probabilities(options)
        self.air = channel.Air(
            position=np.full((rows, count, 3), np.nan),
            velocity=np.full((rows, count, 3), np.nan),
            sent=np.full((rows, count), channel.NEVER),
            travel=np.zeros(rows),
            since=np.zeros(count, dtype=np.int64),
            own=np.full(count, channel.NEVER),
            turn=np.full(1, -1),
            seed=seed,
            range=float(options.range),
            delay=float(options.delay * RATE),
            jitter=float(options.jitter * RATE),
            memory=memory,
            loss=float(options.loss),
            fail=fail,
            recover=recover,
        )
        self.turn = -1
        self._made = np.zeros((rows, count), dtype=np.bool_)
        self._crowd = np.ones(count)
        self._credit = np.array([-channel.draw(seed, channel.PHASE, 0, j, j) for j in range(count)])
        self._head = np.zeros(count, dtype=np.int64)

    def restart(self) -> None:
        """Reset to the initial state; the same random draws follow."""
        self._start()
        for known in self._known:
            known.drop()

    def step(self, positions: ArrayLike, velocities: ArrayLike) -> None:
        """Begin a turn: all vehicles send new samples, and due samples arrive.

        Args:
            positions: shape (N, 3), m ENU; a vehicle whose row is not finite has no sample in this turn.
            velocities: shape (N, 3), m/s ENU; where a row is not finite, the last finite one is sent.

        Raises:
            ValueError: another shape.
        """
        x = self._check("positions", positions)
        v = self._check("velocities", velocities)
        channel.begin_turn(self.air, x, v, self._made)
        self.turn = turn = int(self.air.turn[0])
        sent = self.air.sent[turn % len(self.air.sent)]
        if self.options.bandwidth == math.inf:
            channel.send_everything(self._made, turn, sent)
            return
        messages = self.options.bandwidth / RATE / self.options.message_bits
        near_vehicles.crowds(x, self.air.range, self._crowd)
        channel.send(self._made, turn, self.options.queue, messages, self._crowd, self._credit, self._head, sent)

    def known(self, index: int) -> KnownSwarm:
        """Return the state of the swarm as known to a vehicle, always of the current turn.

        Raises:
            ValueError: the number is out of range.
        """
        if not 0 <= index < self.count:
            raise ValueError(f"network: vehicle {index} does not exist, 0 to {self.count - 1}")
        return self._known[index]

    def samples(self, receivers: NDArray[np.int64], senders: NDArray[np.int64]) -> Samples:
        """Return the state of each of ``senders`` as known to its receiver; numbers, both of shape (E,).

        Raises:
            ValueError: a number is out of range, or the shapes differ.
        """
        size = len(receivers)
        if len(senders) != size:
            raise ValueError(f"network: {size} receivers and {len(senders)} senders, there must be as many of either")
        for numbers in (receivers, senders):
            if size and not 0 <= numbers.min() <= numbers.max() < self.count:
                raise ValueError(
                    f"network: vehicle {_stranger(numbers, self.count)} does not exist, 0 to {self.count - 1}"
                )
        result = Samples(np.empty((size, 3)), np.empty((size, 3)), np.empty(size, dtype=np.int64))
        channel.samples(self.air, receivers, senders, *result)
        return result

    def samples_of_all(self, index: int) -> Samples:
        """Return the states of all vehicles, itself included, as known to one vehicle, in order of their numbers."""
        result = Samples(np.empty((self.count, 3)), np.empty((self.count, 3)), np.empty(self.count, dtype=np.int64))
        channel.samples_of_all(self.air, index, *result)
        return result

    def look_up(self, receivers: NDArray[np.int64], senders: NDArray[np.int64]) -> None:
        """Look up the states of ``senders`` as known to ``receivers`` together, to speed up later single look-ups."""
        positions, velocities, came = self.samples(receivers, senders)
        rows = zip(_vectors(positions), _vectors(velocities), came.tolist(), strict=True)
        for i, j, state in zip(receivers.tolist(), senders.tolist(), rows, strict=True):
            self._known[i].take(j, state)

    def near(self, radius: float) -> Near:
        """Return the vehicles known to be less than ``radius`` m from each vehicle, with their received positions."""
        return Near(*near_vehicles.near(self.air, float(radius)))

    def forget(self, index: int) -> None:
        """Drop all states known to a vehicle, its own included, until the next turn."""
        self.air.since[index] = self.turn + 1
        self._known[index].drop()

    def unreachable(self, adjacency: ArrayLike | tuple[NDArray[np.int64], NDArray[np.int64]]) -> list[int]:
        """Return the vehicles without a path from the leader along links of the topology that are in range now.

        Args:
            adjacency: shape (N, N), or, to avoid work of the order of N^2, its links as returned by ``np.nonzero``:
                receivers and senders.

        Returns:
            Numbers of the vehicles, ascending; includes those of unknown position, and all if the loss is 1.

        Raises:
            ValueError: see :func:`~xtdrone_coordination.laws.topology.check_adjacency`.
        """
        links = adjacency if isinstance(adjacency, tuple) else np.nonzero(check_adjacency(adjacency, self.count))
        reached = np.zeros(self.count, dtype=np.bool_)
        points = self.air.position[self.turn % len(self.air.position)]
        if self.options.loss < 1.0:
            near_vehicles.reached(links[0], links[1], points, self.options.range**2, reached)
        reached[0] = True
        return [int(i) for i in np.flatnonzero(~reached)]

    def _check(self, name: str, values: ArrayLike) -> NDArray[np.float64]:
        array = np.ascontiguousarray(values, dtype=float)
        if array.shape != (self.count, 3):
            raise ValueError(f"network {name}: shape {array.shape} is not allowed, ({self.count}, 3)")
        return array


class KnownSwarm(SwarmState):
    """State of the swarm as received by one vehicle over its network, used by a follower as its ``swarm``.

    It is always that of the current turn; :meth:`Network.step` updates it and counts the turns.

    Attributes:
        network: the network.
        index: the vehicle's number.
        positions: newest received position of each vehicle, m ENU; None where unknown. A sequence.
        velocities: velocity of each vehicle received with its position, m/s ENU; None where unknown.
    """

    def __init__(self, network: Network, index: int) -> None:
        """Create the state known to vehicle ``index`` of a network."""
        self.count = network.count
        self.network = network
        self.index = index
        self.positions = _Vectors(self, 0)  # type: ignore[assignment]
        self.velocities = _Vectors(self, 1)  # type: ignore[assignment]
        self._turn = -1
        self._read: dict[int, _State] = {}  # of single vehicles, in this turn
        self._samples: Samples | None = None  # of all vehicles, once requested

    @property
    def ticks(self) -> int:  # type: ignore[override]
        """The number of the network's current turn; -1 before the first."""
        return self.network.turn

    def samples(self) -> Samples:
        """Return the known states of all vehicles in order of their numbers."""
        self._look()
        if self._samples is None:
            self._samples = self.network.samples_of_all(self.index)
        return self._samples

    def sample(self, other: int) -> _State:
        """Return position and velocity (None if unknown) and turn of reception (-1) of one vehicle."""
        self._look()
        state = self._read.get(other)
        if state is None:
            state = self._read[other] = self._state(other)
        return state

    def take(self, other: int, state: _State) -> None:
        """Store a result of :meth:`sample` for the current turn."""
        self._look()
        self._read[other] = state

    def _state(self, other: int) -> _State:
        other = range(self.count)[other]  # negative numbers and errors as in a list
        if self._samples is None and len(self._read) < _FEW:
            position, velocity = np.empty(3), np.empty(3)
            came = channel.sample(self.network.air, self.index, other, position, velocity)
        else:
            samples = self.samples()
            position, velocity, came = samples.positions[other], samples.velocities[other], int(samples.came[other])
        return as_vector(position.tolist()), as_vector(velocity.tolist()), came

    def drop(self) -> None:
        """Discard all cached look-ups."""
        self._turn, self._read, self._samples = self.network.turn, {}, None

    def _look(self) -> None:
        """Discard cached look-ups of earlier turns."""
        if self._turn != self.network.turn:
            self.drop()

    def restart(self) -> None:
        """Drop all states until the next turn."""
        self.network.forget(self.index)

    def on_position(self, index: int, position: Vector) -> None:
        """Reject it: :meth:`Network.step` provides all states.

        Raises:
            TypeError: always.
        """
        raise TypeError(
            f"vehicle {self.index} receives the state of vehicle {index} over its network only: use Network.step"
        )

    def on_velocity(self, index: int, velocity: Vector) -> None:
        """Reject it, as :meth:`on_position`.

        Raises:
            TypeError: always.
        """
        self.on_position(index, velocity)

    def tick(self) -> None:
        """Do nothing: :meth:`Network.step` counts the turns."""

    def fresh(self, index: int, ticks: int) -> bool:
        """Return whether a new position of this vehicle was received in the last ``ticks`` turns."""
        _, _, came = self.sample(index)
        return came != channel.NEVER and self.network.turn - came <= ticks


class _Vectors(Sequence[Vector | None]):
    """The positions (column 0) or velocities (1) known to a vehicle, looked up on access."""

    def __init__(self, swarm: KnownSwarm, column: Literal[0, 1]) -> None:
        self._swarm = swarm
        self._column = column

    def __len__(self) -> int:
        return self._swarm.count

    @overload
    def __getitem__(self, index: int) -> Vector | None: ...

    @overload
    def __getitem__(self, index: slice) -> list[Vector | None]: ...

    def __getitem__(self, index: int | slice) -> Vector | list[Vector | None] | None:
        if isinstance(index, slice):
            return _vectors(self._swarm.samples()[self._column][index])
        return self._swarm.sample(index)[self._column]

    def __iter__(self) -> Iterator[Vector | None]:
        return iter(self[:])


def make_network(count: int, options: NetworkOptions | None, seed: int = 0) -> Network | None:
    """Return a network of ``count`` vehicles; None without options or if they are those of an ideal network."""
    return None if options is None or options.ideal else Network(count, options, seed)


def _stranger(numbers: NDArray[np.int64], count: int) -> int:
    """Return the first number out of the range 0 to count - 1."""
    return int(numbers[(numbers < 0) | (numbers >= count)][0])


def _vectors(array: NDArray[np.float64]) -> list[Vector | None]:
    """Return the rows as tuples, None where one is not finite."""
    rows: list[Vector | None] = [(x, y, z) for x, y, z in array.tolist()]
    for j in np.flatnonzero(~np.isfinite(array[:, 0])):
        rows[j] = None
    return rows
