"""Metrics of a formation flight: settling, overshoot, steady error, distances, assignment.

A *reconfiguration* lasts from the command of a pattern to the director's next phase. A follower's error is the distance
from its position to its slot, the leader's position plus the follower's assigned offset.
"""

from __future__ import annotations

import os
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xtdrone_coordination.leader import assign
from xtdrone_interaction.missions.formation.criteria import (
    ASSIGNMENT_SLACK,
    CRITERIA,
    SETTLED_ERROR,
    STEADY_LIMIT,
)
from xtdrone_interaction.missions.formation.record import FormationRecord
from xtdrone_interaction.recording.distances import DISTANCE_LIMIT, Array, close_pairs, formation_error, relative
from xtdrone_interaction.recording.positions import FleetTrack
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.report_json import versions

STEADY_SPAN = 2.0  # s; the steady error is taken over the window's last part
_SHORT_STEP = 0.5  # m; the overshoot of a follower whose slot is nearer than this does not count
_PAIRS = 10  # listed of the pairs that came too close


@dataclass(frozen=True)
class Reconfiguration:
    """Metrics of one change of the formation.

    Attributes:
        pattern: name.
        command_time: simulated time of the command, s.
        end_time: end of the window, s.
        settling_time: s from the command until all followers are within SETTLED_ERROR and stay there, None if never.
        overshoot: maximum distance flown past a slot, over the followers, m.
        overshoot_percent: the same relative to that follower's step, %.
        steady_error_mean: over followers and the last STEADY_SPAN of the window, m.
        steady_error_max: the maximum error in that span, m.
        least_distance: minimum distance between two vehicles in the window, m.
        assigned_distance: total from the positions at the command to the assigned slots, relative to the leader, m.
        optimal_distance: the minimum possible total, m.
    """

    pattern: str
    command_time: float
    end_time: float
    settling_time: float | None
    overshoot: float
    overshoot_percent: float
    steady_error_mean: float
    steady_error_max: float
    least_distance: float
    assigned_distance: float
    optimal_distance: float


def settling_time(time: Array, error: Array, limit: float = SETTLED_ERROR) -> float | None:
    """Return the time from ``time[0]`` until every error is within ``limit`` and stays, or None.

    Args:
        time: shape (t,), s.
        error: shape (t, m), m.
        limit: m.
    """
    outside = np.flatnonzero((error > limit).any(axis=1))
    if outside.size == 0:
        return 0.0
    first = int(outside[-1]) + 1
    return float(time[first] - time[0]) if first < len(time) else None


def overshoot(places: Array, offsets: Array) -> tuple[float, float]:
    """Return the maximum overshoot (m, % of the follower's step) over all followers.

    A follower's overshoot is how far it flies past its slot along the straight line from its first position.

    Args:
        places: positions relative to the leader, shape (t, m, 3), m.
        offsets: slots relative to the leader, shape (m, 3), m.
    """
    step = offsets - places[0]
    length = np.linalg.norm(step, axis=1)
    far = length > _SHORT_STEP
    if not far.any():
        return 0.0, 0.0
    direction = step[far] / length[far, None]
    past = np.einsum("tmk,mk->tm", places[:, far] - offsets[far], direction).max(axis=0).clip(min=0.0)
    worst = int(past.argmax())
    return float(past[worst]), float(100.0 * past[worst] / length[far][worst])


def assignment_distances(before: Array, after: Array) -> tuple[float, float]:
    """Return the total distance (as assigned, least), m, from positions ``before`` to slots ``after``, each (m, 3)."""
    return float(np.linalg.norm(before - after, axis=1).sum()), assign(before, after).cost


