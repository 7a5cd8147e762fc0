"""Fleets spawned by launch files in XTDrone's form."""

from __future__ import annotations

from typing import Any

import pytest

from xtdrone_common.fleet import FleetError, StartPose, spawned_fleet, unused_ports


def group(number: int, **changes: Any) -> dict[str, Any]:
    """Return the arguments of vehicle ``number`` as text, as roslaunch sets them."""
    own = {"vehicle": "iris", "sdf": "iris", "ID": number, "ID_in_group": number}
    own |= {"x": 3 * number, "y": 3, "z": 0, "R": 0, "P": 0, "Y": 0}
    own |= {"mavlink_udp_port": 18570 + number, "mavlink_tcp_port": 4560 + number}
    return {key: str(value) for key, value in (own | changes).items()}


def test_names_models_ids_and_poses() -> None:
    groups = {
        "key_c": group(2, vehicle="typhoon_h480", ID_in_group=0, sdf="/somewhere/typhoon_h480/typhoon_h480.sdf"),
        "key_a": group(0, sdf="iris_stereo_camera", Y="1.57", z="0.5"),
        "key_b": group(1, sdf=""),
    }
    fleet = spawned_fleet(groups, 1)
    assert [vehicle.name for vehicle in fleet] == ["iris_0", "iris_1", "typhoon_h480_0"]
    assert [vehicle.model for vehicle in fleet] == ["iris_stereo_camera", "iris", "typhoon_h480"]
    assert [vehicle.system_id for vehicle in fleet] == [1, 2, 3]
    assert fleet[0].pose == StartPose(0.0, 3.0, 0.5, 0.0, 0.0, 1.57)
    assert {vehicle.instance for vehicle in fleet} == {1}


def test_ids_may_have_gaps() -> None:
    assert [vehicle.id for vehicle in spawned_fleet({"a": group(7), "b": group(2)})] == [2, 7]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": "east"}, "vehicle iris_1: x: 'east' is not allowed, a number"),
        ({"Y": "nan"}, "vehicle iris_1: pose: yaw: nan is not allowed"),
        ({"ID": "-1"}, "vehicle iris_1: ID: '-1' is not allowed, a whole number from 0 to 249"),
        ({"ID": "250"}, "vehicle iris_1: ID: '250' is not allowed"),
        ({"ID_in_group": "one"}, "vehicle iris_one: name: 'iris_one' is not allowed"),
        ({"vehicle": "Iris 3"}, "is not allowed, a type of small letters"),
        ({"mavlink_udp_port": "70000"}, "vehicle iris_1: mavlink_udp_port: '70000' is not allowed"),
        ({"ID": "0"}, "ID: iris_0 and iris_1 both have 0; each needs its own"),
        ({"ID_in_group": "0"}, "vehicle iris_0: two groups spawn it, with ID 0 and 1"),
        ({"mavlink_tcp_port": "4560"}, "mavlink_tcp_port: iris_0 and iris_1 both have 4560; each needs its own"),
    ],
)
def test_what_is_not_allowed_is_one_clear_line(changes: dict[str, str], message: str) -> None:
    with pytest.raises(FleetError) as raised:
        spawned_fleet({"a": group(0), "b": group(1, **changes)})
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_launch_without_vehicles() -> None:
    with pytest.raises(FleetError, match="0 are spawned"):
        spawned_fleet({})


def test_ground_stations_ports_follow_the_id() -> None:
    groups = {"a": group(0, mavlink_udp_port="14560"), "b": group(1)}
    sentences = unused_ports(groups, spawned_fleet(groups))
    assert sentences == [
        "iris_0: mavlink_udp_port 14560 is not used; ground stations reach it on UDP port 18570, which follows its ID 0"
    ]
