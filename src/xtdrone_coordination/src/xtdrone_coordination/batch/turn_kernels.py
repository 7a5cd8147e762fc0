"""One turn of all followers of a process: sense, law, command. Bit-identical to ``Follower.update`` of each.

The formulas are those of ``laws.consensus`` and ``laws.formation_avoidance``, compiled here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.network.channel import sample
from xtdrone_coordination.kernel import kernel
from xtdrone_coordination.known_swarm_state import NEVER
from xtdrone_coordination.laws import consensus, formation_avoidance

from .neighbourhood import fill_grid, find_near, relative

FOLLOWER = np.dtype(
    [
        ("id", np.int64),
        ("slots", np.int64),  # index of its table of slots, -1 before the first pattern
        ("first_link", np.int64),  # its neighbours are links[first_link:last_link]
        ("last_link", np.int64),
        ("timeout", np.int64),  # ticks
        ("gain", np.float64),  # Kp, 1/s or 1/s^2
        ("damping", np.float64),  # s
        ("limit", np.float64),  # m/s or m/s^2
        ("avoidance_gain", np.float64),
        ("radius", np.float64),  # m
        ("clearance", np.float64),  # m
        ("acceleration_form", np.bool_),
        ("normalise", np.bool_),  # divide by the in-degree
        ("stock_law", np.bool_),  # compute the consensus law here, else STATE.law is an input
        ("stock_avoidance", np.bool_),  # compute Algorithm 1 here, else STATE.avoidance is an input
        ("gives_way", np.bool_),
        ("overridden", np.bool_),  # some of its methods are called in Python, which handles its reports
    ],
    align=True,
)
"""Settings of a follower, written by FollowerBatch and read by the kernels."""

STATE = np.dtype(
    [
        ("status", np.int64),  # WAITING, STOPPED or READY
        ("problems", np.int64),  # HAS_STOPPED, ALONE, BAD_LAW, MISSING, and above them a hash of missing neighbours
        ("previous_problems", np.int64),
        ("avoidance_changed", np.bool_),
        ("avoidance", np.float64, 3),  # before its gain
        ("law", np.float64, 3),  # result of the law before limits, m/s or m/s^2 ENU
    ],
    align=True,
)
"""Results of a follower's turn, written by the kernels."""

LINK = np.dtype([("peer", np.int64), ("weight", np.float64)])
"""A neighbour's number and w_ij."""

# phases of a turn, combined by addition
SENSE, LAW, COMMAND = 1, 2, 4
ALL = SENSE + LAW + COMMAND

WAITING, STOPPED, READY = 0, 1, 2

HAS_STOPPED, ALONE, BAD_LAW, MISSING = 1, 2, 4, 8
_HASH_SHIFT, _HASH_START, _HASH_FACTOR, _HASH_MASK = 4, 1469598103, 1099511628211, (1 << 58) - 1

_NOT_SEARCHED = -1

_lead = kernel(consensus.lead)
_attraction = kernel(consensus.attraction)
_scaled = kernel(consensus.scaled)
_clip = kernel(consensus.clip)
_contribution = kernel(formation_avoidance.contribution)
_yielding = kernel(formation_avoidance.yielding)