def flight_part(record: FormationRecord, track: FleetTrack) -> FleetTrack:
    """Return the part of ``track`` from the beginning of takeoff on.

    Raises:
        RecordError: there is none.
    """
    starts = [p["time"] for p in record.phases if p["phase"] == "takeoff"]
    if not starts:
        raise RecordError("flight record: there was no takeoff")
    part = track.between(starts[0], np.inf)
    if not len(part.time):
        raise RecordError(
            f"flight record: it is cut, the positions end at {track.time[-1]:.1f} s, before the takeoff at "
            f"{starts[0]:.1f} s"
        )
    return part


def measure(record: FormationRecord, track: FleetTrack) -> list[Reconfiguration]:
    """Return the metrics of every reconfiguration by ``track``; vehicles count until they are lost."""
    results = []
    lost = {record.names.index(event["vehicle"]): event["time"] for event in _lost(record)}
    known = record.estimate or track  # the leader assigns by estimates
    for window in record.windows:
        part = track.between(window.start, window.end)
        if len(part.time) < 2:
            raise RecordError(f"pattern {window.pattern!r}: no positions were recorded")
        gone = [index - 1 for index, time in lost.items() if time < window.end]
        if len(gone) == len(window.offsets):
            continue
        error = np.delete(formation_error(part.position, window.offsets), gone, axis=1)
        steady = error[part.time >= part.time[-1] - STEADY_SPAN]
        way, percent = overshoot(
            np.delete(relative(part.position), gone, axis=1), np.delete(window.offsets, gone, axis=0)
        )
        assigned, optimal = assignment_distances(
            relative(known.between(window.start, window.end).position[0]), window.offsets
        )
        results.append(
            Reconfiguration(
                pattern=window.pattern,
                command_time=window.start,
                end_time=window.end,
                settling_time=settling_time(part.time, error),
                overshoot=way,
                overshoot_percent=percent,
                steady_error_mean=float(steady.mean()),
                steady_error_max=float(steady.max()),
                least_distance=float(track.least_distance[track.part(window.start, window.end)].min()),
                assigned_distance=assigned,
                optimal_distance=optimal,
            )
        )
    return results


