"""One run of a study: a function that flies a swarm without ROS and returns a row of figures."""

from __future__ import annotations

import functools
import logging
import math
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_coordination.patterns import Patterns, with_leader
from xtdrone_interaction.missions.formation.metrics import measure
from xtdrone_interaction.missions.formation.record import FormationRecord
from xtdrone_interaction.recording.distances import Array, least_distances
from xtdrone_interaction.recording.positions import FleetTrack
from xtdrone_interaction.recording.recorded_flight import Change
from xtdrone_interaction.studies.result_store import COLLISION_DISTANCE, FIGURES, Row
from xtdrone_interaction.studies.study_parameters import CLASS, DEFAULTS, Value, make_options
from xtdrone_interaction.studies.user_code import Source, load
from xtdrone_swarm import Swarm

_SOURCE = "truth (in one process)"
_LISTENING = 1.0  # s in the air before the first pattern
_MOST_ERROR = 500  # characters of an error message

QUIET_PACKAGES = ("xtdrone_coordination", "xtdrone_sim", "xtdrone_control", "xtdrone_autopilot", "xtdrone_common")
"""Packages whose warnings a run does not show."""


def fly_batch(common: Mapping[str, Any], tasks: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Fly several runs and return their rows in the same order.

    Args:
        common: data that all runs share: engine, flight, constants, sources.
        tasks: key, varied parameters and seed of each run.
    """
    with _quiet():
        return [fly_row(common, task) for task in tasks]


def fly_row(common: Mapping[str, Any], task: Mapping[str, Any]) -> Row:
    """Fly one run and return its row: key, seed, parameters, figures, error (None for success).

    If a run raises, its row has the error and no figures.
    """
    row: Row = {"key": task["key"], "seed": task["seed"], **task["varied"], "error": None}
    began = time.perf_counter()
    try:
        figures = fly(common, task["varied"], task["seed"])
    except (Exception, SystemExit) as error:  # an exception in a user's class is a result of the study
        figures = {"error": _describe_error(error)}
    return row | figures | {"wall_time": time.perf_counter() - began}


def fly(common: Mapping[str, Any], varied: Mapping[str, Value], seed: int) -> Row:
    """Fly one run and return its figures, including those of the user's metric."""
    parameters = {**DEFAULTS, **common["constants"], **varied}
    swarm = make_swarm(common, parameters, seed)
    try:
        names = str(parameters["patterns"]).split(",")
        if common["flight"] == "mission":
            record = _fly_mission(swarm, names)
        else:
            record = _fly_airborne(swarm, names, float(parameters["hold"]), float(parameters["limit"]))
    finally:
        swarm.close()
    figures = compute_figures(record)
    metric = _load(common, "metric", None)
    return figures | (_check_metric(metric(record), varied) if metric else {})


def make_swarm(common: Mapping[str, Any], parameters: Mapping[str, Value], seed: int) -> Swarm:
    """Return the swarm of a run at its start.

    Args:
        common: see :func:`fly_batch`.
        parameters: all of them, including defaults.
        seed: of the initial positions, the network and, in full physics, the sensors.
    """
    count, kind = int(parameters["n"]), str(parameters["kind"])
    airborne = common["flight"] == "airborne"
    places = start_places(count, float(parameters["scatter"]), seed)
    options = make_options(parameters)
    settings: Row = {
        "follower": _follower_class(common, parameters),
        "leader": _load(common, "leader", Leader),
        "follower_options": options["follower"],
        "leader_options": options["leader"],
        "seed": seed,
    }
    if options["network"] is not None:
        settings["network"] = options["network"]
    if common["engine"] == "core":
        from xtdrone_swarm.full_vehicles import CoreVehicles

        vehicles: Any = CoreVehicles(count, kind=kind, places=places, seed=seed)
        return Swarm(count, vehicles=vehicles, **settings)
    if airborne:
        places[:, 2] = float(parameters["altitude"])
    return Swarm(count, kind=kind, model=options["model"], places=places, airborne=airborne, **settings)


def start_places(count: int, scatter: float, seed: int) -> Array:
    """Return the initial positions, shape (count, 3), m ENU on the ground: the spawn grid with random offsets.

    Args:
        count: number of vehicles.
        scatter: largest offset along x and y, m; the grid has a pitch of 3 m.
        seed: of the offsets.
    """
    places = with_leader(Patterns(count).offsets("origin"))
    places[:, :2] += np.random.default_rng(seed).uniform(-scatter, scatter, (count, 2))
    return places


def compute_figures(record: FormationRecord) -> Row:
    """Return the figures of a flight, all but wall_time; see FIGURES."""
    track = record.track
    changes = measure(record, track)
    if not changes:
        raise RuntimeError(f"no pattern was flown: {_describe_end(record)}")
    distances = track.between(changes[0].command_time, math.inf).position
    settled = all(change.settling_time is not None for change in changes)
    return {
        "settled": settled,
        "settling_time": max(change.settling_time or 0.0 for change in changes) if settled else None,
        "overshoot": max(change.overshoot for change in changes),
        "steady_error": max(change.steady_error_max for change in changes),
        "least_distance": float(least_distances(distances).min()),
        "collisions": count_collided_pairs(distances),
        "assigned_distance": sum(change.assigned_distance for change in changes),
        "simulated_time": record.events[-1]["time"] - record.events[0]["time"],
    }


def count_collided_pairs(positions: Array, limit: float = COLLISION_DISTANCE) -> int:
    """Return the number of pairs of vehicles that came closer than ``limit``.

    Args:
        positions: shape (t, n, 3), m.
        limit: m.
    """
    from scipy.spatial import cKDTree

    nearest = least_distances(positions)
    pairs: set[tuple[int, int]] = set()
    for places in positions[nearest < limit]:
        pairs |= cKDTree(places).query_pairs(np.nextafter(limit, 0.0))
    return len(pairs)


def _fly_airborne(swarm: Swarm, patterns: Sequence[str], hold: float, limit: float) -> FormationRecord:
    """Fly patterns in turn from the air, each until all followers have settled or its time limit."""
    # Otherwise the leader would assign slots before it has received any position over the network
    swarm.run(_LISTENING)
    names = tuple(swarm.vehicles.names)
    events: list[Row] = [{"event": "start", "time": swarm.time, "vehicles": list(names)}]
    changes: list[Change] = []
    topologies: list[Change] = []
    for name in patterns:
        events.append({"event": "phase", "phase": f"pattern {name}", "pattern": name, "time": swarm.time})
        swarm.choose(name)
        offsets, began = np.array(swarm.leader.offsets), swarm.time
        events.append({"event": "assigned", "time": began, "offsets": offsets.tolist()})
        changes.append(Change(began, offsets))
        topologies.append(Change(began, np.array(swarm.leader.adjacency)))
        swarm.run_until(hold=hold, limit=limit)
    events.append({"event": "done", "time": swarm.time})
    assert swarm.record is not None
    truth = FleetTrack(_SOURCE, np.array(swarm.record.times), np.array(swarm.record.positions))
    return FormationRecord(names, truth, None, changes, topologies, events)


def _fly_mission(swarm: Swarm, patterns: Sequence[str]) -> FormationRecord:
    """Fly the demo's whole mission, takeoff to landing."""
    from xtdrone_interaction.missions.formation.swarm_flight import fly_formation

    record = fly_formation(swarm, patterns)
    if record.events[-1]["event"] != "done":
        raise RuntimeError(_describe_end(record))
    return record


def _describe_end(record: FormationRecord) -> str:
    last = record.events[-1]
    return f"the flight ended with {last['event']!r}: {last.get('reason', 'no reason given')}"


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the warnings of thousands of flights; their causes show in the figures."""
    loggers = [logging.getLogger(name) for name in QUIET_PACKAGES]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _load(common: Mapping[str, Any], role: str, default: Any) -> Any:
    source = common["sources"].get(role)
    return load(role, Source(**source)) if source else default


def _follower_class(common: Mapping[str, Any], parameters: Mapping[str, Value]) -> type[Follower]:
    """Return the follower's class with the attributes of the run."""
    own = tuple(sorted((name[len(CLASS) :], value) for name, value in parameters.items() if name.startswith(CLASS)))
    return _with_attributes(_load(common, "follower", Follower), own)


@functools.lru_cache(maxsize=64)
def _with_attributes(cls: type[Follower], attributes: tuple[tuple[str, Value], ...]) -> type[Follower]:
    return type(cls.__name__, (cls,), {**dict(attributes), "__module__": cls.__module__}) if attributes else cls


def _check_metric(values: object, varied: Mapping[str, Value]) -> Row:
    """Convert the result of a user's metric to floats; None for numbers that are not finite.

    Args:
        values: the result.
        varied: the varied parameters, whose names are reserved.

    Raises:
        TypeError: not a mapping of names to numbers.
        ValueError: reserved name.
    """
    if not isinstance(values, Mapping):
        raise TypeError(f"metric returned {values!r}; a mapping of names to numbers is allowed")
    found: Row = {}
    for name, value in values.items():
        taken = ("key", "seed", "error", *FIGURES, *varied)
        if not isinstance(name, str) or not name or name in taken:
            raise ValueError(f"metric returned the name {name!r}; other names than {', '.join(taken)} are allowed")
        if isinstance(value, str | bytes) or not np.isscalar(value):
            raise TypeError(f"metric returned {name}={value!r}; a number is allowed")
        number = float(value)  # type: ignore[arg-type]
        found[name] = number if math.isfinite(number) else None
    return found


def _describe_error(error: BaseException) -> str:
    """Format an error: type, message, and the line of code that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({frames[-1].filename.rpartition('/')[2]}:{frames[-1].lineno})" if frames else ""
    try:
        said = str(error)
    except Exception:  # the __str__ of a user's exception may raise
        said = "it cannot be written"
    return f"{type(error).__name__}: {said}{place}"[:_MOST_ERROR]
