"""Columns of numbers that grow while a recording is read, within a bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_VALUES = 24_000_000
"""Numbers kept of one recording, 192 MB; of longer ones every second, fourth, ... message is kept."""
_SHORT = 5_000  # rows; a topic with fewer is not thinned
_FIRST_ROOM = 64  # rows


@dataclass(frozen=True)
class Series:
    """What a topic said over time.

    Attributes:
        time: increasing, s, shape (t,).
        value: shape (t, k).
    """

    time: Array
    value: Array

    def __len__(self) -> int:
        return len(self.time)

    def at(self, time: Array) -> Array:
        """Return the values at other times, between messages by interpolation, outside of them NaN; shape (t', k)."""
        found = np.full((len(time), self.value.shape[1]), np.nan)
        if len(self.time):
            for column in range(self.value.shape[1]):
                found[:, column] = np.interp(time, self.time, self.value[:, column], np.nan, np.nan)
        return found

    def moved(self, origin: float) -> Series:
        """Return the same with times counted from ``origin``, s."""
        return Series(self.time - origin, self.value)


class Column:
    """Rows of one topic, as they come.

    Attributes:
        width: numbers in a row, without its time.
        stride: of so many messages one is kept.
        rows: how many are kept.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self.stride = 1
        self.rows = 0
        self._room = np.empty((_FIRST_ROOM, width + 1))  # grows by a quarter, and is never handed out in parts
        self._skip = 0  # messages until the next that is kept

    def add(self, time: Array, value: Array) -> int:
        """Add rows, shapes (n,) s and (n, width), and return how many numbers are kept of them."""
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
        """Drop every second row, and of what comes too."""
        if self.rows % 2:
            self._skip += self.stride  # the last one stays, so the next would be dropped
        whole = self._room[: self.rows]
        self.rows = len(whole[::2])
        whole[: self.rows] = whole[::2]
        self.stride *= 2

    def series(self) -> Series:
        """Return what was kept, in order of time, and forget it."""
        whole = self._room[: self.rows]
        if (np.diff(whole[:, 0]) < 0).any():
            whole = whole[np.argsort(whole[:, 0], kind="stable")]
        found = Series(whole[:, 0].copy(), whole[:, 1:].copy())
        self._room, self.rows = self._room[:0], 0
        return found


class Columns:
    """All columns of a recording.

    Attributes:
        most: numbers kept of all together.
        stride: of the topic that was thinned most.
    """

    def __init__(self, most: int = MOST_VALUES) -> None:
        self.most = most
        self.stride = 1
        self._columns: dict[tuple[str, ...], Column] = {}
        self._values = 0

    def add(self, key: tuple[str, ...], time: Array, value: Array) -> None:
        """Add rows to a column, shapes (n,) s and (n, k)."""
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
        self.most = max(self.most, 2 * self._values)  # thousands of short topics: no more can be saved

    @property
    def thinned(self) -> set[tuple[str, ...]]:
        """Keys of the columns of which not every message was kept."""
        return {key for key, column in self._columns.items() if column.stride > 1}

    def series(self) -> dict[tuple[str, ...], Series]:
        """Return all columns by key, and forget them."""
        return {key: column.series() for key, column in self._columns.items()}


def flown(armed: Sequence[tuple[float, bool]], end: float) -> tuple[float, float]:
    """Return from the first arming to the last disarming, s; all until ``end`` where it was never armed."""
    starts = [time for time, is_armed in armed if is_armed]
    if not starts:
        return 0.0, end
    ends = [time for time, is_armed in armed if not is_armed and time > starts[0]]
    return starts[0], end if armed[-1][1] or not ends else ends[-1]
