"""Search of the highest speed at which nodes that run free still do their work. No ROS here.

Nodes outside the lockstep do not hold the simulator: it can be made as fast as one likes, and they then miss turns. The
speed that says something is the highest at which they miss (nearly) none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

LEAST_TURNS = 0.95
"""Share of the turns made in lockstep that a role's nodes must make."""
TURNS = ("commands", "setpoints", "poses")
"""Roles that must make them. Not ``swarm``: its messages say how fresh the positions are that followers work with. When
the MAVROS layer's turns come late, one message takes the place of two; no turn is missed by that."""
LEAST_SPEED = 0.95
"""Share of the target speed that must be reached."""
LADDER = (1.0, 1 / 0.7, 2.0, 3.0, 4.5, 7.0, 10.0)
"""Speeds to begin with, as multiples of that in lockstep."""
LOWEST = 0.1
"""Multiple of the speed in lockstep below which nothing is tried."""
RESOLUTION = 1.06
"""Ratio of two speeds, a good and a bad one, between which no other is tried."""
MAX_TRIALS = 12
FAILURES = 2
"""How often a speed must fail to count as too high: a single failure may be other programs' doing."""


@dataclass(frozen=True)
class Trial:
    """One speed that was tried.

    Attributes:
        speed: target real-time factor.
        real_time_factor: that was reached; 0 when the flight broke off.
        turns: share of the messages in lockstep that nodes published, on average, by role (``bus_statistics.ROLES``).
        cpu: CPU s per simulated s by program.
        others_cpu: cores' worth that other programs took.
    """

    speed: float
    real_time_factor: float = 0.0
    turns: Mapping[str, float] = field(default_factory=dict)
    cpu: Mapping[str, float] = field(default_factory=dict)
    others_cpu: float = 0.0

    @property
    def good(self) -> bool:
        """Whether the speed was reached and the nodes did their work."""
        reached = self.real_time_factor >= LEAST_SPEED * self.speed
        return reached and all(self.turns.get(role, 0.0) >= LEAST_TURNS for role in TURNS)

    @property
    def broken(self) -> bool:
        """Whether the flight broke off."""
        return self.real_time_factor == 0.0


def best(trials: Sequence[Trial]) -> Trial | None:
    """Return the good trial with the highest speed."""
    return max((trial for trial in trials if trial.good), key=lambda trial: trial.real_time_factor, default=None)


def next_speed(exact: float, trials: Sequence[Trial]) -> float | None:
    """Return the speed to try next, None when the search is over.

    Args:
        exact: real-time factor in lockstep.
        trials: those made so far.
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
