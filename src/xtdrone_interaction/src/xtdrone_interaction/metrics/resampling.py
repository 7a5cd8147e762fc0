"""Resampling of series at even steps."""

from __future__ import annotations

import numpy as np

from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series


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
