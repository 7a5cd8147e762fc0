"""The inner loops of :mod:`xtdrone_coordination.network`.

Nothing is stored per link. What is drawn for a message is a function of the seed, the turn of its sending, the sender
and the receiver (a counter-based generator: SplitMix64's finaliser over a counter), and where all vehicles were is kept
for as many turns as a message can matter. So whether a message has arrived is computed when somebody asks, in any
order and for those pairs alone that somebody asks for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_coordination.kernel import kernel

LOSS, JITTER, PHASE = np.uint64(0x6C6F7373), np.uint64(0x6A697474), np.uint64(0x70686173)
"""Which draw it is: each has a stream of its own."""

_STEP = np.uint64(0x9E3779B97F4A7C15)  # 2^64 divided by the golden ratio, odd: SplitMix64's counter step
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31 = np.uint64(30), np.uint64(27), np.uint64(31)
_SHIFT_32, _SHIFT_11 = np.uint64(32), np.uint64(11)
_UNIT = 2.0**-53

NEVER = -1  # no turn


class Air(NamedTuple):
    """What the kernels know of the network; turn k lies in row k % rows.

    Attributes:
        position: where every vehicle was, or was last known to be, shape (rows, N, 3), m; NaN before that.
        velocity: likewise, shape (rows, N, 3), m/s.
        sent: the turn of the newest sample that vehicle j sent in a turn, NEVER if it sent none, shape (rows, N).
        travel: an upper bound of how far any vehicle has come up to a turn, shape (rows,), m.
        since: the turn before which arrivals are forgotten, one a receiver.
        own: the turn of each vehicle's own newest position, NEVER before it.
        turn: the present turn, an array of one.
        seed: of the draws.
        range: m.
        delay: least delay in turns, not rounded.
        jitter: greatest additional delay in turns, not rounded.
        memory: turns after its arrival in which a sample is remembered.
        loss: probability that a message is lost, or that a link is out.
        fail: probability that a link goes out in a turn; below 0 when losses are independent.
        recover: probability that a link which is out comes back in a turn.
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    sent: NDArray[np.int64]
    travel: NDArray[np.float64]
    since: NDArray[np.int64]
    own: NDArray[np.int64]
    turn: NDArray[np.int64]
    seed: np.uint64
    range: float
    delay: float
    jitter: float
    memory: int
    loss: float
    fail: float
    recover: float


@kernel
def draw(seed, stream, turn, sender, receiver):
    """Return a number from 0 to below 1, the same whenever it is asked for."""
    z = (seed ^ stream) + np.uint64(turn) * _STEP
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    z = (z ^ (z >> _SHIFT_31)) + ((np.uint64(sender) << _SHIFT_32) | np.uint64(receiver)) * _STEP
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    return float((z ^ (z >> _SHIFT_31)) >> _SHIFT_11) * _UNIT


@kernel
def turns_of(delay):
    """Return the whole number of turns that a delay takes: rounded up, but for the error of a product of floats."""
    return math.ceil(delay - 1e-9)


@kernel
def within(position, i, j, square):
    """Return whether two rows of ``position`` are not further apart than the root of ``square``; False if unknown."""
    x = position[j, 0] - position[i, 0]
    y = position[j, 1] - position[i, 1]
    z = position[j, 2] - position[i, 2]
    return x * x + y * y + z * z <= square


@kernel
def out_since(air, turn, sender, receiver):
    """Return the first turn up to ``turn`` from which on the link is known to be out, ``turn + 1`` if it is not out.

    The two states of the Gilbert-Elliott channel as functions of the draws alone (coupling from the past): a draw
    below ``fail`` puts the link out whatever it was, one from ``1 - recover`` on brings it back whatever it was, any
    other leaves it as it was. So the last draw of the first two kinds decides, and since then nothing has changed.
    """
    k = turn
    while True:
        u = draw(air.seed, LOSS, k, sender, receiver)
        if u < air.fail:
            return k
        if u >= 1.0 - air.recover:
            return turn + 1
        k -= 1


