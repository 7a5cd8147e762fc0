"""Map merging in a bag: the last state of each vehicle, and the time from which its map is merged."""

from __future__ import annotations

from pathlib import Path

import pytest
from bags import Bag

from xtdrone_interaction.missions.exploration.record import read_merging
from xtdrone_interaction.recording.recorded_flight import RecordError

ARRAY, STATUS = "diagnostic_msgs/msg/DiagnosticArray", "diagnostic_msgs/msg/DiagnosticStatus"


def write_states(path: Path, states: list[tuple[float, str, int, str]]) -> Path:
    """Write a bag of diagnostics: time (s), vehicle, level and text of each."""
    with Bag(path) as bag:
        for time, name, level, text in states:
            status = bag.type(STATUS)(level, f"{name}: map merging", text, name, [])
            other = bag.type(STATUS)(2, f"{name}: octomap", "sensor silent", name, [])
            bag.write("/diagnostics", ARRAY, bag.type(ARRAY)(bag.header(time), [other, status]), time)
    return path


def test_the_last_state_counts_and_the_time_from_which_on_it_has_been_merged(tmp_path: Path) -> None:
    bag = write_states(tmp_path / "flight.bag", [
        (1.0, "iris_0", 0, "the merged map's frame"), (1.0, "iris_1", 1, "not merged: a"), (1.0, "iris_2", 0, "merged"),
        (2.0, "iris_1", 0, "merged"), (3.0, "iris_1", 1, "not merged: b"), (4.0, "iris_1", 0, "merged"),
        (5.0, "iris_1", 0, "merged, residual 0.05 m"), (5.0, "iris_2", 1, "not merged: c"),
    ])  # fmt: skip
    assert read_merging(bag, ["iris_0", "iris_1", "iris_2", "iris_3"]) == {
        "iris_0": {"merged": True, "state": "the merged map's frame", "since": 1.0},
        "iris_1": {"merged": True, "state": "merged, residual 0.05 m", "since": 4.0},
        "iris_2": {"merged": False, "state": "not merged: c", "since": None},
    }


def test_a_bag_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "no.bag").write_text("no bag")
    with pytest.raises(RecordError, match=r"no\.bag"):
        read_merging(tmp_path / "no.bag", ["iris_0"])
