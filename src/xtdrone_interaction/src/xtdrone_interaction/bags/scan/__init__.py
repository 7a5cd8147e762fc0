"""The compiled loop over a bag's records; a separate package, so that other changes do not recompile it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.kernel_cache import compiler

CONNECTION = -1
"""Returned instead of a connection number: the record describes a connection."""
OTHER = -2
"""Returned instead of a connection number: a record of another kind."""

kernel = compiler(Path(__file__).parent)


@kernel
def scan_records(
    data: NDArray[np.uint8],
    start: int,
    connection: NDArray[np.int64],
    time: NDArray[np.int64],
    offset: NDArray[np.int64],
    length: NDArray[np.int64],
) -> tuple[int, int]:
    """Find the records in a part of an unpacked chunk, up to the first incomplete or invalid one.

    Args:
        data: bytes of the chunk, shape (m,).
        start: where the first record begins.
        connection, time, offset, length: written to, each (k,): number of the connection (CONNECTION, OTHER), time in
            ns, where the record's data begin and how many bytes they are; of a connection's record where the record
            begins and how many bytes it has.

    Returns:
        How many records were found, at most k; where the next one begins.
    """
    count, at, end = 0, start, len(data)
    while count < len(connection) and at + 8 <= end:
        field = at + 4
        last = field + (data[at] | data[at + 1] << 8 | data[at + 2] << 16 | np.int64(data[at + 3]) << 24)
        if last + 4 > end:
            break
        kind, number, stamp = np.int64(-1), np.int64(-1), np.int64(0)
        while field + 4 <= last:
            name = field + 4
            size = data[field] | data[field + 1] << 8 | data[field + 2] << 16 | np.int64(data[field + 3]) << 24
            field = name + size
            if field > last:
                kind = np.int64(-1)
                break
            if size == 4 and data[name] == 111 and data[name + 1] == 112 and data[name + 2] == 61:  # op=
                kind = np.int64(data[name + 3])
            elif size == 9 and data[name] == 99 and data[name + 4] == 61:  # conn=
                number = np.int64(0)
                for i in range(4):
                    number |= np.int64(data[name + 5 + i]) << (8 * i)
            elif size == 13 and data[name] == 116 and data[name + 4] == 61:  # time=
                seconds, rest = np.int64(0), np.int64(0)
                for i in range(4):
                    seconds |= np.int64(data[name + 5 + i]) << (8 * i)
                    rest |= np.int64(data[name + 9 + i]) << (8 * i)
                stamp = seconds * 1_000_000_000 + rest
        if kind < 0:
            break
        body = last + 4
        size = data[last] | data[last + 1] << 8 | data[last + 2] << 16 | np.int64(data[last + 3]) << 24
        if body + size > end:
            break
        if kind == 2 and number >= 0:
            connection[count], time[count], offset[count], length[count] = number, stamp, body, size
        else:
            connection[count], time[count] = CONNECTION if kind == 7 else OTHER, 0
            offset[count], length[count] = at, body + size - at
        count, at = count + 1, body + size
    return count, at
