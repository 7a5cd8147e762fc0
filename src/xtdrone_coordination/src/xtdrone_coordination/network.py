"""What the vehicles of a swarm hear of each other: range, delay, loss and bandwidth of their radios.

In every turn of the control loop each vehicle tells everybody its position and velocity, its *sample* of that turn. On
the way to each other vehicle a sample can be too late, get lost or not be sent at all; what a vehicle knows of another
is the newest of its samples that has come. A follower gets that as its ``swarm``, so any class that inherits from
:class:`~xtdrone_coordination.follower.Follower` runs on it unchanged::

    network = Network(9, NetworkOptions(range=20.0, delay=0.1, loss=0.3), seed=4)
    followers = [Follower(i, 9, swarm=network.known(i)) for i in range(1, 9)]
    ...
    network.step(positions, velocities)             # once a turn, 30 Hz
    commands = [follower.update() for follower in followers]

The leader's pattern and topology are not modelled: they reach everybody at once, as by a link of their own with
acknowledgements.

All draws are functions of seed, turn, sender and receiver: whoever asks for what, in whatever order, gets the same.
What no one asks for is not computed; the work of a turn is of the order of N, and of a question of the order of what it
is about. Dense, that is of the order of N^2, are by their nature ``known(i).positions`` of all vehicles, as each is a
list of N, and the count of who shares the air, for a finite ``bandwidth``, when most vehicles are within range of most.

An ideal network needs no object of this class: :func:`make_network` then gives none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Literal, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xtdrone_coordination import network_kernels as kernels
from xtdrone_coordination.consensus import Vector
from xtdrone_coordination.follower import RATE
from xtdrone_coordination.swarm import SwarmState, as_vector
from xtdrone_coordination.topology import check_adjacency

MESSAGE_BITS = 320  # LOCAL_POSITION_NED in a MAVLink 2 frame: 28 bytes, and 12 around them

_LONGEST = 60.0  # s; keeps what has to be remembered within bounds
_MOST_WAITING = 1000
_State = tuple[Vector | None, Vector | None, int]
_FEW = 12  # vehicles: asking for so many one by one is as fast as asking for all


@dataclass(frozen=True)
class NetworkOptions:
    """How the vehicles hear each other; the defaults are an ideal network.

    Attributes:
        range: m, above 0; a sample comes to those who are not further away from the sender when it is sent.
        delay: s, 0 to 60, from sending to arrival; arrivals are at turns, so it is rounded up to those.
        jitter: s, 0 to 60; each message takes longer by a random time between 0 and this, evenly distributed.
        loss: probability that a message does not arrive, 0 to 1, for each receiver by itself.
        burst: mean time in s, 0 to 60, for which a link is out at a stretch: losses then come in bursts (Gilbert and
            Elliott's channel, where the bad state loses all and the good one nothing), at the same mean ``loss``. 0:
            each message is lost or not by itself.
        bandwidth: bit/s, above 0, that the air at any one place takes: a receiver never gets more than this on
            average since the start. It is shared by all within range of each other, since a swarm's vehicles send on
            one channel, which is what bounds a swarm's size; each sender takes the share that is left at the most
            crowded of its listeners, as with time slots that are dealt out evenly. Each vehicle starts at a random
            phase of its sending interval.
        message_bits: size of a sample on the air, bits, 1 or more.
        queue: how many samples may wait at a sender for the air, 1 to 1000. When it is full the oldest is dropped. So
            with 1 a vehicle sends what it knows newest, and with more it sends no more, but later. What goes out in
            one turn goes, and is lost, together.
        memory: s, above 0 and at most 60; what came longer ago than this is forgotten, as if never heard of; so a
            follower's ``pose_timeout`` beyond it makes no difference.
    """

    range: float = math.inf
    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    burst: float = 0.0
    bandwidth: float = math.inf
    message_bits: int = MESSAGE_BITS
    queue: int = 1
    memory: float = 2.0

    def __post_init__(self) -> None:
        """Refuse what makes no sense.

        Raises:
            ValueError: a setting is out of its range.
        """
        for name in ("range", "bandwidth"):
            _check(name, getattr(self, name), 0.0, math.inf, above=True)
        for name in ("delay", "jitter", "burst"):
            _check(name, getattr(self, name), 0.0, _LONGEST)
        _check("loss", self.loss, 0.0, 1.0)
        _check("memory", self.memory, 0.0, _LONGEST, above=True)
        _check_whole("message_bits", self.message_bits, math.inf)
        _check_whole("queue", self.queue, _MOST_WAITING)
        shortest = 1.0 / (RATE * (1.0 - self.loss)) if self.loss < 1.0 else 0.0
        if 0.0 < self.burst < shortest:
            raise ValueError(
                f"network burst: {self.burst} s is not allowed, 0 or at least {shortest:.4g} s: with a loss of "
                f"{self.loss} even independent losses last that long"
            )

    @property
    def ideal(self) -> bool:
        """Whether everything arrives everywhere at once."""
        return self.range == self.bandwidth == math.inf and self.delay == self.jitter == self.loss == 0.0


class Samples(NamedTuple):
    """What vehicles know of others, one row each.

    Attributes:
        positions: shape (E, 3), m ENU; NaN where nothing is known.
        velocities: shape (E, 3), m/s ENU; NaN where none is known.
        came: the turn in which it came, -1 where nothing is known.
    """

    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    came: NDArray[np.int64]


class Near(NamedTuple):
    """Those that each vehicle knows of in its neighbourhood.

    Attributes:
        start: where the entries of each vehicle start in the others, shape (N + 1,).
        others: numbers of the other vehicles, ascending for each vehicle.
        positions: where the vehicle believes them to be, shape (E, 3), m ENU.
    """

    start: NDArray[np.int64]
    others: NDArray[np.int64]
    positions: NDArray[np.float64]


class Network:
    """The radios of N vehicles.

    Attributes:
        count: number of vehicles N.
        options: the settings.
        seed: of all that is random.
        turn: the number of the present turn, counted from 0; -1 before the first.
        air: what the kernels know.
    """

    def __init__(self, count: int, options: NetworkOptions | None = None, seed: int = 0) -> None:
        """Create a network over which nothing has been sent yet.

        Args:
            count: number of vehicles N, at least 1.
            options: settings; an ideal network if none are given.
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
        fail, recover = _chances(options)
        self.air = kernels.Air(
            position=np.full((rows, count, 3), np.nan),
            velocity=np.full((rows, count, 3), np.nan),
            sent=np.full((rows, count), kernels.NEVER),
            travel=np.zeros(rows),
            since=np.zeros(count, dtype=np.int64),
            own=np.full(count, kernels.NEVER),
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
        self._credit = np.array([-kernels.draw(seed, kernels.PHASE, 0, j, j) for j in range(count)])
        self._head = np.zeros(count, dtype=np.int64)

    def restart(self) -> None:
        """Be as after construction: the same will happen again."""
        self._start()
        for known in self._known:
            known.drop()

    def step(self, positions: ArrayLike, velocities: ArrayLike) -> None:
        """Begin a turn: everybody has a new sample and tells it, and what is due arrives.

        Args:
            positions: shape (N, 3), m ENU; a vehicle with one that is not finite has no sample in this turn.
            velocities: shape (N, 3), m/s ENU; where one is not finite the last one before it is told.

        Raises:
            ValueError: another shape.
        """
        x = self._checked("positions", positions)
        v = self._checked("velocities", velocities)
        kernels.take(self.air, x, v, self._made)
        self.turn = turn = int(self.air.turn[0])
        sent = self.air.sent[turn % len(self.air.sent)]
        if self.options.bandwidth == math.inf:
            kernels.send_everything(self._made, turn, sent)
            return
        messages = self.options.bandwidth / RATE / self.options.message_bits
        kernels.crowds(x, self.air.range, self._crowd)
        kernels.send(self._made, turn, self.options.queue, messages, self._crowd, self._credit, self._head, sent)

    def known(self, index: int) -> KnownSwarm:
        """Return what a vehicle knows, always as of the present turn.

        Raises:
            ValueError: there is no such vehicle.
        """
        if not 0 <= index < self.count:
            raise ValueError(f"network: there is no vehicle {index}, 0 to {self.count - 1}")
        return self._known[index]

    def samples(self, receivers: NDArray[np.int64], senders: NDArray[np.int64]) -> Samples:
        """Return what each of ``receivers`` knows of its counterpart in ``senders``; numbers, both of shape (E,).

        Raises:
            ValueError: there is no such vehicle, or they are not equally many.
        """
        size = len(receivers)
        if len(senders) != size:
            raise ValueError(f"network: {size} receivers and {len(senders)} senders, they must be equally many")
        for numbers in (receivers, senders):
            if size and not 0 <= numbers.min() <= numbers.max() < self.count:
                raise ValueError(
                    f"network: there is no vehicle {_stranger(numbers, self.count)}, 0 to {self.count - 1}"
                )
        result = Samples(np.empty((size, 3)), np.empty((size, 3)), np.empty(size, dtype=np.int64))
        kernels.samples(self.air, receivers, senders, *result)
        return result

    def samples_of_all(self, index: int) -> Samples:
        """Return what a vehicle knows of every vehicle in order of their numbers, itself among them."""
        result = Samples(np.empty((self.count, 3)), np.empty((self.count, 3)), np.empty(self.count, dtype=np.int64))
        kernels.samples_of_all(self.air, index, *result)
        return result

    def look_up(self, receivers: NDArray[np.int64], senders: NDArray[np.int64]) -> None:
        """Look up at once what each of ``receivers`` will ask of its counterpart in ``senders`` in this turn.

        It changes nothing but the time that their :meth:`known` takes to answer.
        """
        positions, velocities, came = self.samples(receivers, senders)
        rows = zip(_vectors(positions), _vectors(velocities), came.tolist(), strict=True)
        for i, j, state in zip(receivers.tolist(), senders.tolist(), rows, strict=True):
            self._known[i].take(j, state)

    def near(self, radius: float) -> Near:
        """Return which others each vehicle believes to be less than ``radius`` m from itself, and where."""
        return Near(*kernels.near(self.air, float(radius)))

    def forget(self, index: int) -> None:
        """Let a vehicle know nothing until something comes in a later turn; its own state too."""
        self.air.since[index] = self.turn + 1
        self._known[index].drop()

    def cut_off(self, adjacency: ArrayLike | tuple[NDArray[np.int64], NDArray[np.int64]]) -> list[int]:
        """Return who is out of touch with the leader now: no path from it along the topology has all links in range.

        Args:
            adjacency: who listens to whom, shape (N, N), or, for less work than N^2, the links as ``np.nonzero`` gives
                them for this matrix: the numbers of the listeners and those they listen to.

        Returns:
            Numbers of the vehicles, ascending; also those whose position is unknown, and all if everything gets lost.

        Raises:
            ValueError: the matrix is none, see :func:`~xtdrone_coordination.topology.check_adjacency`.
        """
        links = adjacency if isinstance(adjacency, tuple) else np.nonzero(check_adjacency(adjacency, self.count))
        reached = np.zeros(self.count, dtype=np.bool_)
        points = self.air.position[self.turn % len(self.air.position)]
        if self.options.loss < 1.0:
            kernels.reached(links[0], links[1], points, self.options.range**2, reached)
        reached[0] = True
        return [int(i) for i in np.flatnonzero(~reached)]

    def _checked(self, name: str, values: ArrayLike) -> NDArray[np.float64]:
        array = np.ascontiguousarray(values, dtype=float)
        if array.shape != (self.count, 3):
            raise ValueError(f"network {name}: shape {array.shape} is not allowed, ({self.count}, 3)")
        return array


class KnownSwarm(SwarmState):
    """What one vehicle knows of the swarm by its network, for a follower to use as its ``swarm``.

    It is always that of the present turn. :meth:`Network.step` brings it all and counts the turns.

    Attributes:
        network: the network.
        index: the vehicle's number.
        positions: the newest position of each vehicle that has come, m ENU; None where there is none. To be read like a
            list.
        velocities: the velocity of each vehicle that came with its position, m/s ENU; None where there is none.
    """

    def __init__(self, network: Network, index: int) -> None:
        """Belong to a network, as the state of its vehicle ``index``."""
        self.count = network.count
        self.network = network
        self.index = index
        self.positions = _Vectors(self, 0)  # type: ignore[assignment]
        self.velocities = _Vectors(self, 1)  # type: ignore[assignment]
        self._turn = -1
        self._read: dict[int, _State] = {}  # of single vehicles, in this turn
        self._samples: Samples | None = None  # of all vehicles, once somebody asked for them

    @property
    def ticks(self) -> int:  # type: ignore[override]
        """The number of the network's present turn; -1 before the first."""
        return self.network.turn

    def samples(self) -> Samples:
        """Return what is known of all vehicles in order of their numbers."""
        self._look()
        if self._samples is None:
            self._samples = self.network.samples_of_all(self.index)
        return self._samples

    def sample(self, other: int) -> _State:
        """Return position, velocity (None if unknown) and turn of arrival (-1) of what is known of one vehicle."""
        self._look()
        state = self._read.get(other)
        if state is None:
            state = self._read[other] = self._state(other)
        return state

    def take(self, other: int, state: _State) -> None:
        """Remember for the present turn what :meth:`sample` would find."""
        self._look()
        self._read[other] = state

    def _state(self, other: int) -> _State:
        other = range(self.count)[other]  # as a list counts from its end, or refuses
        if self._samples is None and len(self._read) < _FEW:
            position, velocity = np.empty(3), np.empty(3)
            came = kernels.sample(self.network.air, self.index, other, position, velocity)
        else:
            samples = self.samples()
            position, velocity, came = samples.positions[other], samples.velocities[other], int(samples.came[other])
        return as_vector(position.tolist()), as_vector(velocity.tolist()), came

    def drop(self) -> None:
        """Look everything up anew."""
        self._turn, self._read, self._samples = self.network.turn, {}, None

    def _look(self) -> None:
        """Drop what was read before the present turn."""
        if self._turn != self.network.turn:
            self.drop()

    def restart(self) -> None:
        """Know nothing until something comes in a later turn."""
        self.network.forget(self.index)

    def on_position(self, index: int, position: Vector) -> None:
        """Refuse it: everything comes by :meth:`Network.step`.

        Raises:
            TypeError: always.
        """
        raise TypeError(f"vehicle {self.index} hears of vehicle {index} by its network alone: use Network.step")

    def on_velocity(self, index: int, velocity: Vector) -> None:
        """Refuse it, as :meth:`on_position` does.

        Raises:
            TypeError: always.
        """
        self.on_position(index, velocity)

    def tick(self) -> None:
        """Do nothing: :meth:`Network.step` counts the turns."""

    def fresh(self, index: int, ticks: int) -> bool:
        """Return whether a new position of this vehicle came in the last ``ticks`` turns."""
        _, _, came = self.sample(index)
        return came != kernels.NEVER and self.network.turn - came <= ticks


class _Vectors(Sequence[Vector | None]):
    """The positions (column 0) or velocities (1) that a vehicle knows, looked up when they are read."""

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
    """Return a network of ``count`` vehicles, None when there are no options or those of an ideal network."""
    return None if options is None or options.ideal else Network(count, options, seed)


def _stranger(numbers: NDArray[np.int64], count: int) -> int:
    """Return the first number that is none of 0 to count - 1."""
    return int(numbers[(numbers < 0) | (numbers >= count)][0])


def _vectors(array: NDArray[np.float64]) -> list[Vector | None]:
    """Return the rows as tuples, None where one is not finite."""
    rows: list[Vector | None] = [(x, y, z) for x, y, z in array.tolist()]
    for j in np.flatnonzero(~np.isfinite(array[:, 0])):
        rows[j] = None
    return rows


def _chances(options: NetworkOptions) -> tuple[float, float]:
    """Return the probabilities that a link goes out and comes back in a turn; (-1, 1) for independent losses."""
    if options.burst == 0.0 or options.loss in (0.0, 1.0):
        return -1.0, 1.0
    recover = 1.0 / (options.burst * RATE)
    return recover * options.loss / (1.0 - options.loss), recover


def _check(name: str, value: object, low: float, high: float, *, above: bool = False) -> None:
    """Raise ValueError unless ``value`` is a number from ``low`` (or above it) to ``high``."""
    allowed = f"{'above ' if above else ''}{low:g} {'and at most' if above else 'to'} {high:g}"
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"network {name}: {value!r} is not a number, {allowed} is allowed")
    number = float(value)
    if not low <= number <= high or (above and number == low):
        raise ValueError(f"network {name}: {value} is not allowed, {allowed}")


def _check_whole(name: str, value: object, high: float) -> None:
    """Raise ValueError unless ``value`` is a whole number from 1 to ``high``."""
    allowed = "a whole number, 1 or more" if math.isinf(high) else f"a whole number, 1 to {high:g}"
    if isinstance(value, bool) or not isinstance(value, Integral) or not 1 <= int(value) <= high:
        raise ValueError(f"network {name}: {value!r} is not allowed, {allowed}")
