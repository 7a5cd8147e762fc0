"""Our responses over the reference's, one picture a flight."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from validation.compare_px4.reference import Flight, Track
from xtdrone_interaction.pictures.picture_style import save_figure

_DPI = 130
_REFERENCE, _OURS = "PX4 v1.14.3, recorded", "this autopilot"
_STYLE = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


@dataclass(frozen=True)
class _Panel:
    """One curve over time.

    Attributes:
        column: name in ``reference.COLUMNS``, or speed for the horizontal speed.
        label: of the axis.
        factor: the column is multiplied by it.
        setpoint: column of the setpoint, "" for none.
    """

    column: str
    label: str
    factor: float = 1.0
    setpoint: str = ""


@dataclass(frozen=True)
class _Picture:
    """Picture of a flight: first phase, length in s, title, panels, and whether the first panel is a top view."""

    phase: str
    seconds: float
    title: str
    panels: tuple[_Panel, ...]
    plan: bool = False


_DEGREES = 180.0 / np.pi
_PICTURES = {
    "takeoff": _Picture(
        "takeoff", 20.0, "Takeoff to 5 m",
        (_Panel("z", "height, m", -1.0), _Panel("vz", "climb rate, m/s", -1.0, "sp_vz"),
         _Panel("thrust_sp", "thrust setpoint")),
    ),
    "position_step": _Picture(
        "offb_pos_step", 8.0, "OFFBOARD: position step of 5 m",
        (_Panel("x", "x, m", 1.0, "sp_x"), _Panel("vx", "speed, m/s", 1.0, "sp_vx"),
         _Panel("pitch", "pitch, deg", _DEGREES), _Panel("z", "height, m", -1.0)),
    ),
    "velocity_step": _Picture(
        "offb_vel_step", 14.0, "OFFBOARD: velocity step of 3 m/s, and stop",
        (_Panel("vx", "speed, m/s", 1.0, "sp_vx"), _Panel("pitch", "pitch, deg", _DEGREES),
         _Panel("z", "height, m", -1.0)),
    ),
    "yaw_step": _Picture(
        "yaw_step", 4.0, "OFFBOARD: heading step of 90 deg",
        (_Panel("yaw", "heading, deg", _DEGREES, "sp_yaw"), _Panel("r", "yaw rate, deg/s", _DEGREES),
         _Panel("roll", "roll, deg", _DEGREES)),
    ),
    "offboard_loss": _Picture(
        "offboard_loss", 22.0, "Loss of the setpoints, hold, landing",
        (_Panel("x", "x, m"), _Panel("z", "height, m", -1.0), _Panel("vz", "sink rate, m/s", 1.0, "sp_vz"),
         _Panel("thrust_sp", "thrust setpoint")),
    ),
    "mission": _Picture(
        "mission", 46.0, "Mission: takeoff and a square of 20 m at 10 m",
        (_Panel("speed", "speed, m/s"), _Panel("z", "height, m", -1.0), _Panel("yaw", "heading, deg", _DEGREES)), True,
    ),
    "rtl": _Picture(
        "goto_away", 70.0, "Reposition, then return and landing",
        (_Panel("speed", "speed, m/s"), _Panel("z", "height, m", -1.0), _Panel("vz", "sink rate, m/s", 1.0)), True,
    ),
}  # fmt: skip


def save(reference: Flight, ours: Flight, flight: str, folder: Path) -> Path:
    """Draw ``flight`` (a name of ``flown_scripts.FLIGHTS``) into ``folder`` and return the picture's path."""
    picture = _PICTURES[flight]
    parts = []
    for recording in (reference, ours):
        start = recording.start_of(picture.phase)
        parts.append((recording.track.between(start - 1.0, start + picture.seconds), start))
    with plt.rc_context(_STYLE):
        figure = _draw(picture, parts)
        path = folder / f"{flight}.png"
        save_figure(figure, path, dpi=_DPI)
    return path


def _draw(picture: _Picture, parts: list[tuple[Track, float]]) -> Figure:
    if picture.plan:
        figure = plt.figure(figsize=(12.0, 6.5), layout="constrained")
        grid = figure.add_gridspec(len(picture.panels), 2)
        _draw_plan(figure.add_subplot(grid[:, 0]), parts)
        axes = [figure.add_subplot(grid[i, 1]) for i in range(len(picture.panels))]
    else:
        figure, found = plt.subplots(len(picture.panels), 1, figsize=(9.0, 7.0), sharex=True, layout="constrained")
        axes = list(np.atleast_1d(found))
    for axis, panel in zip(axes, picture.panels, strict=True):
        _draw_panel(axis, panel, parts)
    axes[-1].set_xlabel("time since the command, s")
    axes[0].legend(loc="best")
    figure.suptitle(picture.title)
    return figure


def _values(track: Track, column: str) -> NDArray[np.float64]:
    """Return a column, headings without jumps; speed is the horizontal one."""
    if column == "speed":
        return np.hypot(track["vx"], track["vy"])
    return np.unwrap(track[column]) if column == "yaw" else track[column]


def _draw_panel(axis: Axes, panel: _Panel, parts: list[tuple[Track, float]]) -> None:
    for (track, start), colour, name in zip(parts, ("black", "tab:red"), (_REFERENCE, _OURS), strict=True):
        time = track["t"] - start
        if panel.setpoint:
            axis.plot(time, panel.factor * _values(track, panel.setpoint), color=colour, linewidth=0.8, linestyle=":",
                      label=f"{name}: setpoint")  # fmt: skip
        axis.plot(time, panel.factor * _values(track, panel.column), color=colour, linewidth=1.4, label=name)
    axis.set_ylabel(panel.label)
    axis.set_xlim(-1.0, max(track["t"][-1] - start for track, start in parts))


def _draw_plan(axis: Axes, parts: list[tuple[Track, float]]) -> None:
    for (track, _), colour, name in zip(parts, ("black", "tab:red"), (_REFERENCE, _OURS), strict=True):
        axis.plot(track["y"] - track["y"][0], track["x"] - track["x"][0], color=colour, linewidth=1.4, label=name)
    axis.set_aspect("equal")
    axis.set_xlabel("right, m")
    axis.set_ylabel("forward, m")
    axis.set_title("from above")
    axis.legend(loc="best")
