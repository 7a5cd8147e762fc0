"""Goals of the measurements of ``./xtdrone bench``: target figures, shown beside the measured ones."""

from __future__ import annotations

from typing import NamedTuple

from benchmarks.tables.table_columns import Field, goal


class Goal(NamedTuple):
    """Goals of one measurement.

    Attributes:
        keys: of the row, which name a case.
        figures: to reach, by the values of ``keys``.
        form: format string of a figure.
    """

    keys: tuple[str, ...]
    figures: dict[tuple[object, ...], float]
    form: str = "{:g} x"


GOALS = {
    "core": Goal(("vehicles",), {(9,): 30.0, (100,): 6.0}),
    "simplified": Goal(("vehicles",), {(9,): 1000.0, (1000,): 1.0}),
    "drawing": Goal(("vehicles",), {(100,): 15.0}, "{:g}"),
    "sweep": Goal(("workers",), {(2,): 1.7}),
    "rays": Goal(("lidars", "kind"), {(6, "spinning"): 1.0}),
    "planning": Goal(("vehicles",), {(1,): 20.0, (4,): 20.0}, "{:g} ms"),
    "odometry": Goal(("rings", "kind"), {(16, "odometry"): 40.0, (16, "local_map"): 20.0}, "{:g}"),
    "analyse": Goal(("megabytes",), {(1000,): 100.0}, "{:g}"),
    "stack": Goal(("vehicles",), {(9,): 10.0}),
    "sensing": Goal(("vehicles", "sensors"), {(6, "lidars 16x512"): 1.0}),
    "formation": Goal(
        ("vehicles", "mode"), {(9, "per_uav"): 3.0, (30, "per_uav"): 1.0, (9, "merged"): 9.0, (30, "merged"): 3.0}
    ),
    "search": Goal(("camera_rate",), {(2,): 1.0}),
    "web": Goal(("vehicles",), {(30,): 0.95}, "{:.2f}"),
    "free": Goal(("vehicles",), {(9,): 0.7}, "{:.2f}"),
}


def goal_of(name: str) -> Field:
    """Return the table's column with the goals of a measurement."""
    keys, figures, form = GOALS[name]
    return "to\nreach", goal(figures, keys, form)
