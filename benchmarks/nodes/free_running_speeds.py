"""Search for the highest speed at which free-running nodes complete their cycles; needs no ROS.

Nodes outside the lockstep do not slow the simulator down: it accepts any speed, and they then miss cycles. The
meaningful speed is the highest one at which they miss (almost) none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

LEAST_TURNS = 0.95
"""Required share of the cycles completed in lockstep."""
TURNS = ("commands", "setpoints", "poses")
"""Roles to which that applies. ``swarm`` is excluded: when cycles of the MAVROS layer are late, one
message replaces two, which is not a missed cycle."""
LEAST_SPEED = 0.95
"""Required share of the target speed."""
LADDER = (1.0, 1 / 0.7, 2.0, 3.0, 4.5, 7.0, 10.0)
"""First speeds to try, as multiples of the speed in lockstep."""
LOWEST = 0.1
"""Lowest speed to try, as a multiple of the speed in lockstep."""
RESOLUTION = 1.06
"""Ratio of a bad and a good speed below which the search ends."""
MAX_TRIALS = 12
FAILURES = 2
"""Failures after which a speed is too high; a single failure may be caused by other programs."""


@dataclass(frozen=True)
class Trial:
    """A trial of one speed.

    Attributes:
        speed: target real-time factor.
        real_time_factor: reached; 0 if the flight was aborted.
        turns: mean share of the messages published in lockstep, by role (``bus_statistics.ROLES``).
        cpu: CPU s per simulated s by program.
        others_cpu: cores used by other programs.
    """

    speed: float
    real_time_factor: float = 0.0
    turns: Mapping[str, float] = field(default_factory=dict)
    cpu: Mapping[str, float] = field(default_factory=dict)
    others_cpu: float = 0.0

    @property
    def good(self) -> bool:
        """Whether the speed was reached and the nodes completed their cycles."""
        reached = self.real_time_factor >= LEAST_SPEED * self.speed
        return reached and all(self.turns.get(role, 0.0) >= LEAST_TURNS for role in TURNS)

    @property
    def broken(self) -> bool:
        """Whether the flight was aborted."""
        return self.real_time_factor == 0.0


def best(trials: Sequence[Trial]) -> Trial | None:
    """Return the good trial with the highest speed."""
    return max((trial for trial in trials if trial.good), key=lambda trial: trial.real_time_factor, default=None)


def next_speed(exact: float, trials: Sequence[Trial]) -> float | None:
    """Return the next speed to try, None at the end of the search.

    Args:
        exact: real-time factor in lockstep.
        trials: made so far.
    """
    if len(trials) >= MAX_TRIALS:
        return None
    good = max((trial.speed for trial in trials if trial.good), default=0.0)
    bad = [trial for trial in trials if not trial.good and trial.speed > good]
    if bad and trials[-1] is bad[-1] and not _is_too_high(bad[-1].speed, bad):
        return bad[-1].speed
    least_bad = min((trial.speed for trial in bad), default=math.inf)
    if math.isinf(least_bad):
        return next((exact * step for step in LADDER if exact * step > good * RESOLUTION), None)
    if good == 0.0:
        lower = 0.7 * least_bad
        return lower if lower >= LOWEST * exact else None
    return math.sqrt(good * least_bad) if least_bad > good * RESOLUTION else None


def _is_too_high(speed: float, bad: Sequence[Trial]) -> bool:
    same = [trial for trial in bad if trial.speed == speed]
    return len(same) >= FAILURES or any(trial.broken for trial in same)
