"""The followers of a process computed at once: the same operations in the same order as a single follower's.

What is computed here is explained in ``consensus``, ``avoidance`` and ``follower``; results are equal to the last bit.
A grid of cells finds the vehicles that are near, so N vehicles cost about N times their neighbours and not N times N.

Followers are rows of the arrays below, in any order of their numbers. Columns of ``kinds`` (whole numbers) and of
``settings`` are named by the constants.
"""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from xtdrone_coordination import avoidance
from xtdrone_coordination.kernel import kernel
from xtdrone_coordination.network_kernels import sample
from xtdrone_coordination.swarm import NEVER

# columns of kinds
ID = 0  # the vehicle's number
SLOTS = 1  # which table of slots it flies, -1: none yet
ACCEL = 2  # acceleration form
NORMALISE = 3  # divide by the in-degree
OWN_AVOIDANCE = 4  # compute Algorithm 1 here, else take what stands in ``vectors``
GIVE_WAY = 5
OWN_LAW = 6  # compute the consensus here, else take what stands in ``vectors``
TIMEOUT = 7  # ticks
ASKED = 8  # its class has methods of its own: whoever asks them keeps its records too
KINDS = 9

# columns of settings
GAIN, GAMMA, LIMIT, AVOID_GAIN, RADIUS, CLEARANCE = 0, 1, 2, 3, 4, 5
SETTINGS = 6

# phases of a turn, to be added up
SENSE, LAW, COMMAND = 1, 2, 4
ALL = SENSE + LAW + COMMAND

# rows of notes
STATUS, PROBLEMS, PROBLEMS_BEFORE, MOVED, REPORTED = 0, 1, 2, 3, 4
NOTES = 5

# status
WAITING, STOPPED, READY = 0, 1, 2

# problems: the low bits of a signature; above them a hash of whose positions are missing
HAS_STOPPED, ALONE, BAD_LAW, SILENT = 1, 2, 4, 8
_HASH_SHIFT, _HASH_START, _HASH_FACTOR, _HASH_MASK = 4, 1469598103, 1099511628211, (1 << 58) - 1

FEW = 24  # vehicles: up to so many, looking at every pair is as fast
_CROWD = 48  # near ones: from so many on, looking at every vehicle is faster than sorting
_MARGIN = 1.0 + 1e-6  # a cell is wider than the radius by more than rounding can do, up to _FAR cells away
_FAR = 1 << 20
_EMPTY = -1
ALL_PAIRS = -2  # in table[0]: there are no cells that help, look at every pair

_COINCIDENT = avoidance._COINCIDENT
_COINCIDENT_SQUARE = avoidance._COINCIDENT**2


