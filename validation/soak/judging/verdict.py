"""Verdict on a soak: robust fits of its samples and episodes, held against limits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import stats

from validation.soak.resource_samples import PROCESSES

ALLOWANCES = {"rss": 2.0, "anonymous": 2.0, "descriptors": 0.5, "threads": 0.25, "sockets": 0.5}
"""Allowed growth per simulated hour: MiB of memory, counts of everything else."""
ROS_ALLOWANCES = {"rss": 6.0, "anonymous": 6.0, "descriptors": 2.0, "threads": 1.0, "sockets": 2.0}
"""The same for the ROS master and rosout, which keep some data of every node that has ever registered."""
PARTICIPANTS_ALLOWANCE = 0.1
"""Allowed growth of the number of lockstep participants, per simulated hour."""
PACE_ALLOWANCE = 0.2
"""Fraction by which an episode's real-time factor may fall, or its processor time grow, from first to last quarter."""
LOAD_ALLOWANCE = 0.2
"""Maximum increase of the cores used by other programs at which real-time factors are compared."""
LEAST_FLIGHTS = 0.9
"""Required fraction of the requested takeoffs."""
WARM_UP = 0.1
"""Fraction of the soak, at most WARM_UP_HOURS, that is not judged: memory is still being filled for the first time."""
WARM_UP_HOURS = 0.5
LEAST_SAMPLES = 8
"""Fewer samples between episodes are not judged."""
LEAST_EPISODES = 2
"""Fewer episodes of a kind in the first or the last quarter are not compared."""
_CONFIDENCE = 0.99

MIB = 1 << 20
UNITS = {"rss": "MiB", "anonymous": "MiB"}
_OWN = ("simulator", "mavros")


@dataclass(frozen=True)
class Growth:
    """Growth of a series.

    Attributes:
        slope: Theil-Sen estimate, per hour; NaN with too few samples.
        low, high: 99 % confidence interval of the slope.
        allowance: Maximum slope, per hour.
        samples: number of judged samples.
        verdict: ``flat``, ``growing``, or ``not judged``.
    """

    slope: float
    low: float
    high: float
    allowance: float
    samples: int
    verdict: str


def growth(hours: Sequence[float], values: Sequence[float], allowance: float, warm_up: float) -> Growth:
    """Judge a series.

    It grows if its slope exceeds the maximum and noise does not explain it: the lower end of the confidence interval of
    the slope is above zero.

    Args:
        hours: Times of the samples, h, ascending.
        values: Samples.
        allowance: Maximum slope, per hour, at least 0.
        warm_up: Excluded time at the beginning, h.
    """
    kept = [(hour, value) for hour, value in zip(hours, values, strict=True) if hour >= warm_up]
    if len(kept) < LEAST_SAMPLES or kept[-1][0] <= kept[0][0]:
        return Growth(np.nan, np.nan, np.nan, allowance, len(kept), "not judged")
    x, y = np.array(kept, float).T
    fitted = stats.theilslopes(y, x, _CONFIDENCE)
    slope, low, high = float(fitted.slope), float(fitted.low_slope), float(fitted.high_slope)
    verdict = "growing" if slope > allowance and low > 0.0 else "flat"
    return Growth(slope, low, high, allowance, len(kept), verdict)


@dataclass(frozen=True)
class Stretch:
    """A stretch of the soak in which simulated time advanced.

    Attributes:
        kind: Kind of the episode.
        begin: Soak time, s.
        seconds: Simulated time, s.
        wall: Wall time, s.
        cpu: processor time of simulator and MAVROS layer, s.
        others: processor cores used by other programs.
    """

    kind: str
    begin: float
    seconds: float
    wall: float
    cpu: float
    others: float


@dataclass(frozen=True)
class Pace:
    """Pace of one kind of episode at the beginning and at the end.

    Attributes:
        first, last: real-time factor in the first and the last quarter, medians.
        cpu_first, cpu_last: processor seconds per simulated second in these, medians.
        others_first, others_last: processor cores used by other programs in these, means.
        verdict: ``flat``, ``slower``, ``not comparable`` (other programs used more of the machine at the end, and the
            processor time did not grow), or ``not judged`` (too few episodes).
    """

    first: float
    last: float
    cpu_first: float
    cpu_last: float
    others_first: float
    others_last: float
    verdict: str


