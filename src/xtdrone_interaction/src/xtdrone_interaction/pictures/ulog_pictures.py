"""The usual pictures of a PX4 flight log: setpoints and responses, sensors, spectra, estimator, batteries."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from xtdrone_interaction.metrics.setpoint_tracking import SetpointPair, body_rates, pairs
from xtdrone_interaction.metrics.spectrum import (
    spectrogram,
    spectrum,
)
from xtdrone_interaction.pictures.picture_style import (
    NamedFigure,
    colours_of,
    line,
    panels,
    plain_numbers,
    same_scale,
    shades,
)
from xtdrone_interaction.recording.flight_from_ulog import FlightLog
from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series, spans

_TIME = "time since the log began [s]"
_AXES = ("x", "y", "z")
_STICKS, _OLD_STICKS = ("roll", "pitch", "yaw", "throttle"), ("y", "x", "r", "z")  # since PX4 v1.14, and before
_FIX_3D = 3


def pictures(log: FlightLog) -> Iterator[NamedFigure]:
    """Yield all pictures for which a log has data, each drawn on demand."""
    place = log.series("vehicle_local_position", *_AXES)
    if place is not None and np.isfinite(place.value[:, :2]).all(axis=1).any():
        yield NamedFigure("track", "Track from above", track(log, place))
    yield from _altitude(log)
    for what, group in pairs(log).items():
        yield NamedFigure(what.lower(), f"{what}: setpoint and response", responses(log, what, group))
    yield from _sensors(log)
    yield from _spectra(log)
    yield from _health(log)


def track(log: FlightLog, place: Series) -> Figure:
    """Draw the known positions and the position setpoints from above."""
    good = np.isfinite(place.value[:, :2]).all(axis=1)
    place = Series(place.time[good], place.value[good])
    figure, panel = plt.subplots(figsize=(7.4, 6.4))
    figure.subplots_adjust(left=0.12, right=0.96, top=0.92, bottom=0.09)
    wanted = log.series("vehicle_local_position_setpoint", *_AXES)
    if wanted is not None and np.isfinite(wanted.value[:, :2]).any():
        step = max(1, len(wanted) // 8000)
        panel.plot(wanted.value[::step, 1], wanted.value[::step, 0], color="tab:orange", lw=1.0, label="setpoint")
    step = max(1, len(place) // 8000)
    panel.plot(place.value[::step, 1], place.value[::step, 0], color="tab:blue", lw=1.1, label="estimate")
    panel.plot(place.value[0, 1], place.value[0, 0], marker="o", ms=6, mfc="white", mec="tab:blue", ls="")
    panel.plot(place.value[-1, 1], place.value[-1, 0], marker="s", ms=6, color="tab:blue", ls="")
    panel.set(xlabel="east [m]", ylabel="north [m]")
    same_scale(panel)
    panel.legend(loc="best")
    figure.suptitle("Track from above (circle: first place, square: last)")
    return figure


def responses(log: FlightLog, what: str, group: Sequence[SetpointPair]) -> Figure:
    """Draw responses and their setpoints in stacked panels."""
    figure, axes = panels(len(group), 2.2, 0.8)
    for panel, pair in zip(axes, group, strict=True):
        line(panel, pair.actual.time, pair.actual.value[:, 0], color="tab:blue", lw=1.0, label="response")
        if pair.wanted is not None and np.isfinite(pair.wanted.value).any():
            step = max(1, len(pair.wanted) // 20000)
            panel.plot(pair.wanted.time[::step], pair.wanted.value[::step, 0], color="tab:orange", lw=0.9,
                       label="setpoint", zorder=3)  # fmt: skip
        panel.set_ylabel(pair.name)
    return _finished(log, figure, axes, f"{what}: setpoint and response")


def _altitude(log: FlightLog) -> Iterator[NamedFigure]:
    """Yield the altitude of the estimator, GPS and the barometer."""
    known = [("barometer", log.series("vehicle_air_data", "baro_alt_meter")), ("GPS", _gps_altitude(log)),
             ("estimate", log.series("vehicle_global_position", "alt"))]  # fmt: skip
    shown = [(name, series) for name, series in known if series is not None and np.isfinite(series.value).any()]
    if not shown:
        return
    figure, axes = panels(1, 3.0, 0.8)
    for (name, series), shade in zip(shown, shades(len(shown)), strict=True):
        line(axes[0], series.time, series.value[:, 0], color=shade, lw=1.0, label=name)
    axes[0].set_ylabel("above sea level [m]")
    yield NamedFigure("altitude", "Altitude", _finished(log, figure, axes, "Altitude"))


def _gps_altitude(log: FlightLog) -> Series | None:
    """Return the GPS altitude above mean sea level, m; before PX4 v1.14 it was logged in mm."""
    fields = [(_gps(log, "altitude_msl_m", "fix_type"), 1.0), (_gps(log, "alt", "fix_type"), 1e-3)]
    for series, unit in fields:
        if series is not None:
            fixed = series.value[:, 1] >= _FIX_3D
            return Series(series.time, np.where(fixed, unit * series.value[:, 0], np.nan)[:, None])
    return None


def _gps(log: FlightLog, *fields: str) -> Series | None:
    """Return GPS fields: those fused by the estimator, else of the first receiver."""
    return log.series("vehicle_gps_position", *fields) or log.series("sensor_gps", *fields)


def _sensors(log: FlightLog) -> Iterator[NamedFigure]:
    """Yield sensor measurements, motor outputs and sticks."""
    acceleration = log.array("sensor_combined", "accelerometer_m_s2", 3)
    gyro = log.array("sensor_combined", "gyro_rad", 3)
    rows = []
    if acceleration is not None:
        rows.append(("acceleration [m/s²]", acceleration))
    if gyro is not None:
        rows.append(("rate [°/s]", Series(gyro.time, np.degrees(gyro.value))))
    if rows:
        yield NamedFigure("imu", "Raw acceleration and rates", _several(log, rows, _AXES, "Raw acceleration and rates"))
    motors = _motors(log)
    if motors is not None:
        names = [str(i + 1) for i in range(motors[1].value.shape[1])]
        yield NamedFigure("motors", "Motors", _several(log, [motors], names, "Motor outputs"))
    sticks = log.series("manual_control_setpoint", *_STICKS) or log.series("manual_control_setpoint", *_OLD_STICKS)
    if sticks is not None and len(sticks) > 1:
        rows = [("stick, share of full", sticks)]
        yield NamedFigure("sticks", "Sticks", _several(log, rows, _STICKS, "Sticks of the remote control"))


def _motors(log: FlightLog) -> tuple[str, Series] | None:
    """Return label and outputs of the motors in use."""
    for topic, name, count, unit in (
        ("actuator_motors", "control", 12, "motor, share of full"),
        ("actuator_outputs", "output", 16, "output, as PWM [µs]"),
    ):
        series = log.array(topic, name, count)
        if series is None:
            continue
        used = np.isfinite(series.value).any(axis=0) & (np.nan_to_num(series.value) != 0).any(axis=0)
        if used.any():
            return unit, Series(series.time, series.value[:, used])
    return None


def _spectra(log: FlightLog) -> Iterator[NamedFigure]:
    """Yield the frequency content of rates and accelerations."""
    start, end = log.flown
    rates = body_rates(log) or log.array("sensor_combined", "gyro_rad", 3)
    acceleration = log.array("sensor_combined", "accelerometer_m_s2", 3)
    wanted = log.series("vehicle_rates_setpoint", "roll", "pitch", "yaw")
    shown: list[tuple[str, Series, tuple[str, ...]]] = []
    if rates is not None:
        shown.append(("rates [(°/s)²/Hz]", Series(rates.time, np.degrees(rates.value)), ("roll", "pitch", "yaw")))
    if wanted is not None:
        degrees = Series(wanted.time, np.degrees(wanted.value))
        shown.append(("rate setpoints [(°/s)²/Hz]", degrees, ("roll", "pitch", "yaw")))
    if acceleration is not None:
        shown.append(("acceleration [(m/s²)²/Hz]", acceleration, _AXES))
    made = [(name, found, names) for name, series, names in shown if (found := spectrum(series, start, end))]
    if made:
        yield NamedFigure("spectra", "Frequency content of rates and vibration", _densities(log, made))
    for name, what, series in (("rates", "the rates", rates), ("acceleration", "the acceleration", acceleration)):
        heat = None if series is None else spectrogram(series, start, end)
        if heat is not None:
            title = f"Spectrogram of {what}"
            yield NamedFigure(f"spectrogram_{name}", title, _heat(*heat, title))


def _densities(log: FlightLog, made: Sequence[tuple[str, tuple[Array, Array], Sequence[str]]]) -> Figure:
    figure, axes = plt.subplots(len(made), 1, figsize=(9.0, 1.1 + 2.4 * len(made)), squeeze=False)
    figure.subplots_adjust(left=0.12, right=0.97, hspace=0.35, top=1 - 0.5 / (1.1 + 2.4 * len(made)), bottom=0.09)
    for panel, (name, (frequency, density), names) in zip(axes[:, 0], made, strict=True):
        for i, (axis, shade) in enumerate(zip(names, shades(3), strict=True)):
            panel.semilogy(frequency[1:], density[1:, i], color=shade, lw=1.0, label=axis)
        panel.set_ylabel(name)
        panel.margins(x=0.01)
        plain_numbers(panel)
        panel.legend(loc="upper right", ncol=3, fontsize=8)
    axes[-1, 0].set_xlabel("frequency [Hz]")
    figure.suptitle(f"Power spectral density {log.flown_words} (Welch, median)")
    return figure


def _heat(time: Array, frequency: Array, density: Array, title: str) -> Figure:
    figure, (panel,) = panels(1, 3.4, 0.98)
    level = 10.0 * np.log10(np.maximum(density, density[density > 0].min(initial=1e-12)))
    least, most = np.percentile(level, [5, 99.5])
    panel.grid(visible=False)
    mesh = panel.pcolormesh(time, frequency, level, shading="nearest", vmin=least, vmax=most, cmap="viridis",
                            rasterized=True)  # fmt: skip
    panel.set(xlabel=_TIME, ylabel="frequency [Hz]")
    figure.colorbar(mesh, ax=panel, label="power density, all axes [dB]", pad=0.01)
    figure.suptitle(title)
    return figure


def _health(log: FlightLog) -> Iterator[NamedFigure]:
    """Yield vibration metrics, estimator test ratios, GPS reception, batteries and processor load."""
    metrics = _instances(log, "vehicle_imu_status", "accel_vibration_metric")
    if metrics:
        figure, axes = _beside([("acceleration [m/s²]", 0, 1.0)], metrics, "IMU")
        yield NamedFigure("vibration", "Vibration metrics", _finished(log, figure, axes, "Vibration metrics"))
    fields = ("vel_test_ratio", "pos_test_ratio", "hgt_test_ratio", "mag_test_ratio")
    ratios = log.series("estimator_status", *fields, instance=_estimator(log))
    if ratios is not None:
        names = ("velocity", "position", "height", "heading")
        figure, axes = _started([("test ratio", ratios)], names)
        axes[0].axhline(1.0, color="tab:red", lw=0.9, ls="--")
        yield NamedFigure("estimator", "Estimator: test ratios",
                      _finished(log, figure, axes, "Estimator: test ratios, rejected above 1"))  # fmt: skip
    yield from _reception(log)
    batteries = _instances(log, "battery_status", "voltage_v", "current_a", "remaining")
    if batteries:
        # -1 is PX4's unknown value
        known = {i: Series(b.time, np.where(b.value < 0, np.nan, b.value)) for i, b in batteries.items()}
        units = [("voltage [V]", 0, 1.0), ("current [A]", 1, 1.0), ("charge [%]", 2, 100.0)]
        rows = [row for row in units if any(np.isfinite(series.value[:, row[1]]).any() for series in known.values())]
        if rows:
            figure, axes = _beside(rows, known, "battery")
            yield NamedFigure("battery", "Battery", _finished(log, figure, axes, "Battery"))
    load = log.series("cpuload", "load", "ram_usage")
    if load is not None and len(load) > 1:
        rows_ = [("used [%]", Series(load.time, 100.0 * load.value))]
        yield NamedFigure("load", "Processor and memory", _several(log, rows_, ("processor", "memory"),
                                                               "Processor and memory of the autopilot"))  # fmt: skip


def _reception(log: FlightLog) -> Iterator[NamedFigure]:
    """Yield GPS accuracy and satellites."""
    accuracy, satellites = _gps(log, "eph", "epv"), _gps(log, "satellites_used", "fix_type")
    if accuracy is None:
        return
    figure, axes = panels(1 if satellites is None else 2, 2.4, 0.8)
    for i, name in enumerate(("horizontal accuracy", "vertical accuracy")):
        line(axes[0], accuracy.time, accuracy.value[:, i], color=shades(4)[i], lw=0.9, label=name)
    axes[0].set_ylabel("accuracy [m]")
    if satellites is not None:
        for i, name in enumerate(("satellites", "fix type (3: 3D)")):
            axes[1].step(satellites.time, satellites.value[:, i], where="post", color=shades(4)[2 + i], lw=0.9,
                         label=name)  # fmt: skip
        axes[1].set(ylabel="number", ylim=(0.0, None))
    yield NamedFigure("gps", "GPS", _finished(log, figure, axes, "GPS: reception, and accuracy that it states"))


def _estimator(log: FlightLog) -> int:
    """Return the number of the estimator instance selected last."""
    chosen = log.series("estimator_selector_status", "primary_instance")
    return 0 if chosen is None else int(chosen.value[-1, 0])


def _instances(log: FlightLog, topic: str, *fields: str) -> dict[int, Series]:
    """Return fields of all instances of a topic."""
    numbers = sorted(instance for name, instance in log.topics if name == topic)
    found = {number: log.series(topic, *fields, instance=number) for number in numbers}
    return {number: series for number, series in found.items() if series is not None and len(series) > 1}


def _beside(
    rows: Sequence[tuple[str, int, float]], instances: dict[int, Series], what: str
) -> tuple[Figure, list[Axes]]:
    """Draw instances on the same axes, one panel per row.

    Args:
        rows: unit, column and scale factor.
        instances: series by number.
        what: name of an instance without its number.
    """
    figure, axes = panels(len(rows), 2.4, 0.8)
    for panel, (unit, column, scale) in zip(axes, rows, strict=True):
        for (number, series), shade in zip(instances.items(), shades(len(instances)), strict=True):
            line(panel, series.time, scale * series.value[:, column], color=shade, lw=0.9, label=f"{what} {number}")
        panel.set_ylabel(unit)
    return figure, axes


def _several(log: FlightLog, rows: Sequence[tuple[str, Series]], names: Sequence[str], title: str) -> Figure:
    figure, axes = _started(rows, names)
    return _finished(log, figure, axes, title)


def _started(rows: Sequence[tuple[str, Series]], names: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Draw columns over time, one panel per row."""
    figure, axes = panels(len(rows), 2.4, 0.8)
    for panel, (unit, series) in zip(axes, rows, strict=True):
        for i, shade in enumerate(shades(series.value.shape[1])):
            line(panel, series.time, series.value[:, i], color=shade, lw=0.9, label=names[i])
        panel.set_ylabel(unit)
    return figure, axes


def _finished(log: FlightLog, figure: Figure, axes: Sequence[Axes], title: str) -> Figure:
    """Add the flight modes behind the panels, the legends and the title."""
    colours = colours_of([mode for _, mode in log.modes])
    for start, end, mode in spans(log.modes, log.duration):
        for panel in axes:
            panel.axvspan(start, end, color=colours[mode], alpha=0.13, lw=0, zorder=0)
    named = {label: handle for panel in axes for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(list(named.values()), list(named), loc="upper left", bbox_to_anchor=(0.81, 0.96), fontsize=8)
    if colours:
        figure.legend([Patch(color=shade, alpha=0.3) for shade in colours.values()], list(colours), fontsize=8,
                      loc="lower left", bbox_to_anchor=(0.81, 0.05), title="mode")  # fmt: skip
    axes[-1].set_xlabel(_TIME)
    figure.suptitle(title)
    return figure
