"""Flight records, reports and pictures, from a synthetic flight."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from rich.console import Console
from synthetic import GRID, PATTERNS, RATE, WINDOW, make_bag

from xtdrone_interaction.missions.formation import metrics as reports
from xtdrone_interaction.missions.formation.criteria import CRITERIA, SETTLED_ERROR
from xtdrone_interaction.missions.formation.figures import figures
from xtdrone_interaction.missions.formation.record import FormationRecord, read_formation
from xtdrone_interaction.missions.formation.report import report_of
from xtdrone_interaction.missions.mission import FlightReport
from xtdrone_interaction.pictures.picture_style import NamedFigure, save_figures
from xtdrone_interaction.recording.distances import least_distances, offsets_from_message
from xtdrone_interaction.recording.positions import FleetTrack, regular_times
from xtdrone_interaction.recording.recorded_flight import Change, RecordError
from xtdrone_interaction.recording.topics import ESTIMATE, TRUTH
from xtdrone_interaction.report.html_page import print_page
from xtdrone_interaction.report.report_json import write_report


def test_record_holds_the_flight(flight_bag: Path) -> None:
    record = read_formation(flight_bag)
    assert record.names == tuple(f"iris_{i}" for i in range(9))
    assert record.truth is not None
    assert record.estimate is not None
    assert record.track is record.truth
    np.testing.assert_allclose(record.truth.position[0, 1:, :2], GRID[:, :2], atol=1e-9)
    np.testing.assert_allclose(record.estimate.position, record.truth.position, atol=1e-6)
    assert len(record.patterns) == len(PATTERNS)
    assert record.topologies[0].value[3, 2] == 1
    assert [w.pattern for w in record.windows] == list(PATTERNS)
    assert all(w.topology is not None and w.topology[3, 2] == 1 for w in record.windows)


def test_offsets_are_read_row_major() -> None:
    offsets = offsets_from_message([1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(offsets, [[1, 3, 5], [2, 4, 6]])
    with pytest.raises(ValueError, match="4 values"):
        offsets_from_message([1, 2, 3, 4])


@pytest.mark.parametrize("content", [None, b"", b"no bag at all"])
def test_unreadable_bags_are_reported(tmp_path: Path, content: bytes | None) -> None:
    bag = tmp_path / "broken.bag"
    if content is not None:
        bag.write_bytes(content)
    with pytest.raises(RecordError, match=r"broken\.bag"):
        read_formation(bag)


@pytest.mark.parametrize("name", ["flight", "flight.plan", "old.bag", "log.bag"])
def test_other_files_are_rejected_with_the_command_that_reads_them(tmp_path: Path, name: str) -> None:
    begin = {"old.bag": b"#ROSBAG V1.2\n", "log.bag": b"ULog\x01\x12\x35\x01"}.get(name, b"#ROSBAG V2.0\n")
    (tmp_path / name).write_bytes(begin + bytes(100))
    with pytest.raises(RecordError, match=r"neither a bag of version 2\.0 .*analyse"):
        read_formation(tmp_path / name)


def test_a_folder_is_no_record(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="is a folder"):
        read_formation(tmp_path)


def test_a_withdrawn_pattern_is_absent(tmp_path: Path) -> None:
    make_bag(tmp_path / "flight.bag", patterns=("origin",), taken_back=True)
    record = read_formation(tmp_path / "flight.bag")
    assert [len(change.value) for change in record.patterns] == [8]
    assert [change.value.shape for change in record.topologies] == [(9, 9)]


def test_settling_follows_the_first_order_motion(flight_bag: Path) -> None:
    results = {r.pattern: r for r in reports.measure(read_formation(flight_bag), read_formation(flight_bag).track)}
    assert results["origin"].settling_time == pytest.approx(0.0, abs=0.05)
    farthest = 6.63  # m, from the grid to the cube's slot that is farthest, at the least total distance
    expected = math.log(farthest / SETTLED_ERROR) / RATE
    assert results["cube"].settling_time == pytest.approx(expected, abs=0.5)
    for result in results.values():
        assert result.end_time - result.command_time == pytest.approx(WINDOW, abs=0.1)
        assert result.steady_error_mean < 0.04
        assert result.assigned_distance == pytest.approx(result.optimal_distance, rel=0.01, abs=0.01)


def test_good_flight_has_no_shortcomings(flight_bag: Path) -> None:
    report = reports.make_report(read_formation(flight_bag), {"seed": 7, "command_wall": 990.0})
    assert report["shortcomings"] == []
    assert report["outcome"] == "done"
    assert report["positions"] == TRUTH
    assert report["real_time_factor"] == pytest.approx(2.0)
    assert report["settings"] == {"seed": 7}
    assert report["startup_time"] == pytest.approx(1000.0 + 5.0 / 2 - 990.0, abs=0.1)
    assert 1.0 < report["least_distance"] < 2.0
    json.dumps(report, allow_nan=False)


def test_estimates_serve_where_no_truth_was_recorded(tmp_path: Path) -> None:
    make_bag(tmp_path / "flight.bag", patterns=("cube",), truth=False)
    report = reports.make_report(read_formation(tmp_path / "flight.bag"))
    assert report["positions"] == ESTIMATE
    assert "by_estimate" not in report


def test_bad_flight_is_called_bad(tmp_path: Path) -> None:
    make_bag(tmp_path / "flight.bag", patterns=("cube", "pyramid"), offset=0.3, shuffle=True)
    report = reports.make_report(read_formation(tmp_path / "flight.bag"))
    text = " ".join(report["shortcomings"])
    assert "'cube' did not settle" in text
    assert "assigned distance" in text
    assert report["reconfigurations"][0]["settling_time"] is None


def test_waived_criteria_do_not_count(tmp_path: Path) -> None:
    make_bag(tmp_path / "flight.bag", patterns=("cube", "pyramid"), offset=0.3, shuffle=True)
    record = read_formation(tmp_path / "flight.bag")
    for waived, gone, left in (
        ("assignment", "assigned distance", "did not settle"),
        ("settling", "did not settle", "assigned"),
    ):
        text = " ".join(reports.make_report(record, {"waive": [waived]})["shortcomings"])
        assert gone not in text
        assert left in text
    assert reports.make_report(record, {"waive": list(CRITERIA)})["shortcomings"] == []


def test_a_lost_vehicle_is_reported_and_counts_until_its_loss(tmp_path: Path) -> None:
    make_bag(tmp_path / "flight.bag", patterns=("cube", "pyramid"), offset=0.3)
    record = read_formation(tmp_path / "flight.bag")
    whole = reports.make_report(record)
    assert (whole["lost"], whole["reconfigurations"][1]["settling_time"]) == ([], None)
    second = record.windows[1]
    event = {"event": "lost", "time": second.start + 1.0, "vehicle": record.names[3], "reason": "is away"}
    report = reports.make_report(replace(record, events=[*record.events[:-1], event, record.events[-1]]))
    assert report["reconfigurations"][0] == whole["reconfigurations"][0]
    assert report["reconfigurations"][1]["settling_time"] is not None
    assert report["reconfigurations"][1]["assigned_distance"] == whole["reconfigurations"][1]["assigned_distance"]
    assert report["lost"] == [{"vehicle": "iris_3", "time": event["time"], "reason": "is away"}]
    assert f"iris_3 was lost at {event['time']:.1f} s: is away" in report["shortcomings"]
    gone = [{**event, "vehicle": name} for name in record.names[1:]]
    report = reports.make_report(replace(record, events=[*record.events[:-1], *gone, record.events[-1]]))
    assert [item["pattern"] for item in report["reconfigurations"]] == ["cube"]


def test_a_cut_record_is_reported_as_far_as_it_goes(flight_bag: Path) -> None:
    whole = read_formation(flight_bag)
    assert (whole.cut, whole.unrecorded) == (None, [])

    def cut(end: float) -> FormationRecord:
        return replace(whole, truth=whole.truth.between(0.0, end), estimate=whole.estimate.between(0.0, end))

    report = reports.make_report(cut(25.0))
    assert report["reconfigurations"] == reports.make_report(whole)["reconfigurations"][:1]
    assert report["cut"] == pytest.approx(25.0, abs=0.04)
    assert report["unrecorded"] == list(PATTERNS[1:])
    assert report["shortcomings"] == [
        "the record is cut: positions end at 25.0 s, the flight at 53.0 s; patterns not judged: cube, pyramid, triangle"
    ]
    assert [picture.name for picture in figures(cut(25.0))] == ["formations", "distances"]
    assert [picture.name for picture in figures(cut(9.0))] == ["distances"]
    early = replace(whole, events=[{**event, "time": event["time"] + 90.0} for event in whole.events])
    with pytest.raises(RecordError, match=r"it is cut, the positions end at 5\d\.\d s, before the takeoff at 91\.0 s"):
        reports.make_report(early)


def test_a_collision_is_a_shortcoming(tmp_path: Path) -> None:
    words = "simulator: collision of iris_1 and iris_2"
    make_bag(tmp_path / "flight.bag", patterns=("cube",), log=("simulator: something else", words))
    report = reports.make_report(read_formation(tmp_path / "flight.bag"))
    assert report["collisions"] == [words]
    assert report["shortcomings"] == [words]


def crossing(simulator: str) -> FlightReport:
    """Return the report of five vehicles: 1 flies through 2, then close by 3; 4 stays away."""
    times = np.arange(0.0, 40.0, 0.1)
    places = np.zeros((len(times), 5, 3))
    places[:, :, 1] = [0.0, 2.0, 2.0, 2.3, 9.0]
    places[:, :, 0] = [0.0, 0.0, 10.0, 20.0, 4.0]
    places[:, 1, 0] = times
    offsets = np.array([[40.0, 2.0, 0.0], *(places[-1, 2:] - places[-1, 0])])
    events = [
        {"event": "phase", "time": 0.0, "phase": "takeoff"},
        {"event": "phase", "time": 1.0, "phase": "pattern row", "pattern": "row"},
        {"event": "assigned", "time": 1.0, "pattern": "row", "offsets": offsets.tolist()},
        {"event": "done", "time": 40.0},
    ]
    names = tuple(f"iris_{i}" for i in range(5))
    record = FormationRecord(names, FleetTrack("made up", times, places), None, [Change(1.0, offsets)], [], events)
    return report_of(record, {"simulator": simulator})


def test_pairs_that_came_too_close_are_counted_and_the_closest_is_reported() -> None:
    report = crossing("simplified").data
    found = report["too_close"]
    assert (found["pairs"], found["vehicles"]) == (2, 3)
    assert [pair["vehicles"] for pair in found["closest"]] == [["iris_1", "iris_2"], ["iris_1", "iris_3"]]
    assert [pair["distance"] for pair in found["closest"]] == pytest.approx([0.0, 0.3])
    assert [pair["time"] for pair in found["closest"]] == pytest.approx([10.0, 20.0])
    assert found["first_time"] == pytest.approx(9.6)
    assert found["last_time"] == pytest.approx(20.3, abs=0.11)
    words = (
        "minimum distance 0.00 m (iris_1 and iris_2, at 10.0 s), at least 0.5 m; 2 pairs of 3 vehicles came closer, "
    )
    assert words + "between 9.6 and 20.3 s" in report["shortcomings"]
    json.dumps(report, allow_nan=False)


def test_the_texts_on_contacts_are_the_simulators() -> None:
    said = {}
    for simulator in ("simplified", "full"):
        output = io.StringIO()
        print_page(crossing(simulator).page, Console(file=output, width=200))
        said[simulator] = output.getvalue()
    assert "Simplified vehicles do not collide: where two meet, they fly through each other." in said["simplified"]
    assert "collisions" not in said["simplified"]
    assert "Minimum distance 0.00 m, 0 collisions" in said["full"]


def test_a_good_flight_has_no_close_pairs(flight_bag: Path) -> None:
    found = reports.make_report(read_formation(flight_bag))["too_close"]
    assert found == {"pairs": 0, "vehicles": 0, "first_time": None, "last_time": None, "closest": []}


def test_a_recorder_whose_clock_is_off_changes_nothing(flight_bag: Path, tmp_path: Path) -> None:
    make_bag(tmp_path / "flight.bag", delay=0.9)
    good, bad = (
        reports.measure(r, r.track) for r in (read_formation(flight_bag), read_formation(tmp_path / "flight.bag"))
    )
    for expected, found in zip(good, bad, strict=True):
        assert found.settling_time == pytest.approx(expected.settling_time, abs=0.04)
        assert found.least_distance == pytest.approx(expected.least_distance, abs=0.02)
        assert found.steady_error_max < 0.1


def test_with_stamped_truth_the_recorders_clock_does_not_matter(tmp_path: Path) -> None:
    records = []
    for delay in (0.0, 0.9):
        make_bag(tmp_path / f"{delay}.bag", odometry=True, delay=delay)
        records.append(read_formation(tmp_path / f"{delay}.bag"))
    good, bad = records
    assert good.track is good.truth
    assert good.track.time.tolist() == bad.track.time.tolist()
    assert reports.measure(good, good.track) == reports.measure(bad, bad.track)


def test_lost_messages_shift_the_rest() -> None:
    sent = np.delete(np.arange(2000), slice(700, 720)) * 0.02
    late = sent + np.where((sent > 5.0) & (sent < 6.0), 0.5, 0.0)
    found = regular_times(late)
    away = np.abs(sent - 14.0) > 6.0  # near the gap the shift is not exact to the step
    np.testing.assert_allclose(found[away], sent[away], atol=1e-6)
    assert np.abs(found - sent).max() <= 20 * 0.02 + 1e-6


def test_settling_time_counts_the_last_entry() -> None:
    time = np.arange(6.0)
    error = np.array([[1.0], [0.1], [0.2], [0.1], [0.1], [0.1]])
    assert reports.settling_time(time, error) == 3.0
    assert reports.settling_time(time, error[::-1]) is None
    assert reports.settling_time(time, np.zeros((6, 1))) == 0.0


def test_overshoot_is_the_way_past_the_slot() -> None:
    x = np.array([0.0, 3.0, 5.0, 4.5])
    relative = np.stack([x, np.zeros(4), np.zeros(4)], axis=-1)[:, None]
    assert reports.overshoot(relative, np.array([[4.0, 0.0, 0.0]])) == pytest.approx((1.0, 25.0))
    assert reports.overshoot(relative, np.array([[6.0, 0.0, 0.0]])) == (0.0, 0.0)


def test_least_distance_is_over_all_pairs() -> None:
    positions = np.array([[[0, 0, 0], [3, 0, 0], [3, 0.4, 0.3]]], dtype=float)
    assert least_distances(positions) == pytest.approx([0.5])


def test_table_names_every_pattern(flight_bag: Path, tmp_path: Path) -> None:
    made = report_of(read_formation(flight_bag), {})
    report, output = made.data, io.StringIO()
    print_page(made.page, Console(file=output, width=120))
    assert all(name in output.getvalue() for name in PATTERNS)
    write_report(report, tmp_path / "report.json")
    assert json.loads((tmp_path / "report.json").read_text())["vehicles"] == report["vehicles"]


def test_names_with_blanks_and_slashes_become_file_names(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    name = "response_1_text:A B_to_cloud:/data/$5$.ply:spacing=3"
    figure = Figure()
    figure.suptitle(name)
    ((_, path),) = save_figures([NamedFigure(name, name, figure)], tmp_path)
    assert path.name == "response_1_text-A-B_to_cloud-data-5-.ply-spacing-3.png"
    assert path.is_file()


def test_pictures_are_drawn(flight_bag: Path, tmp_path: Path) -> None:
    paths = [path for _, path in save_figures(figures(read_formation(flight_bag)), tmp_path)]
    names = [p.name for p in paths]
    assert names[0] == "response_1_origin_to_cube.png"
    assert names[-2:] == ["formations.png", "distances.png"]
    for path in paths:
        pixels = image.imread(path)
        assert pixels.shape[0] > 600
        assert pixels[..., :3].std() > 0.02  # not blank
