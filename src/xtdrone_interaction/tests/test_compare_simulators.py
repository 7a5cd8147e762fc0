"""The comparison of two flights, on synthetic ones with known differences."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from xtdrone_interaction.missions.formation.compare_simulators import (
    FULL,
    as_data,
    compare,
    comparison_figures,
    comparison_table,
    overall,
    same_slots,
    summarise_comparison,
)
from xtdrone_interaction.missions.formation.record import FormationRecord
from xtdrone_interaction.pictures.picture_style import save_figures
from xtdrone_interaction.recording.positions import FleetTrack
from xtdrone_interaction.recording.recorded_flight import Change, RecordError

GRID = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [3.0, 3.0, 0.0]])
LINE = np.array([[0.0, 2.0, 0.0], [0.0, 4.0, 0.0], [0.0, 6.0, 1.0]])
NAMES = ("iris_0", "iris_1", "iris_2", "iris_3")
WINDOW = 20.0  # s


def flight(
    *,
    rate: float = 1.0,
    start: float = 2.0,
    step: float = 1.0 / 30.0,
    order: tuple[int, ...] = (0, 1, 2),
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    patterns: tuple[tuple[str, NDArray[np.float64]], ...] = (("origin", GRID), ("line", LINE)),
) -> FormationRecord:
    """Return a flight of first-order followers under a leader that drifts.

    Args:
        rate: 1/s, of the approach.
        start: time of the first command, s.
        step: time between two recorded positions, s.
        order: slot of each follower, in all but the first pattern.
        shift: distance of the followers from their slots, m.
        patterns: name and slots, flown in turn.
    """
    events: list[dict[str, object]] = [
        {"event": "start", "time": 0.0, "wall": 0.0, "vehicles": list(NAMES)},
        {"event": "phase", "time": 1.0, "phase": "takeoff"},
    ]
    times = np.arange(0.0, start + WINDOW * len(patterns) + 1.0, step)
    leader = np.stack([0.1 * times, np.zeros_like(times), np.full_like(times, 8.0)], axis=1)
    followers = np.empty((len(times), 3, 3))
    followers[:] = GRID
    changes = []
    for number, (name, slots) in enumerate(patterns):
        begin = start + number * WINDOW
        offsets = slots if number == 0 else slots[list(order)]
        events.append({"event": "phase", "time": begin, "phase": f"pattern {name}", "pattern": name})
        events.append({"event": "assigned", "time": begin, "pattern": name, "offsets": offsets.tolist()})
        changes.append(Change(begin, offsets))
        late = times >= begin
        before = followers[late][0]
        way = (1.0 - np.exp(-rate * (times[late] - begin)))[:, None, None]
        followers[late] = before + way * (offsets + np.array(shift) - before)
    events.append({"event": "phase", "time": start + WINDOW * len(patterns), "phase": "land"})
    events.append({"event": "done", "time": times[-1], "wall": 1.0})
    places = np.concatenate([leader[:, None], leader[:, None] + followers], axis=1)
    return FormationRecord(NAMES, FleetTrack("made up", times, places), None, changes, [], events)


def test_a_flight_does_not_differ_from_itself_later_and_at_another_rate() -> None:
    """Flights are aligned at the command, whatever its time and the rate of the recording."""
    differences = compare(flight(), flight(start=5.004, step=0.02))
    assert [d.pattern for d in differences] == ["origin", "line"]
    for d in differences:
        assert d.rms < 0.01
        assert d.reassigned == 0
        assert d.duration == pytest.approx(WINDOW, abs=0.03)


def test_the_rms_of_two_first_order_approaches() -> None:
    """It is the integral of (exp(-at) - exp(-bt))^2 over the window, times the mean squared step."""
    a, b = 1.0, 0.5
    line = compare(flight(rate=a), flight(rate=b))[1]
    step = np.mean(np.linalg.norm(LINE - GRID, axis=1) ** 2)
    integral = 1 / (2 * a) + 1 / (2 * b) - 2 / (a + b)
    assert line.rms == pytest.approx(np.sqrt(step * integral / WINDOW), rel=0.02)
    greatest = np.linalg.norm(LINE - GRID, axis=1).max() * 0.25  # exp(-t/2) - exp(-t) is 1/4 at its greatest
    assert line.greatest == pytest.approx(greatest, rel=0.01)
    assert line.settling_time[0] == pytest.approx(np.log(4.0 * greatest / 0.15) / a, abs=0.1)
    assert line.settling_time[1] == pytest.approx(np.log(4.0 * greatest / 0.15) / b, abs=0.1)


def test_a_constant_difference_is_measured() -> None:
    line = compare(flight(rate=50.0), flight(rate=50.0, shift=(0.06, 0.0, 0.08)))[1]
    assert line.rms == pytest.approx(0.1, abs=0.005)
    assert line.steady_error[0] == pytest.approx(0.0, abs=1e-6)
    assert line.steady_error[1] == pytest.approx(0.1, abs=1e-6)


def test_other_assignments_are_reported_and_compared_by_slot() -> None:
    differences = compare(flight(rate=50.0), flight(rate=50.0, order=(1, 0, 2)))
    assert [d.reassigned for d in differences] == [0, 2]
    assert differences[1].greatest < 5.0  # differs on the way from the start; later they are in the same slots
    assert differences[1].rms < 0.5
    assert "Pattern 'line': 2 followers have other slots than in full physics" in summarise_comparison(differences)


def test_same_slots_in_any_order() -> None:
    np.testing.assert_array_equal(same_slots(LINE, LINE[[2, 0, 1]]), [1, 2, 0])
    with pytest.raises(RecordError, match="with different slots"):
        same_slots(LINE, LINE + np.array([0.0, 0.0, 0.5]))


def test_flights_that_cannot_be_compared() -> None:
    with pytest.raises(RecordError, match="patterns origin, line cannot be compared with origin, row"):
        compare(flight(), flight(patterns=(("origin", GRID), ("row", LINE))))
    fewer = flight()
    fewer.names = NAMES[:3]
    with pytest.raises(RecordError, match="4 vehicles cannot be compared with 3 vehicles"):
        compare(flight(), fewer)
    grounded = flight()
    grounded.events = grounded.events[:2]
    with pytest.raises(RecordError, match="flew no pattern"):
        compare(flight(), grounded)


def test_a_flight_that_ended_early_is_compared_as_far_as_it_went() -> None:
    assert [d.pattern for d in compare(flight(), flight(patterns=(("origin", GRID),)))] == ["origin"]


def test_report_table_and_pictures(tmp_path: Path) -> None:
    first, second = flight(rate=1.0), flight(rate=0.8)
    differences = compare(first, second)
    data = json.loads(json.dumps(as_data(differences, FULL), allow_nan=False))
    assert data["with"] == "full physics"
    assert data["patterns"][1]["rms"] == pytest.approx(differences[1].rms)
    assert data["rms"] == pytest.approx(overall(differences))
    assert comparison_table(differences).rows[1][1] == f"{differences[1].rms:.3f}"
    paths = [path for _, path in save_figures(comparison_figures(first, second), tmp_path)]
    assert [p.name for p in paths] == ["comparison_1_origin_to_line.png"]
    assert paths[0].stat().st_size > 20_000