@kernel
def turn(
    phases: int,
    tick: int,
    positions: NDArray[Any],
    velocities: NDArray[Any],
    heard: NDArray[Any],
    kinds: NDArray[Any],
    settings: NDArray[Any],
    slots: NDArray[Any],
    start: NDArray[Any],
    peer: NDArray[Any],
    weight: NDArray[Any],
    cells: NDArray[Any],
    table: NDArray[Any],
    notes: NDArray[Any],
    vectors: NDArray[Any],
    commands: NDArray[Any],
    given: NDArray[Any],
    air: Any,
    radio: Any,
) -> int:
    """Compute phases of one turn of M followers among N vehicles.

    Args:
        phases: SENSE (who is ready; avoidance), LAW (consensus), COMMAND (limits, give way), or sums of them in order.
        tick: now, of the swarm's clock.
        positions: shape (N, 3), m ENU.
        velocities: shape (N, 3), m/s ENU, zero while unknown.
        heard: shape (N,), tick of each position, NEVER while unknown.
        kinds: shape (M, KINDS).
        settings: shape (M, SETTINGS).
        slots: tables of slots, shape (S, N, 3), m ENU, the leader's zero first.
        start: shape (M+1,): row k listens to ``peer[start[k]:start[k+1]]`` with the weights beside them.
        peer: numbers of vehicles.
        weight: w_ij.
        cells: shape (N, 5), int32, for the search: cell x, y, z, next vehicle in the bucket; a list of near ones.
        table: the buckets of the search, int32, a power of two of them.
        notes: shape (NOTES, M): status; signature of problems, now and before; whether the avoidance has changed; the
            rows to be reported.
        vectors: shape (2, M, 3): the avoidance before its gain; the law's result before limits, m/s or m/s^2 ENU.
        commands: shape (N, 3), written: what to command.
        given: shape (N,), written: to whom.
        air: of a network, if followers know what it brings: the states above are written for one after the other.
        radio: what its ``near`` gives, for the greatest radius; None if there is no network.

    Returns:
        The number of rows to be reported: their problems or their avoidance have changed.
    """
    gridded = len(heard) > FEW and air is None
    if gridded and phases & SENSE:
        widest = 0.0
        for k in range(len(kinds)):
            widest = max(widest, settings[k, RADIUS])
        if not _fill_cells(positions, heard, widest * _MARGIN, cells, table):
            table[0] = ALL_PAIRS  # too far away for exact cells
    gridded = gridded and table[0] != ALL_PAIRS
    reported = 0
    for k in range(len(kinds)):
        index = kinds[k, ID]
        if air is not None:
            _receive(k, index, air, start, peer, positions, velocities, heard)
        near = -1  # not looked for yet
        if phases & SENSE:
            status = _status(k, tick, heard, kinds)
            notes[STATUS, k], notes[MOVED, k] = status, 0
            notes[PROBLEMS, k] = HAS_STOPPED if status == STOPPED else 0
            if status == READY and kinds[k, OWN_AVOIDANCE]:
                if radio is None:
                    near = _near(index, positions, heard, settings[k, RADIUS], gridded, cells, table)
                else:
                    near = _near_by_radio(index, positions, settings[k, RADIUS], radio, cells)
                x, y, z = _avoid(index, positions, settings[k, RADIUS], cells, near)
                notes[MOVED, k] = vectors[0, k, 0] != x or vectors[0, k, 1] != y or vectors[0, k, 2] != z
                vectors[0, k, 0], vectors[0, k, 1], vectors[0, k, 2] = x, y, z
        ready = notes[STATUS, k] == READY
        if phases & LAW and ready and kinds[k, OWN_LAW]:
            _law(k, tick, positions, velocities, heard, kinds, settings, slots, start, peer, weight, notes, vectors)
        if phases & COMMAND:
            given[index] = notes[STATUS, k] != WAITING
            commands[index] = 0.0
            if ready:
                if near < 0 and kinds[k, GIVE_WAY]:
                    if radio is None:
                        near = _near(index, positions, heard, settings[k, RADIUS], gridded, cells, table)
                    else:
                        near = _near_by_radio(index, positions, settings[k, RADIUS], radio, cells)
                _command(k, positions, kinds, settings, cells, near, notes, vectors, commands)
            if given[index] and _is_news(k, kinds, notes):
                notes[REPORTED, reported] = k
                reported += 1
    return reported


@kernel
def _is_news(k: int, kinds: NDArray[Any], notes: NDArray[Any]) -> bool:
    """Return whether a row's problems (or their numbers) or its avoidance are others than before, and remember them."""
    problems, before = notes[PROBLEMS, k], notes[PROBLEMS_BEFORE, k]
    notes[PROBLEMS_BEFORE, k] = 0 if kinds[k, ASKED] else problems
    return notes[MOVED, k] != 0 or problems != before or problems & BAD_LAW != 0


@kernel
def _status(k: int, tick: int, heard: NDArray[Any], kinds: NDArray[Any]) -> int:
    at = heard[kinds[k, ID]]
    if at == NEVER or kinds[k, SLOTS] < 0:
        return WAITING
    return READY if tick - at <= kinds[k, TIMEOUT] else STOPPED


@kernel
def _law(
    k: int,
    tick: int,
    positions: NDArray[Any],
    velocities: NDArray[Any],
    heard: NDArray[Any],
    kinds: NDArray[Any],
    settings: NDArray[Any],
    slots: NDArray[Any],
    start: NDArray[Any],
    peer: NDArray[Any],
    weight: NDArray[Any],
    notes: NDArray[Any],
    vectors: NDArray[Any],
) -> None:
    """Put the consensus of a row into ``vectors[1]``, and what is wrong with its neighbours into its signature."""
    index, slot, accel, gamma = kinds[k, ID], slots[kinds[k, SLOTS]], kinds[k, ACCEL], settings[k, GAMMA]
    px, py, pz = positions[index, 0], positions[index, 1], positions[index, 2]
    if accel:
        px += gamma * velocities[index, 0]
        py += gamma * velocities[index, 1]
        pz += gamma * velocities[index, 2]
    dx, dy, dz = slot[index, 0], slot[index, 1], slot[index, 2]
    x = y = z = degree = 0.0
    heard_of, missing = 0, 0
    code = _HASH_START
    for entry in range(start[k], start[k + 1]):
        j, w = peer[entry], weight[entry]
        if heard[j] == NEVER or tick - heard[j] > kinds[k, TIMEOUT]:
            missing = SILENT
            code = ((code ^ j) * _HASH_FACTOR) & _HASH_MASK
            continue
        heard_of += 1
        qx, qy, qz = positions[j, 0], positions[j, 1], positions[j, 2]
        if accel:
            qx += gamma * velocities[j, 0]
            qy += gamma * velocities[j, 1]
            qz += gamma * velocities[j, 2]
        x += w * ((qx - slot[j, 0]) - (px - dx))
        y += w * ((qy - slot[j, 1]) - (py - dy))
        z += w * ((qz - slot[j, 2]) - (pz - dz))
        degree += w
    if degree != 0.0:
        gain = settings[k, GAIN] / degree if kinds[k, NORMALISE] else settings[k, GAIN]
        x, y, z = gain * x, gain * y, gain * z
    else:
        x = y = z = 0.0
    vectors[1, k, 0], vectors[1, k, 1], vectors[1, k, 2] = x, y, z
    if missing:
        notes[PROBLEMS, k] |= SILENT | (code << _HASH_SHIFT)
    if heard_of == 0:
        notes[PROBLEMS, k] |= ALONE


