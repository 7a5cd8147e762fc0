"""Settings of the network between the vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral, Real

from xtdrone_coordination.follower import RATE

MESSAGE_BITS = 320  # LOCAL_POSITION_NED in a MAVLink 2 frame: 28 bytes, and a header and checksum of 12

_LONGEST = 60.0  # s; bounds the memory needed
_MOST_WAITING = 1000


@dataclass(frozen=True)
class NetworkOptions:
    """Settings of the network; the defaults are an ideal network.

    Attributes:
        range: m, above 0; a sample reaches the vehicles within this distance of the sender when it is sent.
        delay: s, 0 to 60, from sending to arrival; rounded up to whole turns.
        jitter: s, 0 to 60; additional delay of each message, uniformly distributed from 0 to this.
        loss: probability that a message does not arrive, 0 to 1, independently for each receiver.
        burst: mean duration of an outage of a link, s, 0 to 60: losses come in bursts (the Gilbert-Elliott channel with
            a bad state that loses all messages and a good one that loses none), at the same mean ``loss``. 0: losses
            are independent.
        bandwidth: capacity of the channel at any place, bit/s, above 0; bounds the mean rate of a receiver since the
            start. All vehicles within range of each other share it, as on a common channel, which bounds the size
            of a swarm; each sender uses the share available at the most crowded of its receivers, as with evenly
            allocated time slots. Each vehicle starts at a random phase of its sending interval.
        message_bits: size of a transmitted sample, bits, 1 or more.
        queue: samples waiting at a sender, 1 to 1000; when it is full the oldest is dropped. With 1 a vehicle sends its
            newest sample; a longer queue does not send more, only later. Samples sent in one turn are sent, and lost,
            together.
        memory: s, above 0 and at most 60; samples received longer ago are dropped, so a longer ``pose_timeout`` of a
            follower has no effect.
    """

    range: float = math.inf
    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    burst: float = 0.0
    bandwidth: float = math.inf
    message_bits: int = MESSAGE_BITS
    queue: int = 1
    memory: float = 2.0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: a setting is out of its range.
        """
        for name in ("range", "bandwidth"):
            _check(name, getattr(self, name), 0.0, math.inf, above=True)
        for name in ("delay", "jitter", "burst"):
            _check(name, getattr(self, name), 0.0, _LONGEST)
        _check("loss", self.loss, 0.0, 1.0)
        _check("memory", self.memory, 0.0, _LONGEST, above=True)
        _check_whole("message_bits", self.message_bits, math.inf)
        _check_whole("queue", self.queue, _MOST_WAITING)
        shortest = 1.0 / (RATE * (1.0 - self.loss)) if self.loss < 1.0 else 0.0
        if 0.0 < self.burst < shortest:
            raise ValueError(
                f"network burst: {self.burst} s is not allowed, 0 or at least {shortest:.4g} s: with a loss of "
                f"{self.loss} even independent losses last that long"
            )

    @property
    def ideal(self) -> bool:
        """Whether every sample reaches every vehicle at once."""
        return self.range == self.bandwidth == math.inf and self.delay == self.jitter == self.loss == 0.0


def transition_probabilities(options: NetworkOptions) -> tuple[float, float]:
    """Return the probabilities per turn that a link fails and recovers; (-1, 1) for independent losses."""
    if options.burst == 0.0 or options.loss in (0.0, 1.0):
        return -1.0, 1.0
    recover = 1.0 / (options.burst * RATE)
    return recover * options.loss / (1.0 - options.loss), recover


def _check(name: str, value: object, low: float, high: float, *, above: bool = False) -> None:
    """Raise ValueError unless ``value`` is a number from ``low`` (or above it) to ``high``."""
    allowed = f"{'above ' if above else ''}{low:g} {'and at most' if above else 'to'} {high:g}"
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"network {name}: {value!r} is not a number, {allowed} is allowed")
    number = float(value)
    if not low <= number <= high or (above and number == low):
        raise ValueError(f"network {name}: {value} is not allowed, {allowed}")


def _check_whole(name: str, value: object, high: float) -> None:
    """Raise ValueError unless ``value`` is a whole number from 1 to ``high``."""
    allowed = "a whole number, 1 or more" if math.isinf(high) else f"a whole number, 1 to {high:g}"
    if isinstance(value, bool) or not isinstance(value, Integral) or not 1 <= int(value) <= high:
        raise ValueError(f"network {name}: {value!r} is not allowed, {allowed}")
