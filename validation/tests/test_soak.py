"""The soak's pure parts: the script, the fits and verdicts, and the judging of logs and bags. No ROS is needed."""

from __future__ import annotations

import argparse
import inspect
import math
import os
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import Bag

from validation.soak import limits, soak_cli, soak_script
from validation.soak.actions import Actions, mission, read_files
from xtdrone_autopilot.logger.message_definitions import message_format
from xtdrone_autopilot.logger.ulog_format import UlogWriter, data_template
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
        begun = [e.arguments["node"] for e in episode.events if e.action in ("start", "record", "client")]
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


# ---- limits


def rows(leak: float = 0.0, slower: float = 0.0) -> list[dict[str, Any]]:
    """Return samples of eight hours, four an hour, that grow by ``leak`` MiB an hour and slow down by a fraction."""
    rng = np.random.default_rng(4)
    made: list[dict[str, Any]] = []
    for number in range(32):
        row: dict[str, Any] = {"soak_time": 900.0 * number, "kind": "mission", "participants": 1}
        for process in limits.PROCESSES:
            row |= {f"{process}_{name}": 40.0 for name in limits.FIGURES}
        row["mavros_rss"] = 100.0 + leak * number / 4 + rng.normal(0.0, 0.5) + (30.0 if number % 11 == 5 else 0.0)
        row["cpu_per_second"] = 0.1 * (1.0 + (slower if number >= 24 else 0.0))
        made.append(row)
    return made


def test_a_leak_is_found_through_noise_and_outliers():
    found = limits.growths(rows(leak=5.0))["mavros_rss"]
    assert found.slope == pytest.approx(5.0, abs=0.5)
    assert found.low < 5.0 < found.high
    flat = limits.growths(rows())["mavros_rss"]
    assert flat.low < 0.0 < flat.high


def test_growth_during_the_warm_up_does_not_count():
    hours = [0.25 * number for number in range(32)]
    values = [200.0 - 100.0 * max(0.0, 0.5 - hour) for hour in hours]
    assert limits.growth(hours, values).slope == pytest.approx(0.0, abs=1e-9)


def test_few_samples_are_not_judged():
    assert math.isnan(limits.growth([0.0, 1.0, 2.0], [1.0, 2.0, 3.0]).slope)


@pytest.mark.parametrize(
    ("samples", "flights", "words"),
    [
        (rows(), 9, []),
        (rows(leak=5.0), 9, ["mavros_rss grows"]),
        (rows(slower=0.5), 9, ["mission became slower"]),
        (rows(slower=0.1), 9, []),
        (rows(), 5, ["only 5 of 9 vehicles"]),
    ],
)
def test_each_limit_that_is_exceeded_is_named(samples, flights, words):
    found = limits.failures(samples, flights, 9, judge_growth=True)
    assert len(found) == len(words)
    assert all(word in text for word, text in zip(words, found, strict=True))


def test_a_short_soak_is_not_judged_by_its_growth():
    assert limits.failures(rows(leak=50.0, slower=1.0), 9, 9, judge_growth=False) == []


def test_figures_of_a_process(tmp_path: Path):
    before = limits.process_figures(os.getpid())
    with (tmp_path / "open").open("w"):
        assert limits.process_figures(os.getpid())["descriptors"] == before["descriptors"] + 1
    assert limits.process_figures(os.getpid())["descriptors"] == before["descriptors"]
    assert 0 < before["anonymous"] <= before["rss"]


# ---- files


def flight_log(path: Path) -> bytes:
    """Write a log of 2 s."""
    layout = message_format("sensor_combined")
    samples = np.repeat(data_template(layout, 0)[None], 500)
    samples["record"]["timestamp"] = 4000 * np.arange(500)
    with path.open("wb") as sink:
        writer = UlogWriter(sink, 0)
        writer.add_format(layout)
        writer.subscribe(0, layout)
        writer.add_messages(samples.tobytes())
        writer.flush()
    return path.read_bytes()


def bag(path: Path) -> bytes:
    """Write a bag of 200 texts in chunks of 1 kB."""
    with Bag(path, threshold=1 << 10) as writer:
        for number in range(200):
            writer.text("/notes", f"note {number:04d}", 0.1 * number)
    return path.read_bytes()


def test_whole_files_are_counted_and_removed(tmp_path: Path):
    flight_log(tmp_path / "a.ulg")
    bag(tmp_path / "b.bag")
    assert read_files(sorted(tmp_path.iterdir())) == (700, [])
    assert list(tmp_path.iterdir()) == []


def test_a_bag_may_be_cut_if_its_recorder_was_killed(tmp_path: Path):
    data = bag(tmp_path / "whole.bag")
    (tmp_path / "killed.bag.active").write_bytes(data[: len(data) // 2])
    (tmp_path / "none.bag.active").write_bytes(b"")
    messages, damaged = read_files([tmp_path / "killed.bag.active", tmp_path / "none.bag.active"])
    assert 50 < messages < 150
    assert damaged == []


@pytest.mark.parametrize("name", ["a.ulg", "b.bag"])
def test_damaged_files_are_named_and_kept(tmp_path: Path, name: str):
    path = tmp_path / name
    data = flight_log(path) if name == "a.ulg" else bag(path)
    for content in (data[: len(data) // 2], b"no log"):
        path.write_bytes(content)
        _, damaged = read_files([path])
        assert [text.split(":")[0] for text in damaged] == [str(path)]
        assert path.exists()


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
