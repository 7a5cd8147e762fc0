from __future__ import annotations

import math
from argparse import ArgumentParser
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest

from xtdrone_common.settings import SettingError, Settings, check_choice, check_range, setting


def _even(value: int) -> None:
    if value % 2:
        raise ValueError("a multiple of 2 px")


@dataclass(frozen=True)
class Example(Settings):
    """Settings of every kind."""

    on_find: str = setting("hold", choices=("hold", "return", "continue"), text="what the others do")
    mode: Literal["vel", "accel"] = setting("vel", choices=("vel", "accel"), text="output")
    pitch: float = setting(-60.0, low=-90.0, high=-5.0, unit="deg", text="camera pitch")
    Kp: float = setting(1.0, above=0.0, unit="1/s", text="gain")
    share: float = setting(0.0, low=0.0, below=1.0, text="lost part, 5 % or more")
    reach: float = setting(math.inf, above=0.0, high=math.inf, unit="m", text="range")
    shift: float = setting(0.0, unit="m", text="shift")
    hits: int = setting(4, low=1, high=100, text="pictures")
    rows: int = setting(3, low=1, text="rows")
    width: int = setting(0, unit="px", check=_even, text="width")
    view: bool = setting(False, text="open a window")
    lockstep: bool = setting(True, text="serve the lockstep")
    log_dir: str = setting("", metavar="DIR", text="folder of the logs")
    rate: float = setting(50.0, low=0.1, high=250.0, unit="Hz", ros="model_states_rate", option="--hz", text="rate")
    limit: float | None = setting(None, low=0.0, unit="s", text="time limit")
    free: object = None


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("on_find", "stay", "hold, return or continue"),
        ("mode", "pos", "vel or accel"),
        ("pitch", 0.0, "-90 to -5 deg"),
        ("pitch", "-60", "-90 to -5 deg"),
        ("pitch", math.nan, "-90 to -5 deg"),
        ("Kp", 0.0, "above 0 1/s"),
        ("Kp", math.inf, "above 0 1/s"),
        ("Kp", True, "above 0 1/s"),
        ("share", 1.0, "at least 0 and below 1"),
        ("reach", math.nan, "above 0 m"),
        ("shift", math.inf, "a finite number in m"),
        ("hits", 0, "a whole number from 1 to 100"),
        ("hits", 2.0, "a whole number from 1 to 100"),
        ("hits", True, "a whole number from 1 to 100"),
        ("rows", 0, "a whole number, at least 1"),
        ("width", 3, "a multiple of 2 px"),
        ("view", 1, "true or false"),
        ("log_dir", 1, "text"),
        ("limit", -1.0, "at least 0 s"),
    ],
)
def test_an_error_names_the_setting_its_value_and_what_is_allowed(name: str, value: object, allowed: str) -> None:
    with pytest.raises(SettingError) as caught:
        Example(**{name: value})
    assert str(caught.value) == f"{name}: {value!r} is not allowed, {allowed}"


@pytest.mark.parametrize(
    ("name", "value"),
    [("pitch", -5.0), ("pitch", -90), ("Kp", 1e-9), ("reach", math.inf), ("reach", 1), ("width", 2), ("limit", None)],
)
def test_allowed_values(name: str, value: object) -> None:
    assert getattr(Example(**{name: value}), name) == value


def test_numbers_have_the_declared_type() -> None:
    example = Example(pitch=-60, Kp=np.float32(0.5), hits=np.int64(7))
    assert [type(value) for value in (example.pitch, example.Kp, example.hits)] == [float, float, int]


def test_undeclared_fields_are_not_checked() -> None:
    assert Example(free=[1]).free == [1]


@dataclass(frozen=True)
class Further(Example):
    """Adds a restriction on a combination of values."""

    clearance: float = setting(0.5, low=0.0, unit="m", text="clearance")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clearance >= self.reach:
            raise SettingError("clearance", self.clearance, f"below reach, {self.reach:g} m")


def test_a_subclass_inherits_settings_and_adds_checks() -> None:
    with pytest.raises(SettingError, match=r"clearance: 3\.0 is not allowed, below reach, 2 m"):
        Further(clearance=3.0, reach=2.0)
    with pytest.raises(SettingError, match="hits: 0 is not allowed"):
        Further(hits=0)


