"""Speed of hovering fleets whose lidars or depth cameras are subscribed to, and the program that limits it."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from benchmarks.flights.stack_and_formation_flights import stack_figures
from benchmarks.measurement_runner import TYPE, Bench, Event, Row, find

LIDARS = "lidars 16x512"
SENSORS = (LIDARS, "depth 320x240", "depth 640x480")
"""The sensors of a fleet, one on each vehicle."""

_RATE = 10.0  # Hz
_CLIENT = 2  # lockstep participants besides the sensors' node: MAVROS layer and client
_MODEL = "sensing.yaml"
_LIDAR = {"name": "points", "kind": "spinning", "position": [0.0, 0.0, 0.06], "samples": 512, "channels": 16,
          "rate": _RATE, "noise": 0.01}  # fmt: skip
_CAMERA = {"name": "depth_camera", "kind": "depth", "link": "base_link", "position": [0.1, 0.0, 0.0],
           "frame_id": "depth_camera_optical_frame", "hfov": 1.047198, "rate": _RATE, "near": 0.05,
           "far": 100.0, "range_min": 0.05, "range_max": 10.0}  # fmt: skip


def sensing_arguments(bench: Bench, known: Row, folder: Path) -> dict[str, Any]:
    """Write the vehicles' description and the fleet into ``folder``, and return the arguments of bench.launch."""
    lidars = known["sensors"] == LIDARS
    sensor = {"lidars": [_LIDAR]} if lidars else {"cameras": [_CAMERA | _size(known["sensors"])]}
    model, fleet = folder / _MODEL, folder / "fleet.yaml"
    model.write_text(yaml.safe_dump({"extends": TYPE, **sensor}), encoding="utf-8")
    fleet.write_text(
        yaml.safe_dump([{"name": f"{TYPE}_{k}", "model": str(model)} for k in range(known["vehicles"])]),
        encoding="utf-8",
    )
    return {
        "fleet": fleet,
        "world": "outdoor",
        "lidars": str(lidars).lower(),
        "cameras": str(not lidars).lower(),
        "participants": _CLIENT + 1,
        "topics": _topic(known["sensors"]),
        "window": bench.length.window,
    }


def _size(sensors: str) -> dict[str, int]:
    width, height = (int(word) for word in sensors.removeprefix("depth ").split("x"))
    return {"width": width, "height": height}


def _topic(sensors: str) -> str:
    return "points" if sensors == LIDARS else "depth_camera/depth/image_raw"


def sensing_figures(events: Sequence[Event], began: float) -> Row:
    """Return the figures of ``stack_figures``, and those of the sensors.

    Args:
        events: of the client.
        began: monotonic wall time of the start of roslaunch, s.

    Returns:
        Also frames_per_simulated_second (scans or images received, of all vehicles together) and cores (busy cores by
        program).

    Raises:
        BenchError: an event is missing.
    """
    figures, window = stack_figures(events, began), find(events, "window")
    rates = figures["messages_per_simulated_second"]
    return {
        **figures,
        "frames_per_simulated_second": sum(rates.get(_topic(sensors), 0.0) for sensors in {SENSORS[0], SENSORS[1]}),
        "cores": {_short(name): seconds / window["elapsed"] for name, seconds in window["cpu"].items()},
    }


def limiting(rows: Sequence[Row]) -> str:
    """Return the program that occupies most cores, and how many (median)."""
    cores = {
        name: statistics.median(row["cores"].get(name, 0.0) for row in rows) for row in rows for name in row["cores"]
    }
    if not cores:
        return ""
    most = max(cores, key=lambda name: cores[name])
    return f"{most} {cores[most]:.2f}"


def _short(program: str) -> str:
    """Return the name of a program without its packages: ``camera_worker`` of ``xtdrone_sim.cameras.camera_worker``."""
    return program.rpartition(".")[2]
