"""Series at even steps, and the frequency content of signals: power spectra and spectrograms."""

from __future__ import annotations

import numpy as np
from scipy import signal

from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series

_SEGMENT = 512  # samples of one spectrum; Welch's method averages many


def even_times(time: Array, step: float) -> Array:
    """Return evenly spaced times from the first to at most the last of ``time``."""
    count = int((time[-1] - time[0]) / step + 1e-6) + 1
    return np.minimum(time[0] + step * np.arange(count), time[-1])


def uniform(series: Series, start: float, end: float) -> tuple[Array, float] | None:
    """Return a part of a series resampled at even steps, shape (t, k), and the step, s; None if it is too short."""
    part = (series.time >= start) & (series.time <= end)
    time = series.time[part]
    if len(time) < 16:
        return None
    step = float(np.median(np.diff(time)))
    if step <= 0.0:
        return None
    return Series(time, series.value[part]).at(even_times(time, step)), step


def spectrum(series: Series, start: float, end: float) -> tuple[Array, Array] | None:
    """Return frequencies, Hz, and the power spectral density of each column, shape (f, k), by Welch's method."""
    made = uniform(series, start, end)
    if made is None:
        return None
    values, step = made
    values = np.nan_to_num(values)
    # the median, so that takeoff and touchdown do not mask permanent vibration
    frequency, density = signal.welch(
        values, 1.0 / step, nperseg=min(_SEGMENT, len(values)), axis=0, average="median", detrend="linear"
    )
    return frequency, density


def spectrogram(series: Series, start: float, end: float) -> tuple[Array, Array, Array] | None:
    """Return times, s, frequencies, Hz, and the power spectral density summed over the columns, shape (f, t)."""
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
