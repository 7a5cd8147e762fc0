"""The same flight at another speed, on one busy core, with other processes: the same messages to the last bit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import wait_for_ports
from rich.console import Console

pytest.importorskip("rospy")

from xtdrone_interaction import replay_check
from xtdrone_interaction.replay import compare
from xtdrone_interaction.scripted_launch import StopRequest


def test_the_short_check_finds_every_flight_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wait_for_ports("iris:3")
    assert replay_check.main(["--short", "--out", str(tmp_path / "replay")]) == 0
    output = capsys.readouterr().out
    assert output.count("the same to the last bit") == len(replay_check.SHORT)
    file = next((tmp_path / "replay").glob("*/digest.jsonl"))
    digests = [json.loads(line) for line in file.read_text().splitlines()]
    topics = {topic for row in digests for topic in row["topics"]}
    # What the comparison rests on: the truth, what the autopilots tell, what the swarm's nodes command.
    assert {"truth", "/gazebo/model_states", "/iris_1/mavros/local_position/pose", "/xtdrone/swarm"} <= topics
    assert {"/xtdrone/iris_1/cmd_vel_enu", "/iris_1/mavros/setpoint_raw/local", "/xtdrone/leader/pose"} <= topics
    assert {row["name"] for row in digests} >= {"/simulator", "/mavros", "/leader", "/formation_director"}


def test_another_seed_is_another_flight(tmp_path: Path) -> None:
    """A check that finds everything the same would be worth nothing."""
    wait_for_ports("iris:3")
    arguments = replay_check._parser().parse_args(["--short", "--until", "2", "--out", str(tmp_path / "seeds")])
    settings = replay_check.replay_settings(arguments)
    with StopRequest() as stop:
        first, second = (
            replay_check.fly(
                replace(settings, seed=seed), replay_check.Circumstance(f"seed {seed}"), stop, Console(quiet=True)
            )
            for seed in (0, 1)
        )
    result = compare(first.digests, second.digests, first.end_us)
    assert not result.same
    assert any(topic.endswith("/imu/data") for topic in result.differing)
