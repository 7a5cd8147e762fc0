"""Time series, and the columns they grow in while a recording is read within bounded memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_VALUES = 24_000_000
"""Numbers kept of one recording, 192 MB; longer ones are thinned to every second, fourth, ... message."""
_SHORT = 5_000  # rows; a topic with fewer is not thinned
_FIRST_ROOM = 64  # rows


@dataclass(frozen=True)
class Series:
    """Values over time.

    Attributes:
        time: not decreasing, s, shape (t,).
        value: shape (t, k).
    """

    time: Array
    value: Array

    def __len__(self) -> int:
        return len(self.time)

    def at(self, time: Array) -> Array:
        """Return values interpolated at other times, shape (t', k); NaN outside the series."""
        found = np.full((len(time), self.value.shape[1]), np.nan)
        if len(self.time):
            for column in range(self.value.shape[1]):
                found[:, column] = np.interp(time, self.time, self.value[:, column], np.nan, np.nan)
        return found

    def column(self, number: int, scale: float = 1.0) -> Series:
        """Return one column times ``scale``, shape (t, 1)."""
        return Series(self.time, scale * self.value[:, number : number + 1])

    def since(self, origin: float) -> Series:
        """Return the series with times counted from ``origin``, s."""
        return Series(self.time - origin, self.value)


class Column:
    """Growing rows of one topic.

    Attributes:
        width: numbers per row, without its time.
        stride: one message in so many is kept.
        rows: number of rows kept.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self.stride = 1
        self.rows = 0
        self._room = np.empty((_FIRST_ROOM, width + 1))  # grows by a quarter; series are copied out of it
        self._skip = 0  # messages until the next kept one

    def add(self, time: Array, value: Array) -> int:
        """Append rows, shapes (n,) s and (n, width); return the count of numbers kept."""
        kept = slice(self._skip, None, self.stride)
        self._skip = (self._skip - len(time)) % self.stride
        count = len(time[kept])
        if (end := self.rows + count) > len(self._room):
            room = np.empty((max(end, 5 * len(self._room) // 4), self.width + 1))
            room[: self.rows] = self._room[: self.rows]
            self._room = room
        self._room[self.rows : end, 0] = time[kept]
        self._room[self.rows : end, 1:] = value[kept]
        self.rows = end
        return count * (self.width + 1)

    def thin(self) -> None:
        """Drop every second row, now and in future."""
        if self.rows % 2:
            self._skip += self.stride  # the last row stays, so the next one is dropped
        whole = self._room[: self.rows]
        self.rows = len(whole[::2])
        whole[: self.rows] = whole[::2]
        self.stride *= 2

    def series(self) -> Series:
        """Return the kept rows sorted by time, and release them."""
        whole = self._room[: self.rows]
        if (np.diff(whole[:, 0]) < 0).any():
            whole = whole[np.argsort(whole[:, 0], kind="stable")]
        found = Series(whole[:, 0].copy(), whole[:, 1:].copy())
        self._room, self.rows = self._room[:0], 0
        return found


class Columns:
    """All columns of a recording.

    Attributes:
        most: maximum number of values kept, of all columns together.
        stride: of the most thinned column.
    """

    def __init__(self, most: float = MOST_VALUES) -> None:
        self.most = most
        self.stride = 1
        self._columns: dict[tuple[str, ...], Column] = {}
        self._values = 0

    def add(self, key: tuple[str, ...], time: Array, value: Array) -> None:
        """Append rows to a column, shapes (n,) s and (n, k)."""
        if key not in self._columns:
            self._columns[key] = Column(value.shape[1])
        self._values += self._columns[key].add(time, value)
        if self._values > self.most:
            self._thin()

    def _thin(self) -> None:
        for column in self._columns.values():
            if column.rows > _SHORT:
                column.thin()
                self.stride = max(self.stride, column.stride)
        self._values = sum(column.rows * (column.width + 1) for column in self._columns.values())
        self.most = max(self.most, 2 * self._values)  # thousands of short topics cannot be thinned further

    @property
    def thinned(self) -> set[tuple[str, ...]]:
        """Keys of the thinned columns."""
        return {key for key, column in self._columns.items() if column.stride > 1}

    def series(self) -> dict[tuple[str, ...], Series]:
        """Return all columns by key, and release them."""
        return {key: column.series() for key, column in self._columns.items()}


def spans(changes: Sequence[tuple[float, Any]], end: float) -> Iterator[tuple[float, float, Any]]:
    """Yield start, end and value of each constant span of a value.

    Args:
        changes: time and new value.
        end: of the last span, s.
    """
    for number, (start, value) in enumerate(changes):
        yield start, changes[number + 1][0] if number + 1 < len(changes) else max(end, start), value


def armed_span(armed: Sequence[tuple[float, bool]], end: float) -> tuple[float, float]:
    """Return the times of the first arming and the last disarming, s; (0, end) if never armed.

    Args:
        armed: time and new state of each change.
        end: of the recording, s.
    """
    starts = [time for time, is_armed in armed if is_armed]
    if not starts:
        return 0.0, end
    ends = [time for time, is_armed in armed if not is_armed and time > starts[0]]
    return starts[0], end if armed[-1][1] or not ends else ends[-1]
