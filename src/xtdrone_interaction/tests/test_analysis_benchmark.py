"""The benchmark's bag is one that the analysis reads."""

from __future__ import annotations

from pathlib import Path

from xtdrone_interaction.analysis.benchmark import chunks, measure
from xtdrone_interaction.analysis.flight import read_flight


def test_its_bag_holds_nine_vehicles_at_even_steps(tmp_path: Path) -> None:
    (tmp_path / "made.bag").write_bytes(b"".join(chunks(2_000_000)))
    flight = read_flight(tmp_path / "made.bag")
    assert len(flight.vehicles) == 9
    assert flight.notes == ["the recorder did not end it: there is no index; it was read by its records"]
    place = flight.vehicles[8].position
    assert place is not None
    assert (place.value == [1.0, 2.0, 3.0]).all()
    assert abs(place.time[1:] - place.time[:-1] - 0.02).max() < 1e-6
    assert len(place) * 27 == sum(topic.count for topic in flight.topics)


def test_it_measures(tmp_path: Path) -> None:
    row = measure(1, tmp_path)
    assert row["megabytes_per_second"] > 0
    assert row["messages"] >= 27 * 200
    assert not list(tmp_path.glob("*.bag"))
