"""Settings of the network between the vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass

from xtdrone_common.settings import SettingError, Settings, setting

RATE = 30  # turns per second, Hz: of the followers and their samples

MESSAGE_BITS = 320  # LOCAL_POSITION_NED in a MAVLink 2 frame: 28 bytes, and a header and checksum of 12

_LONGEST = 60.0  # s; bounds the memory needed
_MOST_WAITING = 1000


@dataclass(frozen=True)
class NetworkOptions(Settings):
    """Settings of the network; the defaults are an ideal network.

    ``burst`` makes losses last (the Gilbert-Elliott channel: a bad state loses all messages, a good one none) at the
    same mean ``loss``.

    All vehicles within range of each other share ``bandwidth``, as on a common channel, which bounds the size of a
    swarm. Each sender uses the share available at the most crowded of its receivers, as with evenly allocated time
    slots, and starts at a random phase of its sending interval.

    With a ``queue`` of 1 a vehicle sends its newest sample; a longer queue does not send more, only later. Samples sent
    in one turn are sent, and lost, together. ``memory`` bounds the effect of a follower's ``pose_timeout``.
    """

    range: float = setting(
        math.inf, above=0.0, high=math.inf, unit="m", metavar="M",
        text="distance from the sender within which a sample is received",
    )  # fmt: skip
    delay: float = setting(
        0.0, low=0.0, high=_LONGEST, unit="s", metavar="S",
        text="time from sending to arrival, rounded up to whole turns",
    )  # fmt: skip
    jitter: float = setting(
        0.0, low=0.0, high=_LONGEST, unit="s", metavar="S",
        text="maximum additional delay of a message, uniformly distributed from 0",
    )  # fmt: skip
    loss: float = setting(
        0.0, low=0.0, high=1.0, metavar="PART",
        text="probability that a message is lost, independently for each receiver",
    )  # fmt: skip
    burst: float = setting(
        0.0, low=0.0, high=_LONGEST, unit="s", metavar="S",
        text="mean duration of an outage of a link; with 0, losses are independent",
    )  # fmt: skip
    bandwidth: float = setting(
        math.inf, above=0.0, high=math.inf, unit="bit/s", metavar="BIT/S",
        text="capacity of the radio channel at any one place",
    )  # fmt: skip
    message_bits: int = setting(MESSAGE_BITS, low=1, unit="bit", text="size of a transmitted sample")
    queue: int = setting(
        1, low=1, high=_MOST_WAITING, text="samples waiting at a sender; when it is full, the oldest is dropped"
    )
    memory: float = setting(2.0, above=0.0, high=_LONGEST, unit="s", text="age at which a received sample is dropped")

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            SettingError: a setting is out of its range.
        """
        try:
            super().__post_init__()
        except SettingError as error:
            raise SettingError(f"network {error.name}", error.value, error.allowed) from error
        shortest = 1.0 / (RATE * (1.0 - self.loss)) if self.loss < 1.0 else 0.0
        if 0.0 < self.burst < shortest:
            allowed = (
                f"0 or at least {shortest:.4g} s: with a loss of {self.loss} even independent losses last that long"
            )
            raise SettingError("network burst", self.burst, allowed)

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
