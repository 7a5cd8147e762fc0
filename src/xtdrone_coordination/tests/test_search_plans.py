"""Missions of a search: heights, positions and plan files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import Polygon

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.plans import qgc_plan
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_coordination.search.planning import plans as search_plans
from xtdrone_coordination.search.planning.coverage_path import sweep
from xtdrone_coordination.search.planning.plans import DatumSettings, SearchOptions, plan_search, write_plans

CAMERA = Pinhole.of_view(640, 360, 2.0)
REGION = Polygon([(0, 20), (180, 20), (180, 140), (0, 140)], [[(60, 60), (90, 60), (90, 90)]])
HOMES = {f"typhoon_h480_{i}": (3.0 * (i % 3), 3.0 * (i // 3 + 1)) for i in range(6)}


def test_six_vehicles_share_the_region_at_heights_of_their_own() -> None:
    options = SearchOptions()
    found = plan_search(REGION, HOMES, CAMERA, options)
    assert list(found) == list(HOMES)
    assert [vehicle.height for vehicle in found.values()] == [12.0, 13.0, 14.0, 15.0, 16.0, 17.0]
    assert sum(vehicle.piece.area for vehicle in found.values()) == pytest.approx(REGION.area)
    for vehicle in found.values():
        assert sweep(vehicle.path, vehicle.seen).intersection(vehicle.piece).area > 0.99 * vehicle.piece.area


def test_more_vehicles_fly_nearer_above_each_other() -> None:
    """Above 17.75 m people are less than 12 px high; the highest vehicle still needs a band for four pictures."""
    options = SearchOptions()
    for count in (7, 11):
        assert options.heights(CAMERA, count) == pytest.approx(np.linspace(12.0, 17.0, count))
    assert options.heights(CAMERA, 1).tolist() == [12.0]
    with pytest.raises(
        ValueError, match=r"12 vehicles .* at 12 m, are not allowed: from above 17 m a person is too small"
    ):
        options.heights(CAMERA, 12)
    with pytest.raises(ValueError, match="height: 20 m: with the gimbal"):
        SearchOptions(height=20.0).heights(CAMERA, 1)


def test_plan_files_contain_the_paths(tmp_path: Path) -> None:
    options, datum = SearchOptions(speed=4.0, gimbal_pitch=-50.0, person_pixels=10.0), DatumSettings(-33.9, 151.2, 30.0)
    found = plan_search(REGION, HOMES, CAMERA, options)
    files = write_plans(tmp_path / "plans", found, options, datum)
    for name, vehicle in found.items():
        mission = qgc_plan.read(files[name]).mission
        takeoff, mount, speed, *path, end = mission
        assert (takeoff.command, takeoff.z, takeoff.relative) == (plan.TAKEOFF, vehicle.height, True)
        assert (mount.command, mount.params[0], mount.z) == (plan.MOUNT_CONTROL, -50.0, 2.0)
        assert (speed.command, speed.params[1]) == (plan.CHANGE_SPEED, 4.0)
        assert end.command == plan.RETURN
        assert len(path) == len(vehicle.path)
        for item, waypoint in zip(path, vehicle.path, strict=True):
            assert (item.command, item.z, item.relative) == (plan.WAYPOINT, vehicle.height, True)
            assert datum.local(item.x, item.y) == pytest.approx((waypoint.x, waypoint.y), abs=1e-6)
            assert math.remainder(
                math.radians(90.0 - item.params[3]) - waypoint.heading, 2.0 * math.pi
            ) == pytest.approx(0.0, abs=1e-9)


def test_the_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    region = tmp_path / "region.yaml"
    region.write_text("region: [[0, 20], [120, 20], [120, 100], [0, 100]]\n", encoding="utf-8")
    arguments = [str(region), "--vehicles", "typhoon_h480:3", "--out", str(tmp_path / "out")]
    assert search_plans.main(arguments) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [f"typhoon_h480_{i}.plan" for i in range(3)]
    assert "3200 m^2 at 14 m" in capsys.readouterr().out
    assert search_plans.main([*arguments, "--height", "90"]) == 2
    assert "height: 90 m: with the gimbal at -60 deg" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        search_plans.main([*arguments, "--speed", "40"])
    assert ended.value.code == 2
    assert "--speed: '40' is not allowed, 0.5 to 15 m/s" in capsys.readouterr().err


def test_the_shipped_plans_match_the_shipped_region(tmp_path: Path) -> None:
    folder = Path(__file__).parents[1] / "config" / "search"
    assert search_plans.main([str(folder / "region.yaml"), "--out", str(tmp_path)]) == 0
    names = sorted(path.name for path in (folder / "plans").iterdir())
    assert names == sorted(path.name for path in tmp_path.iterdir())
    for name in names:
        kept, made = (qgc_plan.read(place / name).mission for place in (folder / "plans", tmp_path))
        assert [item.command for item in kept] == [item.command for item in made]
        assert [(item.x, item.y, item.z) for item in kept] == [
            pytest.approx((item.x, item.y, item.z), abs=1e-7) for item in made
        ]
