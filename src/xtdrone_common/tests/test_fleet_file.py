"""Fleets with models and start poses: files, lists of poses, and the text of /xtdrone/fleet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from xtdrone_common.fleet import (
    FleetError,
    StartPose,
    Vehicle,
    fleet_text,
    parse_fleet,
    read_fleet_file,
    start_poses,
    with_poses,
)

FILE = """\
# two of upstream's vehicles
- name: iris_0
  model: iris_stereo_camera
  pose: {x: 0.0, y: 7.5, z: 1.0, yaw: 1.57}
- {type: iris, pose: [3, -2]}
- {type: typhoon_h480}
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "fleet.yaml"
    path.write_text(text)
    return path


def test_a_fleet_file_gives_names_models_and_poses(tmp_path: Path) -> None:
    fleet = read_fleet_file(written(tmp_path, FILE), instance=2)
    assert fleet == (
        Vehicle("iris", 0, 0, 2, "iris_stereo_camera", StartPose(0.0, 7.5, 1.0, yaw=1.57)),
        Vehicle("iris", 1, 1, 2, "iris", StartPose(3.0, -2.0)),
        Vehicle("typhoon_h480", 0, 2, 2),
    )
    assert [vehicle.name for vehicle in fleet] == ["iris_0", "iris_1", "typhoon_h480_0"]
    assert [vehicle.system_id for vehicle in fleet] == [1, 2, 3]


def test_the_text_of_a_fleet_is_read_as_the_same_fleet(tmp_path: Path) -> None:
    for fleet in (
        parse_fleet("iris:3,typhoon_h480:2"),
        read_fleet_file(written(tmp_path, FILE)),
        parse_fleet("iris:3")[::2],  # one has left the fleet
        parse_fleet("- {name: iris_4, id: 7}\n- {name: solo_0, id: 2}"),
    ):
        assert parse_fleet(fleet_text(fleet)) == fleet
    assert fleet_text(parse_fleet("iris:3,typhoon_h480:2")) == "iris:3,typhoon_h480:2"


def test_poses_are_given_to_vehicles_in_order() -> None:
    fleet = with_poses(parse_fleet("iris:2"), "[[1, 2], [3, 4, 0.5, 0, 0, 3.14]]")
    assert [vehicle.pose for vehicle in fleet] == [StartPose(1.0, 2.0), StartPose(3.0, 4.0, 0.5, yaw=3.14)]
    assert with_poses(parse_fleet("iris:2"), "") == parse_fleet("iris:2")


def test_a_vehicle_without_a_pose_stands_on_the_grid() -> None:
    first, second, third = parse_fleet("iris:3")
    fleet = (first, replace(second, pose=StartPose(50.0, 0.0, yaw=1.0)), third)
    assert start_poses(fleet, 3) == [StartPose(0.0, 3.0), StartPose(50.0, 0.0, yaw=1.0), StartPose(6.0, 3.0)]


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ("[[0, 0]]", "poses: 1 are given for 2 vehicles"),
        ("{x: 1}", "a list with a pose for each vehicle"),
        ("[[0, 0], [0", "a list in YAML: line 1"),
        ("[[0, 0], [0]]", "poses: iris_1: pose: a list of 1 is not allowed, a list or mapping of x, y"),
        ("[[0, 0], [0, .nan]]", r"poses: iris_1: pose: y: nan is not allowed, -100000 to 100000 m"),
        ("[[0, 0], [0, 0, 0, 0, 0, 90]]", r"iris_1: pose: yaw: 90 is not allowed, -6.28319 to 6.28319 rad"),
        ("[[.inf, 0], [0, 0]]", "poses: iris_0: pose: x: inf is not allowed"),
        ("[[true, 0], [0, 0]]", "poses: iris_0: pose: x: True is not allowed"),
        ("['0 0', [0, 0]]", "poses: iris_0: pose: '0 0' is not allowed"),
        (f"[[1{'0' * 400}, 0], [0, 0]]", "a number of 401 characters is not allowed, 400 at most"),
    ],
)
def test_an_invalid_list_of_poses_is_reported(poses: str, message: str) -> None:
    with pytest.raises(FleetError, match=message):
        with_poses(parse_fleet("iris:2"), poses)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("iris: 3", "a list of vehicles is needed, not dict"),
        ("[]", "0 vehicles are not allowed, 1 to 250"),
        ("[" + "{type: iris}," * 251 + "]", "251 vehicles are not allowed, 1 to 250"),
        ("- iris", "entry 1: 'iris' is not allowed, a mapping with name, type, model, pose, id"),
        ("- {pose: [0, 0]}", "entry 1: name and type are missing"),
        ("- {type: iris}\n- {name: iris_0}", "entry 2: name: 'iris_0' is given twice"),
        ("- {name: my drone}", "entry 1: name: 'my drone' is not allowed, a type of small letters"),
        ("- {name: leader}", "entry 1: name: 'leader' is not allowed"),
        ("- {name: iris_0123}", "entry 1: name: 'iris_0123' is not allowed"),
        ("- {name: 7}", "entry 1: name: 7 is not allowed"),
        ("- {name: iris_0, type: solo}", "entry 1: type: 'solo' is not allowed, iris_0 is of type 'iris'"),
        ("- {type: /iris}", "entry 1: type: '/iris' is not allowed"),
        ("- {type: iris, positon: [0, 0]}", "entry 1: 'positon' is not known; there are name, type, model, pose, id"),
        ("- {type: iris, pose: {x: 1, z: 2}}", "entry 1: pose: y is missing"),
        ("- {type: iris, pose: {x: 1, y: 2, w: 3}}", "entry 1: pose: 'w' is not known; there are x, y, z, roll"),
        ("- {type: iris, pose: {x: 1, y: .nan}}", "entry 1: pose: y: nan is not allowed"),
        ("- {type: iris, pose: null}", "entry 1: pose: None is not allowed"),
        ("- {type: iris, model: 3}", "entry 1: model: 3 is not allowed"),
        ("- {type: iris, id: 250}", "entry 1: id: 250 is not allowed, a whole number from 0 to 249"),
        ("- {type: iris, id: 4}\n- {type: iris, id: 4}", "entry 2: id: 4 is not allowed, iris_0 has it"),
        ("- {type: iris", "not valid YAML: line 1"),
        ("[" * 200, "nested more than 100 deep"),
    ],
)
def test_an_invalid_fleet_file_is_reported(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(FleetError, match=message) as raised:
        read_fleet_file(path)
    assert str(path) in str(raised.value)


def test_an_enormous_or_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match=r"it has 14\.3 MB, at most 0\.25 MB are allowed"):
        read_fleet_file(written(tmp_path, "- {type: iris}\n" * 1_000_000))
    with pytest.raises(FleetError, match="vehicles: 2000 vehicles are not allowed"):
        parse_fleet("[" + "{type: iris}," * 2_000 + "]")
    with pytest.raises(FleetError, match=r"none\.yaml: No such file"):
        read_fleet_file(tmp_path / "none.yaml")
