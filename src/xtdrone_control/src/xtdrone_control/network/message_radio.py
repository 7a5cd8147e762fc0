"""Messages of any size by radio: which vehicles receive a broadcast, and when.

The model is that of the vehicles' samples (``channel``), for messages that are sent at any time. All random draws are
functions of seed, sender, receiver and the number of the message, so that the same messages always have the same fate.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.network.channel import JITTER, LOSS, draw, out_since
from xtdrone_control.network.network_options import RATE, NetworkOptions, transition_probabilities


class Arrival(NamedTuple):
    """Arrival of a message at one receiver.

    Attributes:
        time: s.
        receiver: number of the vehicle.
    """

    time: float
    receiver: int


class MessageRadio:
    """The radios of N vehicles.

    Attributes:
        sent: number of messages sent.
        lost: number of receptions that failed within range: by a loss or at a full queue.
        out_of_range: number of receptions that failed because of the distance.
    """

    def __init__(self, count: int, options: NetworkOptions, seed: int = 0) -> None:
        """Create the radios of ``count`` vehicles; ``memory`` and ``message_bits`` of the options are not used.

        Raises:
            ValueError: ``count`` or ``seed`` is out of range.
        """
        if count < 1:
            raise ValueError(f"network: {count} vehicles are not allowed, 1 or more")
        if seed < 0:
            raise ValueError(f"network seed: {seed} is not allowed, 0 or more")
        self._options = options
        self._seed = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
        self._fail, self._recover = transition_probabilities(options)
        self._count = count
        self.restart()

    def restart(self) -> None:
        """Reset to the state after construction; the same random draws follow."""
        self.sent = self.lost = self.out_of_range = 0
        self._numbers = [0] * self._count
        self._leaving: list[deque[float]] = [deque() for _ in range(self._count)]

    def send(self, now: float, sender: int, bits: int, positions: NDArray[np.float64]) -> list[Arrival]:
        """Broadcast a message; return where and when it arrives.

        Messages of a sender leave one after the other, each as long as its bits take at the sender's share of the
        bandwidth. At most ``queue`` of them wait or are being sent; a further one is dropped.

        Args:
            now: s; not less than in earlier calls.
            sender: number of the vehicle.
            bits: size.
            positions: Positions of all vehicles now, shape (N, 3), m; NaN where unknown, which counts as out of range
                if the range is finite.
        """
        number = self._numbers[sender]
        self._numbers[sender] += 1
        self.sent += 1
        heard = self._within(positions, sender)
        others = [j for j in range(self._count) if j != sender]
        receivers = [j for j in others if heard[j]]
        self.out_of_range += len(others) - len(receivers)
        leaves = self._leaves(now, sender, bits, positions, receivers)
        if leaves is None:
            self.lost += len(receivers)
            return []
        options, arrivals = self._options, []
        for receiver in receivers:
            if self._is_lost(leaves, number, sender, receiver):
                self.lost += 1
                continue
            extra = options.jitter * draw(self._seed, JITTER, number, sender, receiver)
            arrivals.append(Arrival(leaves + options.delay + extra, receiver))
        return arrivals

    def _within(self, positions: NDArray[np.float64], sender: int) -> NDArray[np.bool_]:
        if math.isinf(self._options.range):
            return np.ones(self._count, dtype=np.bool_)
        distances = np.linalg.norm(positions - positions[sender], axis=1)
        near: NDArray[np.bool_] = distances <= self._options.range
        return near

    def _leaves(
        self, now: float, sender: int, bits: int, positions: NDArray[np.float64], receivers: list[int]
    ) -> float | None:
        """Return the time at which a message has been sent completely, s; None if the queue is full."""
        if math.isinf(self._options.bandwidth):
            return now
        leaving = self._leaving[sender]
        while leaving and leaving[0] <= now:
            leaving.popleft()
        if len(leaving) >= self._options.queue:
            return None
        crowd = max([int(self._within(positions, j).sum()) for j in receivers], default=1)
        end = (leaving[-1] if leaving else now) + bits * crowd / self._options.bandwidth
        leaving.append(end)
        return end

    def _is_lost(self, time: float, number: int, sender: int, receiver: int) -> bool:
        if self._fail < 0.0:
            return bool(draw(self._seed, LOSS, number, sender, receiver) < self._options.loss)
        turn = int(time * RATE)
        return bool(out_since(self._seed, self._fail, self._recover, turn, sender, receiver) <= turn)
