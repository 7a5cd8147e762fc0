"""How well a response follows its setpoint, and the frequency content of signals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from xtdrone_interaction.analysis.columns import Array, Series

_MOST_DELAY = 1.0  # s that is looked for
_LEAST_LIKENESS = 0.5  # correlation below which a response does not follow, so that there is no delay
_SEGMENT = 512  # samples of one spectrum; Welch's method averages many


@dataclass(frozen=True)
class Tracking:
    """How a response follows.

    Attributes:
        name: of the quantity with its unit.
        rms: of the error.
        greatest: error.
        delay: of the response behind the setpoint, s; None where nothing moves, and where it does not follow.
    """

    name: str
    rms: float
    greatest: float
    delay: float | None


def even_times(time: Array, step: float) -> Array:
    """Return times at even steps from the first to the last of ``time``, none behind it."""
    count = int((time[-1] - time[0]) / step + 1e-6) + 1
    return np.minimum(time[0] + step * np.arange(count), time[-1])


def uniform(series: Series, start: float, end: float) -> tuple[Array, float] | None:
    """Return the part between two times at even steps, shape (t, k), and the step, s; None if it is too short."""
    part = (series.time >= start) & (series.time <= end)
    time = series.time[part]
    if len(time) < 16:
        return None
    step = float(np.median(np.diff(time)))
    if step <= 0.0:
        return None
    return Series(time, series.value[part]).at(even_times(time, step)), step


def tracking(name: str, wanted: Series, actual: Series, start: float, end: float, turn: float = 0.0) -> Tracking | None:
    """Compare a response with its setpoint while there is one.

    Args:
        name: for the result.
        wanted: setpoint, (t, 1); NaN where there is none.
        actual: response, (t, 1).
        start, end: s; what is compared.
        turn: of a full turn in the quantity's unit, where it is an angle.
    """
    made = uniform(actual, start, end)
    if made is None or not len(wanted):
        return None
    values, step = made
    grid = actual.time[(actual.time >= start) & (actual.time <= end)][0] + step * np.arange(len(values))
    # a setpoint holds until the next; stamps are rounded
    last = np.searchsorted(wanted.time, grid + 0.05 * step, "right") - 1
    told = np.where(last >= 0, wanted.value[np.maximum(last, 0), 0], np.nan)
    did = values[:, 0]
    error = did - told
    if turn:
        error = (error + turn / 2) % turn - turn / 2
    good = np.isfinite(error)
    if good.sum() < 16:
        return None
    delay = None if turn else _delay(told[good], did[good], step)
    return Tracking(name, float(np.sqrt(np.mean(error[good] ** 2))), float(np.abs(error[good]).max()), delay)


def _delay(told: Array, did: Array, step: float) -> float | None:
    """Return by how much ``did`` is behind ``told``, s: where the two are most alike; None where they never are."""
    told, did = told - told.mean(), did - did.mean()
    if told.std() < 1e-9 or did.std() < 1e-9:
        return None
    most = min(round(_MOST_DELAY / step), len(told) // 2)
    likeness = signal.correlate(did, told, "full")[len(told) - 1 : len(told) + most]
    best = int(likeness.argmax())
    if likeness[best] < _LEAST_LIKENESS * np.linalg.norm(told) * np.linalg.norm(did) or best == most:
        return None
    return float(step * best)


def spectrum(series: Series, start: float, end: float) -> tuple[Array, Array] | None:
    """Return frequencies, Hz, and the power spectral density of each column, shape (f, k), by Welch's method."""
    made = uniform(series, start, end)
    if made is None:
        return None
    values, step = made
    values = np.nan_to_num(values)
    # the median, so that takeoff and touch-down do not hide what is there all the time
    frequency, density = signal.welch(
        values, 1.0 / step, nperseg=min(_SEGMENT, len(values)), axis=0, average="median", detrend="linear"
    )
    return frequency, density


def spectrogram(series: Series, start: float, end: float) -> tuple[Array, Array, Array] | None:
    """Return times s, frequencies Hz, and the power spectral density summed over the columns, shape (f, t)."""
    made = uniform(series, start, end)
    if made is None or len(made[0]) < 4 * 128:
        return None
    values, step = made
    step_by = max(64, len(values) // 800)
    size = max(256, step_by) if len(values) > 2048 else 128
    frequency, time, density = signal.spectrogram(
        np.nan_to_num(values), 1.0 / step, nperseg=size, noverlap=max(0, size - step_by), axis=0
    )
    first = float(series.time[series.time >= start][0])
    return time + first, frequency, density.sum(axis=1)
