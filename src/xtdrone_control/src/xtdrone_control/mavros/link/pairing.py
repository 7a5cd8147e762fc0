"""Pairs of messages from two topics by their stamps, as ROS's message_filters pairs them for MAVROS.

After the ApproximateTime policy of message_filters (http://wiki.ros.org/message_filters/ApproximateTime), with its own
settings and two topics: a message that is used waits until what came on the other topic is known around its stamp.
"""

from __future__ import annotations

from collections import deque
from typing import Any

_AGE_PENALTY = 1.1  # a partner that is later counts that much farther away
_Entry = tuple[int, Any]


class Pairing:
    """The messages of two topics that have no partner yet.

    The later one of both topics' oldest messages looks for its partner: the other topic's last one before it, or the
    first one after it when that is nearer. Both, and what came before them, are then used up.
    """

    def __init__(self, size: int = 10) -> None:
        """Keep at most ``size`` messages of each topic, the newest."""
        self._size = size
        self._queues: tuple[deque[_Entry], deque[_Entry]] = (deque(), deque())
        self._dropped = [False, False]

    def clear(self) -> None:
        """Forget all messages."""
        for side in (0, 1):
            self._queues[side].clear()
            self._dropped[side] = False

    def add(self, side: int, stamp_ns: int, message: Any) -> list[tuple[Any, Any]]:
        """Take a message and return the pairs that are settled now, the oldest first.

        Args:
            side: topic, 0 or 1.
            stamp_ns: the message's stamp. One that is earlier than the topic's last means that the clock was set back:
                what came before is forgotten.
            message: what comes back in the pairs, topic 0's first.
        """
        queue = self._queues[side]
        if queue and stamp_ns < queue[-1][0]:
            self.clear()
        queue.append((stamp_ns, message))
        if len(queue) > self._size:
            queue.popleft()
            self._dropped[side] = True
        pairs = []
        while (pair := self._settle()) is not None:
            pairs.append(pair)
        return pairs

    def _settle(self) -> tuple[Any, Any] | None:
        """Return the next pair and use it up; None while there is none, or a better partner may still come."""
        first, second = self._queues
        while first and second:
            side = 0 if first[0][0] > second[0][0] else 1
            queue, other = self._queues[side], self._queues[1 - side]
            self._dropped[1 - side] = False
            if self._dropped[side]:  # what was dropped may have been the other's partner
                other.popleft()
                continue
            stamp = queue[0][0]
            while len(other) > 1 and other[1][0] <= stamp:
                other.popleft()
            before = stamp - other[0][0]
            if before > 0:
                if len(other) == 1:
                    return None
                if _AGE_PENALTY * (other[1][0] - stamp) < before:
                    other.popleft()
            mine, partner = queue.popleft()[1], other.popleft()[1]
            return (mine, partner) if side == 0 else (partner, mine)
        return None
