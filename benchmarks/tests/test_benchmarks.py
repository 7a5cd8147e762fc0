"""Benchmark options, figures read from events and /proc, tables, JSON and clean-up; nothing is timed."""

from __future__ import annotations

import asyncio
import dataclasses
import io
import json
import math
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fake_roslaunch
import numpy as np
import pytest
import yaml
from rich.console import Console
from tornado.ioloop import IOLoop, PeriodicCallback

from benchmarks import bench_cli as bench
from benchmarks import calibration, compare_with_commit, measurement_runner, process_use
from benchmarks.flights import (
    free_running_flights,
    search_flights,
    sensing_flights,
    stack_and_formation_flights,
    web_flights,
)
from benchmarks.measurement_table import MEASUREMENTS
from benchmarks.nodes import bus_statistics, free_running_speeds, search_speed_meter, web_clients
from benchmarks.programs import barrier
from benchmarks.tables import printed_tables
from xtdrone_common.fleet import read_fleet_file
from xtdrone_interaction import cli, command_options, machine_facts
from xtdrone_interaction.launching import scripted_launch
from xtdrone_interaction.web.fleet.fleet_frame import CHANNEL, pack_fleet_frame
from xtdrone_interaction.web.fleet.model_states_bytes import COLUMNS
from xtdrone_interaction.web.server.credentials import Credentials
from xtdrone_interaction.web.server.station_server import Address, StationServer
from xtdrone_lockstep.server import LockstepServer
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

TICKS = os.sysconf("SC_CLK_TCK")
CORES = len(os.sched_getaffinity(0))
PATIENCE = 120.0  # s of wall time; bounds a broken test


# ---- options


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--only", "core,wings"],
            "part 'wings' is unknown; there are: core, simplified, drawing, sweep, detector, renderer, rays, effects, "
            "planning, odometry, "
            "rviz, analyse, codecs, barrier, telemetry, stack, sensing, formation, search, free, web",
        ),
        (["--vehicles", "0"], "vehicles of core: '0' is not allowed; 1 to 250"),
        (["--vehicles", "10000"], "vehicles of core: '10000' is not allowed; 1 to 250"),
        (["--vehicles", "simplified=10001"], "vehicles of simplified: '10001' is not allowed; 2 to 10000"),
        (["--vehicles", "drawing=1"], "vehicles of drawing: '1' is not allowed; 2 to 10000"),
        (["--vehicles", "sweep=1"], "workers of sweep: '1' is not allowed; 2 to 64"),
        (["--vehicles", "sweep=65"], "workers of sweep: '65' is not allowed; 2 to 64"),
        (
            ["--only", "sweep", "--vehicles", "9"],
            "vehicles: '9' is for no part that is measured; workers are given as sweep=9",
        ),
        (["--vehicles", "detector=100"], "widths of detector: 100 is not allowed; multiples of 32"),
        (["--vehicles", "detector=0"], "widths of detector: '0' is not allowed; 32 to 2048"),
        (["--vehicles", "search=11"], "rates of search: '11' is not allowed; 1 to 10"),
        (["--vehicles", "effects=0"], "vehicles of effects: '0' is not allowed; 1 to 250"),
        (["--vehicles", "sensing=251"], "vehicles of sensing: '251' is not allowed; 1 to 250"),
        (["--vehicles", "stack=9,many"], "vehicles of stack: 'many' is not allowed; 1 to 250"),
        (["--vehicles", "formation=1"], "vehicles of formation: '1' is not allowed; 2 to 250"),
        (
            ["--vehicles", "swarm=9"],
            "vehicles: part 'swarm' in 'swarm=9' is not measured; measured are: core, simplified, drawing, sweep, "
            "detector",
        ),
        (["--only", "core", "--vehicles", "stack=9"], "part 'stack' in 'stack=9' is not measured; measured are: core"),
        (["--vehicles", "barrier=-1"], "participants of barrier: '-1' is not allowed; 0 to 250"),
        (["--vehicles", "free=1"], "vehicles of free: '1' is not allowed; 2 to 250"),
        (["--vehicles", "=9"], "part '' in '=9' is not measured"),
        (["--repeat", "0"], "--repeat: '0' is not allowed, a whole number from 1 to 20"),
        (["--processes", "many"], "--processes: 'many' is not allowed, all, per-uav, merged or shared"),
        (
            ["--baseline", "no such"],
            "baseline: 'no such' is not a commit of this repository; a hash, a branch or a tag is",
        ),
        (["--json", "/"], "json: '/' is a folder"),
        (["--json", "/proc/bench.json"], "json: '/proc/bench.json' cannot be written"),
        (["--json", "/nowhere/my results.json"], "contains a space"),
    ],
)
def test_invalid_values_are_reported(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command_options, "check_vehicle_ports", lambda fleet: None)  # another simulation may be running
    try:
        status = cli.main(["bench", *arguments])
    except SystemExit as error:  # argparse exits
        status = error.code
    assert status == 2
    assert message in capfd.readouterr().err


def test_vehicles_are_chosen_for_all_parts_or_for_one() -> None:
    assert bench.chosen_vehicles(["core", "stack"], []) == {"core": (1, 9, 30, 100), "stack": (1, 9, 30, 100)}
    assert bench.chosen_vehicles(["core", "stack"], ["9", "core=1,100,1"]) == {"core": (1, 100), "stack": (9,)}
    assert bench.chosen_vehicles(["simplified", "sweep"], ["9"]) == {"simplified": (9,), "sweep": (2,)}
    assert bench.chosen_vehicles(["simplified", "sweep"], ["9", "sweep=2,4"]) == {"simplified": (9,), "sweep": (2, 4)}
    assert bench.chosen_vehicles(["detector", "core"], ["9"]) == {"detector": (320, 416, 640), "core": (9,)}
    assert bench.chosen_parts("formation, core") == ["core", "formation"]


