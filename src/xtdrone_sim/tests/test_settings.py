"""The simulator node's parameters, the meaning of Gazebo's properties, and an orderly end."""

from __future__ import annotations

import math
from functools import partial

import pytest

from xtdrone_common.fleet import parse_fleet
from xtdrone_common.programs.node_command_line import LEAST_SPEED
from xtdrone_sim.autopilots.builtin_autopilot import BuiltinAutopilot
from xtdrone_sim.runtime import full_simulation
from xtdrone_sim.runtime.requests.control_services import target_speed
from xtdrone_sim.runtime.requests.pacing import Pacer
from xtdrone_sim.simulation import Simulation

STEP = 0.004  # s


@pytest.fixture
def settings(monkeypatch):
    """Return a function that reads the settings with some parameters set."""
    values: dict[str, object] = {}
    monkeypatch.setattr(full_simulation.rospy, "get_param", lambda name, default: values.get(name, default))
    monkeypatch.setattr(full_simulation.rospy, "resolve_name", lambda name: name.replace("~", "/simulator/"))

    def read(**parameters: object) -> full_simulation.FullSettings:
        values.clear()
        values.update({f"~{name}": value for name, value in parameters.items()})
        return full_simulation.read_settings()

    return read


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (3, 3),
        ("3", 3),
        (0, 0),
        ("/mavros", ("/mavros",)),
        ("/mavros, leader,/a/b", ("/mavros", "/leader", "/a/b")),
        (["/mavros", "leader"], ("/mavros", "/leader")),
    ],
)
def test_participants_are_a_number_or_names(settings, given, meant):
    assert settings(participants=given).participants == meant


@pytest.mark.parametrize(
    "value", [True, -1, 1.5, "", "/mavros,,/leader", "two words", [1], "/mavros,~leader", "/a b/c"]
)
def test_other_participants_are_rejected(settings, value):
    with pytest.raises(ValueError, match=r"/simulator/participants: .* is not allowed"):
        settings(participants=value)


@pytest.mark.parametrize(
    ("name", "value"), [("rows", True), ("seed", False), ("speed", True), ("until", True), ("shared_datum", 1)]
)
def test_booleans_and_numbers_are_distinguished(settings, name, value):
    with pytest.raises(ValueError, match=f"/simulator/{name}: {value} is not allowed"):
        settings(**{name: value})


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("fleet", "iris:0", ("0 of type 'iris'", "1 to 250")),
        ("fleet", "iris:10000", ("10000 of type 'iris'", "1 to 250")),
        ("speed", -1, ("speed: -1 is not allowed", "0 to")),
        ("paused", "perhaps", ("paused: 'perhaps' is not allowed, true or false",)),
        ("busy_limit", -2, ("busy_limit: -2 is not allowed", "0 to")),
    ],
)
def test_invalid_values_are_reported_with_the_allowed_ones(settings, name, value, words):
    with pytest.raises(ValueError, match="allowed") as refusal:
        settings(**{name: value})
    for word in words:
        assert word in str(refusal.value)


def test_a_hang_limit_leaves_room_for_a_sign_of_life(settings):
    assert settings(hang_limit=0).hang_limit == 0.0
    assert settings(hang_limit=2).hang_limit == 2.0
    with pytest.raises(ValueError, match=r"hang_limit: 1\.9 is not allowed, 0 \(never\), or 2 to 1000000 s"):
        settings(hang_limit=1.9)


def test_every_allowed_update_rate_is_an_allowed_speed():
    least = LEAST_SPEED / STEP
    for rate in (0.0, least, least * (1.0 - 5e-10), 250.0):
        Pacer(target_speed(rate, STEP))
    assert target_speed(500.0, STEP) == 2.0
    for rate in (least * 0.99, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="max_update_rate"):
            target_speed(rate, STEP)


def test_one_that_cannot_be_closed_does_not_keep_the_others_open():
    closed = []

    def full() -> None:
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"):
        full_simulation.close_all(lambda: closed.append("server"), full, lambda: closed.append("mavlink"))
    assert closed == ["server", "mavlink"]


def test_changed_parameters_are_kept_in_a_configured_folder(settings, tmp_path):
    assert settings().params == ""
    assert settings(params="/somewhere").params == "/somewhere"
    fleet = parse_fleet("iris:2")
    first = Simulation(fleet, autopilots=partial(BuiltinAutopilot, params=tmp_path))
    first.commanders[1].parameters.set("MPC_XY_CRUISE", 7.0)
    assert first.commanders[1].parameters.save()
    first.restart()
    assert first.commanders[1].parameters.get("MPC_XY_CRUISE") == 7.0
    first.close()
    assert [file.name for file in tmp_path.iterdir()] == ["iris_1.params"]
    second = Simulation(fleet, autopilots=partial(BuiltinAutopilot, params=tmp_path))
    assert [c.parameters.get("MPC_XY_CRUISE") for c in second.commanders] == [5.0, 7.0]
    assert second.autopilot.params["mpc_xy_cruise"].tolist() == [5.0, 7.0]
    second.close()
