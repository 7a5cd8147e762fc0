"""The soak's pure parts: the script, the fits and verdicts, and the judging of logs and bags. No ROS is needed."""

from __future__ import annotations

import argparse
import inspect
import json
import math
import os
import random
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from bags import Bag
from rich.console import Console

from validation.soak import soak_cli, soak_script
from validation.soak.actions import Actions, mission
from validation.soak.judging import report
from validation.soak.judging.file_checks import Finding, Judge, judge_bag, judge_log
from validation.soak.judging.verdict import Outcome, Stretch, growth, judge, pace
from validation.soak.judging.warnings_in_logs import TextLogs, kind_of
from validation.soak.resource_samples import COLUMNS, PROCESSES, SampleFile, figures, open_files
from xtdrone_control.autopilot.logger.message_definitions import message_format
from xtdrone_control.autopilot.logger.ulog_format import UlogWriter, data_template
from xtdrone_interaction import cli

HOURS = 8.0


# ---- the script


def test_the_same_seed_writes_the_same_script_and_another_seed_another_one():
    first, again, other = (list(soak_script.generate(seed, 9, 1.0)) for seed in (1, 1, 2))
    assert first == again
    assert first != other


@pytest.mark.parametrize("count", [2, 9, 30])
def test_a_script_fills_its_hours_in_order_and_within_its_episodes(count):
    episodes = list(soak_script.generate(3, count, HOURS))
    length = sum(episode.length for episode in episodes)
    assert HOURS * 3600 <= length < HOURS * 3600 + 900
    assert [episode.number for episode in episodes] == list(range(1, len(episodes) + 1))
    for episode in episodes:
        times = [event.time for event in episode.events]
        assert times == sorted(times)
        assert times[0] >= 0.0
        assert episode.events[-1].action == "end_all"
        assert times[-1] == pytest.approx(episode.length - soak_script.REST, abs=0.01)
    assert {episode.kind for episode in episodes[: len(soak_script.KINDS)]} == set(soak_script.KINDS)


def test_the_kinds_of_episodes_get_their_shares_of_the_time():
    spent = Counter()
    for episode in soak_script.generate(5, 9, 40.0):
        spent[episode.kind] += episode.length
    for kind, share in soak_script.SHARES.items():
        assert spent[kind] / spent.total() == pytest.approx(share, abs=0.03), kind


def test_chosen_kinds_of_episodes_share_the_time_among_them():
    chosen = ("formation_merged", "formation_shared")
    spent = Counter()
    for episode in soak_script.generate(5, 9, 20.0, chosen):
        spent[episode.kind] += episode.length
    whole = sum(soak_script.SHARES[kind] for kind in chosen)
    assert set(spent) == set(chosen)
    for kind in chosen:
        assert spent[kind] / spent.total() == pytest.approx(soak_script.SHARES[kind] / whole, abs=0.03)


def test_followers_of_a_merged_formation_carry_out_the_commands_of_all_vehicles_but_the_leaders():
    episode = next(e for e in soak_script.generate(5, 4, 1.0, ("formation_merged",)))
    started = [e.arguments for e in episode.events if e.action == "start" and e.time == 2.0]
    hosting = [a for a in started if "_communication:=true" in a["arguments"]]
    assert [a["arguments"][1] for a in hosting] == ["1", "2", "3"]
    communication = [a["arguments"] for a in started if a["program"][1] == "multirotor_communication.py"]
    assert communication == [["iris", "0"]]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--only", "missions"], "'missions' is not allowed, one of mission,"),
        (["--short", "--only", "mission"], "--short"),
    ],
)
def test_kinds_of_episodes_that_cannot_be_chosen_are_refused(arguments, text, capsys):
    parser = argparse.ArgumentParser()
    soak_cli.add_arguments(parser)
    assert soak_cli.run(parser.parse_args([*arguments, "--script"])) == 2
    assert text in capsys.readouterr().err


