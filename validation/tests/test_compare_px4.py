"""The comparison with the recorded PX4: its figures against closed forms, its data, its tables."""

from __future__ import annotations

import math

import numpy as np
import pytest

from validation.compare_px4 import event_tolerances, flown_scripts, pictures, reference, response_tolerances
from validation.compare_px4.compare_px4_cli import report
from validation.compare_px4.reference import Event, Flight, Track
from xtdrone_common.fleet import Vehicle
from xtdrone_interaction import cli


def test_first_order_step_has_its_known_figures():
    time = np.arange(0.0, 10.0, 0.001)
    step = response_tolerances.step_response(time, 2.0 + 3.0 * (1.0 - np.exp(-time)), 2.0, 5.0)
    assert step.t90 == pytest.approx(math.log(10.0), abs=0.002)
    assert step.t90 - step.t10 == pytest.approx(math.log(9.0), abs=0.002)
    assert step.settle == pytest.approx(math.log(20.0), abs=0.002)
    assert step.overshoot == 0.0


def test_second_order_step_has_its_known_overshoot():
    time, damping = np.arange(0.0, 20.0, 0.001), 0.5
    damped = math.sqrt(1.0 - damping**2)
    value = 1.0 - np.exp(-damping * time) * np.cos(damped * time - math.asin(damping)) / damped
    step = response_tolerances.step_response(time, -value, 0.0, -1.0)
    assert step.overshoot == pytest.approx(100.0 * math.exp(-math.pi * damping / damped), abs=0.1)


def test_step_that_is_not_reached_counts_as_outside():
    time = np.arange(0.0, 5.0, 0.01)
    step = response_tolerances.step_response(time, 0.5 * np.ones_like(time), 0.0, 1.0)
    assert math.isnan(step.t90)
    assert math.isnan(step.settle)
    assert not response_tolerances.Figure("f", "n", "s", 1.0, step.t90, 0.15).within


def test_recordings_hold_the_figures_that_are_known_of_them():
    flight = reference.load()
    found = {figure.name: figure.reference for figure in response_tolerances.figures(flight, flight, "position_step")}
    assert found["90 % reached"] == pytest.approx(1.94, abs=0.04)
    assert found["overshoot"] == pytest.approx(7.8, abs=0.3)
    assert found["settled within 5 %"] == pytest.approx(4.36, abs=0.08)
    assert sum(path.stat().st_size for path in reference.folder().iterdir()) < 1_000_000


@pytest.mark.parametrize("flight", flown_scripts.FLIGHTS)
def test_recording_is_within_its_own_allowances(flight, tmp_path):
    recorded = reference.load()
    assert all(figure.within for figure in response_tolerances.figures(recorded, recorded, flight))
    assert all(match.within for match in event_tolerances.compare(recorded, recorded, flight))
    assert pictures.save(recorded, recorded, flight, tmp_path).stat().st_size > 10_000


def recording(*rows: tuple[float, str, str]) -> Flight:
    found = [Event(0.0, "takeoff", "phase", "takeoff"), *[Event(t, "takeoff", kind, value) for t, kind, value in rows]]
    return Flight(Track(np.zeros((1, len(reference.COLUMNS)))), found)


def test_events_are_compared_by_order_and_time():
    theirs = recording((1.0, "ack", "176 0"), (1.5, "text", "6 first"), (2.5, "text", "6 second"))
    assert all(
        m.within
        for m in event_tolerances.compare(
            theirs, recording(*[(e.time + 0.15, e.kind, e.value) for e in theirs.events[1:]]), "takeoff"
        )
    )
    late = recording((1.0, "ack", "176 0"), (1.75, "text", "6 first"), (2.5, "text", "6 second"))
    assert [m.within for m in event_tolerances.compare(theirs, late, "takeoff")] == [True, False, True]
    swapped = recording((1.0, "ack", "176 0"), (2.5, "text", "6 second"), (2.0, "text", "6 first"))
    assert not all(m.within for m in event_tolerances.compare(theirs, swapped, "takeoff"))
    missing = recording((1.0, "ack", "176 0"), (1.5, "text", "6 first"))
    assert [m.within for m in event_tolerances.compare(theirs, missing, "takeoff")] == [True, True, False]
    more = recording(*[(e.time, e.kind, e.value) for e in theirs.events[1:]], (3.0, "text", "6 third"))
    assert [m.within for m in event_tolerances.compare(theirs, more, "takeoff")] == [True, True, True, False]


def test_changes_in_a_heartbeat_may_be_one_second_older():
    theirs = recording((1.0, "ack", "176 0"), (1.9, "mode", "157 33816576 4"))
    for time, within in ((1.0, True), (1.9, True), (2.05, True), (2.2, False)):
        ours = recording((1.0, "ack", "176 0"), (time, "mode", "157 33816576 4"))
        assert event_tolerances.compare(theirs, ours, "takeoff")[1].within is within


def test_required_flights_come_first():
    assert flown_scripts.needed(("yaw_step",)) == ("takeoff", "yaw_step")
    assert flown_scripts.needed(("rtl",)) == ("mission", "rtl")


def test_report_counts_values_outside():
    text = report("iris", [response_tolerances.Figure("yaw step", "90 % reached", "s", 1.0, 2.0, 0.15)], [])
    assert "1 outside" in text
    assert "OUTSIDE" in text


@pytest.mark.parametrize("arguments", [["--vehicle", "no_such"], ["--flights", "loop"]])
def test_invalid_values_are_reported(arguments, capsys):
    try:
        status = cli.main(["compare-px4", *arguments])
    except SystemExit as stop:
        status = stop.code
    assert status == 2
    assert arguments[1] in capsys.readouterr().err


def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Place the vehicle's MAVLink on ports far from those of a running simulation."""
    for name, port in (("offboard_local_port", 34820), ("offboard_remote_port", 24820), ("gcs_local_port", 18820)):
        monkeypatch.setattr(Vehicle, name, port)


@pytest.fixture(scope="module")
def flown():
    """Our autopilot in the recorded flights, on the recorded plant."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        elsewhere(monkeypatch)
        return flown_scripts.fly("px4_reference", flown_scripts.FLIGHTS, 0, lambda _name: None)


@pytest.mark.parametrize("flight", flown_scripts.FLIGHTS)
def test_our_autopilot_flies_as_the_recorded_px4(flown, flight):
    recorded = reference.load()
    outside = [f for f in response_tolerances.figures(recorded, flown, flight) if not f.within]
    assert not outside
    assert not [match for match in event_tolerances.compare(recorded, flown, flight) if not match.within]


def test_flights_are_the_same_to_the_last_bit(monkeypatch):
    elsewhere(monkeypatch)
    first, second = (flown_scripts.fly("px4_reference", ("takeoff",), 3, lambda _name: None) for _ in range(2))
    np.testing.assert_array_equal(first.track.rows, second.track.rows)
    assert first.events == second.events
