"""Pictures of a recording: positions, velocities, modes, topology, avoidance, setpoints, spectra, batteries."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from xtdrone_interaction.metrics.spectrum import spectrum
from xtdrone_interaction.metrics.vehicle_metrics import least_distance_series
from xtdrone_interaction.pictures import odometry_pictures
from xtdrone_interaction.pictures.picture_style import (
    NO_MODE,
    NamedFigure,
    colours_of,
    line,
    mark_times,
    name_lines,
    panels,
    plain_numbers,
    same_scale,
    shades,
)
from xtdrone_interaction.recording.distances import DISTANCE_LIMIT
from xtdrone_interaction.recording.found_mission import FoundMission
from xtdrone_interaction.recording.recorded_flight import Recording, VehicleRecord
from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series, armed_span, spans

_RESPONSES = 4  # vehicles whose setpoints are drawn with their responses
_MOST_MODES = 14  # in the legend
# PositionTarget: bits of the type mask that mark position and velocity as unused
_NO_POSITION, _NO_VELOCITY = 0b000_111, 0b111_000


def pictures(recording: Recording, found: FoundMission | None) -> Iterator[NamedFigure]:
    """Yield all pictures for which a recording has data, each drawn on demand.

    Args:
        recording: of any kind but a flight log.
        found: Its formation flight, if it has one.
    """
    marks = [] if found is None else found.marks
    known = {name: series for name, series in recording.positions.items() if len(series)}
    if known:
        yield NamedFigure("positions", "Positions", positions(recording, known, marks))
        yield NamedFigure("tracks", "Tracks from above", tracks(recording, known))
    yield from odometry_pictures.pictures(recording)
    placed = [vehicle for vehicle in recording.vehicles if vehicle.name in known]
    if any("velocity" in vehicle.series for vehicle in placed):
        yield NamedFigure("velocities", "Velocities", velocities(recording, placed, marks))
    if found is not None and marks:
        yield from found.figures()
    elif len(known) > 1 and (least := least_distance_series(known.values())) is not None:
        yield NamedFigure("distances", "Minimum distance between vehicles", distances(recording, least))
    if any(vehicle.modes or vehicle.armed for vehicle in recording.vehicles):
        yield NamedFigure("modes", "Flight modes", modes(recording, marks))
    if any(_activity(vehicle) for vehicle in recording.vehicles) or recording.topologies:
        yield NamedFigure("activity", "Commands, avoidance and topology", activity(recording, marks))
    for vehicle in [vehicle for vehicle in placed if _has_setpoints(vehicle)][:_RESPONSES]:
        title = f"Setpoints and response of {vehicle.name}"
        yield NamedFigure(f"setpoints_{vehicle.name}", title, response(recording, vehicle))
    spectra = [(vehicle.name, made) for vehicle in recording.vehicles if (made := _imu_spectra(vehicle))]
    if spectra:
        yield NamedFigure("spectra", "Frequency content of rates and vibration", frequencies(recording, spectra))
    if any(_has_battery(vehicle) for vehicle in recording.vehicles):
        yield NamedFigure("batteries", "Batteries", batteries(recording))


def _colours(recording: Recording) -> dict[str, Any]:
    """Return each vehicle's colour, the same in all pictures."""
    return dict(zip((v.name for v in recording.vehicles), shades(len(recording.vehicles)), strict=True))


def positions(recording: Recording, known: Mapping[str, Series], marks: list[tuple[float, str]]) -> Figure:
    """Draw x, y and z of all vehicles over time."""
    figure, axes = panels(3)
    colour = _colours(recording)
    for name, place in known.items():
        for axis, panel in enumerate(axes):
            line(panel, place.time, place.value[:, axis], color=colour[name], lw=1.1, label=name)
    for panel, letter in zip(axes, ("x, east", "y, north", "z, up"), strict=True):
        panel.set_ylabel(f"{letter} [m]")
    axes[-1].set_xlabel(recording.time_label)
    mark_times(axes, marks)
    estimated = any(vehicle.position for vehicle in recording.vehicles)
    figure.suptitle(f"Positions of {_fleet(list(known))} ({'estimates' if estimated else 'truth'}, ENU)")
    name_lines(figure, axes[0])
    return _with_room(figure, marks)


