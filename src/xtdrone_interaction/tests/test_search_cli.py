"""Checks of ``demo search``, and its files written before the flight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import Point
from shapely.ops import unary_union

from xtdrone_autopilot.plans import qgc_plan
from xtdrone_interaction import cli, command_options
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.missions.search import cli as search_cli
from xtdrone_interaction.missions.search.prepare import SearchSettings, is_search, prepare, read_prepared
from xtdrone_worlds.worlds.sdf import load_world_file

REGION = "region: [[15, -8], [45, -8], [45, 16], [15, 16]]\nholes: [[[25, 0], [30, 0], [30, 5], [25, 5]]]\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--n", "0"], "--n: '0' is not allowed, a whole number from 1 to 12"),
        (["--n", "two"], "--n: 'two' is not allowed"),
        (["--height", "3"], "--height: '3' is not allowed, 6 to 25 m"),
        (["--camera-rate", "nan"], "--camera-rate: 'nan' is not allowed, 0.5 to 10 Hz"),
        (["--persons", "-1"], "--persons: '-1' is not allowed"),
        (["--world", "nowhere"], "worlds: 'nowhere' is not known; there are city, countryside"),
        (["--height", "20"], "height: 20 m: with the gimbal at -60 deg a person of 1.7 m"),
        (["--n", "12"], "height: 12 vehicles that are at least 0.5 m above each other"),
        (["--region", __file__], "test_search_cli.py: "),
        (["--plans", str(Path(__file__).parent)], "typhoon_h480_0.plan' does not exist"),
        (["--plans", "nowhere"], "plans: 'nowhere' does not exist"),
        (["--region", "nowhere.yaml"], "region: 'nowhere.yaml' does not exist"),
        (["--world", "outdoor", "--persons", "3"], "persons: they are in the world's file"),
    ],
)
def test_invalid_values_are_reported(arguments: list[str], message: str, capfd: pytest.CaptureFixture[str]) -> None:
    try:
        status = cli.main(["demo", "search", *arguments])
    except SystemExit as ended:  # argparse
        status = ended.code
    assert status == 2
    assert message in capfd.readouterr().err


@pytest.fixture
def settings(tmp_path: Path) -> SearchSettings:
    region = tmp_path / "region.yaml"
    region.write_text(REGION, encoding="utf-8")
    out = tmp_path / "out"
    out.mkdir()
    return SearchSettings(
        n=3, type="typhoon_h480", region=str(region), plans="", world="", persons=2, walking=True, height=12.0,
        on_find="hold", follow_time=60.0, time_limit=900.0, camera_rate=2.0, film=True, seed=5, speed=0.0, out=out,
        master_port=11311, headless=True, logs=False,
    )  # fmt: skip


def test_people_walk_inside_the_region(settings: SearchSettings) -> None:
    prepared = prepare(settings)
    world = load_world_file(str(prepared.world_file))
    assert prepared.persons == ("actor_0", "actor_1")
    for actor in world.actors:
        way = actor.trajectory.waypoints if actor.trajectory else ()
        assert all(prepared.region.contains(Point(w.pose.position[:2])) for w in way)


def test_the_same_seed_makes_the_same_search(settings: SearchSettings, tmp_path: Path) -> None:
    again = replace(settings, out=tmp_path / "again")
    again.out.mkdir()
    one, other = prepare(settings), prepare(again)
    assert one.world_file.read_bytes() == other.world_file.read_bytes()
    assert all(np.array_equal(one.ways[name], other.ways[name]) for name in one.names)
    different = prepare(replace(again, seed=6))
    assert different.world_file.read_bytes() != one.world_file.read_bytes()


def test_each_vehicle_gets_a_piece_and_its_plan(settings: SearchSettings) -> None:
    prepared = prepare(settings)
    assert unary_union(prepared.pieces).area == pytest.approx(prepared.region.area)
    for name in prepared.names:
        plan = qgc_plan.read(prepared.plans_folder / f"{name}.plan")
        assert sum(item.command == 16 for item in plan.mission) == len(prepared.ways[name]) >= 2


def test_plans_of_ones_own_are_read(settings: SearchSettings, tmp_path: Path) -> None:
    made = prepare(settings)
    mine = tmp_path / "mine"
    made.plans_folder.rename(mine)
    own = prepare(replace(settings, plans=str(mine), out=tmp_path / "own"))
    assert own.pieces == ()
    for name in made.names:
        assert own.ways[name] == pytest.approx(made.ways[name], abs=0.05)
        assert (own.plans_folder / f"{name}.plan").read_bytes() == (mine / f"{name}.plan").read_bytes()
    (mine / "typhoon_h480_2.plan").unlink()
    with pytest.raises(OptionError, match=r"typhoon_h480_2\.plan' does not exist"):
        prepare(replace(settings, plans=str(mine)))


@pytest.mark.parametrize("count", [3, 11])  # of eleven, the tenth's name comes before the second's
def test_preparations_are_read_back(settings: SearchSettings, count: int) -> None:
    made = prepare(replace(settings, n=count))
    assert is_search(settings.out)
    back = read_prepared(settings.out)
    assert (back.names, back.persons) == (made.names, made.persons)
    assert back.region.equals(made.region)
    assert all(one.equals(other) for one, other in zip(back.pieces, made.pieces, strict=True))
    for name in made.names:
        assert back.ways[name] == pytest.approx(made.ways[name], abs=0.05)


def test_damaged_preparations_are_rejected(settings: SearchSettings) -> None:
    prepare(settings)
    for text in ("[1, 2]", "typhoon_h480_0: {region: 5}", "{"):
        (settings.out / "pieces.yaml").write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=r"pieces\.yaml: "):
            read_prepared(settings.out)
    (settings.out / "region.yaml").unlink()
    assert not is_search(settings.out)


def test_a_vehicle_without_the_camera_is_rejected(settings: SearchSettings) -> None:
    nowhere = settings.out / "new"
    with pytest.raises(OptionError, match="'iris' has no camera cgo3_camera"):
        prepare(replace(settings, type="iris", out=nowhere))
    assert not nowhere.exists()


def test_the_launch_file_gets_the_options(settings: SearchSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("xtdrone_interaction.launching.supervised_launch.shutil.which", lambda program: program)
    command = search_cli.flight(settings, prepare(settings)).command()
    assert "on_find:=hold" in command
    assert f"plans:={settings.out}/plans" in command
    assert command_options.repository() / "launch" / "search.launch" == Path(command[command.index("11311") + 1])