def test_plan_names_each_measurement(tmp_path: Path) -> None:
    settings = bench.BenchSettings(
        vehicles={
            "core": (1,),
            "simplified": (1000,),
            "drawing": (9,),
            "sweep": (2,),
            "detector": (640,),
            "renderer": (640,),
            "effects": (6,),
            "rviz": (30,),
            "analyse": (100,),
            "barrier": (0, 9),
            "telemetry": (30,),
            "sensing": (6,),
            "formation": (9, 100),
            "search": (5,),
            "free": (9,),
        },
        repeat=2,
        quick=True,
        json=tmp_path / "b.json",
    )
    planned = list(bench.plan(settings))
    assert [case.title for case, _ in planned] == [
        "core, 1 vehicle, 1 of 2",
        "core, 1 vehicle, 2 of 2",
        "simplified, 1000 vehicles, 1 of 2",
        "simplified, 1000 vehicles, 2 of 2",
        "drawing, 9 vehicles, 1 of 2",
        "drawing, 9 vehicles, 2 of 2",
        "sweep, 2 workers, 1 of 2",
        "sweep, 2 workers, 2 of 2",
        "detector, 640 px wide, 1 of 2",
        "detector, 640 px wide, 2 of 2",
        "renderer, 640 x 360 px, egl, 1 of 2",
        "renderer, 640 x 360 px, egl, 2 of 2",
        "renderer, 640 x 360 px, tiny, 1 of 2",
        "renderer, 640 x 360 px, tiny, 2 of 2",
        "renderer, 640 x 480 px, egl, 1 of 2",
        "renderer, 640 x 480 px, egl, 2 of 2",
        "renderer, 640 x 480 px, tiny, 1 of 2",
        "renderer, 640 x 480 px, tiny, 2 of 2",
        "effects, 6 vehicles, none, 1 of 2",
        "effects, 6 vehicles, none, 2 of 2",
        "effects, 6 vehicles, wind, 1 of 2",
        "effects, 6 vehicles, wind, 2 of 2",
        "effects, 6 vehicles, dryden, 1 of 2",
        "effects, 6 vehicles, dryden, 2 of 2",
        "effects, 6 vehicles, wind_region, 1 of 2",
        "effects, 6 vehicles, wind_region, 2 of 2",
        "effects, 6 vehicles, wind_field, 1 of 2",
        "effects, 6 vehicles, wind_field, 2 of 2",
        "effects, 6 vehicles, ground_effect, 1 of 2",
        "effects, 6 vehicles, ground_effect, 2 of 2",
        "effects, 6 vehicles, downwash, 1 of 2",
        "effects, 6 vehicles, downwash, 2 of 2",
        "effects, 6 vehicles, body_drag, 1 of 2",
        "effects, 6 vehicles, body_drag, 2 of 2",
        "rviz, 30 vehicles, 1280 x 720 px, 1 of 2",
        "rviz, 30 vehicles, 1280 x 720 px, 2 of 2",
        "rviz, 30 vehicles, 1280 x 720 px, rough, 1 of 2",
        "rviz, 30 vehicles, 1280 x 720 px, rough, 2 of 2",
        "rviz, 30 vehicles, 640 x 360 px, 1 of 2",
        "rviz, 30 vehicles, 640 x 360 px, 2 of 2",
        "analyse, bag of 100 MB, 1 of 2",
        "analyse, bag of 100 MB, 2 of 2",
        "barrier, 0 participants, 1 of 2",
        "barrier, 0 participants, 2 of 2",
        "barrier, 9 participants, python, 1 of 2",
        "barrier, 9 participants, python, 2 of 2",
        "barrier, 9 participants, cpp, 1 of 2",
        "barrier, 9 participants, cpp, 2 of 2",
        "telemetry, 30 vehicles, 1 of 2",
        "telemetry, 30 vehicles, 2 of 2",
        "sensing, 6 vehicles, lidars 16x512, 1 of 2",
        "sensing, 6 vehicles, lidars 16x512, 2 of 2",
        "sensing, 6 vehicles, depth 320x240, 1 of 2",
        "sensing, 6 vehicles, depth 320x240, 2 of 2",
        "sensing, 6 vehicles, depth 640x480, 1 of 2",
        "sensing, 6 vehicles, depth 640x480, 2 of 2",
        "formation, 9 vehicles, processes per uav, 1 of 2",
        "formation, 9 vehicles, processes per uav, 2 of 2",
        "formation, 9 vehicles, processes merged, 1 of 2",
        "formation, 9 vehicles, processes merged, 2 of 2",
        "formation, 9 vehicles, processes shared, 1 of 2",
        "formation, 9 vehicles, processes shared, 2 of 2",
        "formation, 100 vehicles, processes shared, 1 of 2",
        "formation, 100 vehicles, processes shared, 2 of 2",
        "search, 5 Hz, 1 of 2",
        "search, 5 Hz, 2 of 2",
        "free, 9 vehicles, 1 of 2",
        "free, 9 vehicles, 2 of 2",
    ]
    known = [case.known | {"repeat": number} for case, number in planned]
    assert known[-3] == {"vehicles": 6, "repeat": 2, "camera_rate": 5}
    assert known[-5] == {"vehicles": 100, "repeat": 2, "mode": "shared"}
    assert known[7] == {"workers": 2, "repeat": 2}
    assert known[47] == {"participants": 9, "repeat": 2, "kind": "cpp"}


# ---- /proc


def _process(proc: Path, pid: int, parent: int, cpu: float, command: list[str], state: str = "S", pss: int = 0) -> None:
    """Write a process into a fake /proc: ``cpu`` s of CPU time, half user, half system; ``pss`` in kB."""
    folder = proc / str(pid)
    folder.mkdir(parents=True, exist_ok=True)
    half = int(cpu * TICKS / 2)
    (folder / "stat").write_text(f"{pid} (a) b) {state} {parent} 1 1 0 -1 4194560 9 0 0 0 {half} {half} 77 88 20 0\n")
    (folder / "cmdline").write_bytes(b"\0".join(word.encode() for word in command) + b"\0")
    (folder / "smaps_rollup").write_text(
        f"00400000-7ffd ---p 00000000 00:00 0 [rollup]\nRss: 999999 kB\nPss: {pss:8d} kB\nPss_Dirty: 5 kB\n"
    )


@pytest.fixture
def proc(tmp_path: Path) -> Path:
    """A fake /proc: a launch (10) with two followers, a simulator and a zombie, and an unrelated process (50)."""
    proc = tmp_path / "proc"
    _process(proc, 10, 1, 1.0, ["/usr/bin/python3", "/usr/bin/roslaunch", "x.launch"], pss=100)
    _process(proc, 11, 10, 4.0, ["python3", "/ws/lib/simulator.py", "__name:=simulator"], pss=1000)
    _process(proc, 12, 10, 1.0, ["/venv/bin/python3", "-u", "/ws/follower.py", "iris", "1"], pss=10)
    _process(proc, 13, 12, 1.0, ["python3", "/ws/follower.py", "iris", "2"], pss=20)
    _process(proc, 14, 10, 9.0, ["/usr/lib/rosbag/record", "-O", "x"], state="Z", pss=7)
    _process(proc, 50, 1, 5.0, ["/usr/bin/make"], pss=3)
    (proc / "self").mkdir()
    (proc / "stat").write_text("cpu  100 0 100 5000 5000 0 0 0 0 0\ncpu0 1 1 1 1 1 1 1 1 1 1\n")
    return proc


def test_tree_has_all_generations_and_no_zombie(proc: Path) -> None:
    assert sorted(process_use.process_tree(10, proc)) == [10, 11, 12, 13]


def test_memory_is_the_sum_of_pss_alone(proc: Path) -> None:
    assert process_use.memory([10, 11, 12, 13], proc) == 1130 * 1024
    assert process_use.memory([12, 4711], proc) == 10 * 1024  # 4711 has ended


def test_cpu_time_goes_to_programs_and_others(proc: Path) -> None:
    before = process_use.CpuSample.take(10, proc)
    _process(proc, 11, 10, 6.0, ["python3", "/ws/lib/simulator.py", "__name:=simulator"])
    _process(proc, 12, 10, 1.5, ["/venv/bin/python3", "-u", "/ws/follower.py", "iris", "1"])
    _process(proc, 15, 10, 0.5, ["python3", "/ws/follower.py", "iris", "3"])  # began meanwhile
    user, idle, steal = 100 + 4 * TICKS, 9999, 2 * TICKS
    (proc / "stat").write_text(f"cpu  {user} 0 100 {idle} 5000 0 0 {steal} 0 0\n")
    use = process_use.CpuSample.take(10, proc).since(before)
    assert use.programs == pytest.approx({"roslaunch": 0.0, "simulator": 2.0, "follower": 1.0})
    assert use.others == pytest.approx(3.0)  # 4 s used and 2 s stolen, of which this launch used 3 s


def test_own_process_is_read_from_the_real_proc() -> None:
    own = os.getpid()
    assert own in process_use.process_tree(os.getppid())
    assert process_use.memory([own]) > 2**20
    assert process_use.CpuSample.take(own).processes[own][1] > 0.0


# ---- events


def _event(event: str, time: float, wall: float, **values: Any) -> dict[str, Any]:
    return {"event": event, "time": time, "wall": wall, **values}


FORMATION = [
    _event("start", 0.0, 1003.0, vehicles=["iris_0", "iris_1"]),
    _event("phase", 0.1, 1003.1, phase="takeoff"),
    _event("armed", 2.0, 1004.0),
    _event("phase", 30.0, 1008.0, phase="pattern cube", pattern="cube"),
    _event("phase", 60.0, 1020.0, phase="land"),
    _event("done", 82.0, 1024.0, unsettled=["cube"]),
]


def test_formation_figures() -> None:
    assert stack_and_formation_flights.formation_figures(FORMATION, began=1000.0) == {
        "real_time_factor": 4.0,
        "flight": {"simulated": 80.0, "elapsed": 20.0},
        "startup_seconds": 4.0,
        "unsettled": ["cube"],
    }


def test_missing_event_is_reported() -> None:
    with pytest.raises(measurement_runner.BenchError, match="no 'done' among start, phase, armed"):
        stack_and_formation_flights.formation_figures(FORMATION[:3], 1000.0)


