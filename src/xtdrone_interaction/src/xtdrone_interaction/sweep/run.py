"""One run of a study: a function of plain data that flies a swarm without ROS and returns a row of figures."""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from xtdrone_coordination.follower import Follower, FollowerOptions
from xtdrone_coordination.leader import Leader, LeaderOptions
from xtdrone_coordination.network import NetworkOptions
from xtdrone_coordination.patterns import Patterns, with_leader
from xtdrone_interaction.formation_geometry import Array, least_distances
from xtdrone_interaction.metrics.formation import measure
from xtdrone_interaction.recording.formation import FormationRecord
from xtdrone_interaction.recording.model import Change
from xtdrone_interaction.recording.positions import FleetTrack
from xtdrone_interaction.sweep.parameters import CLASS, DEFAULTS, Value, group_of
from xtdrone_interaction.sweep.sources import Source, load
from xtdrone_swarm import Swarm
from xtdrone_swarm.simplified.model import load_model

COLLISION_DISTANCE = 0.5  # m between the middles of two vehicles; nearer ones have touched
_SOURCE = "truth (in one process)"
_LISTENING = 1.0  # s in the air before the first pattern
_MOST_ERROR = 500  # characters of an error that are kept

FIGURES: dict[str, type] = {
    "settled": bool,
    "settling_time": float,
    "overshoot": float,
    "steady_error": float,
    "least_distance": float,
    "collisions": int,
    "assigned_distance": float,
    "simulated_time": float,
    "wall_time": float,
}
"""Figures of every run and their types.

settled: whether every pattern settled; settling_time: of the slowest pattern, s, none unless all settled; overshoot and
steady_error: the greatest over patterns, m; least_distance: between any two vehicles from the first pattern's command
on, m; collisions: pairs of vehicles that came nearer than COLLISION_DISTANCE; assigned_distance: sum over patterns, m;
simulated_time and wall_time: s. All but wall_time are the same to the last bit in every repetition.
"""

Row = dict[str, Any]


