"""The formation flight in one process, on simplified vehicles and in full physics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from xtdrone_coordination.follower import Follower
from xtdrone_coordination.patterns import PatternError
from xtdrone_interaction.missions.formation.compare_simulators import compare, with_assignments_of
from xtdrone_interaction.missions.formation.figures import figures
from xtdrone_interaction.missions.formation.metrics import make_report
from xtdrone_interaction.missions.formation.record import FormationRecord, read_formation, save_formation
from xtdrone_interaction.missions.formation.swarm_flight import FormationFlight, fly_formation, outcome_of
from xtdrone_interaction.pictures.picture_style import save_figures
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.report_json import write_report
from xtdrone_swarm import Swarm
from xtdrone_swarm.full_vehicles import CoreVehicles

COUNT = 6
PATTERNS = ["T", "diamond"]


def fly(**options: Any) -> FormationRecord:
    return fly_formation(Swarm(COUNT, airborne=False, record=False, **options), PATTERNS)


@pytest.fixture(scope="module")
def record() -> FormationRecord:
    return fly()


def test_a_complete_flight_has_a_report_without_shortcomings(record: FormationRecord, tmp_path: Path) -> None:
    assert outcome_of(record) == ("done", "")
    phases = [e["phase"] for e in record.phases]
    assert phases == [
        "connect", "takeoff", "offboard", "pattern origin", "climb", "pattern T", "move", "pattern diamond",
        "pattern origin", "descend", "land",
    ]  # fmt: skip
    track = record.track
    assert track.position.shape == (len(track.time), COUNT, 3)
    assert np.diff(track.time).max() <= 0.036 + 1e-9  # each turn of 30 Hz
    assert track.position[-1, :, 2].max() < 0.1
    report = make_report(record, {"seed": 0})
    assert report["shortcomings"] == []
    assert [r["pattern"] for r in report["reconfigurations"]] == ["origin", *PATTERNS, "origin"]
    assert all(r["settling_time"] < 20.0 for r in report["reconfigurations"])
    assert report["real_time_factor"] > 0.0
    write_report(report, tmp_path / "report.json")
    assert json.loads((tmp_path / "report.json").read_text())["vehicles"] == [f"iris_{i}" for i in range(COUNT)]
    assert all(path.stat().st_size > 10_000 for _, path in save_figures(figures(record), tmp_path))
    assert all(w.topology is not None for w in record.windows)


def test_the_same_flight_twice_is_the_same_to_the_bit(record: FormationRecord) -> None:
    again = fly()
    np.testing.assert_array_equal(record.track.time, again.track.time)
    np.testing.assert_array_equal(record.track.position, again.track.position)


def test_full_physics_flies_the_same_mission_close_by(record: FormationRecord) -> None:
    """Classes and assignments are the same; sensor noise and GPS wander are part of the difference."""
    vehicles = CoreVehicles(COUNT)
    full = fly(vehicles=vehicles, leader=with_assignments_of(record, type(Swarm(COUNT).leader)))
    vehicles.close()
    assert outcome_of(full) == ("done", "")
    assert full.collisions == []
    differences = compare(record, full)
    assert [d.pattern for d in differences] == ["origin", *PATTERNS, "origin"]
    assert [d.reassigned for d in differences] == [0] * 4
    assert all(0.005 < d.rms < 0.15 for d in differences)


class Lazy(Follower):
    """Never flies anywhere."""

    def control_law(self, position: Any, peers: Any) -> tuple[float, float, float]:
        return 0.0, 0.0, 0.0


def test_followers_that_do_not_fly_are_missed_in_the_report() -> None:
    record = fly_formation(Swarm(COUNT, follower=Lazy, airborne=False), ["T"])
    assert record.events[-1]["event"] == "done"
    assert "T" in record.events[-1]["unsettled"]
    assert any("'T' did not settle" in text for text in make_report(record)["shortcomings"])


class Stubborn(CoreVehicles):
    """Vehicle 3 does not arm."""

    def command(self, index: int, text: str) -> str:
        return "no" if index == 3 and text == "ARM" else super().command(index, text)


def test_a_failed_flight_lands_and_reports_the_reason() -> None:
    vehicles = Stubborn(COUNT)
    events: list[dict[str, Any]] = []
    progress: list[dict[str, Any]] = []
    record = fly_formation(Swarm(COUNT, vehicles=vehicles), PATTERNS, on_event=events.append, progress=progress.append)
    outcome, reason = outcome_of(record)
    assert outcome == "failed"
    assert "iris_3 (disarmed" in reason
    assert "did not arm within" in reason
    assert not any(vehicles.armed)
    assert events == record.events
    assert progress[0]["steps"] == 11
    vehicles.close()


def test_unknown_patterns_are_rejected() -> None:
    with pytest.raises(PatternError, match="'heart' is unknown for 6 vehicles"):
        fly_formation(Swarm(COUNT, airborne=False), ["heart"])


def test_turn_by_turn(record: FormationRecord) -> None:
    """A window flies the same flight turn by turn."""
    flight = FormationFlight(Swarm(COUNT, airborne=False, record=False), PATTERNS)
    turns = flight.turns()
    for _ in range(100):
        next(turns)
    assert flight.mission.phase == "takeoff"
    part = flight.record().track
    np.testing.assert_array_equal(part.position, record.track.position[: len(part.time)])


def test_the_saved_record_has_the_flight_and_can_be_read(record: FormationRecord, tmp_path: Path) -> None:
    save_formation(record, tmp_path / "flight.npz")
    with np.load(tmp_path / "flight.npz") as saved:
        np.testing.assert_array_equal(saved["position"], record.track.position)
        assert saved["names"].tolist() == list(record.names)
        assert saved["offsets"].shape == (4, COUNT - 1, 3)
        assert saved["topology"].shape == (4, COUNT, COUNT)
    again = read_formation(tmp_path / "flight.npz")
    assert make_report(again, {"seed": 0}) == make_report(record, {"seed": 0})
    assert [w.pattern for w in again.windows] == [w.pattern for w in record.windows]
    assert all((a.topology == b.topology).all() for a, b in zip(again.windows, record.windows, strict=True))


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 broken"])
def test_an_invalid_archive_is_reported(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "flight.npz").write_bytes(content)
    with pytest.raises(RecordError, match=r"flight record: .*flight\.npz cannot be read"):
        read_formation(tmp_path / "flight.npz")


def test_an_archive_of_other_content_is_reported(tmp_path: Path) -> None:
    np.savez(tmp_path / "flight.npz", position=np.zeros((3, 3)))
    with pytest.raises(RecordError, match=r"flight\.npz cannot be read \(.*pattern_time"):
        read_formation(tmp_path / "flight.npz")