def _getter(values: dict[str, object]):
    return lambda name, default: values.get(name, default)


def test_parameters() -> None:
    given = {"~pitch": -30, "~model_states_rate": 10.0, "~log_dir": 7, "~mode": "accel", "~rate": 1.0}
    example = Example.from_parameters(_getter(given), free=3)
    assert example == Example(pitch=-30.0, rate=10.0, log_dir="7", mode="accel", free=3)
    assert Example.from_parameters(_getter({"/a/hits": 9}), prefix="/a/").hits == 9
    assert Example.from_parameters(_getter({"~hits": 9, "~rows": 9}), names=("rows",)) == Example(rows=9)


def test_an_error_names_the_parameter() -> None:
    with pytest.raises(SettingError, match=r"^~model_states_rate: 'fast' is not allowed, 0.1 to 250 Hz$"):
        Example.from_parameters(_getter({"~model_states_rate": "fast"}))


def test_an_error_names_the_parameter_as_ros_resolves_it(monkeypatch: pytest.MonkeyPatch) -> None:
    rospy = pytest.importorskip("rospy")
    monkeypatch.setattr(rospy, "get_param", _getter({"~hits": 0}))
    monkeypatch.setattr(rospy, "resolve_name", lambda name: name.replace("~", "/node/"))
    with pytest.raises(SettingError, match=r"^/node/hits: 0 is not allowed"):
        Example.from_parameters(rospy.get_param)


def _parsed(*words: str) -> Example:
    parser = ArgumentParser(exit_on_error=False)
    Example.add_arguments(parser)
    return Example.from_arguments(parser.parse_args(words))


def test_options() -> None:
    assert _parsed() == Example()
    words = ("--pitch=-45", "--hz", "5", "--hits", "3", "--view", "--no-lockstep", "--on-find", "return")
    assert _parsed(*words) == Example(pitch=-45.0, rate=5.0, hits=3, view=True, lockstep=False, on_find="return")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--hits", "x"), "argument --hits: 'x' is not allowed, a whole number from 1 to 100"),
        (("--hits", "0"), "argument --hits: '0' is not allowed, a whole number from 1 to 100"),
        (("--width", "3"), "argument --width: '3' is not allowed, a multiple of 2 px"),
        (("--on-find", "x"), "argument --on-find: 'x' is not allowed, hold, return or continue"),
    ],
)
def test_an_option_that_is_not_allowed(
    words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = ArgumentParser()
    Example.add_arguments(parser)
    with pytest.raises(SystemExit) as ended:
        parser.parse_args(words)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_some_options_only() -> None:
    parser = ArgumentParser()
    assert list(Example.add_arguments(parser, ("hits", "view"))) == ["hits", "view"]
    assert Example.from_arguments(parser.parse_args(["--hits", "2"]), rows=5) == Example(hits=2, rows=5)


def test_help_states_range_unit_and_default() -> None:
    parser = ArgumentParser()
    Example.add_arguments(parser)
    text = " ".join(parser.format_help().split())
    assert "--pitch PITCH camera pitch, -90 to -5 deg (default: -60)" in text
    assert "--shift SHIFT shift, m (default: 0)" in text
    assert "--log-dir DIR folder of the logs" in text
    assert "lost part, 5 % or more" in text


@dataclass(frozen=True)
class Wind(Settings):
    """Settings that are positional on the command line."""

    east: float = setting(..., low=-50.0, high=50.0, unit="m/s", text="towards the east", positional=True)
    up: float = setting(0.0, low=-5.0, high=5.0, unit="m/s", text="upwards", metavar="RISE", positional=True)


def test_positional_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    parser = ArgumentParser()
    Wind.add_arguments(parser)
    assert Wind.from_arguments(parser.parse_args(["-3", "1.5"])) == Wind(-3.0, 1.5)
    assert Wind.from_arguments(parser.parse_args(["2"])) == Wind(2.0)
    assert "towards the east, -50 to 50 m/s\n" in parser.format_help()
    assert "upwards, -5 to 5 m/s (default: 0)\n" in parser.format_help()
    for given, said in (
        (["60"], "argument EAST: '60' is not allowed, -50 to 50 m/s"),
        (["1", "up"], "argument RISE: 'up' is not allowed, -5 to 5 m/s"),
        ([], "the following arguments are required: EAST"),
    ):
        with pytest.raises(SystemExit):
            parser.parse_args(given)
        assert said in capsys.readouterr().err
    with pytest.raises(SettingError, match="east: None is not allowed, -50 to 50 m/s"):
        Wind()


def test_table() -> None:
    rows = Example.table().splitlines()
    assert rows[0] == "| name | default | range | unit | meaning |"
    assert "| `on_find` | hold | hold, return or continue |  | what the others do |" in rows
    assert "| `pitch` | -60 | -90 to -5 | deg | camera pitch |" in rows
    assert "| `model_states_rate` | 50 | 0.1 to 250 | Hz | rate |" in rows
    assert "| `view` | false | true or false |  | open a window |" in rows
    assert len(rows) == 2 + 15


def _speed(given: object) -> float:
    if given == "unlimited":
        return 0.0
    try:
        return float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise ValueError("a number") from None


@dataclass(frozen=True)
class Special(Settings):
    """Settings parsed from text, and tuples."""

    offset: tuple[float, float, float] = setting((0.0, 0.0, 1.0), low=-10.0, high=10.0, unit="m", text="offset")
    names: tuple[str, ...] = setting(("a", "b"), text="names")
    speed: float = setting(0.0, parse=_speed, allowed="a factor or unlimited", text="speed")


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("offset", [1.0], "3 numbers, -10 to 10 m"),
        ("offset", [1.0, 2.0, 11.0], "3 numbers, -10 to 10 m"),
        ("offset", 1.0, "3 numbers, -10 to 10 m"),
        ("names", [1], "a list of texts"),
        ("names", "a", "a list of texts"),
        ("speed", "fast", "a factor or unlimited"),
        ("speed", math.nan, "a factor or unlimited"),
    ],
)
def test_special_values_that_are_not_allowed(name: str, value: object, allowed: str) -> None:
    with pytest.raises(SettingError) as caught:
        Special.from_parameters(_getter({f"~{name}": value}))
    assert str(caught.value) == f"~{name}: {value!r} is not allowed, {allowed}"


