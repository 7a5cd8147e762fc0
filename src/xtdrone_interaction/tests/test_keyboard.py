"""The keyboard without ROS and without a terminal: the meaning of keys, and the display."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_common.fleet import parse_fleet
from xtdrone_common.programs.node_command_line import ArgumentError
from xtdrone_control.communication.commands import HOVER_SPEED, HOVER_YAW_RATE, PX4_MODES
from xtdrone_coordination.patterns import Patterns
from xtdrone_interaction.keyboard.arguments import parse_arguments
from xtdrone_interaction.keyboard.key_bindings import Command, Message, Pilot, Setpoint, Target, digits
from xtdrone_interaction.keyboard.screen import ScreenContent, VehicleStatus, frame, help_lines, layout, sentence
from xtdrone_interaction.keyboard.terminal import PAGE_DOWN, PAGE_UP, QUIT, KeyDecoder

STEERING = {"w": 0, "x": 0, "a": 1, "d": 1, "i": 2, ",": 2, "j": 3, "l": 3}
KEYS = [*STEERING, *"tyvnrbskg0123456789"]
LIMITS = (20.0, 20.0, 20.0, 3.0)


# ---- meaning of keys


@settings(deadline=None, derandomize=True)
@given(st.lists(st.sampled_from(KEYS), max_size=300))
def test_each_press_counts_by_a_hundredth_and_nothing_else_moves(keys: list[str]) -> None:
    pilot = Pilot(digits(Patterns(9).names))
    for key in keys:
        before = pilot.speeds
        pilot.press(key)
        steps = [now - then for now, then in zip(pilot.speeds, before, strict=True)]
        if key in STEERING:
            axis = STEERING[key]
            assert steps[axis] == pytest.approx(0.01 if key in "waij" else -0.01, abs=1e-12)
            assert not any(step for other, step in enumerate(steps) if other != axis)
        elif key in "sk":
            assert pilot.speeds == (0.0, 0.0, 0.0, 0.0)
        elif key != "g":
            assert pilot.speeds == before


@settings(deadline=None, derandomize=True)
@given(st.sampled_from(sorted(STEERING)), st.integers(0, 2500))
def test_speeds_are_within_xtdrones_limits(key: str, presses: int) -> None:
    pilot = Pilot()
    for _ in range(presses):
        pilot.press(key)
    axis = STEERING[key]
    assert abs(pilot.speeds[axis]) == min(presses / 100, LIMITS[axis])
    pilot.press({"w": "x", "x": "w", "a": "d", "d": "a", "i": ",", ",": "i", "j": "l", "l": "j"}[key])
    assert abs(pilot.speeds[axis]) == pytest.approx(abs(min(presses / 100, LIMITS[axis]) - 0.01))


@settings(deadline=None, derandomize=True)
@given(st.lists(st.sampled_from([*KEYS, "cycle"]), max_size=200))
def test_a_vehicle_with_a_commanded_speed_is_stopped_before_it_is_deselected(keys: list[str]) -> None:
    """It is stopped at the end, too; a vehicle at rest receives one message."""
    pilot = Pilot(digits(Patterns(6).names))
    told = dict.fromkeys(Target, Setpoint(Target.ALL))
    for key in [*keys, "end"]:
        before = dict(told)
        if key in ("cycle", "end"):
            messages: list[Message | None] = [pilot.cycle() if key == "cycle" else pilot.stop()]
        else:
            messages = list(pilot.press(key))
        for message in messages:
            if isinstance(message, Setpoint):
                told[message.target] = message
        for target in Target:
            if target is not pilot.target or key == "end":
                assert at_rest(told[target])
        if key == "cycle" and not any(pilot.speeds) and at_rest(before[pilot.target]):
            assert messages == [None]


def at_rest(message: Setpoint) -> bool:
    return not any((message.forward, message.left, message.up, message.turn))


def test_a_single_press_is_more_than_the_dead_zone() -> None:
    for key, axis in STEERING.items():
        pilot = Pilot()
        pilot.press(key)
        assert abs(pilot.speeds[axis]) > (HOVER_YAW_RATE if axis == 3 else HOVER_SPEED)


def test_commands_are_xtdrones() -> None:
    pilot = Pilot()
    pilot.press("i")
    said = {key: pilot.press(key) for key in "tyvnrb"}
    commands = ("ARM", "DISARM", "AUTO.TAKEOFF", "AUTO.LAND", "AUTO.RTL", "OFFBOARD")
    assert said == {key: [Command(Target.ALL, text)] for key, text in zip("tyvnrb", commands, strict=True)}
    assert set(commands[2:]) <= set(PX4_MODES)
    for key in "sk":
        pilot.press("w")
        assert pilot.press(key) == [Command(Target.ALL, "HOVER"), Setpoint(Target.ALL)], "the zero comes last"
        assert pilot.cycle() is None


def test_the_documented_takeoff() -> None:
    pilot = Pilot()
    for _ in range(35):
        assert pilot.press("i") == []
    assert pilot.cycle() == Setpoint(Target.ALL, up=0.35)
    assert pilot.press("b") == [Command(Target.ALL, "OFFBOARD")]
    assert pilot.press("t") == [Command(Target.ALL, "ARM")]
    assert pilot.cycle() == Setpoint(Target.ALL, up=0.35), "the stream goes on"


def test_offboard_at_rest_holds_the_place_of_that_moment() -> None:
    assert Pilot().press("b") == [Command(Target.ALL, "HOVER"), Command(Target.ALL, "OFFBOARD")]


def test_the_leader_alone_is_steered_after_g() -> None:
    pilot = Pilot(digits(Patterns(9).names))
    pilot.press("w")
    pilot.cycle()
    assert pilot.press("g") == [Setpoint(Target.ALL)]
    pilot.press("w")
    assert pilot.cycle() == Setpoint(Target.LEADER, forward=0.01)
    assert pilot.press("n") == [Command(Target.LEADER, "AUTO.LAND")]
    assert pilot.press("g") == [Setpoint(Target.LEADER)]
    assert pilot.press("t") == [Command(Target.ALL, "ARM")]


@pytest.mark.parametrize("count", [*range(1, 21), 100, 250])
def test_digits_are_existing_patterns(count: int) -> None:
    patterns = Patterns(count) if count > 1 else None
    pilot = Pilot(digits(patterns.names) if patterns else {})
    for digit in "0123456789":
        assert pilot.press(digit) == [], "a pattern's name is no command of a vehicle"
        assert "press g" in pilot.note
    pilot.press("g")
    for digit in "0123456789":
        match pilot.press(digit):
            case [Command(Target.LEADER, name)]:
                assert name == "waiting" if digit == "0" else patterns is not None and name in patterns
            case nothing:
                assert nothing == []
                assert "no such pattern" in pilot.note


@pytest.mark.parametrize(
    ("count", "names"),
    [(6, ["T", "diamond", "triangle"]), (9, ["cube", "pyramid", "triangle"]), (18, ["cuboid", "sphere", "diamond"])],
)
def test_the_first_digits_are_xtdrones(count: int, names: list[str]) -> None:
    chosen = list(digits(Patterns(count).names).values())
    assert chosen[:3] == names
    assert chosen[-1] == "origin"
    assert len(set(chosen)) == len(chosen) <= 9


def test_other_keys_have_no_effect_and_are_shown() -> None:
    pilot = Pilot()
    for key in "W!qz?":
        assert pilot.press(key) == []
        assert repr(key) in pilot.note
    assert pilot.cycle() is None


# ---- bytes


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"wwi,", ["w", "w", "i", ","]),
        (b"\x1b[A\x1b[1;5Dw", ["w"]),
        (b"\x1b[15~\x1bOAs", ["s"]),
        (b"\x1bt", []),
        (b"\x1b\x1b[5~", [PAGE_UP]),
        (b"\x1b[6~t", [PAGE_DOWN, "t"]),
        ("äß€w".encode(), ["w"]),
        (b"\x1b[\x03", [QUIT]),
        (b"\x00\t\r\n \x7f", []),
        (b"\x1b[" + b"1" * 50 + b"~", ["1"] * 19 + ["~"]),
    ],
)
def test_keys_of_bytes_in_one_piece_and_in_many(data: bytes, keys: list[str]) -> None:
    assert KeyDecoder().feed(data) == keys
    decoder = KeyDecoder()
    assert [key for byte in data for key in decoder.feed(bytes([byte]))] == keys


def test_escape_alone_does_not_consume_later_keys() -> None:
    decoder = KeyDecoder()
    assert decoder.feed(b"\x1b") == []
    decoder.drop_partial()
    assert decoder.feed(b"s") == ["s"]


@settings(deadline=None, derandomize=True)
@given(st.binary(max_size=200))
def test_any_bytes_are_keys_or_nothing(data: bytes) -> None:
    pilot = Pilot()
    for key in KeyDecoder().feed(data):
        pilot.press(key)


# ---- the command line


@pytest.mark.parametrize(
    ("arguments", "names", "mode"),
    [
        (["iris", "9", "vel"], 9, "vel"),
        (["iris", "9", "accel"], 9, "accel"),
        (["iris", "1"], 1, "vel"),
        (["iris", "250"], 250, "vel"),
        (["typhoon_h480", "accel"], 1, "accel"),
        (["iris:3,typhoon_h480:2", "accel"], 5, "accel"),
        (["iris:3,typhoon_h480:2"], 5, "vel"),
    ],
)
def test_command_lines(arguments: list[str], names: int, mode: str) -> None:
    request = parse_arguments(arguments, None)
    assert len(set(request.names)) == names
    assert request.mode == mode


def test_the_formation_is_the_first_types() -> None:
    request = parse_arguments(["iris:3,typhoon_h480:2", "vel"], parse_fleet("iris:3,typhoon_h480:2"))
    assert request.counts == {"iris": 3, "typhoon_h480": 2}
    assert request.formation == 3
    assert request.names[-1] == "typhoon_h480_1"


@pytest.mark.parametrize(
    ("arguments", "fleet", "word"),
    [
        ([], None, "1 to 3 arguments"),
        (["iris", "9", "vel", "x"], None, "1 to 3 arguments"),
        (["iris", "9", "pose"], None, "'pose' is not allowed"),
        (["iris:9", "pose"], None, "'pose' is not allowed"),
        (["iris", "0", "vel"], None, "1 to 250"),
        (["iris", "251"], None, "1 to 250"),
        (["iris", "nine"], None, "'nine'"),
        (["iris:200,solo:51", "vel"], None, "1 to 250"),
        (["iris:3", "3", "vel"], None, "iris:3:3"),
        (["plane", "3", "vel"], None, "no multirotor"),
        (["iris", "4", "vel"], "iris:3", "has 3 of type iris"),
        (["solo", "1", "vel"], "iris:3", "not in the fleet"),
    ],
)
def test_invalid_command_lines_are_reported(arguments: list[str], fleet: str | None, word: str) -> None:
    with pytest.raises(ArgumentError, match=word):
        parse_arguments(arguments, parse_fleet(fleet) if fleet else None)


# ---- the screen


def seen(count: int, kind: str = "iris") -> list[VehicleStatus]:
    return [VehicleStatus(f"{kind}_{i}", True, "AUTO.TAKEOFF", 12.345, 0.318, 0.1) for i in range(count)]


def view(page: list[VehicleStatus], count: int, note: str = "") -> ScreenContent:
    patterns = digits(Patterns(9).names)
    speeds = (0.01, -20.0, 0.35, -3.0)
    return ScreenContent("iris 9", "vel", Target.ALL, True, speeds, note, page, 0, count, patterns)


@pytest.mark.parametrize("help_wanted", [None, True, False])
@pytest.mark.parametrize("count", [1, 9, 250])
@pytest.mark.parametrize("rows", [2, 8, 12, 24, 60])
@pytest.mark.parametrize("columns", [10, 40, 58, 80, 200])
def test_any_screen_is_kept_within(columns: int, rows: int, count: int, help_wanted: bool | None) -> None:
    shown = layout(columns, rows, count, digits(Patterns(9).names), help_wanted)
    assert 1 <= shown.rows <= count
    lines = frame(view(seen(shown.rows), count), columns, rows, shown)
    assert len(lines) <= rows
    assert max(map(len, lines)) < columns


@pytest.mark.parametrize(("columns", "rows"), [(40, 16), (80, 24), (200, 60)])
def test_armed_mode_height_and_speed_of_each_vehicle_are_seen(columns: int, rows: int) -> None:
    names = [f"typhoon_h480_{i}" for i in range(9)]
    shown = layout(columns, rows, 9, {}, None)
    assert shown.rows >= 9
    lines = frame(view(seen(9, "typhoon_h480"), 9), columns, rows, shown)
    for name in names:
        (line,) = [line for line in lines if name in line]
        for word in ("TAKEOFF", "12.3", "0.32", "armed" if columns > 75 else " A "):
            assert word in line
    speeds = " ".join(lines)
    for word in ("forward +0.01", "left -20.00", "up +0.35", "turn -3.00"):
        assert word in speeds


def test_more_vehicles_than_rows_are_paged() -> None:
    shown = layout(80, 24, 100, {}, False)
    foot = frame(view(seen(shown.rows), 100), 80, 24, shown)[-1]
    assert foot == f"1-{shown.rows} of 100, p next, h keys, Ctrl-C ends"
    narrow = replace(view(seen(4), 100), first=96)
    assert frame(narrow, 40, 10, layout(40, 10, 100, {}, False))[-1] == "97-100 of 100, p next, Ctrl-C ends"


def test_problems_of_a_vehicle_are_shown() -> None:
    shown = layout(80, 24, 3, {}, None)
    page = [
        VehicleStatus("iris_0"),
        VehicleStatus("iris_1", silence=12.4),
        VehicleStatus("iris_2", True, "POSCTL", 1.0, 0.0, 0.0, False),
    ]
    text = "\n".join(frame(view(page, 3), 80, 24, shown))
    for word in ("no messages", "silent for 12 s", "takes no commands"):
        assert word in text
    assert "iris_0 no messages" in "\n".join(frame(view(page, 3), 40, 24, shown)), "where the rows have no room"
    assert sentence(page[2]) == "iris_2: armed, POSCTL, height 1.00 m, speed 0.00 m/s, takes no commands"


@pytest.mark.parametrize("columns", [30, 40, 80, 160])
def test_help_names_every_key(columns: int) -> None:
    lines = help_lines(columns, digits(Patterns(9).names))
    assert max(map(len, lines)) < columns
    assert not any(line.rstrip(",").endswith(tuple("0123456789")) for line in lines), "a digit stays with its pattern"
    text = " ".join(lines)
    for key in (
        "w/x",
        "a/d",
        "i/,",
        "j/l",
        "s or k",
        "t/y",
        "v ",
        "n ",
        "b ",
        "r ",
        "g ",
        "p ",
        "h ",
        "0 waiting",
        "1 cube",
    ):
        assert key in text
