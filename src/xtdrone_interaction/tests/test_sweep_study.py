"""Studies: their allowed contents, the resulting runs, and rejections."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from xtdrone_common.settings import SettingError
from xtdrone_coordination.patterns import PatternError
from xtdrone_interaction.command_options import repository
from xtdrone_interaction.studies.list_of_runs import Plan
from xtdrone_interaction.studies.study_file import Study, make_study, read_study
from xtdrone_interaction.studies.study_parameters import StudyError
from xtdrone_interaction.sweep.sweep_cli import main

FOLLOWER = """
from xtdrone_coordination.follower import Follower

class Slow(Follower):
    share = 0.5
    label = "slow"
    careful = True
    _hidden = 1

    def control_law(self, position, peers):
        return tuple(self.share * v for v in super().control_law(position, peers))

def figures(record):
    return {"turns": len(record.track.time)}
"""


def study(tmp_path: Path, **data: Any) -> Study:
    return make_study({"name": "s"} | data, tmp_path)


def test_all_mistakes_are_named_at_once(tmp_path: Path) -> None:
    with pytest.raises(StudyError) as raised:
        make_study({"engine": "simplfied", "seed": 2, "parameters": {"folower.Kp": [1.0]}, "name": "x"}, tmp_path)
    for words in ("'seed' is unknown", "engine: 'simplfied' is not allowed", "did you mean follower.Kp"):
        assert words in str(raised.value)


def test_shipped_studies_are_good() -> None:
    files = sorted((repository() / "src/xtdrone_interaction/config/studies").glob("*.yaml"))
    assert files
    for file in files:
        Plan(read_study(file)).check()


def test_grid_runs_every_combination_with_every_seed_first_seed_first(tmp_path: Path) -> None:
    plan = Plan(study(tmp_path, parameters={"n": [4, 6], "follower.Kp": [0.5, 1, 2]}, seeds=2))
    runs = list(plan)
    assert len(plan) == len(runs) == 12
    assert [r.seed for r in runs] == [0] * 6 + [1] * 6
    assert [tuple(r.varied.values()) for r in runs[:4]] == [(4, 0.5), (4, 1.0), (4, 2.0), (6, 0.5)]
    assert len({r.key for r in runs}) == 12
    assert plan[7].varied == {"n": 4, "follower.Kp": 1.0}
    with pytest.raises(IndexError):
        plan[12]


def test_zip_pairs_values(tmp_path: Path) -> None:
    parameters = {"n": [4, 6], "follower.Kp": {"from": 1, "to": 2, "steps": 2}}
    plan = Plan(study(tmp_path, parameters=parameters, combine="zip"))
    assert [tuple(r.varied.values()) for r in plan] == [(4, 1.0), (6, 2.0)]


def test_ranges_are_linear_or_logarithmic_with_plain_numbers(tmp_path: Path) -> None:
    linear = study(tmp_path, parameters={"follower.Kp": {"from": 0.1, "to": 0.5, "steps": 5}}).axes[0].values
    assert linear == (0.1, 0.2, 0.3, 0.4, 0.5)
    spec = {"from": 0.01, "to": 100, "steps": 5, "log": True}
    assert study(tmp_path, parameters={"follower.Kp": spec}).axes[0].values == (0.01, 0.1, 1.0, 10.0, 100.0)
    assert study(tmp_path, parameters={"n": {"from": 2, "to": 8, "steps": 4}}).axes[0].values == (2, 4, 6, 8)


@pytest.mark.parametrize("combine", ["random", "latin"])
def test_samples_are_in_range_and_repeatable(tmp_path: Path, combine: str) -> None:
    parameters = {
        "follower.Kp": {"from": 0.01, "to": 100.0, "log": True},
        "n": {"from": 3, "to": 5},
        "pattern": ["cube", "pyramid"],
    }
    made = study(tmp_path, parameters=parameters, combine=combine, samples=200, sample_seed=3)
    points = [run.varied for run in Plan(made)]
    assert len(points) == 200
    gains = [float(p["follower.Kp"]) for p in points]
    assert 0.01 <= min(gains) < 0.02
    assert 50.0 < max(gains) <= 100.0
    assert 70 < sum(gain < 1.0 for gain in gains) < 130
    assert {p["n"] for p in points} == {3, 4, 5}
    assert {p["patterns"] for p in points} == {"cube", "pyramid"}
    assert points == [run.varied for run in Plan(made)]


def test_latin_hypercube_has_one_sample_in_each_part(tmp_path: Path) -> None:
    parameters = {"follower.Kp": {"from": 1.0, "to": 2.0}}
    plan = Plan(study(tmp_path, parameters=parameters, combine="latin", samples=10))
    assert sorted(math.floor(10 * (float(run.varied["follower.Kp"]) - 1.0)) for run in plan) == list(range(10))


def test_keys_depend_only_on_the_flight(tmp_path: Path) -> None:
    def keys(**data: Any) -> set[str]:
        return {run.key for run in Plan(study(tmp_path, **data))}

    some = keys(parameters={"n": [4]}, constants={"follower.Kp": 1}, seeds=2)
    assert some < keys(parameters={"n": [6, 4]}, constants={"follower.Kp": 1.0}, seeds=3)
    assert not some & keys(parameters={"n": [4]}, constants={"follower.Kp": 2}, seeds=2)
    assert some == keys(name="other", parameters={"n": [4]}, constants={"follower.Kp": 1}, seeds=[1, 0])


def test_own_follower_and_its_attributes(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(FOLLOWER)
    made = study(
        tmp_path, follower="mine.py:Slow", metric="mine.py:figures", parameters={"class.share": [0.1, 1]},
        constants={"class.careful": False},
    )  # fmt: skip
    assert made.axes[0].values == (0.1, 1.0)
    before = Plan(made)[0].key
    (tmp_path / "mine.py").write_text(FOLLOWER.replace("super()", " super()"))
    changed = study(
        tmp_path, follower="mine.py:Slow", metric="mine.py:figures", parameters={"class.share": [0.1, 1]},
        constants={"class.careful": False},
    )  # fmt: skip
    assert Plan(changed)[0].key != before
    with pytest.raises(StudyError, match=r"class\._hidden.*unknown"):
        study(tmp_path, follower="mine.py:Slow", constants={"class._hidden": 2})


BAD: list[tuple[dict[str, Any], str]] = [
    ({"name": None}, "name: None is not allowed"),
    ({"name": "../x"}, r"name: '\.\./x' is not allowed"),
    ({"nmae": 1}, "'nmae' is unknown; there are: name"),
    ({"engine": "gazebo"}, "engine: 'gazebo' is not allowed, simplified or core"),
    ({"engine": "core", "flight": "airborne"}, "engine core, which begins on the ground"),
    ({"engine": "core", "constants": {"model.delay": 0.1}}, "model.delay.*no effect in engine core"),
    ({"flight": "mission", "constants": {"hold": 1}}, "'hold' has no effect in flight mission"),
    ({"parameters": {"Kp": [1]}}, "parameter 'Kp' is unknown; did you mean follower.Kp"),
    ({"parameters": {"follower.kp": [1]}}, "'follower.kp' is unknown; did you mean follower.Kp"),
    ({"parameters": {"zzz": [1]}}, "'zzz' is unknown; there are: n, patterns"),
    ({"parameters": ["n"]}, "parameters: .* a mapping"),
    ({"parameters": {"n": 4}}, "n: 4 is not allowed; a list"),
    ({"parameters": {"n": []}}, "n: the list of values is empty"),
    ({"parameters": {"n": [4, 4]}}, "n: 4 is given twice"),
    ({"parameters": {"n": [4, 5.5]}}, "n: 5.5 is not allowed, a whole number"),
    ({"parameters": {"n": [1]}}, "n: 1 is not allowed, a whole number from 2"),
    ({"parameters": {"n": [True]}}, "n: True is not allowed"),
    ({"parameters": {"follower.Kp": [math.nan]}}, "follower.Kp: nan is not allowed, above 0"),
    ({"parameters": {"follower.Kp": ["much"]}}, "follower.Kp: 'much' is not allowed"),
    ({"parameters": {"follower.mode": ["thrust"]}}, "follower.mode: 'thrust' is not allowed, vel or accel"),
    ({"parameters": {"follower.raw_weights": ["yes"]}}, "raw_weights: 'yes' is not allowed, true or false"),
    ({"parameters": {"n": {"from": 2, "to": 5, "steps": 3}}}, "n: 3.5 is not allowed, a whole number"),
    ({"parameters": {"n": {"from": 2, "to": 5}}}, "n: the range has no 'steps'"),
    ({"parameters": {"n": {"from": 2, "to": 2, "steps": 2}}}, "n: the range from 2 to 2"),
    ({"parameters": {"n": {"from": 2, "to": 5, "step": 1}}}, "n: 'step' is unknown in a range"),
    ({"parameters": {"scatter": {"from": 0, "to": 1, "steps": 3, "log": True}}}, "both must be above 0"),
    ({"parameters": {"follower.mode": {"from": 0, "to": 5, "steps": 3}}}, "a range is for numbers only"),
    ({"parameters": {"n": [4]}, "constants": {"n": 4}}, "'n' is both a constant and a varied"),
    ({"parameters": {"pattern": ["cube"], "patterns": ["cube"]}}, "parameters: 'patterns' is given twice"),
    ({"combine": "zip", "parameters": {"n": [4, 5], "follower.Kp": [1]}}, "zip needs .* n 2, follower.Kp 1"),
    ({"combine": "random"}, "random needs parameters"),
    ({"combine": "random", "parameters": {"n": [4]}}, "samples: None is not allowed"),
    ({"samples": 4}, "samples: needs combine: random or latin"),
    ({"seeds": 0}, "seeds: 0 is not allowed"),
    ({"seeds": []}, "seeds: the list is empty"),
    ({"seeds": [1, 1]}, "seeds: 1 is given twice"),
    ({"seeds": [-1]}, "seeds: -1 is not allowed"),
    ({"follower": "missing.py:A"}, r"follower: .*missing\.py: No such file"),
    ({"follower": "class"}, r"follower: 'class' is not allowed; FILE\.py:NAME"),
    (
        {"parameters": {"follower.Kp": {"from": 1, "to": 2, "steps": 2000}}, "seeds": 1000},
        r"2,000,000 runs \(2000 points x 1000 seeds\); 1,000,000 at most",
    ),
]


@pytest.mark.parametrize(("data", "message"), BAD)
def test_rejects_by_name(tmp_path: Path, data: dict[str, Any], message: str) -> None:
    with pytest.raises((StudyError, SettingError), match=message):
        study(tmp_path, **data)


def test_rejects_incompatible_options(tmp_path: Path) -> None:
    with pytest.raises(
        StudyError, match=r"follower\.clearance=3\.0.*clearance: 3\.0 is not allowed, below avoid_radius"
    ):
        Plan(study(tmp_path, parameters={"follower.clearance": [0.5, 3]})).check()
    with pytest.raises(PatternError, match="'sphinx' is unknown for 4 vehicles"):
        Plan(study(tmp_path, parameters={"n": [4]}, constants={"pattern": "sphinx"})).check()
    with pytest.raises(PatternError, match="altitude: 3 m is not allowed with pattern 'pyramid'"):
        Plan(study(tmp_path, constants={"altitude": 3})).check()
    with pytest.raises(StudyError, match=r"n=\d+ is given twice.*combine: random"):
        Plan(study(tmp_path, parameters={"n": [4, 5]}, combine="random", samples=3)).check()
    with pytest.raises(StudyError, match="vehicle"):
        Plan(study(tmp_path, constants={"kind": "balloon"})).check()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: [", "is not YAML"),
        ("name: a\nname: b", "'name' is given twice, again in line 2"),
        ("3", "3 is not a study"),
        ("# nothing yet\n", "study.yaml: it is empty"),
        ("? [1, 2]\n: 3", "is not YAML: line 1, column 3: found unhashable key"),
    ],
)
def test_rejects_files(tmp_path: Path, text: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(text)
    assert main([str(file)]) == 2
    assert message in capsys.readouterr().err


def test_rejects_an_incompatible_python(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(FOLLOWER)
    (tmp_path / "broken.py").write_text("import nothing_of_that_name")
    with pytest.raises(StudyError, match=r"broken\.py cannot be loaded: ModuleNotFoundError"):
        study(tmp_path, follower="broken.py:A")
    with pytest.raises(StudyError, match="has no 'Fast'"):
        study(tmp_path, follower="mine.py:Fast")
    with pytest.raises(StudyError, match=r"'Slow' .* is not a subclass of Leader"):
        study(tmp_path, leader="mine.py:Slow")
    with pytest.raises(StudyError, match=r"'__name__' .* is not a function"):
        study(tmp_path, metric="mine.py:__name__")


def test_dry_run_flies_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "study.yaml"
    file.write_text("name: some\nparameters: {n: [4, 6], follower.Kp: [1e-1, 1]}\nseeds: 5\n")
    assert main([str(file), "--dry-run", "--out", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert "4 points (grid) x 5 seeds = 20 runs" in text
    assert "n=4 follower.Kp=0.1 seed=0" in text
    assert "and 10 more" in text
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 20_000, "nested more than 100 deep"),
        ("- " * 20_000 + "1", "nested more than 100 deep"),
        ("seeds: " + "9" * 5000, "a number of 5000 characters is not allowed"),
        ("seeds: 1\nname: a\nseeds: 2\n", "'seeds' is given twice, again in line 3"),
        ("? [1, 2]\n: 3\n", "is not YAML"),
        ("<a>" * 20_000, "is not a study"),
    ],
)
def test_study_files_that_no_person_writes(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(text)
    with pytest.raises(StudyError, match=message) as caught:
        read_study(path)
    assert len(str(caught.value)) < 1000