def test_special_values() -> None:
    given = {"~offset": [1, 2, 3], "~names": ["c"], "~speed": "unlimited"}
    assert Special.from_parameters(_getter(given)) == Special((1.0, 2.0, 3.0), ("c",), 0.0)
    assert "| `offset` | [0, 0, 1] | -10 to 10 | m | offset |" in Special.table()
    assert "| `speed` | 0 | a factor or unlimited |  | speed |" in Special.table()


def test_a_mapping() -> None:
    assert Special.from_mapping({"speed": "2", "names": ["x"]}, "special") == Special(names=("x",), speed=2.0)
    with pytest.raises(SettingError, match=r"^special: \{'sped': 1\} is not allowed, a mapping with offset, names, sp"):
        Special.from_mapping({"sped": 1}, "special")
    with pytest.raises(SettingError, match=r"^special: 3 is not allowed, a mapping with"):
        Special.from_mapping(3, "special")
    with pytest.raises(SettingError, match=r"^special speed: 'x' is not allowed, a factor or unlimited"):
        Special.from_mapping({"speed": "x"}, "special")


@pytest.mark.parametrize("value", [0.0, 1, 2.0])
def test_values_within_limits_are_returned_as_numbers(value: float) -> None:
    assert check_range("speed", value, 0.0, 2.0) == float(value)


@pytest.mark.parametrize("value", [-0.1, 2.1, math.nan, math.inf, True, "1", None])
def test_invalid_values_are_reported_with_the_allowed_ones(value: object) -> None:
    with pytest.raises(ValueError, match=r"^speed: .* is not allowed, 0 to 2 m/s$"):
        check_range("speed", value, 0.0, 2.0, "m/s")
    with pytest.raises(ValueError, match=r"^seed: -1 is not allowed, at least 0$"):
        check_range("seed", -1, 0)


def test_a_choice_lists_the_available_values() -> None:
    assert check_choice("law", "vel", ("vel", "accel")) == "vel"
    with pytest.raises(ValueError, match=r"^law: 'pos' is not allowed, vel or accel$"):
        check_choice("law", "pos", ("vel", "accel"))