def test_probe_samples_cpu_from_arming_to_landing_and_memory_between(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = iter([({1: ("leader", 1.0)}, 10.0), ({1: ("leader", 7.0)}, 20.0)])
    monkeypatch.setattr(
        stack_and_formation_flights.CpuSample, "take", lambda root: process_use.CpuSample(*next(samples))
    )
    monkeypatch.setattr(stack_and_formation_flights, "process_tree", lambda root: [root, 2, 3])
    monkeypatch.setattr(stack_and_formation_flights, "memory", lambda pids: 1000 * len(pids))
    probe = stack_and_formation_flights.FormationProbe("cube")
    for event in FORMATION:
        probe(event, 1)
    figures = stack_and_formation_flights.probe_figures(probe)
    assert figures["cpu_per_simulated_second"] == {"leader": pytest.approx(6.0 / 58.0)}
    assert figures["overlap"] == pytest.approx(6.0 / 16.0 / CORES)
    assert figures["others_cpu"] == pytest.approx(4.0 / 16.0)
    assert (figures["memory_bytes"], figures["processes"]) == (3000, 3)


def test_stack_figures() -> None:
    window = {
        "simulated": 20.0,
        "elapsed": 4.0,
        "received": {"pose": 600, "state": 20},
        "cpu": {"simulator": 2.0},
        "others": 1.0,
        "memory": 5,
        "processes": 6,
    }
    events = [_event("start", 0.0, 1002.0), _event("armed", 1.0, 1003.0), _event("window", 30.0, 1009.0, **window)]
    assert stack_and_formation_flights.stack_figures(events, began=1000.0) == {
        "real_time_factor": 5.0,
        "window": {"simulated": 20.0, "elapsed": 4.0},
        "messages_per_second": 155.0,
        "messages_per_simulated_second": {"pose": 30.0, "state": 1.0},
        "cpu_per_simulated_second": {"simulator": 0.1},
        "overlap": 0.5 / CORES,
        "others_cpu": 0.25,
        "memory_bytes": 5,
        "processes": 6,
        "startup_seconds": 3.0,
    }


# ---- search

FLYING = {"typhoon_h480_0": "searching", "typhoon_h480_1": "second look"}


def _probed(
    monkeypatch: pytest.MonkeyPatch, messages: list[tuple[float, float, str, dict[str, str]]]
) -> tuple[int, list[dict[str, Any]]]:
    """Run a probe that measures 10 s; return its exit status and events. Two pictures precede each message."""
    samples = iter([({1: ("yolo", 1.0)}, 10.0), ({1: ("yolo", 7.0)}, 20.0)])
    monkeypatch.setattr(search_speed_meter.CpuSample, "take", lambda root: process_use.CpuSample(*next(samples)))
    monkeypatch.setattr(search_speed_meter, "process_tree", lambda root: [root, 2, 3])
    monkeypatch.setattr(search_speed_meter, "memory", lambda pids: 1000 * len(pids))
    pictures = search_speed_meter.Pictures(FLYING)

    def feed() -> Iterator[search_speed_meter.Progress]:
        for number, (sim_time, wall, phase, states) in enumerate(messages):
            for name in FLYING:
                pictures.count(name, number // 2)
            said = {"sim_time": sim_time, "phase": phase, "vehicles": states, "covered_fraction": 0.5}
            yield search_speed_meter.Progress.read(json.dumps(said), wall)

    written = io.StringIO()
    status = search_speed_meter.SearchProbe(10.0, pictures, written).run(feed())
    return status, [json.loads(line) for line in written.getvalue().splitlines()]


def test_search_is_measured_while_all_search(monkeypatch: pytest.MonkeyPatch) -> None:
    climbing = FLYING | {"typhoon_h480_1": "taking off"}
    status, events = _probed(
        monkeypatch,
        [
            (5.0, 90.0, "searching", climbing),
            (6.0, 100.0, "second look", FLYING),
            (12.0, 103.0, "searching", FLYING),
            (16.0, 104.0, "searching", FLYING),
            (17.0, 105.0, "finished", FLYING),  # too late to matter
        ],
    )
    assert status == 0
    assert [event["event"] for event in events] == ["start", *["progress"] * 4, "window", "done"]
    assert [event.get("phase") for event in events[1:3]] == ["searching", "second look"]
    assert search_flights.search_figures(events) == {
        "real_time_factor": 2.5,
        "window": {"simulated": 10.0, "elapsed": 4.0},
        "pictures_per_simulated_second": 0.4,
        "dropped": 2,
        "cpu_per_simulated_second": {"yolo": pytest.approx(0.6)},
        "cpu_share": {"cameras": 0.0, "yolo": 1.0, "simulator": 0.0, "mavros": 0.0, "others": 0.0},
        "others_cpu": 1.0,
        "memory_bytes": 3000,
        "processes": 3,
    }


@pytest.mark.parametrize(
    ("last", "reason"),
    [
        (
            [(9.0, 2.0, "returning", FLYING | {"typhoon_h480_0": "lost"})],
            "search: returning before 10 s were measured; typhoon_h480_0 lost, typhoon_h480_1 second look",
        ),
        ([], "search: the launch ended before 10 s were measured"),
    ],
)
def test_search_that_ends_too_early_is_no_measurement(
    monkeypatch: pytest.MonkeyPatch, last: list[tuple[float, float, str, dict[str, str]]], reason: str
) -> None:
    status, events = _probed(monkeypatch, [(6.0, 1.0, "searching", FLYING), *last])
    assert (status, events[-1]["event"], events[-1]["reason"]) == (1, "failed", reason)


def test_shares_of_the_cpu_time() -> None:
    cpu = {
        "cameras": 1.0,
        "xtdrone_sim.cameras.camera_worker": 3.0,
        "simulator": 2.0,
        "record": 1.0,
        "search_mission": 1.0,
    }
    assert search_flights.shares(cpu) == {"cameras": 0.5, "yolo": 0.0, "simulator": 0.25, "mavros": 0.0, "others": 0.25}
    assert sum(search_flights.shares({}).values()) == 0.0


def test_table_of_the_search() -> None:
    row = {
        "vehicles": 6,
        "camera_rate": 2,
        "real_time_factor": 1.25,
        "dropped": 3,
        "cpu_per_simulated_second": {"cameras": 0.5, "yolo": 0.25},
        "cpu_share": {"cameras": 0.5, "yolo": 0.25, "simulator": 0.125, "mavros": 0.0, "others": 0.125},
    }
    failed = {"vehicles": 6, "camera_rate": 5, "error": "search: returning"}
    text = _printed({"machine": {"load_before": [0.1, 0.1, 0.1]}, "search": [row, failed]})
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["2 Hz", "1.25 x", "1 x", "50%", "25%", "12%", "0%", "12%"] in lines
    assert ["5 Hz", *["failed"] * 7] in lines
    assert ["cameras", "0.500"] in lines
    assert "…" not in text  # it fits a terminal of 80 columns
    flat = " ".join(text.split())
    assert "search, 2 Hz: the detector skipped 3 of the images" in flat
    assert "search, 5 Hz: failed: search: returning" in flat
    assert printed_tables.short_result("search", row) == "1.25 x real time"


# ---- barrier


def test_figures_of_ticks() -> None:
    durations = [1000] * 90 + [21000] * 9 + [1_000_000]
    assert barrier.figures(durations) == {
        "ticks": 100,
        "mean_us": pytest.approx(12.79),
        "median_us": pytest.approx(1.0),
        "p99_us": pytest.approx(30.79),
    }


def test_empty_barrier_ticks_at_the_base_step(monkeypatch: pytest.MonkeyPatch) -> None:
    server = LockstepServer()
    times: list[int] = []
    monkeypatch.setattr(server, "tick", times.append)
    try:
        durations = barrier.run_ticks(server, 0.0, 5)
    finally:
        server.close()
    assert len(durations) == 5
    assert times == [4000 * k for k in range(1 + barrier.WARM_UP + 5)]


def test_barrier_with_real_participants(tmp_path: Path) -> None:
    file = tmp_path / "b.json"
    arguments = ["--participants", "2", "--seconds", "0", "--ticks", "5", "--json", str(file)]
    subprocess.run([sys.executable, "-m", "benchmarks.programs.barrier", *arguments], check=True, timeout=PATIENCE)
    (row,) = json.loads(file.read_text())
    assert row["ticks"] >= 5
    assert 0.0 < row["median_us"] <= row["p99_us"]


def test_interrupted_barrier_leaves_nothing_running(tmp_path: Path) -> None:
    mark = f"XTDRONE_TEST={os.getpid()}-{tmp_path.name}"
    environment = {**os.environ, mark.partition("=")[0]: mark.partition("=")[2]}
    arguments = ["bench", "--only", "barrier", "--vehicles", "2", "--json", str(tmp_path / "b.json")]
    program = f"import sys; from xtdrone_interaction import cli; sys.exit(cli.main({arguments!r}))"
    bench_process = subprocess.Popen(
        [sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    end = time.monotonic() + PATIENCE
    while not _marked(mark, "lockstep_idle") and time.monotonic() < end:
        time.sleep(0.02)  # no event records that a process belongs to its grandparent's starter
    assert _marked(mark, "lockstep_idle")
    bench_process.send_signal(signal.SIGINT)
    output, _ = bench_process.communicate(timeout=PATIENCE)
    assert bench_process.returncode == 130, output
    assert "stopped by SIGINT" in output
    assert _marked(mark, "") == []


def _marked(mark: str, word: str) -> list[str]:
    """Return the living processes with ``mark`` in their environment and ``word`` in their command."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if (
                entry.name.isdigit()
                and mark.encode() in (entry / "environ").read_bytes().split(b"\0")
                and word in (command := (entry / "cmdline").read_bytes().decode(errors="replace"))
            ):
                found.append(command)
        except OSError:
            continue
    return found


# ---- free-running


TURNS = {"commands": 1.0, "setpoints": 1.0, "poses": 1.0, "swarm": 0.9}


def _search(
    exact: float, works: Callable[[float, int], bool], breaks: float = math.inf
) -> list[free_running_speeds.Trial]:
    """Run a search; ``works(speed, trial number)`` returns whether the nodes keep up at that speed."""
    trials: list[free_running_speeds.Trial] = []
    while (speed := free_running_speeds.next_speed(exact, trials)) is not None:
        turns = TURNS | {"poses": 0.99 if works(speed, len(trials)) else 0.5}
        trials.append(free_running_speeds.Trial(speed, 0.0 if speed > breaks else speed, turns))
    return trials


@pytest.mark.parametrize("limit", [0.3, 0.99, 1.2, 1.9, 2.9, 4.6, 8.0])
@pytest.mark.parametrize("breaks", [1.5, math.inf])
def test_search_finds_the_highest_speed_at_which_nodes_keep_up(limit: float, breaks: float) -> None:
    trials = _search(5.0, lambda speed, _: speed <= 5.0 * limit, 5.0 * max(limit, breaks))
    top = free_running_speeds.best(trials)
    assert top is not None
    assert 5.0 * limit / free_running_speeds.RESOLUTION / 1.02 <= top.speed <= 5.0 * limit
    assert len(trials) <= free_running_speeds.MAX_TRIALS


def test_search_does_not_believe_a_single_failure() -> None:
    trials = _search(2.0, lambda speed, number: speed < 7.0 and number != 2)
    top = free_running_speeds.best(trials)
    assert top is not None
    assert 7.0 / free_running_speeds.RESOLUTION <= top.speed < 7.0
    assert trials[2].speed == trials[3].speed


def test_search_gives_up_where_nodes_keep_up_at_no_speed() -> None:
    trials = _search(2.0, lambda speed, _: False)
    assert free_running_speeds.best(trials) is None
    assert len(trials) <= free_running_speeds.MAX_TRIALS


@pytest.mark.parametrize(
    ("reached", "turns", "good"),
    [
        (2.0, TURNS | {"commands": 0.96}, True),
        (1.8, TURNS, False),
        (2.0, TURNS | {"poses": 0.9}, False),
        (2.0, {"commands": 1.0}, False),
        (0.0, TURNS, False),
    ],
)
def test_good_is_speed_and_work(reached: float, turns: dict[str, float], good: bool) -> None:
    assert free_running_speeds.Trial(2.0, reached, turns).good == good


class _Master:
    """A master with one follower and the MAVROS layer of two vehicles."""

    def getSystemState(self) -> Any:  # noqa: N802 - rosgraph's name
        topics = {
            "/xtdrone/iris_1/cmd_vel_enu": ["/follower_1"],
            "/xtdrone/leader/cmd_vel_enu": ["/somebody"],
            "/iris_0/mavros/local_position/pose": ["/mavros"],
            "/iris_1/mavros/local_position/pose": ["/mavros"],
            "/rosout": ["/follower_1", "/mavros"],
        }
        return [[list(item) for item in topics.items()], [], []]

    def lookupNode(self, name: str) -> str:  # noqa: N802 - rosgraph's name
        return f"http:/{name}"


def _node_with(counts: dict[str, dict[int, int]]) -> Any:
    """Return the proxy of a node that has sent ``counts`` by topic and connection."""
    published = [[topic, 0, [[c, 99, n, True] for c, n in sent.items()]] for topic, sent in counts.items()]
    return SimpleNamespace(getBusStats=lambda caller: [1, "", [published, [], []]])


def test_turns_are_counted_by_asking_the_nodes() -> None:
    command, poses = "/xtdrone/iris_1/cmd_vel_enu", "/iris_{}/mavros/local_position/pose"
    roles = bus_statistics.publishers(_Master())
    assert roles == {
        "/follower_1": {command: "commands"},
        "/mavros": {poses.format(0): "poses", poses.format(1): "poses"},
    }
    clock = iter([10.0, 10.5, 20.0, 20.5])
    taken = [
        bus_statistics.take(_Master(), roles, lambda: next(clock), nodes.__getitem__)
        for nodes in (
            {
                "http://follower_1": _node_with({command: {1: 50, 2: 20}, "/rosout": {1: 7}}),
                "http://mavros": _node_with({poses.format(0): {1: 0}, poses.format(1): {1: 1000}}),
            },
            {
                "http://follower_1": _node_with({command: {2: 320, 1: 350, 3: 9000}, "/rosout": {1: 999}}),
                "http://mavros": _node_with({poses.format(0): {1: 400}, poses.format(1): {1: 1200}}),
            },
        )
    ]
    assert bus_statistics.rates(roles, *taken) == {"commands": 30.0, "poses": 30.0}


@pytest.mark.parametrize("lockstep", ["true", "false"])
def test_flights_to_compare_differ_in_the_lockstep_alone(lockstep: str, tmp_path: Path) -> None:
    words = ["n:=2", f"lockstep:={lockstep}", f"plan:={tmp_path}/plan.json", f"out:={tmp_path}"]
    command = ["roslaunch", "--dump-params", str(command_options.repository() / "launch" / "bench_free.launch"), *words]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=PATIENCE).stdout
    parameters = yaml.safe_load(printed)
    assert parameters["/lockstep/wait"] is parameters["/simulator/lockstep"] is (lockstep == "true")
    assert float(parameters["/simulator/speed"]) == {"true": 0.0, "false": 1.0}[lockstep]


def test_trial_that_broke_the_flight_off_is_one() -> None:
    good = {"speed": 2.0, "real_time_factor": 2.0, "turns": TURNS, "cpu": {}, "others_cpu": 0.1}
    events = [
        _event("start", 0.0, 0.0),
        _event("trying", 1.0, 1.0, speed=2.0),
        _event("trial", 2.0, 2.0, **good),
        _event("trying", 3.0, 3.0, speed=4.0),
        _event("failed", 4.0, 4.0, reason="iris_0: is armed in mode 'AUTO.LAND'"),
    ]
    trials = free_running_flights.new_trials(events)
    assert [(trial.speed, trial.good, trial.broken) for trial in trials] == [(2.0, True, False), (4.0, False, True)]
    with pytest.raises(measurement_runner.BenchError, match="before a speed was tried"):
        free_running_flights.new_trials(events[:1])


def test_comparison_continues_after_an_aborted_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flights: list[dict[str, Any]] = []

    def fly(
        bench: Any, launch: str, arguments: dict[str, Any], folder: Path, vehicles: int, on_event: Callable[..., None]
    ) -> None:
        plan = json.loads(arguments["plan"].read_text())
        flights.append(plan)
        if "exact" not in plan:
            on_event(_event("window", 1.0, 1.0, real_time_factor=3.0, rates={"poses": 30.0}, cpu={}, others_cpu=0.0), 1)
            return
        trials = [free_running_speeds.Trial(**trial) for trial in plan["trials"]]
        while (speed := free_running_speeds.next_speed(plan["exact"]["real_time_factor"], trials)) is not None:
            on_event(_event("trying", 1.0, 1.0, speed=speed), 1)
            if speed > 4.0:
                raise measurement_runner.BenchError("the flight has ended: failed")
            trials.append(free_running_speeds.Trial(speed, speed, TURNS))
            on_event(_event("trial", 1.0, 1.0, **dataclasses.asdict(trials[-1])), 1)

    monkeypatch.setattr(free_running_flights, "fly", fly)
    with scripted_launch.StopRequest() as stop:
        shared = measurement_runner.Bench(tmp_path, stop, lambda text: None, bench.QUICK)
        (case,) = MEASUREMENTS["free"].cases("free", 9, ())
        row = MEASUREMENTS["free"].command(shared, case)
    assert [len(plan.get("trials", ())) for plan in flights] == [0, 0, 2]
    assert row["exact_real_time_factor"] == 3.0
    assert 4.0 / free_running_speeds.RESOLUTION <= row["free_real_time_factor"] <= 4.0
    assert row["exact_share"] == pytest.approx(3.0 / row["free_real_time_factor"])
    assert [trial["speed"] for trial in row["trials"] if not trial["good"]] == sorted(
        [trial["speed"] for trial in row["trials"] if not trial["good"]], reverse=True
    )


# ---- the station in the browser


def test_the_station_s_cost_is_that_of_windows_with_clients() -> None:
    def window(clients: int, factor: float, station: float) -> dict[str, Any]:
        figures = {"station": station, "simulated": 5.0 * factor, "elapsed": 5.0, "others_cpu": 0.1}
        figures |= {"flight": (0.42 if clients else 0.40) * 5.0 * factor, "readers": 0.1 if clients else 0.0}
        return _event("window", 1.0, 1.0, clients=clients, real_time_factor=factor, **figures)

    received = _event("received", 2.0, 2.0, clients=3, frames=150, bytes=150_000, elapsed=5.0)
    events = [window(0, 4.0, 0.05), window(3, 3.9, 0.3), received, window(0, 4.0, 0.05), window(3, 3.9, 0.2), received]
    figures = web_flights.web_figures(events)
    assert figures["kept"] == pytest.approx(0.975)
    assert figures["station_cores"] == pytest.approx(0.05)
    assert figures["station_cpu"] == pytest.approx(0.5 / 39.0)
    assert figures["idle_cores"] == pytest.approx(0.01)
    assert figures["cost"] == pytest.approx((0.42 + 0.5 / 39.0) / 0.40 - 1.0)
    assert figures["readers_cores"] == pytest.approx(0.02)
    assert (figures["frame_rate"], figures["frame_bytes"]) == (pytest.approx(10.0), pytest.approx(1000.0))
    with pytest.raises(measurement_runner.BenchError, match="web: 0 windows with clients, 1 without, 0 with frames"):
        web_flights.web_figures(events[:1])
    row = figures | {"vehicles": 30}
    assert printed_tables.short_result("web", row) == "0.050 cores, 8.2% more CPU time, 0.97 of the real-time factor"
    printed = _printed({"machine": {"load_before": [0.1] * 3}, "web": [row]})
    assert ["30", "3.90 x", "4.00 x", "0.97", "0.95", "0.050", "8.2%", "10.0", "1000"] in [
        [cell.strip() for cell in line.strip("│").split("│")] for line in printed.splitlines() if "│" in line
    ]


def test_the_station_s_readers_count_frames_of_the_fleet() -> None:
    """The server sends what the station sends; the readers are the program that the probe starts."""
    frame = pack_fleet_frame(np.zeros((30, COLUMNS)), np.zeros((0, COLUMNS)), 1.0, 1, 1)
    with _station_that_sends(frame) as url:
        command = [sys.executable, "-m", "benchmarks.nodes.web_clients", url, "2"]
        readers = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=command_options.repository()
        )
        assert readers.stdout is not None
        assert readers.stdout.readline() == "reading\n"
        output, _ = readers.communicate("", timeout=PATIENCE)
    received = json.loads(output)
    assert received["clients"] == 2
    assert received["bytes"] == received["frames"] * (1 + len(frame))
    assert received["elapsed"] > 0.0


def test_readers_without_a_station_end() -> None:
    with pytest.raises(ConnectionRefusedError):
        asyncio.run(web_clients.read("http://127.0.0.1:9/#token=none", 1))


@contextmanager
def _station_that_sends(frame: bytes) -> Iterator[str]:
    """Serve the station's protocol in a thread, with a frame every 20 ms; yield the URL."""
    ready = threading.Event()
    found: list[Any] = []

    def serve() -> None:
        asyncio.set_event_loop(asyncio.new_event_loop())
        server = StationServer(Address("127.0.0.1", 0, Credentials("a-token-to-use")), command_options.repository(), ())
        url = server.address.urls(server.start())["operate"]
        timer = PeriodicCallback(
            lambda: [session.push_latest(CHANNEL, frame) for session in server.sessions.values()], 20.0
        )
        timer.start()
        found.extend([url, IOLoop.current()])
        ready.set()
        IOLoop.current().start()
        timer.stop()
        server.stop()

    thread = threading.Thread(target=serve)
    thread.start()
    assert ready.wait(PATIENCE)
    yield found[0]
    found[1].add_callback(found[1].stop)
    thread.join(PATIENCE)


def test_the_probe_is_launched_beside_a_flight_with_its_page(tmp_path: Path) -> None:
    words = ["n:=2", f"plan:={tmp_path}/plan.json", f"out:={tmp_path}"]
    command = ["roslaunch", "--dump-params", str(command_options.repository() / "launch" / "bench_web.launch"), *words]
    parameters = yaml.safe_load(
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=PATIENCE).stdout
    )
    assert float(parameters["/simulator/speed"]) == 0.0
    assert parameters["/web_station/host"] == "127.0.0.1"
    assert parameters["/web_station_meter/plan"] == f"{tmp_path}/plan.json"


# ---- calibration


def test_calibration_does_the_documented_work() -> None:
    """The results equal those of the same loops in plain Python, so a change of the work changes the reference too."""
    value = 88172645463325252
    for _ in range(1000):
        value ^= value << 13 & (1 << 64) - 1
        value ^= value >> 7
        value ^= value << 17 & (1 << 64) - 1
    assert calibration._integer(1000) == value
    assert calibration._floating(1000) == calibration._floating.py_func(1000)


def test_calibration_compares_with_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    took = iter([100.0, 47.7, 49.6])
    monkeypatch.setattr(calibration, "_shortest", lambda work, steps: next(took))
    assert calibration.calibrate()["speed"] == pytest.approx(0.5 ** (1 / 3))


# ---- results


def _core_row(vehicles: int, factor: float) -> dict[str, Any]:
    steps = factor * 250 * vehicles
    return {
        "vehicles": vehicles,
        "real_time_factor": factor,
        "vehicle_steps_per_second": steps,
        "microseconds_per_vehicle_step": 1e6 / steps,
    }


def _formation_row(factor: float) -> dict[str, Any]:
    figures = stack_and_formation_flights.formation_figures(FORMATION, 1000.0)
    return figures | {
        "vehicles": 9,
        "mode": "per_uav",
        "real_time_factor": factor,
        "cpu_per_simulated_second": {"follower_consensus": 0.25, "rosout": 0.0001},
        "overlap": 0.625,
        "others_cpu": 1.5,
        "memory_bytes": 900_000_000,
        "processes": 24,
    }


CALIBRATION = {"integer_ms": 100.0, "floating_ms": 95.4, "python_ms": 99.2, "speed": 0.5}


def _printed(results: dict[str, Any]) -> str:
    console = Console(file=io.StringIO(), width=80)
    printed_tables.print_results(results, console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_tables() -> None:
    results = {
        "machine": {"load_before": [2.5, 1.0, 1.0]},
        "calibration": CALIBRATION,
        "core": [_core_row(9, 40.0), {"vehicles": 100, "error": "core: ended with status 1 [x]"}],
        "formation": [_formation_row(3.0), _formation_row(5.0), _formation_row(4.5)],
    }
    text = _printed(results)
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["9", "40.00 x", "30 x", "90000", "11.11"] in lines
    assert ["100", "failed", "failed", "failed", "failed"] in lines
    assert ["9 per-uav", "4.50 x", "3 x", "80.0", "62%", "4.0", "900", "24"] in lines  # the median
    assert ["follower_consensus", "0.250"] in lines
    assert "3.00 to 5.00" in text
    assert "│ rosout" not in text  # too little for a line
    assert "…" not in text  # it fits a terminal of 80 columns
    flat = " ".join(text.split())
    assert flat.count("calibration: 0.50 (integer 100 ms, floating 95 ms, python 99 ms)") == 2  # below each table
    assert "load average was 2.5 before the benchmark" in flat
    assert "core, 100: failed: core: ended with status 1 [x]" in flat
    assert "formation, 9 per-uav: other programs took 1.5 cores" in flat
    assert "formation, 9 per-uav: did not settle: cube" in flat


def test_tables_of_barrier_and_comparison() -> None:
    barrier = {"median_us": 80.0, "mean_us": 91.25, "p99_us": 200.0, "server_cpu_us": 30.0, "ticks": 999}
    trials = [
        {"speed": 6.0, "real_time_factor": 0.0, "turns": {}, "good": False},
        {"speed": 4.0, "real_time_factor": 3.99, "turns": {"swarm": 0.98, "poses": 1.0}, "good": True},
    ]
    free = {
        "vehicles": 9,
        "exact_real_time_factor": 3.0,
        "free_real_time_factor": 4.0,
        "exact_share": 0.75,
        "trials": trials,
        "exact_cpu": {"simulator": 0.2},
        "free_cpu": {"simulator": 0.1},
    }
    nowhere = free | {"vehicles": 30, "free_real_time_factor": 0.0, "exact_share": None, "trials": [], "free_cpu": {}}
    results = {
        "machine": {"load_before": [0.1, 0.1, 0.1]},
        "barrier": [
            barrier | {"participants": 0, "kind": "none", "participants_cpu_us": 0.0},
            barrier | {"participants": 9, "kind": "cpp", "participants_cpu_us": 40.0},
            {"participants": 9, "kind": "python", "error": "barrier: ended with status 1"},
        ],
        "free": [free, nowhere, {"vehicles": 50, "error": "free: ended"}],
    }
    text = _printed(results)
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["0", "80.0", "", "91.2", "200.0", "30.0", "0.0", "999"] in lines
    assert ["9 cpp", "80.0", "8.89", "91.2", "200.0", "30.0", "40.0", "999"] in lines
    assert ["9 python", *["failed"] * 7] in lines
    assert ["9", "3.00 x", "4.00 x", "0.75", "0.70"] in lines
    assert ["30", "3.00 x", "0.00 x", "", ""] in lines
    assert ["50", *["failed"] * 4] in lines
    assert lines.index(["9", "4.00 x", "3.99 x", "98%", "100%", "yes"]) + 1 == lines.index(
        ["9", "6.00 x", "broke off", "", "", "no"]
    )
    assert ["simulator", "0.200", "0.100", "0.200"] in lines  # 9 in lockstep and free, 30 in lockstep
    flat = " ".join(text.split())
    assert "barrier, 9 python: failed: barrier: ended with status 1" in flat
    assert "free, 30: free-running, the nodes kept up at none of the speeds tried" in flat
    assert printed_tables.short_result("barrier", results["barrier"][0]) == "80 us per tick"
    assert printed_tables.short_result("free", free) == "3.00 x real time, free-running 4.00 x"


def test_table_of_the_detector() -> None:
    row = {"width": 640, "height": 384, "milliseconds": 21.5}
    results = {
        "machine": {"load_before": [0.1, 0.1, 0.1]},
        "detector": [row, row | {"milliseconds": 22.5}, {"width": 320, "error": "detector: ended with status 1"}],
    }
    text = _printed(results)
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["640 x 384", "22.00"] in lines
    assert ["320", "failed"] in lines
    assert "detector, 320 px wide: failed" in " ".join(text.split())
    assert printed_tables.short_result("detector", row) == "21.5 ms per image"


def test_table_of_the_renderer() -> None:
    row = {"width": 640, "height": 360, "backend": "egl", "milliseconds": 30.0, "wall_milliseconds": 24.5,
           "depth_milliseconds": 25.0, "stereo_milliseconds": 49.0}  # fmt: skip
    results = {"machine": {"load_before": [0.1, 0.1, 0.1]}, "renderer": [row, row | {"backend": "tiny"}]}
    text = _printed(results)
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["640 x 360 px, egl", "30.00", "24.50", "40", "20"] in lines
    assert ["640 x 360 px, tiny", "30.00", "24.50", "40", "20"] in lines


def test_table_of_the_effects() -> None:
    row = {"vehicles": 6, "effect": "dryden", "effect_microseconds": 0.5, "microseconds_per_vehicle_step": 4.25,
           "real_time_factor": 160.0}  # fmt: skip
    text = _printed({"machine": {"load_before": [0.1, 0.1, 0.1]}, "effects": [row]})
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["6 dryden", "0.50", "4.25", "160.00 x"] in lines
    assert printed_tables.short_result("effects", row) == "0.50 us per vehicle and step"


def test_fleets_with_sensors_are_flown_by_one_launch_file(tmp_path: Path) -> None:
    shared: Any = SimpleNamespace(length=bench.QUICK)
    cases: list[tuple[str, str, str, Callable[[Any], tuple[int, int]], tuple[int, int]]] = [
        ("lidars 16x512", "lidars", "points", lambda one: (one.channels, one.samples), (16, 512)),
        ("depth 640x480", "cameras", "depth_camera/depth/image_raw",
         lambda one: (one.pinhole.width, one.pinhole.height), (640, 480)),
    ]  # fmt: skip
    for sensors, key, topic, size, numbers in cases:
        arguments = sensing_flights.sensing_arguments(shared, {"vehicles": 2, "sensors": sensors}, tmp_path)
        assert (arguments["lidars"], arguments["cameras"]) == (
            str(key == "lidars").lower(),
            str(key == "cameras").lower(),
        )
        assert (arguments["topics"], arguments["participants"]) == (topic, 3)
        fleet = read_fleet_file(arguments["fleet"])
        assert [vehicle.name for vehicle in fleet] == ["iris_0", "iris_1"]
        (mount,) = getattr(load_vehicle(fleet[1].model), key)
        assert (mount.rate, topic.split("/")[0]) == (10.0, mount.name)
        assert size(mount) == numbers


def test_fleets_with_sensors_are_limited_by_the_program_with_most_cores() -> None:
    window = {"simulated": 10.0, "elapsed": 8.0, "received": {"pose": 600, "depth_camera/depth/image_raw": 600},
              "cpu": {"xtdrone_sim.cameras.camera_worker": 6.0, "simulator": 2.0}, "others": 0.5, "memory": 5,
              "processes": 6}  # fmt: skip
    events = [_event("armed", 1.0, 1003.0), _event("window", 30.0, 1009.0, **window)]
    row = {"vehicles": 6, "sensors": "depth 640x480"} | sensing_flights.sensing_figures(events, 1000.0)
    assert (row["real_time_factor"], row["frames_per_simulated_second"]) == (1.25, 60.0)
    assert row["cores"] == {"camera_worker": 0.75, "simulator": 0.25}
    lidars = row | {"sensors": "lidars 16x512", "overlap": 0.5}
    text = _printed({"machine": {"load_before": [0.1, 0.1, 0.1]}, "sensing": [row | {"overlap": 0.5}, lidars]})
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["6 depth 640x480", "1.25 x", "", "60.0", "50%", "camera_worker 0.75"] in lines
    assert ["6 lidars 16x512", "1.25 x", "1 x", "60.0", "50%", "camera_worker 0.75"] in lines
    assert "…" not in text  # it fits a terminal of 80 columns


def test_table_of_films() -> None:
    use = {"rviz_offscreen": 28.0, "ffmpeg": 18.5, "robot_tf": 1.0, "swarm_markers": 1.5}
    smooth = {"vehicles": 9, "width": 1280, "height": 720, "antialiasing": True, "frames_per_second": 31.25,
              "cpu_per_frame": use}  # fmt: skip
    rough = smooth | {"antialiasing": False, "frames_per_second": 50.0}
    text = _printed({"machine": {"load_before": [0.1, 0.1, 0.1]}, "rviz": [smooth, rough]})
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["9 vehicles, 1280 x 720 px", "31.25", "28.0", "18.5", "2.5"] in lines
    assert ["9 vehicles, 1280 x 720 px,", "50.00", "28.0", "18.5", "2.5"] in lines
    assert ["rough", "", "", "", ""] in lines


def test_table_of_the_analysis() -> None:
    row = {
        "megabytes": 1000,
        "megabytes_per_second": 250.0,
        "cpu_seconds": 4.5,
        "messages": 5_000_000,
        "memory_bytes": 6e8,
        "report_seconds": 12.34,
    }
    text = _printed({"machine": {"load_before": [0.1, 0.1, 0.1]}, "analyse": [row]})
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["1000 MB", "250.00", "100", "4.50", "5000000", "600", "12.3"] in lines
    assert printed_tables.short_result("analyse", row) == "250 MB/s, 600 MB of memory"


def test_table_of_the_telemetry() -> None:
    row = {
        "vehicles": 9,
        "messages": 6000.0,
        "microseconds": 8.0,
        "share": 0.048,
        "setpoint": 4.0,
        "read": 3.0,
    }
    text = _printed({"machine": {"load_before": [0.1, 0.1, 0.1]}, "telemetry": [row]})
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["9", "6000", "8000", "125000", "0.05", "4000", "3000"] in lines
    assert printed_tables.short_result("telemetry", row) == "8000 ns per datagram"


def test_tables_of_drawing_and_sweep() -> None:
    sweep = {"workers": 2, "one_worker": 20.0, "runs_per_second": 38.0, "speed_up": 1.9}
    drawing = {"vehicles": 100, "pictures_per_second": 45.25}
    results = {
        "machine": {"load_before": [0.1, 0.1, 0.1]},
        "drawing": [drawing, {"vehicles": 9, "error": "drawing: ended with status 1"}],
        "sweep": [
            sweep,
            sweep | {"runs_per_second": 40.0, "speed_up": 2.0},
            {"workers": 4, "error": "sweep: ended with status 1"},
        ],
    }
    text = _printed(results)
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in text.splitlines() if "│" in line]
    assert ["100", "45.25", "15"] in lines
    assert ["9", "failed", "failed"] in lines
    assert ["2", "39.00", "20.00", "1.95 x", "1.7 x"] in lines  # the medians
    assert ["4", *["failed"] * 4] in lines
    flat = " ".join(text.split())
    assert "sweep, 4 workers: failed: sweep: ended with status 1" in flat
    assert printed_tables.short_result("sweep", sweep) == "38.0 runs per second, 1.90 x those of one worker"
    assert printed_tables.short_result("drawing", drawing) == "45.2 images per second"


def test_drawing_and_sweep_pass_the_options_to_their_benchmarks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def run(shared: measurement_runner.Bench, part: str, name: str, module: str, arguments: list[str]) -> Any:
        asked.append((part, name, module, arguments))
        return [{"pictures_per_second": 1.0}] if part == "drawing" else [{"workers": 4, "speed_up": 3.0}]

    monkeypatch.setattr(measurement_runner, "run_program", run)
    with scripted_launch.StopRequest() as stop:
        shared = measurement_runner.Bench(tmp_path, stop, lambda text: None, bench.QUICK)
        (drawing, sweep) = (
            case.known | MEASUREMENTS[part].command(shared, case)
            for part, number in (("drawing", 30), ("sweep", 4))
            for case in MEASUREMENTS[part].cases(part, number, ())
        )
    assert (drawing["vehicles"], drawing["pictures_per_second"]) == (30, 1.0)
    assert (sweep["workers"], sweep["speed_up"]) == (4, 3.0)
    assert asked == [
        ("drawing", "drawing-30", "benchmarks.programs.drawing", ["--vehicles", "30", "--seconds", "1.0"]),
        ("sweep", "sweep-4", "benchmarks.programs.sweep", ["--workers", "4", "--seconds", "3.0"]),
    ]


def test_idle_machine_has_no_note() -> None:
    text = _printed({"machine": {"load_before": [0.4, 1.0, 1.0]}, "core": [_core_row(1, 90.0)]})
    assert "Note" not in text
    assert "90.00 x" in text


def test_machine_facts(tmp_path: Path) -> None:
    facts = machine_facts.machine_facts(tmp_path)
    assert facts["cores"] >= 1
    assert facts["memory_bytes"] > 2**28
    assert facts["kernel"]
    assert facts["python"] == ".".join(map(str, sys.version_info[:3]))
    assert facts["packages"]["numpy"]
    assert len(facts["load_before"]) == 3
    assert (facts["commit"], facts["changed_since_commit"]) == (None, None)  # no repository


def test_results_are_written_and_one_failure_leaves_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(shared: measurement_runner.Bench, case: measurement_runner.Case) -> dict[str, Any]:
        if case.known["vehicles"] == 9:
            raise measurement_runner.BenchError("core: ended with status 1")
        return _core_row(case.known["vehicles"], 50.0)

    core = dataclasses.replace(MEASUREMENTS["core"], command=measure)
    monkeypatch.setitem(MEASUREMENTS, "core", core)
    monkeypatch.setattr(bench, "calibrate", lambda: CALIBRATION)
    file = tmp_path / "new" / "b.json"
    assert cli.main(["bench", "--only", "core", "--vehicles", "9,30", "--quick", "--json", str(file)]) == 1
    results = json.loads(file.read_text())
    assert list(results) == ["schema", "started", "finished", "options", "machine", "calibration", "core"]
    assert results["schema"] == 1
    assert results["finished"] >= results["started"]
    assert results["options"]["vehicles"] == {"core": [9, 30]}
    assert results["core"][0] == {"vehicles": 9, "repeat": 1, "error": "core: ended with status 1"}
    assert results["core"][1] == {"vehicles": 30, "repeat": 1} | _core_row(30, 50.0)
    assert list(file.parent.iterdir()) == [file]


# ---- baseline


FAKE_BENCH = """\
#!{python}
import json, os, signal, subprocess, sys, time
option = dict(zip(sys.argv, sys.argv[1:]))
if sys.argv[1] == "setup":
    open("{folder}/set-up", "a").write("x")
elif option["--only"] == "core":
    row = dict(vehicles=9, real_time_factor={speed}, cpu=1.5, load_before=1.0, repeat=1)
    json.dump(dict(core=[row]), open(option["--json"], "w"))
elif option["--only"] == "barrier":
    print("xtdrone: part is unknown")
    sys.exit(2)
else:
    subprocess.Popen([sys.executable, "-c", "MARK = {folder!r}; import time; time.sleep(600)"], start_new_session=True)
    with open(f"/proc/{{os.getppid()}}/stat") as file:  # of what guards this process
        os.kill(int(file.read().rpartition(")")[2].split()[1]), signal.SIGINT)
    time.sleep(600)
"""


def _program(folder: Path, speed: str) -> None:
    (folder / "xtdrone").write_text(FAKE_BENCH.format(python=sys.executable, folder=str(folder), speed=speed))
    (folder / "xtdrone").chmod(0o755)


@pytest.fixture
def commits(tmp_path: Path) -> Path:
    """A repository whose first commit runs at half the speed of its working tree."""
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "requirements.txt").write_text("numpy\n")
    (folder / ".gitignore").write_text("/.setup\n/set-up\n/.venv\n")
    (folder / ".venv").mkdir()
    (folder / ".venv" / ".requirements.installed").write_text("numpy\n")
    (folder / ".venv" / "package").write_text("kept")
    _program(folder, "2.0")
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "first"]):
        subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=b", "-C", folder, *words], check=True)
    _program(folder, "4.0")
    return folder