def make_report(record: FormationRecord, settings: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return the report of a flight as plain data.

    Args:
        record: the flight.
        settings: of the flight (seed, speed, ...), stored as they are; ``command_wall``, the monotonic time of the
            command in s, gives the start-up time.

    Raises:
        RecordError: the flight ended before takeoff.
    """
    settings = dict(settings or {})
    track = record.track
    flight = flight_part(record, track)
    distances = track.least_distance[len(track.time) - len(flight.time) :]
    reconfigurations = measure(record, track)
    first, last = record.events[0], record.events[-1]
    timed = [event for event in record.events if "wall" in event]  # only events in the file have wall times
    wall = timed[-1]["wall"] - timed[0]["wall"] if timed else None
    report: dict[str, Any] = {
        "outcome": last["event"],
        "vehicles": list(record.names),
        "positions": track.source,
        "reconfigurations": [asdict(r) for r in reconfigurations],
        "least_distance": float(distances.min()),
        "least_distance_time": float(flight.time[distances.argmin()]),
        "too_close": _too_close(record.names, flight, distances),
        "collisions": record.collisions,
        "cut": record.cut,
        "unrecorded": [window.pattern for window in record.unrecorded],
        "end_time": last["time"],
        "sim_time": last["time"] - first["time"],
        "wall_time": wall,
        "real_time_factor": (timed[-1]["time"] - timed[0]["time"]) / wall if wall else None,
        "startup_time": _startup_time(record, settings.pop("command_wall", None)),
        "settings": settings,
        "limits": {
            "settled_error": SETTLED_ERROR,
            "steady_error": STEADY_LIMIT,
            "least_distance": DISTANCE_LIMIT,
        },
        "versions": versions(),
        "machine": {"cpu": _cpu_name(), "cores": os.cpu_count(), "system": platform.platform()},
    }
    if record.truth is not None and record.estimate is not None:
        report["by_estimate"] = [asdict(r) for r in measure(record, record.estimate)]
    report["lost"] = [{key: event[key] for key in ("vehicle", "time", "reason")} for event in _lost(record)]
    report["shortcomings"] = shortcomings(report)
    return report


def _lost(record: FormationRecord) -> list[dict[str, Any]]:
    """Return the director's events of lost vehicles."""
    return [event for event in record.events if event["event"] == "lost"]


def _too_close(names: tuple[str, ...], flight: FleetTrack, nearest: Array) -> dict[str, Any]:
    """Return the number of pairs closer than DISTANCE_LIMIT, when they were, and the closest of them."""
    found = close_pairs(flight.position, DISTANCE_LIMIT, nearest)
    closest = sorted(found.items(), key=lambda item: item[1][1])[:_PAIRS]
    times = flight.time[nearest < DISTANCE_LIMIT]
    return {
        "pairs": len(found),
        "vehicles": len({i for pair in found for i in pair}),
        "first_time": float(times[0]) if len(times) else None,
        "last_time": float(times[-1]) if len(times) else None,
        "closest": [
            {"vehicles": [names[i], names[j]], "distance": distance, "time": float(flight.time[row])}
            for (i, j), (row, distance) in closest
        ],
    }


def _too_close_text(found: dict[str, Any]) -> str:
    worst = found["closest"][0]
    text = f"minimum distance {worst['distance']:.2f} m ({' and '.join(worst['vehicles'])}, at {worst['time']:.1f} s), "
    text += f"at least {DISTANCE_LIMIT} m"
    if found["pairs"] == 1:
        return text
    return (
        f"{text}; {found['pairs']} pairs of {found['vehicles']} vehicles came closer, "
        f"between {found['first_time']:.1f} and {found['last_time']:.1f} s"
    )


def _cut_text(report: dict[str, Any]) -> str:
    end = report["end_time"]
    missing = ", ".join(report["unrecorded"])
    return (
        f"the record is cut: positions end at {report['cut']:.1f} s, the flight at {end:.1f} s"
        f"{'; patterns not judged: ' * bool(missing)}{missing}"
    )


def shortcomings(report: dict[str, Any]) -> list[str]:
    """Return where the flight fell short, as sentences; none for a good flight.

    Criteria that ``waive`` of the flight's settings names (see ``formation.criteria``) do not count.
    """
    judged = CRITERIA.keys() - set(report["settings"].get("waive", ()))
    found = []
    if report["cut"] is not None:
        found.append(_cut_text(report))
    if report["outcome"] != "done":
        found.append(f"the flight ended with {report['outcome']!r}")
    for item in report["lost"]:
        found.append(f"{item['vehicle']} was lost at {item['time']:.1f} s: {item['reason']}")
    for item in report["reconfigurations"]:
        name = item["pattern"]
        if item["settling_time"] is None and "settling" in judged:
            found.append(f"pattern {name!r} did not settle within {SETTLED_ERROR} m")
        elif item["steady_error_mean"] > STEADY_LIMIT and "steady-error" in judged:
            error = item["steady_error_mean"]
            found.append(f"pattern {name!r}: steady error {error:.3f} m, at most {STEADY_LIMIT} m")
        most = item["optimal_distance"] * (1 + ASSIGNMENT_SLACK) + 0.01
        if item["assigned_distance"] > most and "assignment" in judged:
            found.append(
                f"pattern {name!r}: assigned distance {item['assigned_distance']:.2f} m, "
                f"the optimum is {item['optimal_distance']:.2f} m"
            )
    if report["least_distance"] < DISTANCE_LIMIT and "distance" in judged:
        found.append(_too_close_text(report["too_close"]))
    return found + (report["collisions"] if "collision" in judged else [])


def _startup_time(record: FormationRecord, command_wall: float | None) -> float | None:
    """Return the wall time from the command to the first armed vehicle, s."""
    armed = [e["wall"] for e in record.events if e["event"] == "armed" and "wall" in e]
    return armed[0] - command_wall if armed and command_wall is not None else None


def _cpu_name() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()
