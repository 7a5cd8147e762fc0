"""Pairing of messages from two topics by their stamps, like ROS's message_filters in MAVROS.

Follows the ApproximateTime policy of message_filters (http://wiki.ros.org/message_filters/ApproximateTime) with its
default settings and two topics: a message is held until the other topic's messages around its stamp are known.
"""

from __future__ import annotations

from collections import deque
from typing import Any

_AGE_PENALTY = 1.1  # weight of the distance to a later partner
_Entry = tuple[int, Any]


class Pairing:
    """Unpaired messages of two topics.

    The later of the two topics' oldest messages is paired with the other topic's last message before it, or with the
    first one after it if that is closer. Both, and all earlier messages, are then removed.
    """

    def __init__(self, size: int = 10) -> None:
        """Keep at most the newest ``size`` messages of each topic."""
        self._size = size
        self._queues: tuple[deque[_Entry], deque[_Entry]] = (deque(), deque())
        self._dropped = [False, False]

    def clear(self) -> None:
        """Drop all messages."""
        for side in (0, 1):
            self._queues[side].clear()
            self._dropped[side] = False

    def add(self, side: int, stamp_ns: int, message: Any) -> list[tuple[Any, Any]]:
        """Add a message and return the pairs that are now complete, oldest first.

        Args:
            side: topic, 0 or 1.
            stamp_ns: the message's stamp. A stamp earlier than the topic's last one means that the clock was set back,
                and drops all stored messages.
            message: object to return in the pairs, topic 0's first.
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
        """Remove and return the next pair; None if there is none yet, or a better partner may still arrive."""
        first, second = self._queues
        while first and second:
            side = 0 if first[0][0] > second[0][0] else 1
            queue, other = self._queues[side], self._queues[1 - side]
            self._dropped[1 - side] = False
            if self._dropped[side]:  # the dropped message may have been the partner
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