def test_each_node_has_a_name_of_its_own_and_is_ended_after_its_start():
    for episode in soak_script.generate(7, 9, HOURS):
        begun = [e.arguments["node"] for e in episode.events if e.action in ("start", "record", "echo", "client")]
        assert len(set(begun)) == len(begun)
        seen: set[str] = set()
        for event in episode.events:
            if event.action in ("end", "halt"):
                assert event.arguments["node"] in seen
            elif "node" in event.arguments:
                seen.add(event.arguments["node"])


def test_the_short_script_has_every_kind_of_event():
    actions = {name for name, _ in inspect.getmembers(Actions, inspect.isfunction) if not name.startswith("_")}
    for seed in range(5):
        events = [event for episode in soak_script.generate_short(seed, 3) for event in episode.events]
        assert {event.action for event in events} == actions - {"do", "settle"}
        assert {event.arguments["signal"] for event in events if event.action == "end"} == {"INT", "TERM", "KILL"}
        assert {event.arguments["what"] for event in events if event.action == "client"} == {"params", "logs", "status"}
        assert {event.arguments["what"] for event in events if event.action == "reset"} == {"simulation", "world"}


def test_missions_take_off_fly_their_waypoints_and_land():
    plan = mission({"places": [[10.0, 0.0], [0.0, 20.0]], "height": 7.0, "rounds": 3})
    assert [item.command for item in plan.mission] == [22, 16, 16, 177, 21]
    assert plan.mission[3].params[:2] == (1.0, 3.0)
    north = math.radians(plan.mission[2].x - plan.mission[1].x) * 6_371_000
    assert north == pytest.approx(20.0, rel=0.01)
    assert [item.command for item in mission({"places": [[1.0, 1.0]], "height": 7.0, "rounds": 0}).mission] == [
        22,
        16,
        21,
    ]


# ---- fits


def series(slope: float, noise: float, jumps: int = 0, samples: int = 100) -> tuple[list[float], list[float]]:
    """Return times, h, and values around 200 that grow by ``slope`` an hour; some samples are 50 higher."""
    rng = np.random.default_rng(4)
    hours = np.linspace(0.0, HOURS, samples)
    values = 200.0 + slope * hours + rng.normal(0.0, noise, samples)
    values[rng.choice(samples, jumps, replace=False)] += 50.0
    return hours.tolist(), values.tolist()


def test_a_leak_is_found_through_noise_and_outliers():
    found = growth(*series(3.0, 2.0, jumps=10), allowance=2.0, warm_up=0.5)
    assert found.verdict == "growing"
    assert found.slope == pytest.approx(3.0, abs=0.3)
    assert found.low < 3.0 < found.high


def test_a_flat_noisy_series_is_flat():
    found = growth(*series(0.0, 10.0, jumps=10), allowance=0.25, warm_up=0.5)
    assert found.verdict == "flat"
    assert found.low < 0.0 < found.high


def test_growth_within_allowance_or_noise_is_flat():
    assert growth(*series(1.0, 0.1), allowance=2.0, warm_up=0.5).verdict == "flat"
    hours, values = series(0.0, 100.0, samples=9)
    values[-1] += 400.0
    assert growth(hours, values, allowance=0.0, warm_up=0.0).verdict == "flat"


def test_growth_during_the_warm_up_is_flat():
    hours, values = series(0.0, 1.0)
    values = [value - 100.0 * max(0.0, 0.5 - hour) for hour, value in zip(hours, values, strict=True)]
    assert growth(hours, values, allowance=0.5, warm_up=0.5).verdict == "flat"


def test_one_descriptor_a_simulated_hour_is_found_in_whole_numbers():
    hours = np.linspace(0.0, HOURS, 100)
    assert growth(hours.tolist(), np.floor(40 + hours).tolist(), allowance=0.5, warm_up=0.5).verdict == "growing"
    steady = [40.0 + (number % 3) for number in range(100)]
    assert growth(hours.tolist(), steady, allowance=0.0, warm_up=0.5).verdict == "flat"