@kernel
def turn(
    phases: int,
    tick: int,
    positions: NDArray[Any],
    velocities: NDArray[Any],
    heard: NDArray[Any],
    followers: NDArray[Any],
    states: NDArray[Any],
    links: NDArray[Any],
    slots: NDArray[Any],
    grid: NDArray[Any],
    buckets: NDArray[Any],
    commands: NDArray[Any],
    given: NDArray[Any],
    reported: NDArray[Any],
    air: Any,
    radio: Any,
) -> int:
    """Compute phases of one turn of M followers among N vehicles.

    Args:
        phases: SENSE (status and avoidance), LAW (consensus), COMMAND (limits, giving way), or sums of them in order.
        tick: current tick of the swarm's clock.
        positions: shape (N, 3), m ENU; with a network this and the next two are overwritten for each follower.
        velocities: shape (N, 3), m/s ENU, zero while unknown.
        heard: shape (N,), tick of each position's reception, NEVER while unknown.
        followers: FOLLOWER, shape (M,).
        states: STATE, shape (M,).
        links: LINK, those of one follower after the other.
        slots: tables of slots, shape (S, N, 3), m ENU, the leader's zero first.
        grid: GRID, shape (N,).
        buckets: of the grid, see ``make_grid``.
        commands: shape (N, 3), written: m/s or m/s^2 ENU.
        given: shape (N,), written: whether there is a command.
        reported: shape (M,), written: rows whose problems or avoidance have changed.
        air: of a network, None without one.
        radio: result of the network's ``near`` for the largest radius, None without a network.

    Returns:
        The number of rows in ``reported``.
    """
    if phases & SENSE and air is None:
        fill_grid(positions, heard, _largest_radius(followers), grid, buckets)
    count = 0
    for k in range(len(followers)):
        f, s = followers[k], states[k]
        if air is not None:
            _receive(f, links, air, positions, velocities, heard)
        found = _NOT_SEARCHED
        if phases & SENSE:
            found = _sense(f, s, tick, positions, heard, grid, buckets, radio)
        if phases & LAW and s.status == READY and f.stock_law:
            _apply_law(f, s, tick, positions, velocities, heard, links, slots[f.slots])
        if phases & COMMAND:
            given[f.id] = s.status != WAITING
            command = _command(f, s, positions, heard, grid, buckets, found, radio)
            commands[f.id, 0], commands[f.id, 1], commands[f.id, 2] = command
            if s.status != WAITING and _has_news(f, s):
                reported[count] = k
                count += 1
    return count


@kernel
def _largest_radius(followers: NDArray[Any]) -> float:
    largest = 0.0
    for k in range(len(followers)):
        largest = max(largest, followers[k].radius)
    return largest


@kernel
def _receive(
    f: Any, links: NDArray[Any], air: Any, positions: NDArray[Any], velocities: NDArray[Any], heard: NDArray[Any]
) -> None:
    """Store what the follower's vehicle has received over the network of itself and its neighbours."""
    for entry in range(f.first_link - 1, f.last_link):
        j = f.id if entry < f.first_link else links[entry].peer
        heard[j] = sample(air, f.id, j, positions[j], velocities[j])
        for axis in range(3):
            if not math.isfinite(velocities[j, axis]):
                velocities[j, axis] = 0.0


@kernel
def _sense(
    f: Any,
    s: Any,
    tick: int,
    positions: NDArray[Any],
    heard: NDArray[Any],
    grid: NDArray[Any],
    buckets: NDArray[Any],
    radio: Any,
) -> int:
    """Update status and avoidance; return the number of near vehicles, _NOT_SEARCHED if not needed."""
    s.status = _status(f, tick, heard[f.id])
    s.problems = HAS_STOPPED if s.status == STOPPED else 0
    s.avoidance_changed = False
    if s.status != READY or not f.stock_avoidance:
        return _NOT_SEARCHED
    found = find_near(f.id, positions, heard, f.radius, grid, buckets, radio)
    vector = _avoid(f, positions, grid, found)
    s.avoidance_changed = s.avoidance[0] != vector[0] or s.avoidance[1] != vector[1] or s.avoidance[2] != vector[2]
    _put(s.avoidance, vector)
    return found


@kernel
def _status(f: Any, tick: int, heard: int) -> int:
    if heard == NEVER or f.slots < 0:
        return WAITING
    return READY if _is_recent(heard, tick, f.timeout) else STOPPED


@kernel
def _is_recent(heard: int, tick: int, timeout: int) -> bool:
    return heard != NEVER and tick - heard <= timeout


@kernel
def _avoid(f: Any, positions: NDArray[Any], grid: NDArray[Any], found: int) -> tuple[float, float, float]:
    """Return Algorithm 1 for the near vehicles, m/s."""
    index, radius = f.id, f.radius
    ax = ay = az = 0.0
    for entry in range(found):
        j = grid[entry].near
        dx, dy, dz = _contribution(relative(positions, index, j), radius, formation_avoidance.GAIN, index < j)
        ax, ay, az = ax + dx, ay + dy, az + dz
    return ax, ay, az