@kernel
def newest(air, i, j):
    """Return when the newest of j's samples that have come to i was sent, and when it came; NEVER if there is none.

    A sample that comes after a later one does not count, and what came before ``since`` or more than ``memory`` turns
    ago is forgotten.
    """
    now = air.turn[0]
    rows = air.sent.shape[0]
    longest = turns_of(air.delay + air.jitter)
    first = max(0, now - air.memory - longest)
    everywhere = math.isinf(air.range)
    square = air.range * air.range
    if not everywhere:
        reach = air.range + 2.0 * (air.travel[now % rows] - air.travel[first % rows]) + 1e-6
        if not within(air.position[now % rows], i, j, reach * reach):
            return NEVER, NEVER
    k = now - turns_of(air.delay)
    while k >= first:
        row = k % rows
        if air.sent[row, j] == NEVER or not (everywhere or within(air.position[row], i, j, square)):
            k -= 1
            continue
        if air.fail >= 0.0:
            out = out_since(air, k, j, i)
            if out <= k:
                k = out - 1
                continue
        elif draw(air.seed, LOSS, k, j, i) < air.loss:
            k -= 1
            continue
        came = k + turns_of(air.delay)
        if air.jitter > 0.0:
            came = k + turns_of(air.delay + air.jitter * draw(air.seed, JITTER, k, j, i))
        if air.since[i] <= came <= now:
            return (k, came) if now - came <= air.memory else (NEVER, NEVER)
        k -= 1
    return NEVER, NEVER


@kernel
def sample(air, i, j, position, velocity):
    """Write what i knows of j into two arrays of three; return when that came, NEVER (and NaN) if it knows nothing."""
    rows = air.sent.shape[0]
    row = air.turn[0] % rows
    came = NEVER
    if i == j:
        if air.own[i] >= air.since[i]:
            came = air.own[i]
    else:
        sent, came = newest(air, i, j)
        if came != NEVER:
            row = air.sent[sent % rows, j] % rows
    for axis in range(3):
        position[axis] = air.position[row, j, axis] if came != NEVER else np.nan
        velocity[axis] = air.velocity[row, j, axis] if came != NEVER else np.nan
    return came


@kernel
def samples(air, receivers, senders, positions, velocities, came):
    """Write what each of ``receivers`` knows of its counterpart in ``senders``, see ``sample``."""
    for k in range(len(receivers)):
        came[k] = sample(air, receivers[k], senders[k], positions[k], velocities[k])


@kernel
def samples_of_all(air, i, positions, velocities, came):
    """Write what i knows of every vehicle, see ``sample``."""
    for j in range(len(came)):
        came[j] = sample(air, i, j, positions[j], velocities[j])


@kernel
def cells(points, size):
    """Sort points into cubes of at least ``size``; those that are not finite are left out.

    Returns:
        The lowest corner (3,), the inverse of the edge, the numbers of cells (3,), where each cell starts in the last
        array (cells + 1,), and the points' numbers, cell by cell, ascending in each.
    """
    count = len(points)
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for i in range(count):
        if math.isfinite(points[i, 0] + points[i, 1] + points[i, 2]):
            for axis in range(3):
                low[axis] = min(low[axis], points[i, axis])
                high[axis] = max(high[axis], points[i, axis])
    shape = np.ones(3, dtype=np.int64)
    edge = size
    while math.isfinite(edge) and low[0] <= high[0]:
        total = 1.0
        for axis in range(3):
            total *= math.floor((high[axis] - low[axis]) / edge) + 1.0
        if total <= 4.0 * count + 64.0:
            for axis in range(3):
                shape[axis] = math.floor((high[axis] - low[axis]) / edge) + 1
            break
        edge *= 1.26  # twice the volume: no more cells than is worth it, however far the swarm is spread out
    inverse = 1.0 / edge
    cell = np.full(count, -1, dtype=np.int64)
    start = np.zeros(shape[0] * shape[1] * shape[2] + 1, dtype=np.int64)
    for i in range(count):
        if math.isfinite(points[i, 0] + points[i, 1] + points[i, 2]):
            cell[i] = cell_of(points[i], low, inverse, shape)
            start[cell[i] + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]
    order = np.empty(start[-1], dtype=np.int64)
    filled = start[:-1].copy()
    for i in range(count):
        if cell[i] >= 0:
            order[filled[cell[i]]] = i
            filled[cell[i]] += 1
    return low, inverse, shape, start, order


