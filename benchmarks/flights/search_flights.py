"""Speed of the cooperative search with six camera vehicles, and the share of its CPU time by program."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measurement_runner import Bench, Event, Row, find
from xtdrone_common.fleet import parse_fleet, spawn_grid
from xtdrone_coordination.search.planning.plans import SearchOptions, plan_search, write_plans
from xtdrone_coordination.search.planning.region import read_region
from xtdrone_interaction.missions.search.prepare import ROWS, camera_of, generate_world, shipped_region
from xtdrone_worlds.worlds.sdf import write_world

SEARCHERS = 6
"""Number of vehicles."""
_TYPE = "typhoon_h480"
_SEED = 0  # of the world
# Slower and in narrower lanes than in a real search, so that no vehicle finishes before the measurement; the same for
# all camera rates, so that the rate is the only difference.
_PLANNED = SearchOptions(speed=2.5, overlap=0.8)
_PROGRAMS = {
    "cameras": ("cameras", "xtdrone_sim.cameras.camera_worker"),  # the node, and its rendering process
    "yolo": ("yolo",),
    "simulator": ("simulator",),
    "mavros": ("mavros_node",),
}
_OTHERS = "others"


def search_arguments(bench: Bench, known: Row, folder: Path) -> dict[str, Any]:
    """Write the world and the plans into ``folder``, and return the launch arguments of bench_search.launch."""
    flight = folder / "flight"
    shutil.rmtree(flight, ignore_errors=True)  # the mission control appends to its events
    flight.mkdir()
    return {
        "n": SEARCHERS,
        "type": _TYPE,
        "rows": ROWS,
        "camera_rate": known["camera_rate"],
        "window": bench.length.search_window,
        **_prepare(folder),
    }


def search_figures(events: Sequence[Event]) -> Row:
    """Return the figures of a search in a world without people, film and bag included, at unlimited speed.

    Args:
        events: of the probe.

    Returns:
        real_time_factor, window (``simulated`` and ``elapsed`` s, while all vehicles search),
        pictures_per_simulated_second (processed by the detector, of all cameras), dropped (images that it skipped),
        cpu_per_simulated_second (CPU s by program), cpu_share (by ``cameras``, ``yolo``, ``simulator``, ``mavros``,
        ``others``: share of the CPU time of the launch), others_cpu (cores used by programs outside the launch),
        memory_bytes, processes.

    Raises:
        BenchError: an event is missing.
    """
    window = find(events, "window")
    simulated, elapsed = window["simulated"], window["elapsed"]
    return {
        "real_time_factor": simulated / elapsed,
        "window": {"simulated": simulated, "elapsed": elapsed},
        "pictures_per_simulated_second": window["pictures"] / simulated,
        "dropped": window["dropped"],
        "cpu_per_simulated_second": {name: seconds / simulated for name, seconds in window["cpu"].items()},
        "cpu_share": shares(window["cpu"]),
        "others_cpu": window["others"] / elapsed,
        "memory_bytes": window["memory"],
        "processes": window["processes"],
    }


def shares(cpu: Mapping[str, float]) -> dict[str, float]:
    """Return the share of each group of programs in the CPU time of all, 0 to 1; all 0 if that is 0.

    Args:
        cpu: CPU s by program.
    """
    whole = sum(cpu.values()) or 1.0
    found = {group: sum(cpu.get(name, 0.0) for name in names) / whole for group, names in _PROGRAMS.items()}
    rest = sum(seconds for name, seconds in cpu.items() if not any(name in names for names in _PROGRAMS.values()))
    return {**found, _OTHERS: rest / whole}


def _prepare(folder: Path) -> dict[str, Any]:
    """Write the world and a plan for each vehicle, and return the launch arguments that name them."""
    region = read_region(shipped_region())
    world = generate_world(region, _SEED, persons=0)
    world_file, plans_folder = folder / "search.world", folder / "plans"
    world_file.write_text(write_world(world), encoding="utf-8")
    fleet = parse_fleet(f"{_TYPE}:{SEARCHERS}")
    homes = {vehicle.name: (x, y) for vehicle, (x, y, _) in zip(fleet, spawn_grid(fleet, ROWS), strict=True)}
    plans = plan_search(region, homes, camera_of(_TYPE), _PLANNED)
    write_plans(plans_folder, plans, _PLANNED, world.datum)
    return {"world": world_file, "plans": plans_folder}
