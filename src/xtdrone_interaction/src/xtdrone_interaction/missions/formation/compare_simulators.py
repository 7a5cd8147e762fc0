"""Comparison of the same flight in the simplified simulator and in full physics: accuracy of the approximation.

The positions of the followers relative to the leader are compared slot by slot, from the command of each pattern on. If
the two flights assigned a slot to different vehicles, the vehicles of the same slot are compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, cast

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from xtdrone_coordination.leader import Assignment, Leader
from xtdrone_interaction.missions.formation.metrics import measure
from xtdrone_interaction.missions.formation.record import FormationRecord, PatternWindow
from xtdrone_interaction.pictures.picture_style import NamedFigure, fleet_colours
from xtdrone_interaction.recording.distances import Array, relative
from xtdrone_interaction.recording.positions import FleetTrack
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.report_tables import ReportTable

SIMPLIFIED, FULL = "simplified", "full physics"
_STEP = 0.02  # s, interval between compared positions
_SAME_SLOT = 1e-3  # m; offsets travel as 32-bit floats
_LEAD_IN = 1.0  # s shown before the command
_MAX_LEGEND = 18  # vehicles; larger fleets have no individual legend


@dataclass(frozen=True)
class Difference:
    """One reconfiguration in both simulators.

    Attributes:
        pattern: name.
        duration: length of the comparison from the command on, s; the shorter window of the two.
        rms: root mean square over followers and time of the distance between the positions in the two simulators,
            relative to the leader, m.
        greatest: the greatest such distance, m.
        reassigned: number of followers with another slot than in the other simulator.
        settling_time: s, simplified and full; None: never.
        overshoot: m, likewise.
        steady_error: m, mean over the followers, likewise.
    """

    pattern: str
    duration: float
    rms: float
    greatest: float
    reassigned: int
    settling_time: tuple[float | None, float | None]
    overshoot: tuple[float, float]
    steady_error: tuple[float, float]


@dataclass(frozen=True)
class _Pair:
    """Positions in one reconfiguration at common times, in the order of the followers of the simplified flight.

    Attributes:
        time: s since the command, shape (t,).
        simplified, full: relative to the leader, shape (t, n - 1, 3), m.
        follower: index of the follower of the full flight by slot, shape (n - 1,), from 0.
    """

    time: Array
    simplified: Array
    full: Array
    follower: NDArray[np.int64]


def compare(simplified: FormationRecord, full: FormationRecord) -> list[Difference]:
    """Return the differences, one per reconfiguration of both flights.

    Raises:
        RecordError: the flights have different vehicles or patterns.
    """
    windows = _common_windows(simplified, full)
    figures = measure(simplified, simplified.track), measure(full, full.track)
    differences = []
    for number, (first, second) in enumerate(windows):
        pair = _pair(simplified.track, first, full.track, second)
        distance = np.linalg.norm(pair.simplified - pair.full, axis=-1)
        a, b = figures[0][number], figures[1][number]
        differences.append(
            Difference(
                pattern=first.pattern,
                duration=float(pair.time[-1]),
                rms=float(np.sqrt(np.mean(distance**2))),
                greatest=float(distance.max()),
                reassigned=int((pair.follower != np.arange(len(pair.follower))).sum()),
                settling_time=(a.settling_time, b.settling_time),
                overshoot=(a.overshoot, b.overshoot),
                steady_error=(a.steady_error_mean, b.steady_error_mean),
            )
        )
    return differences


def with_assignments_of(record: FormationRecord, base: type[Leader]) -> type[Leader]:
    """Return a leader class with the assignments of a recorded flight, otherwise equal to ``base``.

    From a symmetric formation many assignments have about the same length, and noise decides between them. With equal
    assignments, two flights differ only by the motion of the vehicles.
    """
    given = [np.asarray(change.value) for change in record.patterns]

    class SameAssignments(base):  # type: ignore[misc,valid-type]
        """A leader that returns recorded assignments in their order."""

        _choices = 0

        def restart(self) -> None:
            """Restart with the first assignment."""
            super().restart()
            self._choices = 0

        def assignment(self, current: Array, target: Array) -> Assignment:
            """Return the recorded assignment; that of the base class after the last one, or for other slots."""
            number, self._choices = self._choices, self._choices + 1
            if number >= len(given):
                return cast(Assignment, super().assignment(current, target))
            try:
                slots = same_slots(given[number], target)
            except RecordError:
                return cast(Assignment, super().assignment(current, target))
            return Assignment(slots, float(np.linalg.norm(current - target[slots], axis=1).sum()))

    return SameAssignments


def as_data(differences: list[Difference], full: str) -> dict[str, Any]:
    """Return the comparison for report.json.

    Args:
        differences: of :func:`compare`.
        full: description of the full flight.
    """
    return {
        "with": full,
        "order_of_pairs": [SIMPLIFIED, FULL],
        "rms": overall(differences),
        "patterns": [asdict(d) for d in differences],
    }


def overall(differences: list[Difference]) -> float:
    """Return the RMS difference over all reconfigurations, weighted by duration, m."""
    weights = np.array([d.duration for d in differences])
    return float(np.sqrt(np.average([d.rms**2 for d in differences], weights=weights)))


def check_comparable(full: FormationRecord, count: int, patterns: list[str]) -> None:
    """Check that a flight can be compared with one of ``count`` vehicles through ``patterns``, up to the shorter end.

    Raises:
        RecordError: it has other vehicles, other patterns, or no pattern.
    """
    if len(full.names) != count:
        raise RecordError(f"comparison: {count} vehicles cannot be compared with {len(full.names)} vehicles")
    flown = [w.pattern for w in full.windows]
    if not flown or not patterns:
        raise RecordError("comparison: a flight that flew no pattern cannot be compared")
    shorter = min(len(flown), len(patterns))
    if flown[:shorter] != patterns[:shorter]:
        raise RecordError(f"comparison: patterns {', '.join(patterns)} cannot be compared with {', '.join(flown)}")


def _common_windows(simplified: FormationRecord, full: FormationRecord) -> list[tuple[PatternWindow, PatternWindow]]:
    first, second = simplified.windows, full.windows
    check_comparable(full, len(simplified.names), [w.pattern for w in first])
    return list(zip(first, second, strict=False))


def _pair(
    track: FleetTrack, window: PatternWindow, full_track: FleetTrack, full_window: PatternWindow, lead_in: float = 0.0
) -> _Pair:
    end = min(window.end - window.start, full_window.end - full_window.start)
    time = np.arange(-lead_in, end, _STEP)
    follower = same_slots(window.offsets, full_window.offsets)
    return _Pair(
        time,
        relative(_at(track, window.start + time)),
        relative(_at(full_track, full_window.start + time))[:, follower],
        follower,
    )


def same_slots(offsets: Array, others: Array) -> NDArray[np.int64]:
    """Return the index of the follower of the other flight with the same slot, shape (n - 1,).

    Args:
        offsets, others: assigned slots of both flights, shape (n - 1, 3), m.

    Raises:
        RecordError: the slots differ.
    """
    if np.allclose(offsets, others, atol=_SAME_SLOT):
        return np.arange(len(offsets))
    cost = cdist(offsets, others)
    rows, columns = linear_sum_assignment(cost)
    if cost[rows, columns].max() > _SAME_SLOT:
        raise RecordError("comparison: the two flights flew patterns of one name with different slots")
    return columns


def _at(track: FleetTrack, times: Array) -> Array:
    """Return the positions at given times, shape (t, n, 3)."""
    after = np.clip(np.searchsorted(track.time, times), 1, len(track.time) - 1)
    before = after - 1
    span = np.maximum(track.time[after] - track.time[before], 1e-9)
    part = np.clip((times - track.time[before]) / span, 0.0, 1.0)[:, None, None]
    return (1.0 - part) * track.position[before] + part * track.position[after]


def comparison_table(differences: list[Difference]) -> ReportTable:
    """Return the table of the comparison."""
    head = ("pattern", "RMS\n(m)", "greatest\n(m)", "settled (s)\nsimpl./full", "overshoot (m)\nsimpl./full",
            "steady (m)\nsimpl./full")  # fmt: skip
    rows = [
        (
            d.pattern,
            f"{d.rms:.3f}",
            f"{d.greatest:.2f}",
            "/".join("never" if s is None else f"{s:.2f}" for s in d.settling_time),
            f"{d.overshoot[0]:.2f}/{d.overshoot[1]:.2f}",
            f"{d.steady_error[0]:.3f}/{d.steady_error[1]:.3f}",
        )
        for d in differences
    ]
    return ReportTable("Simplified against full physics (relative to the leader)", head, rows)


def summarise_comparison(differences: list[Difference]) -> str:
    """Return the RMS difference, and the number of followers with different slots, as sentences."""
    lines = [f"RMS difference over all: {overall(differences):.3f} m."]
    lines += [
        f"Pattern {d.pattern!r}: {d.reassigned} followers have other slots than in full physics; "
        "those with the same slot are compared."
        for d in differences
        if d.reassigned
    ]
    return "\n".join(lines)


def comparison_figures(simplified: FormationRecord, full: FormationRecord) -> Iterator[NamedFigure]:
    """Yield both responses to each pattern in one figure.

    Raises:
        RecordError: see :func:`compare`.
    """
    windows = _common_windows(simplified, full)
    names = [window.pattern for window, _ in windows]
    for number, (before, pattern) in enumerate(pairwise(names), 1):
        figure = _response(simplified, full, *windows[number], before=before)
        yield NamedFigure(f"comparison_{number}_{before}_to_{pattern}", f"From {before} to {pattern}", figure)


def _response(
    first: FormationRecord, full: FormationRecord, window: PatternWindow, other: PatternWindow, before: str
) -> Figure:
    """Draw x, y and z of every follower relative to the leader, simplified solid, full physics dashed."""
    pair = _pair(first.track, window, full.track, other, _LEAD_IN)
    figure, axes = plt.subplots(3, 1, figsize=(9.0, 7.5), sharex=True)
    figure.subplots_adjust(left=0.08, right=0.81, top=0.93, bottom=0.07, hspace=0.1)
    shades = fleet_colours(len(first.names))
    for axis, (panel, letter) in enumerate(zip(axes, "xyz", strict=True)):
        for i in range(pair.full.shape[1]):
            panel.plot(pair.time, pair.full[:, i, axis], color=shades[i + 1], lw=2.2, alpha=0.35)
            panel.plot(pair.time, pair.simplified[:, i, axis], color=shades[i + 1], lw=1.1, ls="--")
        panel.axvline(0.0, color="grey", lw=0.8, ls="--", zorder=1)
        panel.set_ylabel(f"{letter} [m]")
        panel.margins(x=0.01)
    axes[-1].set_xlabel(f"time since the command '{window.pattern}' [s]")
    figure.suptitle(f"From {before} to {window.pattern}, relative to the leader: simplified and full physics")
    handles = [
        Line2D([], [], color="grey", lw=1.1, ls="--"),
        Line2D([], [], color="grey", lw=2.2, alpha=0.35),
    ]
    labels = [SIMPLIFIED, FULL]
    if len(first.names) <= _MAX_LEGEND:
        handles += [Line2D([], [], color=shade, lw=1.5) for shade in shades[1:]]
        labels += list(first.names[1:])
    figure.legend(handles, labels, loc="upper left", bbox_to_anchor=(0.82, 0.94))
    return figure