@kernel
def cell_of(point, low, inverse, shape):
    """Return the number of the cell that a point lies in; a finite point, not below ``low``."""
    x = max(0, min(int((point[0] - low[0]) * inverse), shape[0] - 1))
    y = max(0, min(int((point[1] - low[1]) * inverse), shape[1] - 1))
    z = max(0, min(int((point[2] - low[2]) * inverse), shape[2] - 1))
    return (x * shape[1] + y) * shape[2] + z


@kernel
def around(point, low, inverse, shape, start, order, found):
    """Write the numbers of the points in a point's cell and those next to it into ``found``; return how many."""
    n = 0
    x = max(0, min(int((point[0] - low[0]) * inverse), shape[0] - 1))
    y = max(0, min(int((point[1] - low[1]) * inverse), shape[1] - 1))
    z = max(0, min(int((point[2] - low[2]) * inverse), shape[2] - 1))
    for cx in range(max(0, x - 1), min(shape[0], x + 2)):
        for cy in range(max(0, y - 1), min(shape[1], y + 2)):
            for cz in range(max(0, z - 1), min(shape[2], z + 2)):
                c = (cx * shape[1] + cy) * shape[2] + cz
                for k in range(start[c], start[c + 1]):
                    found[n] = order[k]
                    n += 1
    return n


@kernel
def crowds(points, reach, crowd):
    """Write for each vehicle how many there are within ``reach`` of the most crowded of those within its reach.

    Everybody counts itself too; a vehicle whose position is not known gets 1.
    """
    count = len(points)
    heard = np.ones(count)
    if math.isinf(reach):
        known = 0
        for i in range(count):
            known += math.isfinite(points[i, 0] + points[i, 1] + points[i, 2])
        crowd[:] = max(known, 1)
        return
    low, inverse, shape, start, order = cells(points, reach)
    found = np.empty(count, dtype=np.int64)
    square = reach * reach
    for i in order:
        n = around(points[i], low, inverse, shape, start, order, found)
        heard[i] = 0
        for k in range(n):
            heard[i] += within(points, i, found[k], square)
    crowd[:] = heard
    for i in order:
        n = around(points[i], low, inverse, shape, start, order, found)
        for k in range(n):
            if heard[found[k]] > crowd[i] and within(points, i, found[k], square):
                crowd[i] = heard[found[k]]


@kernel
def send(made, now, queue, messages, crowd, credit, head, sent):
    """Let every vehicle send what waits, oldest first, as far as its share of the air allows.

    Args:
        made: whether a vehicle had a sample in a turn, shape (rows, N); turn k in row k % rows.
        now: the present turn.
        queue: most samples that wait at a vehicle; the oldest are dropped.
        messages: that the air at one place takes in a turn.
        crowd: how many share it, one a sender.
        credit: messages that a vehicle may send by now, updated.
        head: turn of the oldest sample that waits at a vehicle, updated.
        sent: turn of the newest sample that it sends now, or NEVER.
    """
    rows = len(made)
    for j in range(len(head)):
        credit[j] = min(credit[j], 1.0) + messages / crowd[j]
        head[j] = max(head[j], now - queue + 1)
        sent[j] = NEVER
        while head[j] <= now:
            if made[head[j] % rows, j]:
                if credit[j] < 1.0:
                    break
                credit[j] -= 1.0
                sent[j] = head[j]
            head[j] += 1


@kernel
def send_everything(made, now, sent):
    """Let every vehicle that has a sample send it at once."""
    for j in range(len(sent)):
        sent[j] = now if made[now % len(made), j] else NEVER


@kernel
def take(air, positions, velocities, made):
    """Write a new turn's positions and velocities, the last finite ones where there is none; say who had a sample."""
    air.turn[0] += 1
    now = air.turn[0]
    rows = air.sent.shape[0]
    row, before = now % rows, (now - 1) % rows
    furthest = 0.0
    for j in range(positions.shape[0]):
        finite = math.isfinite(positions[j, 0] + positions[j, 1] + positions[j, 2])
        moving = math.isfinite(velocities[j, 0] + velocities[j, 1] + velocities[j, 2])
        made[row, j] = finite
        if finite:
            air.own[j] = now
        square = 0.0
        for axis in range(3):
            air.position[row, j, axis] = positions[j, axis] if finite else air.position[before, j, axis]
            air.velocity[row, j, axis] = velocities[j, axis] if moving else air.velocity[before, j, axis]
            square += (air.position[row, j, axis] - air.position[before, j, axis]) ** 2
        if math.isfinite(square):  # a vehicle that was nowhere before has not come from anywhere
            furthest = max(furthest, square)
    air.travel[row] = (air.travel[before] if now > 0 else 0.0) + math.sqrt(furthest)