@kernel
def _apply_law(
    f: Any,
    s: Any,
    tick: int,
    positions: NDArray[Any],
    velocities: NDArray[Any],
    heard: NDArray[Any],
    links: NDArray[Any],
    slots: NDArray[Any],
) -> None:
    """Store the consensus law's result, and the problems with the neighbours."""
    own, offset = _place(f, positions, velocities, f.id), _row(slots, f.id)
    x = y = z = degree = 0.0
    peers, missing = 0, False
    code = _HASH_START
    for entry in range(f.first_link, f.last_link):
        j, weight = links[entry].peer, links[entry].weight
        if not _is_recent(heard[j], tick, f.timeout):
            missing = True
            code = ((code ^ j) * _HASH_FACTOR) & _HASH_MASK
            continue
        peers += 1
        dx, dy, dz = _attraction(weight, own, offset, _place(f, positions, velocities, j), _row(slots, j))
        x, y, z = x + dx, y + dy, z + dz
        degree += weight
    _put(s.law, _scaled((x, y, z), degree, f.gain, f.normalise))
    if missing:
        s.problems |= MISSING | (code << _HASH_SHIFT)
    if peers == 0:
        s.problems |= ALONE


@kernel
def _place(f: Any, positions: NDArray[Any], velocities: NDArray[Any], j: int) -> tuple[float, float, float]:
    """Return the position of vehicle ``j`` that enters the law, m: with its lead in the acceleration form."""
    position = _row(positions, j)
    return _lead(position, _row(velocities, j), f.damping) if f.acceleration_form else position


@kernel
def _command(
    f: Any,
    s: Any,
    positions: NDArray[Any],
    heard: NDArray[Any],
    grid: NDArray[Any],
    buckets: NDArray[Any],
    found: int,
    radio: Any,
) -> tuple[float, float, float]:
    """Return law plus avoidance within the limit, the law limited first, and give way; zero unless READY."""
    if s.status != READY:
        return 0.0, 0.0, 0.0
    if found == _NOT_SEARCHED and f.gives_way:
        found = find_near(f.id, positions, heard, f.radius, grid, buckets, radio)
    x, y, z = _clip(_usable_law(s), f.limit)
    ax, ay, az = _vector(s.avoidance)
    gain = f.avoidance_gain
    command = _clip((x + gain * ax, y + gain * ay, z + gain * az), f.limit)
    return _give_way(f, positions, command, grid, found) if f.gives_way else command


@kernel
def _give_way(f: Any, positions: NDArray[Any], command: Any, grid: NDArray[Any], found: int) -> Any:
    """Return ``command`` with its components towards near vehicles reduced, m/s."""
    index, radius, clearance = f.id, f.radius, f.clearance
    for _ in range(formation_avoidance.ROUNDS):
        for entry in range(found):
            command = _yielding(relative(positions, index, grid[entry].near), command, radius, clearance)
    return command


@kernel
def _usable_law(s: Any) -> tuple[float, float, float]:
    """Return the law's result; zero without neighbours, and zero with a problem recorded if it is not finite."""
    x, y, z = _vector(s.law)
    if s.problems & ALONE:
        return 0.0, 0.0, 0.0
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        s.problems |= BAD_LAW
        return 0.0, 0.0, 0.0
    return x, y, z


@kernel
def _has_news(f: Any, s: Any) -> bool:
    """Return whether problems (or the missing neighbours) or avoidance differ from the previous turn."""
    previous = s.previous_problems
    s.previous_problems = 0 if f.overridden else s.problems
    return s.avoidance_changed or s.problems != previous or s.problems & BAD_LAW != 0


@kernel
def _row(array: NDArray[Any], k: int) -> tuple[float, float, float]:
    return array[k, 0], array[k, 1], array[k, 2]


@kernel
def _vector(array: NDArray[Any]) -> tuple[float, float, float]:
    return array[0], array[1], array[2]


@kernel
def _put(array: NDArray[Any], vector: tuple[float, float, float]) -> None:
    array[0], array[1], array[2] = vector