def fly_batch(common: Mapping[str, Any], tasks: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Fly several runs and return their rows in the same order.

    Args:
        common: what all runs of the study share: engine, flight, constants, sources.
        tasks: key, varied parameters and seed of each run.
    """
    with _quiet():
        return [fly_row(common, task) for task in tasks]


def fly_row(common: Mapping[str, Any], task: Mapping[str, Any]) -> Row:
    """Fly one run and return its row: key, seed, parameters, figures, error (None: it went well).

    A run that raises is a row with its error and no figures.
    """
    row: Row = {"key": task["key"], "seed": task["seed"], **task["varied"], "error": None}
    began = time.perf_counter()
    try:
        figures = fly(common, task["varied"], task["seed"])
    except (Exception, SystemExit) as error:  # whatever a user's class raises is a result of the study
        figures = {"error": _words(error)}
    return row | figures | {"wall_time": time.perf_counter() - began}


def fly(common: Mapping[str, Any], varied: Mapping[str, Value], seed: int) -> Row:
    """Fly one run and return its figures, those of the user's metric included."""
    parameters = {**DEFAULTS, **common["constants"], **varied}
    swarm = make_swarm(common, parameters, seed)
    try:
        names = str(parameters["patterns"]).split(",")
        if common["flight"] == "mission":
            record = _mission(swarm, names)
        else:
            record = _airborne(swarm, names, float(parameters["hold"]), float(parameters["limit"]))
    finally:
        swarm.close()
    figures = figures_of(record)
    metric = _loaded(common, "metric", None)
    return figures | (_checked_metric(metric(record), varied) if metric else {})


def make_swarm(common: Mapping[str, Any], parameters: Mapping[str, Value], seed: int) -> Swarm:
    """Return the swarm of a run at its start.

    Args:
        common: see :func:`fly_batch`.
        parameters: all of them, defaults included.
        seed: of the places at the start, the network and, in full physics, the sensors.
    """
    count, kind = int(parameters["n"]), str(parameters["kind"])
    airborne = common["flight"] == "airborne"
    places = start_places(count, float(parameters["scatter"]), seed)
    options = make_options(parameters)
    settings: Row = {
        "follower": _follower_class(common, parameters),
        "leader": _loaded(common, "leader", Leader),
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
    """Return where vehicles begin, shape (count, 3), m ENU on the ground: the spawn grid, each moved a little.

    Args:
        count: number of vehicles.
        scatter: greatest way along x and along y, m; the grid's pitch is 3 m.
        seed: of the ways.
    """
    places = with_leader(Patterns(count).offsets("origin"))
    places[:, :2] += np.random.default_rng(seed).uniform(-scatter, scatter, (count, 2))
    return places


def make_options(parameters: Mapping[str, Value]) -> dict[str, Any]:
    """Return the settings of follower, leader, model and network; network is None when nothing is said of it.

    Raises:
        ValueError: a combination that is not allowed.
    """
    network, model = group_of(parameters, "network"), group_of(parameters, "model")
    return {
        "follower": FollowerOptions(**group_of(parameters, "follower")),  # type: ignore[arg-type]
        "leader": LeaderOptions(**group_of(parameters, "leader")),  # type: ignore[arg-type]
        "model": dataclasses.replace(load_model(str(parameters["kind"])), **model),  # type: ignore[arg-type]
        "network": NetworkOptions(**network) if network else None,  # type: ignore[arg-type]
    }


def check_options(parameters: Mapping[str, Value]) -> None:
    """Check a combination of settings.

    Raises:
        ValueError: it is not allowed.
    """
    make_options({**DEFAULTS, **parameters})


def figures_of(record: FormationRecord) -> Row:
    """Return the figures of a flight, all but wall_time; see FIGURES."""
    track = record.track
    changes = measure(record, track)
    if not changes:
        raise RuntimeError(f"no pattern was flown: {_ending(record)}")
    distances = track.between(changes[0].command_time, math.inf).position
    settled = all(change.settling_time is not None for change in changes)
    return {
        "settled": settled,
        "settling_time": max(change.settling_time or 0.0 for change in changes) if settled else None,
        "overshoot": max(change.overshoot for change in changes),
        "steady_error": max(change.steady_error_max for change in changes),
        "least_distance": float(least_distances(distances).min()),
        "collisions": collided_pairs(distances),
        "assigned_distance": sum(change.assigned_distance for change in changes),
        "simulated_time": record.events[-1]["time"] - record.events[0]["time"],
    }


def collided_pairs(positions: Array, limit: float = COLLISION_DISTANCE) -> int:
    """Return how many pairs of vehicles came nearer than ``limit`` metres.

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


def _airborne(swarm: Swarm, patterns: Sequence[str], hold: float, limit: float) -> FormationRecord:
    """Fly patterns in turn from the air, each until all followers have settled or the limit is over."""
    swarm.run(_LISTENING)  # else the leader assigns by the grid: over a network it has heard of nobody yet
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


def _mission(swarm: Swarm, patterns: Sequence[str]) -> FormationRecord:
    """Fly the demo's whole mission, takeoff to landing."""
    from xtdrone_interaction.swarm_flight import fly_formation

    record = fly_formation(swarm, patterns)
    if record.events[-1]["event"] != "done":
        raise RuntimeError(_ending(record))
    return record


def _ending(record: FormationRecord) -> str:
    last = record.events[-1]
    return f"the flight ended with {last['event']!r}: {last.get('reason', 'no reason given')}"


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the warnings of thousands of flights off the screen: what they are about shows in the figures."""
    loggers = [logging.getLogger(name) for name in ("xtdrone_coordination", "xtdrone_sim", "xtdrone_control")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _loaded(common: Mapping[str, Any], role: str, default: Any) -> Any:
    source = common["sources"].get(role)
    return load(role, Source(**source)) if source else default


def _follower_class(common: Mapping[str, Any], parameters: Mapping[str, Value]) -> type[Follower]:
    """Return the follower's class, with its attributes as the run has them."""
    own = tuple(sorted((name[len(CLASS) :], value) for name, value in parameters.items() if name.startswith(CLASS)))
    return _with_attributes(_loaded(common, "follower", Follower), own)


@functools.lru_cache(maxsize=64)
def _with_attributes(cls: type[Follower], attributes: tuple[tuple[str, Value], ...]) -> type[Follower]:
    return type(cls.__name__, (cls,), {**dict(attributes), "__module__": cls.__module__}) if attributes else cls


def _checked_metric(values: object, varied: Mapping[str, Value]) -> Row:
    """Return what a user's metric gave as floats; a number that is not finite is none.

    Args:
        values: what it gave.
        varied: the varied parameters, whose names are taken too.

    Raises:
        TypeError: it is no mapping of names to numbers.
        ValueError: a name is taken.
    """
    if not isinstance(values, Mapping):
        raise TypeError(f"metric gave {values!r}; a mapping of names to numbers is allowed")
    found: Row = {}
    for name, value in values.items():
        taken = ("key", "seed", "error", *FIGURES, *varied)
        if not isinstance(name, str) or not name or name in taken:
            raise ValueError(f"metric gave the name {name!r}; other names than {', '.join(taken)} are allowed")
        if isinstance(value, str | bytes) or not np.isscalar(value):
            raise TypeError(f"metric gave {name}={value!r}; a number is allowed")
        number = float(value)  # type: ignore[arg-type]
        found[name] = number if math.isfinite(number) else None
    return found


def _words(error: BaseException) -> str:
    """Return an error as text: its kind, what it says, and the line of code it came from."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({frames[-1].filename.rpartition('/')[2]}:{frames[-1].lineno})" if frames else ""
    try:
        said = str(error)
    except Exception:  # a user's exception may have a broken __str__
        said = "it cannot be written"
    return f"{type(error).__name__}: {said}{place}"[:_MOST_ERROR]


Work = Callable[[Mapping[str, Any], Sequence[Mapping[str, Any]]], list[Row]]