@kernel
def _command(
    k: int,
    positions: NDArray[Any],
    kinds: NDArray[Any],
    settings: NDArray[Any],
    cells: NDArray[Any],
    near: int,
    notes: NDArray[Any],
    vectors: NDArray[Any],
    commands: NDArray[Any],
) -> None:
    """Put law and avoidance together, the law within the limit first, and give way."""
    index, limit, gain = kinds[k, ID], settings[k, LIMIT], settings[k, AVOID_GAIN]
    x, y, z = vectors[1, k, 0], vectors[1, k, 1], vectors[1, k, 2]
    if notes[PROBLEMS, k] & ALONE:
        x = y = z = 0.0
    elif not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        notes[PROBLEMS, k] |= BAD_LAW
        x = y = z = 0.0
    x, y, z = _clip(x, y, z, limit)
    x, y, z = _clip(x + gain * vectors[0, k, 0], y + gain * vectors[0, k, 1], z + gain * vectors[0, k, 2], limit)
    if kinds[k, GIVE_WAY]:
        x, y, z = _give_way(index, positions, x, y, z, settings[k, RADIUS], settings[k, CLEARANCE], cells, near)
    commands[index, 0], commands[index, 1], commands[index, 2] = x, y, z


@kernel
def _clip(x: float, y: float, z: float, limit: float) -> tuple[float, float, float]:
    length = math.sqrt(x * x + y * y + z * z)
    if length <= limit:
        return x, y, z
    k = limit / length
    return x * k, y * k, z * k


@kernel
def _avoid(
    index: int, positions: NDArray[Any], radius: float, cells: NDArray[Any], near: int
) -> tuple[float, float, float]:
    """Algorithm 1 against the ``near`` vehicles in the list."""
    px, py, pz = positions[index, 0], positions[index, 1], positions[index, 2]
    ax = ay = az = 0.0
    for entry in range(near):
        j = cells[entry, 4]
        dx, dy, dz = _pair(positions[j, 0] - px, positions[j, 1] - py, positions[j, 2] - pz, radius, index < j)
        ax, ay, az = ax + dx, ay + dy, az + dz
    return ax, ay, az


@kernel
def _pair(x: float, y: float, z: float, radius: float, first: bool) -> tuple[float, float, float]:
    distance = math.sqrt(x * x + y * y + z * z)
    if not distance < radius:
        return 0.0, 0.0, 0.0
    if distance < _COINCIDENT:
        x, y, z = (1.0 if first else -1.0), 0.0, 0.0
    if abs(x) < abs(y):
        ax, ay, az = 0.0, z, -y
    else:
        ax, ay, az = -z, 0.0, x
    k = avoidance.GAIN * (1.0 - distance / radius) / math.sqrt(ax * ax + ay * ay + az * az)
    return k * ax, k * ay, k * az


@kernel
def _give_way(
    index: int,
    positions: NDArray[Any],
    vx: float,
    vy: float,
    vz: float,
    radius: float,
    clearance: float,
    cells: NDArray[Any],
    near: int,
) -> tuple[float, float, float]:
    px, py, pz = positions[index, 0], positions[index, 1], positions[index, 2]
    for _ in range(avoidance.ROUNDS):
        for entry in range(near):
            j = cells[entry, 4]
            x, y, z = positions[j, 0] - px, positions[j, 1] - py, positions[j, 2] - pz
            square = x * x + y * y + z * z
            towards = x * vx + y * vy + z * vz
            if towards <= 0.0 or square <= _COINCIDENT_SQUARE:
                continue
            remains = (math.sqrt(square) - clearance) / (radius - clearance)
            if not remains > 0.0:
                remains = 0.0
            k = (1.0 - remains * remains) * towards / square
            vx, vy, vz = vx - k * x, vy - k * y, vz - k * z
    return vx, vy, vz


