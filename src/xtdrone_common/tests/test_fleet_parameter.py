"""Waiting for vehicles in the parameter ``/xtdrone/fleet``."""

from __future__ import annotations

import pytest

pytest.importorskip("rospy")

import rospy

from xtdrone_common.programs import plain_node
from xtdrone_common.programs.node_command_line import ArgumentError

JOINED = '[{"name": "iris_0", "id": 0}, {"name": "iris_3", "id": 3}]'


@pytest.mark.parametrize(
    ("vehicle", "values", "polls"),
    [
        ("", ["iris:1"], 0),
        ("", ["", "", "iris:1"], 2),
        ("iris_3", ["", "iris:1", JOINED], 2),
        ("iris_0", ["iris:1"], 0),
    ],
)
def test_waits_until_the_vehicle_is_listed(
    vehicle: str, values: list[str], polls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = list(values)
    monkeypatch.setattr(rospy, "get_param", lambda name, default: left[0])
    monkeypatch.setattr(plain_node.time, "sleep", lambda seconds: left.pop(0))
    assert plain_node.wait_for_fleet(vehicle) == values[-1]
    assert len(values) - len(left) == polls


def test_a_malformed_fleet_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rospy, "get_param", lambda name, default: "Iris 3")
    with pytest.raises(ArgumentError, match="/xtdrone/fleet"):
        plain_node.wait_for_fleet("iris_1")