def test_few_samples_are_not_judged():
    assert growth([0.0, 1.0, 2.0], [1.0, 2.0, 3.0], allowance=0.0, warm_up=0.0).verdict == "not judged"


def stretches(last_wall: float = 10.0, last_cpu: float = 6.0, last_others: float = 0.1) -> list[Stretch]:
    """Return 40 episodes of 100 s; those of the last quarter have other times."""
    rng = random.Random(2)
    made = []
    for number in range(40):
        last = number >= 30
        wall, cpu = (last_wall, last_cpu) if last else (10.0, 6.0)
        factor = rng.uniform(0.95, 1.05)
        made.append(
            Stretch("mission", 100.0 * number, 100.0, wall * factor, cpu * factor, last_others if last else 0.1)
        )
    return made


@pytest.mark.parametrize(
    ("last", "verdict"),
    [
        ({}, "flat"),
        ({"last_wall": 15.0, "last_cpu": 9.0}, "slower"),
        ({"last_wall": 15.0}, "slower"),  # it waits for something while the machine is idle
        ({"last_wall": 15.0, "last_others": 1.5}, "not comparable"),
        ({"last_wall": 15.0, "last_cpu": 9.0, "last_others": 1.5}, "slower"),
        ({"last_wall": 5.0, "last_cpu": 3.0}, "flat"),
    ],
)
def test_pace(last, verdict):
    found = pace(stretches(**last), 4000.0)
    assert found.verdict == verdict
    assert found.first == pytest.approx(10.0, rel=0.05)


def test_pace_of_few_episodes_is_not_judged():
    assert pace(stretches()[:12], 4000.0).verdict == "not judged"


# ---- files


def flight_log(path: Path) -> bytes:
    """Write a log of 2 s."""
    layout = message_format("sensor_combined")
    rows = np.repeat(data_template(layout, 0)[None], 500)
    rows["record"]["timestamp"] = 4000 * np.arange(500)
    with path.open("wb") as sink:
        writer = UlogWriter(sink, 0)
        writer.add_format(layout)
        writer.subscribe(0, layout)
        writer.add_messages(rows.tobytes())
        writer.flush()
    return path.read_bytes()


def bag(path: Path) -> bytes:
    """Write a bag of 200 texts in chunks of 1 kB."""
    with Bag(path, threshold=1 << 10) as writer:
        for number in range(200):
            writer.text("/notes", f"note {number:04d}", 0.1 * number)
    return path.read_bytes()


