"""The benchmark's cooperative search: how fast six vehicles with cameras search, and what takes the CPU time."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from xtdrone_control.fleet import parse_fleet, spawn_grid
from xtdrone_coordination.search.plans import Datum, SearchOptions, plan_search, write_plans
from xtdrone_coordination.search.region import read_region
from xtdrone_interaction.bench_flight import Bench, Event, Row, find, fly, fresh_folder
from xtdrone_interaction.search_prepare import ROWS, camera_of, made_world, shipped_region
from xtdrone_sim.worlds.sdf import write_world

SEARCHERS = 6
"""How many vehicles search."""
_TYPE = "typhoon_h480"
_SEED = 0  # of the world
# Slower and in narrower lanes than a search is flown, so that nobody is done before the measurement is; the same for
# all rates, so that they differ in nothing else.
_PLANNED = SearchOptions(speed=2.5, overlap=0.8)
_PROGRAMS = {
    "cameras": ("cameras", "xtdrone_sim.cameras.camera_worker"),  # the node, and the process that draws
    "yolo": ("yolo",),
    "simulator": ("simulator",),
    "mavros": ("mavros_node",),
}
_OTHERS = "others"


def measure_search(bench: Bench, camera_rate: int) -> Row:
    """Measure the cooperative search in a world without people, film and bag included, as fast as it goes.

    Args:
        bench: what all measurements share.
        camera_rate: pictures of each camera, Hz of simulated time.

    Returns:
        vehicles, camera_rate, real_time_factor, window (``simulated`` and ``elapsed`` s, while all search),
        pictures_per_simulated_second (of all cameras, that the detector looked at), dropped (those that it
        passed over), cpu_per_simulated_second (CPU s by program), cpu_share (by ``cameras``, ``yolo``, ``simulator``,
        ``mavros``, ``others``: of what all programs of the launch took), others_cpu (cores' worth that foreign programs
        took), memory_bytes, processes.

    Raises:
        BenchError: it failed.
    """
    row = {"vehicles": SEARCHERS, "camera_rate": camera_rate, "load_before": os.getloadavg()[0]}
    folder = fresh_folder(bench, f"search-{camera_rate}")
    flight = folder / "flight"
    shutil.rmtree(flight, ignore_errors=True)  # the mission control appends to its events
    flight.mkdir()
    arguments = {
        "n": SEARCHERS,
        "type": _TYPE,
        "rows": ROWS,
        "camera_rate": camera_rate,
        "window": bench.length.search_window,
        "out": folder,
        **_prepare(folder),
    }
    try:
        events = fly(bench, "bench_search.launch", arguments, folder, SEARCHERS, lambda event, root: None)
    finally:
        for bag in flight.glob("flight.bag*"):
            bag.unlink()  # large, and of no use here
    return row | search_figures(events)


def search_figures(events: Sequence[Event]) -> Row:
    """Return the figures of a search from the probe's events; see :func:`measure_search`."""
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
    """Return the share of each group of programs in what all took, 0 to 1; all 0 where none took anything.

    Args:
        cpu: CPU s by program.
    """
    whole = sum(cpu.values()) or 1.0
    found = {group: sum(cpu.get(name, 0.0) for name in names) / whole for group, names in _PROGRAMS.items()}
    rest = sum(seconds for name, seconds in cpu.items() if not any(name in names for names in _PROGRAMS.values()))
    return {**found, _OTHERS: rest / whole}


def _prepare(folder: Path) -> dict[str, Any]:
    """Write the world and a plan for each vehicle, and return the launch file's arguments for them."""
    region = read_region(shipped_region())
    world = made_world(region, _SEED, persons=0)
    world_file, plans_folder = folder / "search.world", folder / "plans"
    world_file.write_text(write_world(world), encoding="utf-8")
    fleet = parse_fleet(f"{_TYPE}:{SEARCHERS}")
    homes = {vehicle.name: (x, y) for vehicle, (x, y, _) in zip(fleet, spawn_grid(fleet, ROWS), strict=True)}
    plans = plan_search(region, homes, camera_of(_TYPE), _PLANNED)
    datum = Datum(world.datum.latitude, world.datum.longitude, world.datum.altitude)
    write_plans(plans_folder, plans, _PLANNED, datum)
    return {"world": world_file, "plans": plans_folder}