def pace(stretches: Sequence[Stretch], total: float) -> Pace:
    """Compare the first and the last quarter of a soak in one kind of episode.

    Args:
        stretches: Stretches of one kind, one per episode.
        total: Length of the soak, s.
    """
    whole = [s for s in stretches if s.seconds > 0.0 and s.wall > 0.0]
    first = [s for s in whole if s.begin < 0.25 * total]
    last = [s for s in whole if s.begin >= 0.75 * total]
    if min(len(first), len(last)) < LEAST_EPISODES:
        none = math.nan
        return Pace(none, none, none, none, none, none, "not judged")
    rtf = [float(np.median([s.seconds / s.wall for s in part])) for part in (first, last)]
    cpu = [float(np.median([s.cpu / s.seconds for s in part])) for part in (first, last)]
    others = [float(np.mean([s.others for s in part])) for part in (first, last)]
    verdict = "flat"
    if cpu[1] > (1.0 + PACE_ALLOWANCE) * cpu[0]:
        verdict = "slower"
    elif rtf[1] < (1.0 - PACE_ALLOWANCE) * rtf[0]:
        verdict = "not comparable" if others[1] - others[0] > LOAD_ALLOWANCE else "slower"
    return Pace(rtf[0], rtf[1], cpu[0], cpu[1], others[0], others[1], verdict)


@dataclass
class Outcome:
    """Findings of the runner.

    Attributes:
        settings: Settings of the soak, with the facts of the machine.
        end: reason of an early end; empty after a complete run.
        rows: Samples.
        stretches: Stretches of the episodes.
        hours: simulated time, h.
        wall: wall time, s.
        counts: further figures of the report by name.
        tracebacks: Tracebacks of processes that were not killed.
        wrong: failures of nodes.
        damaged: descriptions of the files that cannot be read to their end.
        unread: number of files that were not judged.
        judge_growth: whether growth and pace are judged; a short soak is insufficient.
    """

    settings: Mapping[str, Any]
    end: str
    rows: Sequence[Mapping[str, Any]]
    stretches: Sequence[Stretch]
    hours: float
    wall: float
    counts: Mapping[str, Any]
    tracebacks: Sequence[str]
    wrong: Sequence[str]
    damaged: Sequence[str]
    unread: int
    judge_growth: bool = True


@dataclass
class Verdict:
    """Verdicts on a soak.

    Attributes:
        growths: by process and figure, as ``simulator rss``.
        paces: by kind of episode.
        failures: one sentence each; empty for a good soak.
    """

    growths: dict[str, Growth] = field(default_factory=dict)
    paces: dict[str, Pace] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)


def judge(outcome: Outcome) -> Verdict:
    """Judge a soak."""
    verdict = Verdict()
    if outcome.judge_growth:
        verdict.growths = growths(outcome.rows, outcome.hours)
        kinds = dict.fromkeys(stretch.kind for stretch in outcome.stretches)
        for kind in kinds:
            own = [stretch for stretch in outcome.stretches if stretch.kind == kind]
            verdict.paces[kind] = pace(own, outcome.hours * 3600.0)
    fail = verdict.failures.append
    for name, found in verdict.growths.items():
        if found.verdict == "growing":
            fail(f"{name} grows by {found.slope:.2f} an hour, {found.allowance:g} are allowed")
    for kind, compared in verdict.paces.items():
        if compared.verdict == "slower":
            fail(
                f"{kind} became slower: {compared.first:.2f} to {compared.last:.2f} x real time, "
                f"{compared.cpu_first:.4f} to {compared.cpu_last:.4f} processor seconds a simulated second"
            )
    verdict.failures += [f"traceback: {text.splitlines()[0]} {text.splitlines()[-1]}" for text in outcome.tracebacks]
    verdict.failures += [f"node: {text}" for text in outcome.wrong]
    verdict.failures += [f"file: {text}" for text in outcome.damaged]
    expected, flights = outcome.counts["expected"], outcome.counts["flights"]
    if flights < LEAST_FLIGHTS * expected:
        fail(f"only {flights} of {expected} vehicles took off when commanded")
    if outcome.unread:
        fail(f"{outcome.unread} files were not read to their end in time")
    if outcome.end:
        fail(outcome.end)
    return verdict


def growths(rows: Sequence[Mapping[str, Any]], hours: float) -> dict[str, Growth]:
    """Return the growth of the figures of each process, from the samples between episodes."""
    resting = [row for row in rows if row["resting"]]
    warm_up = min(WARM_UP * hours, WARM_UP_HOURS)
    found = {}
    series = {
        f"{process} {figure}": limit
        for process in PROCESSES
        for figure, limit in (ALLOWANCES if process in _OWN else ROS_ALLOWANCES).items()
    }
    for name, limit in {**series, "lockstep participants": PARTICIPANTS_ALLOWANCE}.items():
        column = "participants" if name.startswith("lockstep") else name.replace(" ", "_")
        scale = MIB if name.split()[-1] in UNITS else 1
        kept = [row for row in resting if row.get(column) not in (None, "")]
        times = [row["soak_time"] / 3600.0 for row in kept]
        found[name] = growth(times, [row[column] / scale for row in kept], limit, warm_up)
    return found