def _compare(commits: Path, monkeypatch: pytest.MonkeyPatch, parts: str) -> tuple[int, dict[str, Any]]:
    """Run the comparison with the first commit; return exit status and results."""
    monkeypatch.setattr(command_options, "check_vehicle_ports", lambda fleet: None)  # another simulation may be running
    monkeypatch.setattr(bench, "resolve", lambda name: compare_with_commit.resolve(name, commits))
    monkeypatch.setattr(bench, "calibrate", lambda: CALIBRATION)
    file = commits.with_name("b.json")
    arguments = ["--only", parts, "--vehicles", "9", "--repeat", "2", "--json", str(file), "--baseline", "HEAD"]
    return cli.main(["bench", *arguments]), json.loads(file.read_text())


def test_a_baseline_is_compared_figure_by_figure(
    commits: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status, results = _compare(commits, monkeypatch, "core,barrier")
    text = " ".join(capsys.readouterr().out.split())
    assert status == 1  # neither has the part barrier
    assert [(row["tree"], row["real_time_factor"]) for row in results["rows"]["core"]] == [
        ("baseline", 2.0),
        ("this", 4.0),
        ("this", 4.0),
        ("baseline", 2.0),
    ]
    assert results["trees"]["this"] == f"{results['trees']['baseline']} with changes"
    assert "│ 9 │ real_time_factor │ 2 │ 4 │ 2.000 │ │ │ │ 2 to 2 │ 4 to 4 │ │" in text
    assert "│ cpu │ 1.5 │ 1.5 │ 1.000 │" in text
    assert "load_before" not in text
    assert "barrier, 9, baseline: not measured by its benchmark: xtdrone: part is unknown" in text


def test_a_baseline_is_kept_with_the_same_packages(
    commits: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status, results = _compare(commits, monkeypatch, "core")
    kept = commits / ".setup" / "baselines" / results["trees"]["baseline"]
    assert (kept / ".venv" / "package").samefile(commits / ".venv" / "package")
    assert (kept / ".venv" / ".made-for").read_text() == str(kept / ".venv")
    assert (status, _compare(commits, monkeypatch, "core")[0]) == (0, 0)
    assert (commits / "set-up").read_text() == "xx"  # by the copy of its commit
    (kept / "requirements.txt").write_text("changed")
    assert _compare(commits, monkeypatch, "core")[0] == 1
    assert f"{kept} was changed after its checkout; remove that folder" in capsys.readouterr().err


def test_an_interrupted_comparison_leaves_nothing_running(commits: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    status, results = _compare(commits, monkeypatch, "stack")
    assert (status, results["finished"], results["rows"]) == (130, None, {})
    assert fake_roslaunch.running(str(commits)) == []


# the copy of its commit has run the set-up

FAKE_ROSLAUNCH = """\
#!{python}
# Starts a node in a session of its own, as roslaunch does, and then what the test wants.
import json, os, signal, subprocess, sys, time
subprocess.Popen([sys.executable, "-c", "MARK = {mark!r}; import time; time.sleep(600)"], start_new_session=True)
def argument(name):
    return next(word.partition(":=")[2] for word in sys.argv if word.startswith(name + ":="))
out = argument("out")
def event(name, **values):
    with open(out + "/events.jsonl", "a") as file:
        print(json.dumps(dict(event=name, time=1.0, wall=time.monotonic(), **values)), file=file)
def bench():  # the parent of what guards this process
    with open(f"/proc/{{os.getppid()}}/stat") as file:
        return int(file.read().rpartition(")")[2].split()[1])
{then}
"""


@pytest.mark.parametrize(
    ("then", "status", "message"),
    [
        ("event('start'); os.kill(bench(), signal.SIGINT); time.sleep(600)", 130, "stopped by SIGINT"),
        ("event('start'); os.kill(bench(), signal.SIGTERM); time.sleep(600)", 143, "stopped by SIGTERM"),
        ("print('FATAL: no plane'); sys.exit(1)", 1, "the launch ended early; FATAL: no plane"),
        ("print('[mavros-3] process has died', flush=True); time.sleep(600)", 1, "a node died at the start"),
        ("event('start'); event('failed', reason='iris_0: no wings'); time.sleep(600)", 1, "failed: iris_0: no wings"),
    ],
)
def test_nothing_is_left_running(tmp_path: Path, then: str, status: int, message: str) -> None:
    done, results, left = _bench_with_fake_roslaunch(tmp_path, then, ["--only", "stack", "--vehicles", "1"])
    assert done.returncode == status, done.stdout + done.stderr
    assert message in " ".join(done.stdout.split())
    assert left == []
    assert (results["finished"] is None) == (status > 128)


SEARCH_FLIGHT = """
import glob
plans = sorted(os.path.basename(path) for path in glob.glob(argument("plans") + "/*.plan"))
assert plans == [f"typhoon_h480_{i}.plan" for i in range(6)], plans
assert "<actor" not in open(argument("world")).read()
assert (argument("camera_rate"), argument("window")) == ("5", "10.0"), sys.argv
open(out + "/flight/flight.bag", "w").write("large")
event("start")
event("progress", phase="searching")
event("window", simulated=10.0, elapsed=4.0, pictures=300, dropped=0, cpu={"yolo": 3.0, "record": 1.0}, others=0.4,
      memory=5, processes=6)
event("done")
"""


def test_search_flies_over_a_world_without_people(tmp_path: Path) -> None:
    arguments = ["--only", "search", "--vehicles", "search=5", "--quick"]
    done, results, left = _bench_with_fake_roslaunch(tmp_path, SEARCH_FLIGHT, arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    assert left == []
    (row,) = results["search"]
    assert (row["vehicles"], row["camera_rate"], row["real_time_factor"]) == (6, 5, 2.5)
    assert row["pictures_per_simulated_second"] == 30.0
    assert row["cpu_share"]["yolo"] == 0.75
    assert "search, 5 Hz: 2.50 x real time" in " ".join(done.stdout.split())
    assert list((tmp_path / "b-logs" / "search-5" / "flight").iterdir()) == []  # no bag is left


def _bench_with_fake_roslaunch(
    folder: Path, then: str, arguments: list[str]
) -> tuple[subprocess.CompletedProcess[str], dict[str, Any], list[str]]:
    """Run the benchmark with a roslaunch that executes ``then``; return status, results and surviving processes."""
    mark = f"xtdrone-test-{os.getpid()}-{folder.name}"
    path = fake_roslaunch.install(folder, FAKE_ROSLAUNCH.format(python=sys.executable, mark=mark, then=then))
    file = folder / "b.json"
    program = textwrap.dedent(f"""
        import sys
        from benchmarks import bench_cli
        from xtdrone_interaction import cli, command_options
        bench_cli.calibrate = lambda: {CALIBRATION}
        command_options.check_vehicle_ports = lambda fleet: None
        sys.exit(cli.main(["bench", *{arguments!r}, "--json", {str(file)!r}]))
    """)
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        check=False,
    )
    return done, json.loads(file.read_text()), fake_roslaunch.running(mark)