@kernel
def whereabouts(air):
    """Return the corners of the box that holds each vehicle in all turns that can still matter, (N, 3) each."""
    now = air.turn[0]
    rows = air.sent.shape[0]
    low = air.position[now % rows].copy()
    high = low.copy()
    for row in range(min(rows, now + 1)):
        for j in range(len(low)):
            for axis in range(3):
                x = air.position[row, j, axis]
                if x < low[j, axis]:
                    low[j, axis] = x
                elif x > high[j, axis]:
                    high[j, axis] = x
    return low, high


@kernel
def beside(point, low, high, square):
    """Return whether a point is nearer than the root of ``square`` to a box."""
    total = 0.0
    for axis in range(3):
        d = max(low[axis] - point[axis], 0.0, point[axis] - high[axis])
        total += d * d
    return total <= square


@kernel
def near(air, radius):
    """Find which others each vehicle knows of at less than ``radius`` from its own place.

    Asked are those alone that were near it, as it is now, in any turn that can still matter.

    Returns:
        Where the entries of each vehicle start (N + 1,), the others' numbers, ascending, and their positions as this
        vehicle knows them (E, 3), m.
    """
    now = air.turn[0]
    rows = air.sent.shape[0]
    points = air.position[now % rows]
    count = len(points)
    first = max(0, now - rows + 1)
    reach = radius + (air.travel[now % rows] - air.travel[first % rows]) + 1e-6
    least, greatest = whereabouts(air)
    low, inverse, shape, begin, order = cells(points, reach)
    start = np.zeros(count + 1, dtype=np.int64)
    found = np.empty(count, dtype=np.int64)
    others = np.empty(16 * count, dtype=np.int64)
    places = np.empty((16 * count, 3))
    velocity = np.empty(3)
    n = 0
    for i in range(count):
        if air.own[i] >= max(air.since[i], 0):
            candidates = around(points[i], low, inverse, shape, begin, order, found)
            kept = 0
            for k in range(candidates):
                if found[k] != i and beside(points[i], least[found[k]], greatest[found[k]], radius * radius):
                    found[kept] = found[k]
                    kept += 1
            found[:kept].sort()
            for k in range(kept):
                if n == len(others):
                    others = np.concatenate((others, np.empty_like(others)))
                    places = np.concatenate((places, np.empty_like(places)))
                if sample(air, i, found[k], places[n], velocity) == NEVER:
                    continue
                x, y, z = places[n, 0] - points[i, 0], places[n, 1] - points[i, 1], places[n, 2] - points[i, 2]
                if x * x + y * y + z * z < radius * radius:
                    others[n] = found[k]
                    n += 1
        start[i + 1] = n
    return start, others[:n], places[:n]


@kernel
def reached(listeners, speakers, points, square, reach):
    """Mark in ``reach`` whom the leader's state reaches along links between vehicles that are within range.

    Args:
        listeners: who listens, one a link.
        speakers: to whom, one a link.
        points: positions, shape (N, 3), m.
        square: of the range, m^2.
        reach: all False, shape (N,); written.
    """
    count = len(points)
    start = np.zeros(count + 1, dtype=np.int64)
    for k in range(len(speakers)):
        start[speakers[k] + 1] += 1
    for j in range(count):
        start[j + 1] += start[j]
    order = np.empty(len(speakers), dtype=np.int64)
    filled = start[:-1].copy()
    for k in range(len(speakers)):
        order[filled[speakers[k]]] = listeners[k]
        filled[speakers[k]] += 1
    waiting = np.empty(count, dtype=np.int64)
    waiting[0] = 0
    reach[0] = True
    n = 1
    while n > 0:
        n -= 1
        j = waiting[n]
        for k in range(start[j], start[j + 1]):
            i = order[k]
            if not reach[i] and within(points, i, j, square):
                reach[i] = True
                waiting[n] = i
                n += 1
