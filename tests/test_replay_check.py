"""The same flight at another speed, on one busy core, with other processes: the same messages to the last bit.

The check runs as a separate program, since it ends every process below it when it ends.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import WALL_LIMIT, wait_for_ports

pytest.importorskip("rospy")

from validation.replay import replay_check
from validation.replay.digest_comparison import compare, read_digests

LIMIT = 1200.0  # s of wall time; a starved machine takes twenty times as long as a quiet one

FLY_ANOTHER_SEED = """
import argparse
import sys
from dataclasses import replace
from rich.console import Console
from validation.replay import replay_check
from xtdrone_interaction.launching.scripted_launch import StopRequest

parser = argparse.ArgumentParser()
replay_check.add_arguments(parser)
settings = replay_check.replay_settings(parser.parse_args(["--short", "--until", "2", "--out", sys.argv[1]]))
with StopRequest() as stop:
    replay_check.fly(replace(settings, seed=1), replay_check.Circumstance("seed 1"), stop, Console(quiet=True))
"""


def run(*command: str) -> str:
    """Run Python with these arguments to its end and return its output."""
    result = subprocess.run(
        [sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT
    )
    assert result.returncode == 0, result.stdout
    return result.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the short check."""
    return tmp_path_factory.mktemp("check") / "replay"


@pytest.mark.timeout(LIMIT + WALL_LIMIT)
def test_the_short_check_finds_every_flight_the_same(folder: Path) -> None:
    wait_for_ports("iris:3")
    output = run("-m", "validation", "replay-check", "--short", "--until", "11", "--out", str(folder))
    assert output.count("the same to the last bit") == len(replay_check.SHORT)
    digests = [json.loads(line) for line in (folder / "as-fast-as-it-goes/digest.jsonl").read_text().splitlines()]
    topics = {topic for row in digests for topic in row["topics"]}
    # The basis of the comparison: the truth, the autopilots' telemetry, the commands of the swarm's nodes.
    assert {"truth", "/gazebo/model_states", "/iris_1/mavros/local_position/pose", "/xtdrone/swarm"} <= topics
    assert {"/xtdrone/iris_1/cmd_vel_enu", "/iris_1/mavros/setpoint_raw/local", "/xtdrone/leader/pose"} <= topics
    assert {row["name"] for row in digests} >= {"/simulator", "/mavros", "/leader", "/formation_director"}


@pytest.mark.timeout(LIMIT + WALL_LIMIT)
def test_another_seed_is_another_flight(folder: Path, tmp_path: Path) -> None:
    """Its digest differs from the check's; a check that finds no differences at all would be worthless."""
    wait_for_ports("iris:3")
    run("-c", FLY_ANOTHER_SEED, str(tmp_path / "seeds"))
    flights = (folder / "as-fast-as-it-goes", tmp_path / "seeds" / "seed-1")
    first, second = (read_digests(flight / "digest.jsonl") for flight in flights)
    result = compare(first, second, 2_000_000)
    assert not result.same
    assert any(topic.endswith("/imu/data") for topic in result.differing)
