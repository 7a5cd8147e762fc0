"""Reading the director's events."""

from __future__ import annotations

from xtdrone_interaction.recording.flight_events import read_events


def test_a_phase_of_an_older_recording_has_its_present_name(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_text('{"event": "phase", "phase": "take-off", "time": 1.0}\n{"event": "done", "time": 2.0}\n{"eve')
    assert read_events(path) == [{"event": "phase", "phase": "takeoff", "time": 1.0}, {"event": "done", "time": 2.0}]
