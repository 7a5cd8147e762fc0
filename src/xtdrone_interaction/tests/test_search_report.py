"""Report and map of a search, from a record with known figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from shapely.geometry import box

from xtdrone_interaction.missions.search.camera_views import Views
from xtdrone_interaction.missions.search.metrics import make_report
from xtdrone_interaction.missions.search.record import CUT_SHORT, SearchRecord, Sight, read_search
from xtdrone_interaction.missions.search.report import summarise
from xtdrone_interaction.pictures.picture_style import NamedFigure, save_figures
from xtdrone_interaction.recording.recorded_flight import RecordError

FINISHED: dict[str, Any] = {
    "event": "finished", "time": 100.0, "outcome": "found", "vehicle": "typhoon_h480_0", "position": [10.0, 0.0],
    "found_time": 30.0, "covered_area": 900.0, "region_area": 1000.0, "covered_fraction": 0.9, "possible": [],
    "lost": [],
}  # fmt: skip


def confirmed(x: float, y: float, time: float = 30.0, vehicle: str = "typhoon_h480_0") -> dict[str, Any]:
    """Return a find at (x, y) m."""
    return {"event": "confirmed", "time": time + 0.5, "vehicle": vehicle, "position": [x, y], "found_time": time}


def record(*events: dict[str, Any], sights: list[Sight] | None = None, **changes: Any) -> SearchRecord:
    """Return a record: the first vehicle flies 100 m east at 1 m/s; a person walks north from (10, -30) at 1 m/s."""
    time = np.linspace(0.0, 100.0, 1001)
    position = np.zeros((1001, 2, 3))
    position[:, 0, 0] = time
    position[:, :, 2] = 12.0
    person = np.column_stack([np.full(1001, 10.0), time - 30.0, np.zeros(1001)])
    return SearchRecord(
        names=("typhoon_h480_0", "typhoon_h480_1"),
        time=time,
        position=position,
        persons={"person_0": person},
        sights={"typhoon_h480_0": sights or [], "typhoon_h480_1": []},
        events=[*events, {**FINISHED, **changes}],
        collisions=[],
    )


def test_a_find_is_compared_with_where_the_person_was_then() -> None:
    report = make_report(record(confirmed(13.0, 4.0)), {})
    assert report["find"]["person"] == "person_0"
    assert report["find"]["error"] == pytest.approx(5.0)  # (13, 4) from (10, 0)
    assert report["shortcomings"] == ["the find of typhoon_h480_0 is not a person: the nearest person was 5.0 m away"]


def test_a_good_find_has_no_shortcoming() -> None:
    report = make_report(record(confirmed(10.3, 0.4)), {})
    assert report["find"]["error"] == pytest.approx(0.5)
    assert report["shortcomings"] == []


def test_a_continued_search_must_find_all_people() -> None:
    search = record(confirmed(10.0, 0.2), confirmed(10.0, 40.0, time=70.0, vehicle="typhoon_h480_1"))
    search.persons["person_1"] = np.tile([50.0, 50.0, 0.0], (1001, 1))
    report = make_report(search, {"on_find": "continue"})
    assert [(find["person"], find["again"]) for find in report["finds"]] == [("person_0", False), ("person_0", True)]
    assert report["shortcomings"] == ["not found: person_1"]
    assert make_report(search, {"on_find": "hold"})["shortcomings"] == []
    said = summarise(report)
    assert "Found by typhoon_h480_0 at 30.0 s, at (10.0, 0.2) m, 0.20 m from person_0." in said
    assert "Found again by typhoon_h480_1 at 70.0 s" in said


def test_the_way_of_each_vehicle_is_measured() -> None:
    vehicles = make_report(record(), {})["vehicles"]
    assert vehicles["typhoon_h480_0"]["distance"] == pytest.approx(100.0)
    assert vehicles["typhoon_h480_1"]["distance"] == pytest.approx(0.0)


def test_following_counts_the_pictures_that_show_the_person() -> None:
    follow = {"event": "following", "time": 40.0, "vehicle": "typhoon_h480_0"}
    ended = {"event": "follow_ended", "time": 60.0, "vehicle": "typhoon_h480_0", "reason": "time"}
    sights = [Sight(t, 0, (1,), (1,) if t < 55.0 else ()) for t in np.arange(30.0, 80.0, 0.5)]
    report = make_report(record(confirmed(10.0, 0.0), follow, ended, sights=sights), {})
    (following,) = report["following"]
    assert following["duration"] == pytest.approx(20.0)
    assert following["in_view"] == pytest.approx(30 / 41)
    assert report["shortcomings"] == ["typhoon_h480_0 had the person in view in 73 % of its images"]


def test_a_search_without_a_find_is_a_shortcoming_only_if_people_are_present() -> None:
    one_person = record(outcome="not found")
    assert make_report(one_person, {})["shortcomings"] == ["no person was found, but the region has 1 person"]
    empty = SearchRecord(**{**vars(one_person), "persons": {}})
    assert make_report(empty, {})["shortcomings"] == []


def test_losses_and_collisions_are_reported() -> None:
    silent = {"event": "camera_silent", "time": 20.0, "vehicle": "typhoon_h480_0", "position": [20.0, 0.0]}
    bad = record(confirmed(10.0, 0.0), silent, lost=["typhoon_h480_1"])
    bad.collisions.append("collision of typhoon_h480_1 and house_3")
    assert make_report(bad, {})["shortcomings"] == [
        "lost: typhoon_h480_1",
        "failed cameras: typhoon_h480_0",
        "1 collisions",
    ]


def test_an_aborted_search_is_reported_with_the_known_results() -> None:
    follow = {"event": "following", "time": 90.0, "vehicle": "typhoon_h480_0"}
    changes = {"outcome": CUT_SHORT, "vehicle": None, "covered_area": None, "covered_fraction": 0.25}
    report = make_report(record(confirmed(10.3, 0.4), follow, **changes), {"on_find": "continue"})
    assert report["shortcomings"] == ["the search was cut short"]
    assert report["find"]["error"] == pytest.approx(0.5)
    assert report["following"][0]["duration"] == pytest.approx(10.0)  # to the end of the record
    assert "Cut short." in summarise(report)
    assert "Covered 25.0 %, in 100 s." in summarise(report)


def test_a_missing_bag_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="does not exist"):
        read_search(tmp_path / "flight.bag", ("a",), ())


def test_the_map_shows_find_and_ways(tmp_path: Path) -> None:
    from xtdrone_interaction.missions.search.figures import draw_map

    found = {"event": "confirmed", "time": 30.0, "vehicle": "typhoon_h480_0", "position": [10.0, 0.0]}
    region = box(-10.0, -40.0, 120.0, 40.0).difference(box(50.0, -5.0, 60.0, 5.0))
    ways = {"typhoon_h480_0": np.array([[0.0, 0.0], [100.0, 0.0]])}
    figure = draw_map(record(found), region, [region], ways)
    ((_, path),) = save_figures([NamedFigure("map", "Map", figure)], tmp_path)
    picture = cv2.imread(str(path))
    assert picture.shape[1] > 1000
    red = (picture[..., 2] > 200) & (picture[..., 1] < 60) & (picture[..., 0] < 60)
    assert red.sum() > 50  # the star


def test_views_have_a_tile_a_vehicle_with_its_newest_picture() -> None:
    views = Views([f"typhoon_h480_{i}" for i in range(6)])
    assert views.size[0] % 2 == views.size[1] % 2 == 0
    for shade in (50, 250):
        views.set_image("typhoon_h480_4", 12.0, np.full((360, 640, 3), shade, np.uint8))
    picture = views.draw("12 s")
    assert picture.shape == (views.size[1], views.size[0], 4)
    width, height = views.size[0] // 3, (views.size[1] - 22) // 2
    middle_of_tile = picture[height + 22 + 135, width + width // 2, :3]
    assert tuple(middle_of_tile) == (250, 250, 250)
    assert tuple(picture[22 + 135, width // 2, :3]) == (32, 32, 32)  # no cell seen yet