def test_bags_are_whole_cut_or_damaged(tmp_path: Path):
    path = tmp_path / "flight.bag"
    data = bag(path)
    assert (judge_bag(path, False).verdict, judge_bag(path, False).messages) == ("whole", 200)
    path.write_bytes(data[: len(data) // 2])
    assert judge_bag(path, may_be_cut=False).verdict == "damaged"  # its recorder ended normally
    cut = judge_bag(path, may_be_cut=True)
    assert cut.verdict == "cut"
    assert 50 < cut.messages < 150
    middle = len(data) // 2
    path.write_bytes(data[:middle] + bytes(300) + data[middle + 300 :])
    assert judge_bag(path, may_be_cut=True).verdict == "damaged"
    path.write_bytes(b"")
    assert judge_bag(path, may_be_cut=True).verdict == "cut"
    assert judge_bag(path, may_be_cut=False).verdict == "damaged"


def test_flight_logs_are_whole_or_damaged(tmp_path: Path):
    path = tmp_path / "00_00_00.ulg"
    data = flight_log(path)
    assert (judge_log(path).verdict, judge_log(path).messages) == ("whole", 500)
    path.write_bytes(data[:-7])
    assert judge_log(path).verdict == "damaged"
    path.write_bytes(b"no log")
    assert judge_log(path).verdict == "damaged"


def test_the_judge_keeps_damaged_files_and_a_few_whole_ones(tmp_path: Path):
    paths = [tmp_path / "ulog" / "iris_0" / "2020-01-01" / f"00_00_{number:02d}.ulg" for number in range(6)]
    paths[0].parent.mkdir(parents=True)
    for path in paths:
        flight_log(path)
    paths[2].write_bytes(b"no log")
    judge = Judge(tmp_path / "kept", os.environ)
    for path in (*paths, paths[0]):  # one twice
        judge.give("ulog", path)
    assert judge.close(60.0) == 0
    assert judge.counts == {("ulog", "whole"): 5, ("ulog", "damaged"): 1}
    assert [Path(finding.path) for finding in judge.damaged] == [paths[2]]
    assert not any(path.exists() for path in paths)
    assert sorted(path.name.split("-")[0] for path in (tmp_path / "kept").iterdir()) == ["damaged", *["whole"] * 3]


# ---- logs as text


def test_warnings_are_counted_by_kind_and_tracebacks_found(tmp_path: Path):
    folder = tmp_path / "run"
    folder.mkdir()
    collected, own = folder / "rosout.log", folder / "simulator-2.log"
    collected.write_text(
        "1.0 Node Startup\n"
        "1.5 WARN /simulator [node.py:12(f)] [topics: /rosout, /clock] 3 datagrams were lost at 5.25 s\n"
        "2.5 WARN /simulator [node.py:12(f)] [topics: /rosout, /clock] 41 datagrams were lost at 7.5 s\n"
        "2.6 INFO /simulator [node.py:13(f)] [topics: /rosout] reset\n"
        "3.5 ERROR /mavros [a.py:1(g)] [topics: /rosout] Traceback (most recent call last):\n"
        "3.6 WARN /mavros [a.py:1(g)] [topics: /ro"
    )
    own.write_text("fine\n")
    (folder / "master.log").write_text("Traceback (most recent call last):\n")  # of an update sent to a killed node
    logs = TextLogs(tmp_path)
    logs.update()
    assert logs.warnings["WARN /simulator: # datagrams were lost at # s"] == 2
    assert (logs.warnings.total(), logs.lost, logs.tracebacks) == (3, 2, [])
    with collected.open("a") as file:
        file.write("sout] 5 messages have not come\n")
    with own.open("a") as file:
        file.write("Traceback (most recent call last):\n  File x\nValueError: no\n")
    logs.update()
    logs.update()
    assert (logs.warnings.total(), logs.lost) == (4, 3)
    assert len(logs.tracebacks) == 1
    assert logs.tracebacks[0].endswith("ValueError: no")


def test_kinds_of_warnings_ignore_varying_parts():
    assert kind_of("WARN", "/soak_12_follower_3", "iris_4: -0.5 m") == "WARN /soak_follower: iris_#: # m"


# ---- samples and report


def test_figures_of_a_process_and_its_open_files(tmp_path: Path):
    before = figures(os.getpid())
    with (tmp_path / "open").open("w"):
        assert figures(os.getpid())["descriptors"] == before["descriptors"] + 1
        assert str(tmp_path / "open") in open_files(os.getpid())
    assert figures(os.getpid())["descriptors"] == before["descriptors"]
    assert 0 < before["anonymous"] <= before["pss"] <= before["rss"]


def rows(leak: float = 0.0) -> list[dict[str, object]]:
    """Return samples of eight hours, four an hour between episodes, of processes of 100 MiB."""
    made = []
    for number in range(128):
        row: dict[str, object] = dict.fromkeys(COLUMNS, 1)
        row |= {"soak_time": 225.0 * number, "resting": number % 4 == 0}
        for process in PROCESSES:
            row[f"{process}_rss"] = row[f"{process}_anonymous"] = 100 << 20
        row["mavros_rss"] = (100 << 20) + int(leak * (1 << 20) * number / 16)
        made.append(row)
    return made


def outcome(**changes: object) -> Outcome:
    phases = {"mission": {"episodes": 40, "share": 1.0, "rtf": 10.0, "cpu": 0.06, "wall": 400.0}}
    counts = {
        "phases": phases, "files": {"ulog whole": 3}, "flights": 9, "expected": 9, "forced": 0, "lost": 0,
        "warnings": {"WARN x": 2}, "warnings_total": 2,
    }  # fmt: skip
    values: dict[str, object] = {
        "settings": {"n": 9, "seed": 1}, "end": "", "rows": rows(), "stretches": stretches(), "hours": 8.0,
        "wall": 3600.0, "counts": counts, "tracebacks": [], "wrong": [], "damaged": [], "unread": 0,
    }  # fmt: skip
    return Outcome(**{**values, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({}, ""),
        ({"rows": rows(leak=5.0)}, "mavros rss grows by 5.00 an hour, 2 are allowed"),
        ({"stretches": [Stretch("mission", 700.0 * i, 100.0, 10.0 + i, 6.0, 0.1) for i in range(40)]}, "became slower"),
        ({"tracebacks": ["a.log:\nTraceback (most recent call last):\nValueError: no"]}, "ValueError: no"),
        ({"wrong": ["soak_1_leader_2: ended by itself with status 1"]}, "ended by itself"),
        ({"damaged": ["a.bag: bytes 3 to 4 of 9 are damaged"]}, "are damaged"),
        ({"unread": 3}, "3 files were not read"),
        ({"counts": {**outcome().counts, "flights": 5}}, "only 5 of 9 vehicles"),
        ({"end": "stopped by SIGINT"}, "stopped by SIGINT"),
    ],
)
def test_the_verdict_names_each_failure(changes, word):
    soaked = outcome(**changes)
    verdict = judge(soaked)
    assert bool(verdict.failures) == bool(word)
    assert word in "\n".join(verdict.failures)


def test_the_report_is_written_with_its_figure(tmp_path: Path):
    soaked = outcome(hours=math.inf)
    report.write(soaked, judge(outcome()), tmp_path)
    written = json.loads((tmp_path / "report.json").read_text())
    assert written["good"] is True
    assert written["simulated_hours"] is None  # JSON has no infinity
    assert written["growth_per_hour"]["simulator rss"]["verdict"] == "flat"
    assert (tmp_path / "soak.png").stat().st_size > 10_000


def test_a_short_soak_is_not_judged_by_its_growth(capsys, tmp_path: Path):
    soaked = outcome(rows=rows(leak=50.0), judge_growth=False)
    verdict = judge(soaked)
    assert verdict.failures == []
    report.show(soaked, verdict, tmp_path, Console())
    assert "not judged" in capsys.readouterr().out


def test_samples_can_be_read_while_the_soak_runs(tmp_path: Path):
    samples = SampleFile(tmp_path / "samples.csv")
    samples.add({"wall": 1.5, "phase": "mission"})
    lines = (tmp_path / "samples.csv").read_text().splitlines()
    assert lines[0].split(",") == list(COLUMNS)
    assert lines[1].startswith("1.5,,,mission,")
    samples.close()


def test_findings_travel_as_json():
    finding = Finding("ulog", "/a", "whole", 1, 2, ["x"])
    assert Finding(**json.loads(json.dumps(finding.__dict__))) == finding


# ---- the command


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--hours", "0"], "--hours: '0' is not allowed, above 0 and at most 1000"),
        (["--hours", "nan"], "--hours: 'nan' is not allowed"),
        (["--n", "1"], "--n: '1' is not allowed"),
        (["--seed", "-1"], "--seed: '-1' is not allowed"),
        (["--speed", "fast"], "--speed: 'fast' is not allowed"),
        (["--hours", "1", "--short"], "not allowed with argument"),
    ],
)
def test_values_that_are_not_allowed(arguments, message, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["soak", *arguments])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_the_script_can_be_looked_at(capsys):
    assert cli.main(["soak", "--hours", "0.1", "--seed", "4", "--script"]) == 0
    said = capsys.readouterr().out
    assert "fly_mission" in said
    assert "reset what=" in said
