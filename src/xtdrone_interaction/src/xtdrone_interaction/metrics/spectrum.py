"""Frequency content of signals: power spectra and spectrograms."""

from __future__ import annotations

import numpy as np
from scipy import signal

from xtdrone_interaction.metrics.resampling import uniform
from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series

_SEGMENT = 512  # samples of one spectrum; Welch's method averages many


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
