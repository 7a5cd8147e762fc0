"""The figures of a recorded landing: where the UAV has touched down, and how it approached."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xtdrone_interaction.missions.fleet_record import read_fleet
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.recording.series_in_bounded_memory import Array
from xtdrone_interaction.report.report_json import versions

TYPE, ROBOT = "iris_landing_camera", "ugv_0"
LIMIT = 0.15  # m, of the touchdown's error on a robot at up to 1 m/s
_AT_REST = 0.02  # m above the height at which the UAV stays
_SPAN = 0.1  # s before the touchdown over which velocities are taken


@dataclass(frozen=True)
class LandingRecord:
    """One landing.

    Attributes:
        time: of the true positions, (t,), s.
        uav, robot: true positions, (t, 3), m, ENU.
        events: of the director.
        detections: time of each picture, s, and whether it showed the board, (k, 2).
        collisions: the simulator's messages.
    """

    time: Array
    uav: Array
    robot: Array
    events: list[dict[str, Any]]
    detections: Array
    collisions: list[str]

    @property
    def offset(self) -> Array:
        """From the robot to the UAV, (t, 3), m, ENU."""
        return self.uav - self.robot


def read_landing(bag: Path, name: str, robot: str) -> LandingRecord:
    """Read a landing from its bag, and the events beside it.

    Raises:
        RecordError: the file cannot be read, or has no true positions of both.
    """
    topic = f"/{name}/tag_detections"
    recording, _ = read_fleet(bag, [name], [topic], [robot])
    if robot not in recording.models:
        raise RecordError(f"bag: {bag} has no true positions of {name} and {robot}; this is no record of a landing")
    platform = recording.models[robot]
    uav = recording.models[name].at(platform.time)
    known = np.isfinite(uav).all(axis=1)
    rows = [(_seconds(message.header.stamp), bool(message.detections)) for _, message in recording.messages[topic]]
    return LandingRecord(
        platform.time[known],
        uav[known],
        platform.value[known],
        recording.events,
        np.array(rows, float).reshape(-1, 2),
        recording.collisions,
    )


def make_report(record: LandingRecord, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a landing as plain data.

    Args:
        record: the landing.
        settings: of the flight, stored as they are.
    """
    events = {event["event"]: event for event in record.events}
    end = events.get("finished", {})
    landed = end.get("outcome") == "landed"
    touch = touchdown(record) if landed else None
    found = events.get("tags found", {}).get("time")
    stamps = record.detections[:, 0]
    until = np.inf if touch is None else touch["time"]
    shown = record.detections[(stamps >= (np.inf if found is None else found)) & (stamps <= until), 1]
    report: dict[str, Any] = {
        "outcome": end.get("outcome", "cut short"),
        "reason": end.get("reason", ""),
        "tags_found": found,
        "touchdown": touch,
        "final_error": float(np.hypot(*record.offset[-1, :2])) if landed else None,
        "landing_time": None if touch is None or found is None else touch["time"] - found,
        "in_sight": float(shown.mean()) if len(shown) else None,
        "pictures": len(record.detections),
        "simulated_time": float(record.time[-1]),
        "collisions": record.collisions,
        "settings": settings,
        "versions": versions(),
    }
    report["shortcomings"] = _shortcomings(report)
    return report


def touchdown(record: LandingRecord) -> dict[str, float] | None:
    """Return time, s, error, m, and velocities relative to the robot, m/s, of the first moment on the platform.

    None if the UAV ends beside the robot.
    """
    offset = record.offset
    height = float(offset[-1, 2])
    if height < 2.0 * _AT_REST:
        return None
    low = offset[:, 2] < height + _AT_REST
    above = np.flatnonzero(~low)
    index = int(above[-1]) + 1 if len(above) else 0
    if index >= len(offset):
        return None
    before = int(np.searchsorted(record.time, record.time[index] - _SPAN))
    velocity = (offset[index] - offset[before]) / max(record.time[index] - record.time[before], 1e-9)
    return {
        "time": float(record.time[index]),
        "error": float(np.hypot(*offset[index, :2])),
        "horizontal_velocity": float(np.hypot(*velocity[:2])),
        "vertical_velocity": float(velocity[2]),
    }


def _shortcomings(report: dict[str, Any]) -> list[str]:
    touch = report["touchdown"]
    if report["outcome"] != "landed" or touch is None:
        return [f"the UAV has not landed on the platform: {report['reason'] or report['outcome']}"]
    if touch["error"] > LIMIT:
        return [f"touchdown {touch['error']:.2f} m from the centre of the tags, more than {LIMIT:g} m"]
    return []


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)
