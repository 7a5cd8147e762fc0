"""The display of a flight's progress: it fits a terminal, and reports a world that stands still."""

from __future__ import annotations

import io
import types
from typing import Any

import genpy
import pytest
from rich.console import Console

from xtdrone_interaction.launching.message_feed import standstill
from xtdrone_interaction.monitoring.progress_display import LineDisplay, LiveDisplay

PROGRESS: dict[str, Any] = {
    "phase": "pattern pyramid", "step": 12, "steps": 15, "sim_time": 1234.5, "error": 12.34, "least_distance": 12.82,
}  # fmt: skip


def status(**values: Any) -> Any:
    plain = {"paused": False, "stepping": False, "waiting_for": [], "waiting": genpy.Duration(0), "reason": ""}
    return types.SimpleNamespace(**{**plain, **values})


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({}, ""),
        ({"paused": True, "reason": "paused"}, "paused"),
        ({"paused": True, "stepping": True}, ""),
        ({"waiting_for": ["/b", "/a"], "waiting": genpy.Duration(4)}, "waiting for /a, /b (4 s)"),
        ({"waiting_for": list("dcbae"), "waiting": genpy.Duration(4)}, "waiting for a, b, c and 2 more (4 s)"),
        ({"reason": "time has not started: 1 of 3"}, "time has not started: 1 of 3"),
    ],
)
def test_the_cause_of_a_standstill(values: dict[str, Any], text: str) -> None:
    assert standstill(status(**values)) == text


def test_all_figures_fit_80_columns() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=80, height=25, color_system=None)
    display = LiveDisplay(console)
    display.update(PROGRESS)
    display.close()
    shown = console.file.getvalue()
    for text in ("pattern pyramid", "12.34 m", "12.82 m", "11/15", "1234.5 s"):
        assert text in shown
    assert "…" not in shown


def test_a_standstill_replaces_the_figures_until_it_is_over() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=80, height=25, color_system=None)
    display = LiveDisplay(console)
    display.update(PROGRESS)
    display.standstill("paused")
    display.update(PROGRESS)
    assert display._progress.tasks[0].fields["figures"] == "paused"
    display.standstill("")
    assert "12.34 m" in display._progress.tasks[0].fields["figures"]
    display.close()


def test_lines_report_a_standstill_once() -> None:
    console = Console(file=io.StringIO())
    display = LineDisplay(console)
    for text in ("", "waiting for /a (1 s)", "waiting for /a (2 s)", "paused", "", ""):
        display.standstill(text)
    lines = [line.strip() for line in console.file.getvalue().splitlines()]
    assert lines == ["starting the nodes", "waiting for /a (1 s)", "paused", "continues"]
