"""One recorded flight, whatever file it was read from. Positions are ENU, metres."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from xtdrone_interaction.recording.flight_from_ulog import FlightLog
from xtdrone_interaction.recording.series_in_bounded_memory import Series
from xtdrone_interaction.recording.topics import TRUTH


class RecordError(ValueError):
    """A file that does not contain the expected flight."""


@dataclass(frozen=True)
class Change:
    """A new value on a topic that is repeated all the time.

    Attributes:
        time: when the recorder first received it, s of the recorder's clock.
        value: assigned offsets, shape (n - 1, 3), m, or a topology, shape (n, n).
    """

    time: float
    value: NDArray[Any]


@dataclass
class TopicStatistics:
    """Traffic on one topic.

    Attributes:
        name, type: of the topic.
        publishers: number of connections.
        count: number of messages.
        bytes: their total size.
        first, last: when they were recorded, ns of the recorder's clock.
    """

    name: str
    type: str
    publishers: int = 0
    count: int = 0
    bytes: int = 0
    first: int = 2**63 - 1
    last: int = -(2**63)

    @property
    def rate(self) -> float:
        """Messages per second; NaN for a single message."""
        span = (self.last - self.first) * 1e-9
        return (self.count - 1) / span if span > 0 else math.nan


@dataclass
class VehicleRecord:
    """All recorded data of one vehicle.

    Attributes:
        name: last part of its namespace.
        series: by quantity: "pose" (x, y, z in m; from bags also a quaternion x, y, z, w), "velocity" (m/s), "setpoint"
            and "target" (type mask, position, velocity), "position setpoint", "velocity setpoint"; XTDrone's
            "command" and "body command" (m/s), "acceleration command" and "body acceleration command" (m/s2),
            "avoidance" (m/s or m/s2); "battery" (V, share of full, A flowing in), "global" (degrees, m), "imu" (rad/s
            and m/s2, FLU).
        odometry: poses x, y, z (m), quaternion x, y, z, w by the node that found them, as "lidar_odometry".
        thinned: quantities of which not every message was kept.
        modes: start time and name of each flight mode.
        armed: time and new state of each arming and disarming.
        commands: time and text of the commands on XTDrone's command topic.
        texts: status texts of the autopilot: time, severity (0 worst to 7), text.
    """

    name: str
    series: dict[str, Series] = field(default_factory=dict)
    odometry: dict[str, Series] = field(default_factory=dict)
    thinned: set[str] = field(default_factory=set)
    modes: list[tuple[float, str]] = field(default_factory=list)
    armed: list[tuple[float, bool]] = field(default_factory=list)
    commands: list[tuple[float, str]] = field(default_factory=list)
    texts: list[tuple[float, int, str]] = field(default_factory=list)

    @property
    def position(self) -> Series | None:
        """Estimated position, m ENU, shape (t, 3)."""
        pose = self.series.get("pose")
        return Series(pose.time, pose.value[:, :3]) if pose is not None else None


@dataclass
class Recording:
    """One recorded flight.

    Attributes:
        path: of the first file.
        size: bytes of all files.
        notes: unreadable or doubtful parts, as sentences.
        cut: whether the file ends before its writer finished it.
        parts: number of flights in the file, separated by resets of simulated time; this is one of them.
        origin: zero of all times: 0 for simulated time, else s since 1970.
        duration: from the first to the last message, s.
        topics: sorted by name.
        vehicles: sorted by name.
        models: true positions by model name, m, each (t, 3); empty where no simulator ran.
        true_poses: x, y, z (m), quaternion x, y, z, w by name, where the truth's odometry was recorded.
        truth_source: description of ``models``, for captions.
        patterns: assigned offsets at each change.
        topologies: communication topologies at each change; row i: the vehicles that vehicle i listens to.
        events: of the formation director or the search mission: from ``events.jsonl`` beside the file, else
            as recorded.
        log: warnings and errors of nodes: time, level, node, text.
        collisions: the simulator's collision messages.
        messages: time and message, for the topics that were asked for.
        flight_log: the ULog, if the file is one.
    """

    path: Path
    size: int
    notes: list[str] = field(default_factory=list)
    cut: bool = False
    parts: int = 1
    origin: float = 0.0
    duration: float = 0.0
    topics: list[TopicStatistics] = field(default_factory=list)
    vehicles: list[VehicleRecord] = field(default_factory=list)
    models: dict[str, Series] = field(default_factory=dict)
    true_poses: dict[str, Series] = field(default_factory=dict)
    truth_source: str = TRUTH
    patterns: list[Change] = field(default_factory=list)
    topologies: list[Change] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    log: list[tuple[float, int, str, str]] = field(default_factory=list)
    collisions: list[str] = field(default_factory=list)
    messages: dict[str, list[tuple[float, Any]]] = field(default_factory=dict)
    flight_log: FlightLog | None = None

    @property
    def time_label(self) -> str:
        """Label of time axes."""
        return "time since the recording began [s]" if self.origin else "simulated time [s]"

    @property
    def positions(self) -> dict[str, Series]:
        """Positions by vehicle: the vehicle's own estimate, else the truth; m ENU, each (t, 3)."""
        known = {vehicle.name: vehicle.position or self.models.get(vehicle.name) for vehicle in self.vehicles}
        return {name: series for name, series in known.items() if series is not None}
