"""Growth of a series and slowdown of work: robust fits with verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

LEAST_SAMPLES = 8
"""Fewer samples than these are not judged."""
_CONFIDENCE = 0.99


@dataclass(frozen=True)
class Growth:
    """Growth of a series.

    Attributes:
        slope: Theil-Sen estimate, per hour; NaN with too few samples.
        low, high: 99 % confidence interval of the slope.
        allowance: maximum slope, per hour.
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
        hours: times of the samples, h, ascending.
        values: the samples.
        allowance: maximum slope, per hour, at least 0.
        warm_up: excluded time at the beginning, h.
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
        kind: of the episode.
        begin: soak time, s.
        seconds: simulated, s.
        wall: wall time, s.
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


def pace(stretches: Sequence[Stretch], total: float, allowance: float, load_allowance: float, least: int = 2) -> Pace:
    """Compare the first and the last quarter of a soak in one kind of episode.

    Args:
        stretches: of one kind, one per episode.
        total: length of the soak, s.
        allowance: maximum relative decrease of the real-time factor and increase of the processor time.
        load_allowance: maximum increase of the cores used by others at which real-time factors are compared.
        least: minimum number of episodes per quarter.
    """
    whole = [s for s in stretches if s.seconds > 0.0 and s.wall > 0.0]
    first = [s for s in whole if s.begin < 0.25 * total]
    last = [s for s in whole if s.begin >= 0.75 * total]
    if min(len(first), len(last)) < least:
        none = float("nan")
        return Pace(none, none, none, none, none, none, "not judged")
    rtf = [float(np.median([s.seconds / s.wall for s in part])) for part in (first, last)]
    cpu = [float(np.median([s.cpu / s.seconds for s in part])) for part in (first, last)]
    others = [float(np.mean([s.others for s in part])) for part in (first, last)]
    verdict = "flat"
    if cpu[1] > (1.0 + allowance) * cpu[0]:
        verdict = "slower"
    elif rtf[1] < (1.0 - allowance) * rtf[0]:
        verdict = "not comparable" if others[1] - others[0] > load_allowance else "slower"
    return Pace(rtf[0], rtf[1], cpu[0], cpu[1], others[0], others[1], verdict)
