"""Kernels of the radio channel: sending, losses, delays, and the newest sample received over a link.

Nothing is stored per link. The random draws of a message are functions of the seed, its turn, sender and receiver (a
counter-based generator: SplitMix64's finaliser over a counter), and positions are kept for as many turns as a message
can be relevant. Reception is therefore computed on demand, in any order, for the requested pairs only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.kernel import kernel

LOSS, JITTER, PHASE = np.uint64(0x6C6F7373), np.uint64(0x6A697474), np.uint64(0x70686173)
"""Streams of random draws, one per purpose."""

_STEP = np.uint64(0x9E3779B97F4A7C15)  # 2^64 divided by the golden ratio, odd: SplitMix64's counter step
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31 = np.uint64(30), np.uint64(27), np.uint64(31)
_SHIFT_32, _SHIFT_11 = np.uint64(32), np.uint64(11)
_UNIT = 2.0**-53

NEVER = -1  # no turn


class Air(NamedTuple):
    """State and settings of the network; turn k is in row k % rows.

    Attributes:
        position: Position of every vehicle, or its last known one, shape (rows, N, 3), m; NaN before the first.
        velocity: likewise, shape (rows, N, 3), m/s.
        sent: turn of the newest sample sent by vehicle j in a turn, NEVER if none, shape (rows, N).
        travel: upper bound of the distance travelled by any vehicle up to a turn, shape (rows,), m.
        since: turn before which received samples are dropped, one per receiver.
        own: turn of each vehicle's own newest position, NEVER before the first.
        turn: the current turn, shape (1,).
        seed: Seed of the draws.
        range: m.
        delay: minimum delay in turns, not rounded.
        jitter: maximum additional delay in turns, not rounded.
        memory: turns for which a received sample is kept.
        loss: probability that a message is lost, or that a link is in its bad state.
        fail: probability that a link fails in a turn; below 0 for independent losses.
        recover: probability that a failed link recovers in a turn.
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
    """Return a random number in [0, 1), a function of its arguments alone."""
    z = (seed ^ stream) + np.uint64(turn) * _STEP
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    z = (z ^ (z >> _SHIFT_31)) + ((np.uint64(sender) << _SHIFT_32) | np.uint64(receiver)) * _STEP
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    return float((z ^ (z >> _SHIFT_31)) >> _SHIFT_11) * _UNIT


@kernel
def turns_of(delay):
    """Return a delay in whole turns: rounded up, apart from rounding errors of floating-point products."""
    return math.ceil(delay - 1e-9)


@kernel
def within(position, i, j, square):
    """Return whether the squared distance of two rows of ``position`` is at most ``square``; False if unknown."""
    x = position[j, 0] - position[i, 0]
    y = position[j, 1] - position[i, 1]
    z = position[j, 2] - position[i, 2]
    return x * x + y * y + z * z <= square


@kernel
def out_since(seed, fail, recover, turn, sender, receiver):
    """Return the first turn of the link's current outage as of ``turn``, ``turn + 1`` if there is none.

    The state of the Gilbert-Elliott channel is a function of the draws alone (coupling from the past): a draw below
    ``fail`` puts the link into the bad state, one of at least ``1 - recover`` into the good state, whatever the state
    was, and any other draw leaves it unchanged. The last draw of the first two kinds is therefore decisive.
    """
    k = turn
    while True:
        u = draw(seed, LOSS, k, sender, receiver)
        if u < fail:
            return k
        if u >= 1.0 - recover:
            return turn + 1
        k -= 1


@kernel
def newest(air, i, j):
    """Return the turns of sending and reception of the newest sample of j received by i; NEVER if there is none.

    A sample overtaken by a later one is ignored, as is one received before ``since`` or more than ``memory`` turns ago.
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
            out = out_since(air.seed, air.fail, air.recover, k, j, i)
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
    """Store the state of j as known to i in two arrays of three (NaN if unknown); return its turn of reception."""
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
    """Store the state of each of ``senders`` as known to its receiver, see ``sample``."""
    for k in range(len(receivers)):
        came[k] = sample(air, receivers[k], senders[k], positions[k], velocities[k])


@kernel
def samples_of_all(air, i, positions, velocities, came):
    """Store the states of all vehicles as known to i, see ``sample``."""
    for j in range(len(came)):
        came[j] = sample(air, i, j, positions[j], velocities[j])


@kernel
def begin_turn(air, positions, velocities, made):
    """Store a new turn: positions and velocities (the last finite ones where missing), and vehicles with a sample."""
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
        if math.isfinite(square):  # the first position of a vehicle does not count as movement
            furthest = max(furthest, square)
    air.travel[row] = (air.travel[before] if now > 0 else 0.0) + math.sqrt(furthest)


@kernel
def send(made, now, queue, messages, crowd, credit, head, sent):
    """Send the waiting samples of every vehicle, oldest first, within its share of the channel.

    Args:
        made: whether a vehicle had a sample in a turn, shape (rows, N); turn k is in row k % rows.
        now: the current turn.
        queue: maximum number of waiting samples per vehicle; the oldest are dropped.
        messages: capacity of the channel at one place per turn.
        crowd: number of vehicles sharing it, one per sender.
        credit: messages that a vehicle may send now, updated.
        head: turn of the oldest waiting sample of a vehicle, updated.
        sent: turn of the newest sample sent now, or NEVER.
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
    """Send the samples of all vehicles at once."""
    for j in range(len(sent)):
        sent[j] = now if made[now % len(made), j] else NEVER