def tracks(recording: Recording, known: Mapping[str, Series]) -> Figure:
    """Draw the paths of all vehicles from above."""
    figure, panel = plt.subplots(figsize=(8.0, 6.4))
    figure.subplots_adjust(left=0.1, right=0.8, top=0.92, bottom=0.09)
    colour = _colours(recording)
    for name, place in known.items():
        shade = colour[name]
        way = place.value[:: max(1, len(place) // 4000)]
        panel.plot(way[:, 0], way[:, 1], color=shade, lw=1.0, label=name)
        panel.plot(*place.value[0, :2], marker="o", ms=5, mfc="white", mec=shade)
        panel.plot(*place.value[-1, :2], marker="s", ms=5, color=shade)
    panel.set(xlabel="x, east [m]", ylabel="y, north [m]")
    same_scale(panel)
    name_lines(figure, panel, 0.81)
    figure.suptitle(f"Tracks of {_fleet(list(known))} from above (circle: first place, square: last)")
    return figure


def velocities(recording: Recording, vehicles: list[VehicleRecord], marks: list[tuple[float, str]]) -> Figure:
    """Draw the horizontal and the vertical speed of all vehicles over time."""
    figure, axes = panels(2, 2.6)
    colour = _colours(recording)
    for vehicle in vehicles:
        shade = colour[vehicle.name]
        if (series := vehicle.series.get("velocity")) is None or not len(series):
            continue
        speed = np.hypot(series.value[:, 0], series.value[:, 1])
        line(axes[0], series.time, speed, color=shade, lw=1.0, label=vehicle.name)
        line(axes[1], series.time, series.value[:, 2], color=shade, lw=1.0)
    axes[0].set_ylabel("horizontal speed [m/s]")
    axes[1].set(ylabel="climb [m/s]", xlabel=recording.time_label)
    mark_times(axes, marks)
    figure.suptitle(f"Velocities of {_fleet([vehicle.name for vehicle in vehicles])}")
    name_lines(figure, axes[0])
    return _with_room(figure, marks)


def distances(recording: Recording, found: Series) -> Figure:
    """Draw the minimum distance between any two vehicles over time."""
    figure, (panel,) = panels(1, 3.2, 0.97)
    line(panel, found.time, found.value[:, 0], color="tab:blue", lw=1.1)
    panel.axhline(DISTANCE_LIMIT, color="tab:red", lw=1.0, ls="--", label=f"limit {DISTANCE_LIMIT} m")
    panel.set(ylabel="minimum distance [m]", xlabel=recording.time_label, ylim=(0.0, None))
    panel.legend(loc="best")
    figure.suptitle("Minimum distance between any two vehicles")
    return figure


def modes(recording: Recording, marks: list[tuple[float, str]]) -> Figure:
    """Draw each vehicle's flight modes and the times when it was armed."""
    shown = [vehicle for vehicle in recording.vehicles if vehicle.modes or vehicle.armed]
    end = _end(recording)
    colour = colours_of([mode for vehicle in shown for _, mode in vehicle.modes])
    height = min(0.42, 9.0 / len(shown)) * len(shown)
    figure, (panel,) = panels(1, height + 0.3, 0.78)
    longest = max(len(vehicle.name) for vehicle in shown)
    figure.subplots_adjust(left=min(0.3, max(0.09, 0.025 + 0.0085 * longest)))
    for row, vehicle in enumerate(shown):
        for start, stop, mode in spans(vehicle.modes, end):
            panel.barh(row, stop - start, 0.62, start, color=colour.get(mode, NO_MODE), lw=0)
        for start, stop, armed in spans(vehicle.armed, end):
            if armed:
                panel.plot([start, stop], [row + 0.38] * 2, color="black", lw=1.6, solid_capstyle="butt")
    step = max(1, len(shown) // 40)
    panel.set_yticks(range(0, len(shown), step), [vehicle.name for vehicle in shown[::step]])
    panel.set(ylim=(len(shown) - 0.4, -0.6), xlabel=recording.time_label)
    panel.grid(axis="y", visible=False)
    mark_times([panel], marks)
    handles = [Patch(color=shade) for shade in colour.values()][:_MOST_MODES]
    labels = list(colour)[:_MOST_MODES]
    handles.append(Line2D([], [], color="black", lw=1.6))  # type: ignore[arg-type]
    figure.legend(handles, [*labels, "armed"], loc="upper left", bbox_to_anchor=(0.79, 0.97), fontsize=8)
    figure.suptitle("Flight modes")
    return _with_room(figure, marks)


def activity(recording: Recording, marks: list[tuple[float, str]]) -> Figure:
    """Draw the magnitude of velocity commands and of avoidance, and the number of links in the topology."""
    shown = [vehicle for vehicle in recording.vehicles if _activity(vehicle)]
    commanded = [what for what in _COMMANDED if any(what in vehicle.series for vehicle in shown)]
    avoided = any("avoidance" in vehicle.series for vehicle in shown)
    rows = bool(commanded) + avoided + bool(recording.topologies)
    figure, axes = panels(rows, 2.2)
    free, colour = list(axes), _colours(recording)
    for what, title in ((commanded, "command"), (["avoidance"] if avoided else [], "avoidance")):
        if not what:
            continue
        panel = free.pop(0)
        for vehicle in shown:
            for name in what:
                if (series := vehicle.series.get(name)) is not None and len(series):
                    size = np.linalg.norm(series.value, axis=1)
                    line(panel, series.time, size, color=colour[vehicle.name], lw=1.0, label=vehicle.name)
        unit = "m/s²" if "acceleration" in (commanded or what)[0] else "m/s"
        panel.set(ylabel=f"{title} [{unit}]", ylim=(0.0, None))
    if recording.topologies:
        _draw_links(free.pop(0), recording)
    axes[-1].set_xlabel(recording.time_label)
    mark_times(axes, marks)
    figure.suptitle("Velocity commands, avoidance, and links of the communication topology")
    name_lines(figure, axes[0])
    return _with_room(figure, marks)


_COMMANDED = ("command", "body command", "acceleration command", "body acceleration command")


def _activity(vehicle: VehicleRecord) -> bool:
    return any(what in vehicle.series for what in (*_COMMANDED, "avoidance"))


def _draw_links(panel: plt.Axes, recording: Recording) -> None:
    """Draw the number of links in the topology, and the number of new ones at each change."""
    times = np.array([change.time for change in recording.topologies])
    matrices = [change.value > 0 for change in recording.topologies]
    counts = np.array([int(matrix.sum()) for matrix in matrices])
    new = [
        int((now & ~before).sum()) if now.shape == before.shape else int(now.sum())
        for before, now in zip([matrices[0], *matrices[:-1]], matrices, strict=True)
    ]
    end = max(_end(recording), float(times[-1]))
    panel.step(np.append(times, end), np.append(counts, counts[-1]), where="post", color="tab:blue", label="links")
    panel.plot(times, new, color="tab:orange", marker="o", ls="", ms=4, label="new at the change")
    panel.set(ylabel="links", ylim=(0, None))
    panel.legend(loc="center right", fontsize=8)


def _has_setpoints(vehicle: VehicleRecord) -> bool:
    names = ("setpoint", "target", "position setpoint", "velocity setpoint", "command")
    return any(len(vehicle.series.get(name, ())) > 1 for name in names)


def _setpoints(vehicle: VehicleRecord) -> tuple[Series | None, Series | None]:
    """Return the position and the velocity setpoints, m and m/s ENU; NaN where missing."""
    place, velocity = vehicle.series.get("position setpoint"), vehicle.series.get("velocity setpoint")
    raw = vehicle.series.get("setpoint") or vehicle.series.get("target")
    if raw is not None:
        mask = raw.value[:, 0].astype(np.int64)
        wanted = np.where((mask & _NO_POSITION == _NO_POSITION)[:, None], np.nan, raw.value[:, 1:4])
        moving = np.where((mask & _NO_VELOCITY == _NO_VELOCITY)[:, None], np.nan, raw.value[:, 4:7])
        place = place or Series(raw.time, wanted)
        velocity = velocity or Series(raw.time, moving)
    return place, velocity or vehicle.series.get("command")


def response(recording: Recording, vehicle: VehicleRecord) -> Figure:
    """Draw a vehicle's setpoints and its response."""
    place, velocity = _setpoints(vehicle)
    rows: list[tuple[str, Series, Series | None]] = []
    known, speed = vehicle.position, vehicle.series.get("velocity")
    if known is not None and place is not None and np.isfinite(place.value).any():
        rows += [(f"{axis} [m]", known.column(i), place.column(i)) for i, axis in enumerate("xyz")]
    if speed is not None and velocity is not None and np.isfinite(velocity.value).any():
        rows += [(f"v{axis} [m/s]", speed.column(i), velocity.column(i)) for i, axis in enumerate("xyz")]
    if not rows and known is not None:
        rows = [(f"{axis} [m]", known.column(i), None) for i, axis in enumerate("xyz")]
    figure, axes = panels(len(rows), 1.9, 0.97)
    for panel, (name, did, told) in zip(axes, rows, strict=True):
        line(panel, did.time, did.value[:, 0], color="tab:blue", lw=1.1, label="response")
        if told is not None:
            panel.plot(*_thin_gaps(told), color="tab:orange", lw=1.0, label="setpoint", zorder=3)
        panel.set_ylabel(name)
    axes[0].legend(loc="upper right", ncol=2, fontsize=8)
    axes[-1].set_xlabel(recording.time_label)
    figure.suptitle(f"Setpoints and response of {vehicle.name}")
    return figure


def _thin_gaps(series: Series) -> tuple[Array, Array]:
    """Return a line of a limited number of points that keeps its gaps."""
    step = max(1, len(series) // 8000)
    return series.time[::step], series.value[::step, 0]


def _imu_spectra(vehicle: VehicleRecord) -> tuple[tuple[Array, Array], tuple[Array, Array]] | None:
    """Return frequencies and power densities, (f,) and (f, 3), of rates and acceleration; None for a thinned series."""
    imu = vehicle.series.get("imu")
    if imu is None or not len(imu) or "imu" in vehicle.thinned:
        return None  # thinning would show up as aliases
    start, end = armed_span(vehicle.armed, float(imu.time[-1]))
    rates = spectrum(Series(imu.time, np.degrees(imu.value[:, :3])), start, end)
    acceleration = spectrum(Series(imu.time, imu.value[:, 3:]), start, end)
    return None if rates is None or acceleration is None else (rates, acceleration)


def frequencies(recording: Recording, spectra: Sequence[tuple[str, Any]]) -> Figure:
    """Draw the power spectral density of rates and acceleration: of one vehicle by axis, of several the sum."""
    figure, axes = panels(2, 2.6)
    for panel in axes:
        panel.tick_params(labelbottom=True)
    colour = _colours(recording)
    for name, found in spectra:
        for panel, (frequency, density) in zip(axes, found, strict=True):
            if len(spectra) > 1:
                panel.semilogy(frequency[1:], density[1:].sum(axis=1), color=colour[name], lw=1.0, label=name)
                continue
            for axis, (shade, letter) in enumerate(zip(shades(3), ("x, front", "y, left", "z, up"), strict=True)):
                panel.semilogy(frequency[1:], density[1:, axis], color=shade, lw=1.0, label=letter)
    for panel, name in zip(axes, ("rates [(°/s)²/Hz]", "acceleration [(m/s²)²/Hz]"), strict=True):
        panel.set_ylabel(name)
        plain_numbers(panel)
    axes[-1].set_xlabel("frequency [Hz]")
    what = f"of {spectra[0][0]}'s IMU" if len(spectra) == 1 else "of IMUs, all axes"
    when = " while armed" if any(armed for vehicle in recording.vehicles for _, armed in vehicle.armed) else ""
    figure.suptitle(f"Power spectral density {what}{when} (Welch, median)")
    name_lines(figure, axes[0])
    return figure


def _has_battery(vehicle: VehicleRecord) -> bool:
    series = vehicle.series.get("battery")
    return series is not None and len(series) > 1


_BATTERY = (
    ("voltage [V]", 0, 1.0),
    ("charge [%]", 1, 100.0),
    ("current [A]", 2, -1.0),
)  # current flowing out is positive, as in PX4


def batteries(recording: Recording) -> Figure:
    """Draw voltage, charge and current of all vehicles' batteries, if recorded."""
    shown = {vehicle.name: vehicle.series["battery"] for vehicle in recording.vehicles if _has_battery(vehicle)}
    known = {name: np.array(series.value) for name, series in shown.items()}
    for value in known.values():
        value[:, 1][value[:, 1] < 0] = np.nan  # -0.01 is MAVROS's unknown charge
        value[:, 2][value[:, 2] == 0] = np.nan
    rows = [row for row in _BATTERY if any(np.isfinite(value[:, row[1]]).any() for value in known.values())]
    figure, axes = panels(max(1, len(rows)))
    colour = _colours(recording)
    for panel, (unit, column, scale) in zip(axes, rows, strict=False):
        for name, series in shown.items():
            line(panel, series.time, scale * known[name][:, column], color=colour[name], lw=1.0, label=name)
        panel.set_ylabel(unit)
    axes[-1].set_xlabel(recording.time_label)
    figure.suptitle("Batteries")
    name_lines(figure, axes[0])
    return figure


def _fleet(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} vehicles"


def _end(recording: Recording) -> float:
    """Return the time of the last sample, s."""
    ends = [series.time[-1] for vehicle in recording.vehicles for series in vehicle.series.values() if len(series)]
    ends += [changes[-1][0] for vehicle in recording.vehicles for changes in (vehicle.modes, vehicle.armed) if changes]
    return float(max(ends, default=0.0))


def _with_room(figure: Figure, marks: list[tuple[float, str]]) -> Figure:
    """Make room for the names of marks between the title and the first panel."""
    if marks:
        width, height = figure.get_size_inches()
        figure.set_size_inches(width, height + 0.45)
        figure.subplots_adjust(top=1 - 0.95 / (height + 0.45))
    return figure