@kernel
def _fill_cells(
    positions: NDArray[Any], heard: NDArray[Any], size: float, cells: NDArray[Any], table: NDArray[Any]
) -> bool:
    """Sort the known vehicles into cells of ``size`` m, each bucket's in ascending order; False if one is too far."""
    table[:] = _EMPTY
    for j in range(len(positions) - 1, -1, -1):
        if heard[j] == NEVER:
            continue
        for axis in range(3):
            number = math.floor(positions[j, axis] / size)
            if not abs(number) < _FAR:
                return False
            cells[j, axis] = int(number)
        bucket = _bucket(cells[j, 0], cells[j, 1], cells[j, 2], len(table))
        cells[j, 3] = table[bucket]
        table[bucket] = j
    return True


@kernel
def _bucket(x: int, y: int, z: int, buckets: int) -> int:
    return (x * 73856093 ^ y * 19349663 ^ z * 83492791) & (buckets - 1)


@kernel
def _near(
    index: int,
    positions: NDArray[Any],
    heard: NDArray[Any],
    radius: float,
    gridded: bool,
    cells: NDArray[Any],
    table: NDArray[Any],
) -> int:
    """List the known vehicles within ``radius`` of a known one in ``cells[:, 4]``, ascending; return how many."""
    square = radius * radius
    if gridded:
        found = _near_in_cells(index, positions, square, cells, table)
        if found < _CROWD:
            return found
    px, py, pz = positions[index, 0], positions[index, 1], positions[index, 2]
    found = 0
    for j in range(len(positions)):
        x, y, z = positions[j, 0] - px, positions[j, 1] - py, positions[j, 2] - pz
        if x * x + y * y + z * z < square and j != index and heard[j] != NEVER:
            cells[found, 4] = j
            found += 1
    return found


@kernel
def _near_in_cells(index: int, positions: NDArray[Any], square: float, cells: NDArray[Any], table: NDArray[Any]) -> int:
    """As _near; it stops at _CROWD of them."""
    px, py, pz = positions[index, 0], positions[index, 1], positions[index, 2]
    cx, cy, cz = cells[index, 0], cells[index, 1], cells[index, 2]
    found = 0
    for ix in range(cx - 1, cx + 2):
        for iy in range(cy - 1, cy + 2):
            for iz in range(cz - 1, cz + 2):
                j = table[_bucket(ix, iy, iz, len(table))]
                while j != _EMPTY:
                    if cells[j, 0] == ix and cells[j, 1] == iy and cells[j, 2] == iz and j != index:
                        x, y, z = positions[j, 0] - px, positions[j, 1] - py, positions[j, 2] - pz
                        if x * x + y * y + z * z < square:
                            if found == _CROWD:
                                return found
                            _insert(cells, found, j)
                            found += 1
                    j = cells[j, 3]
    return found


@kernel
def _receive(
    k: int,
    index: int,
    air: Any,
    start: NDArray[Any],
    peer: NDArray[Any],
    positions: NDArray[Any],
    velocities: NDArray[Any],
    heard: NDArray[Any],
) -> None:
    """Write what a row's vehicle knows by its network of itself and of those it listens to."""
    for entry in range(start[k] - 1, start[k + 1]):
        j = index if entry < start[k] else peer[entry]
        heard[j] = sample(air, index, j, positions[j], velocities[j])
        for axis in range(3):
            if not math.isfinite(velocities[j, axis]):
                velocities[j, axis] = 0.0


@kernel
def _near_by_radio(index: int, positions: NDArray[Any], radius: float, radio: Any, cells: NDArray[Any]) -> int:
    """List those that a vehicle knows of within ``radius`` as _near does, and write where it believes them to be."""
    start, others, places = radio
    px, py, pz = positions[index, 0], positions[index, 1], positions[index, 2]
    found = 0
    for entry in range(start[index], start[index + 1]):
        x, y, z = places[entry, 0] - px, places[entry, 1] - py, places[entry, 2] - pz
        if x * x + y * y + z * z < radius * radius:
            j = others[entry]
            positions[j, 0], positions[j, 1], positions[j, 2] = places[entry, 0], places[entry, 1], places[entry, 2]
            cells[found, 4] = j
            found += 1
    return found


@kernel
def _insert(cells: NDArray[Any], found: int, j: int) -> None:
    """Put ``j`` in its place among the ``found`` ascending numbers of the list."""
    place = found
    while place > 0 and cells[place - 1, 4] > j:
        cells[place, 4] = cells[place - 1, 4]
        place -= 1
    cells[place, 4] = j
