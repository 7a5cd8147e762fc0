"""Command lines of nodes."""

from __future__ import annotations

import pytest

from xtdrone_common.programs.node_command_line import (
    ArgumentError,
    check_multirotor,
    fleet_of,
    parse_count,
    parse_ids,
    served_vehicles,
)


@pytest.mark.parametrize(
    ("text", "ids"), [("0", [0]), ("0-3", [0, 1, 2, 3]), ("5,1-2,1", [1, 2, 5]), ("all", list(range(9)))]
)
def test_ids(text: str, ids: list[int]) -> None:
    assert parse_ids(text, 0, 8) == ids


@pytest.mark.parametrize("text", ["", "-1", "9", "0-9", "3-1", "x", "1,,2", "1.5"])
def test_invalid_ids_are_reported(text: str) -> None:
    with pytest.raises(ArgumentError, match="id: "):
        parse_ids(text, 0, 8)


def test_all_needs_a_fleet() -> None:
    with pytest.raises(ArgumentError, match="/xtdrone/fleet"):
        parse_ids("all", 0, None)


@pytest.mark.parametrize("text", ["0", "-3", "10000", "nine", "1e1", ""])
def test_bad_counts(text: str) -> None:
    with pytest.raises(ArgumentError, match="1 to 250"):
        parse_count(text)


def test_count() -> None:
    assert parse_count("9") == 9


def test_types() -> None:
    fleet = fleet_of("iris:3,solo:2")
    assert check_multirotor("solo", fleet) == 2
    assert check_multirotor("iris", None) is None
    with pytest.raises(ArgumentError, match="no multirotor"):
        check_multirotor("plane", None)
    with pytest.raises(ArgumentError, match="unknown vehicle 'irsi'"):
        check_multirotor("irsi", None)
    with pytest.raises(ArgumentError, match="iris, solo"):
        check_multirotor("typhoon_h480", fleet)
    with pytest.raises(ArgumentError, match="/xtdrone/fleet"):
        fleet_of("iris:zero")


def test_served_vehicles() -> None:
    assert served_vehicles(["solo", "1"], "iris:3,solo:2") == ("solo", [1], "solo_1")
    assert served_vehicles(["iris", "all"], "iris:3,solo:2") == ("iris", [0, 1, 2], "iris_0_2")
    assert served_vehicles(["iris", "7-8"], None) == ("iris", [7, 8], "iris_7_8")
    with pytest.raises(ArgumentError, match="2 arguments are needed, 1 were given"):
        served_vehicles(["iris"], None)
    with pytest.raises(ArgumentError, match="id: 3 is out of range"):
        served_vehicles(["iris", "3"], "iris:3")
