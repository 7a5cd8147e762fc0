"""PX4's flight logs (ULog): what the usual plots need, read with pyulog, as far as a log is whole.

Frames are PX4's: positions and velocities north, east, down; angles of roll, pitch and yaw. Times count from the log's
beginning, s.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyulog import ULog

from xtdrone_control.autopilot import modes
from xtdrone_interaction.analysis.columns import Array, Series

MAGIC = b"ULog\x01\x12\x35"
TOPICS = (
    "actuator_motors",
    "actuator_outputs",
    "battery_status",
    "cpuload",
    "estimator_status",
    "failsafe_flags",
    "manual_control_setpoint",
    "sensor_combined",
    "sensor_gps",
    "vehicle_air_data",
    "vehicle_angular_velocity",
    "vehicle_attitude",
    "vehicle_attitude_setpoint",
    "vehicle_global_position",
    "vehicle_gps_position",
    "vehicle_imu_status",
    "vehicle_land_detected",
    "vehicle_local_position",
    "vehicle_local_position_setpoint",
    "vehicle_rates_setpoint",
    "vehicle_status",
)
"""Those that are shown; PX4 v1.11 to v1.16 have these names, older ones lack some."""
_ARMED = 2  # vehicle_status.arming_state
_STATES = {mode.state: mode.name for mode in modes.ALL} | {
    19: "AUTO.FOLLOW_TARGET",
    21: "ORBIT",
    22: "AUTO.VTOL_TAKEOFF",
}
_KINDS = frozenset(b"BFIMPQADRSOLC")  # of messages, by their letters
_HEADER = 16  # bytes


class LogError(ValueError):
    """A file of which nothing can be read as a flight log."""


@dataclass
class FlightLog:
    """A flight log.

    Attributes:
        path: of the file.
        size: bytes.
        notes: what could not be read, in words.
        cut: whether it is not whole.
        duration: s.
        info: what the log says of the vehicle, as sys_name, ver_sw.
        counts: messages by topic and instance, of all topics.
        topics: time (t,) in s, and fields by name, each (t,); of those in TOPICS, by name and instance.
        modes, armed: at each change.
        texts: time, severity, text.
        changed: parameters that differ from their defaults: name, value, default (None if it is not known).
        dropouts: time and length, s.
    """

    path: Path
    size: int
    notes: list[str] = field(default_factory=list)
    cut: bool = False
    duration: float = 0.0
    info: dict[str, Any] = field(default_factory=dict)
    counts: dict[tuple[str, int], int] = field(default_factory=dict)
    topics: dict[tuple[str, int], tuple[Array, dict[str, NDArray[Any]]]] = field(default_factory=dict)
    modes: list[tuple[float, str]] = field(default_factory=list)
    armed: list[tuple[float, bool]] = field(default_factory=list)
    texts: list[tuple[float, str, str]] = field(default_factory=list)
    changed: list[tuple[str, float, float | None]] = field(default_factory=list)
    dropouts: list[tuple[float, float]] = field(default_factory=list)

    def series(self, topic: str, *fields: str, instance: int = 0) -> Series | None:
        """Return fields of a topic side by side; None where it was not logged or has no such fields."""
        time, columns = self.topics.get((topic, instance), (np.empty(0), {}))
        if not len(time) or any(name not in columns for name in fields):
            return None
        return Series(time, np.column_stack([columns[name].astype(np.float64) for name in fields]))

    def array(self, topic: str, name: str, count: int) -> Series | None:
        """Return an array of a topic, shape (t, count)."""
        return self.series(topic, *(f"{name}[{i}]" for i in range(count)))

    @property
    def flown(self) -> tuple[float, float]:
        """From the first arming to the last disarming, s; the whole log where it was never armed."""
        starts = [time for time, armed in self.armed if armed]
        if not starts:
            return 0.0, self.duration
        ends = [time for time, armed in self.armed if not armed and time > starts[0]]
        last_armed = self.armed[-1][1]
        return starts[0], self.duration if last_armed or not ends else ends[-1]


def is_log(path: Path) -> bool:
    """Return whether a file says that it is a ULog."""
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def read_log(path: Path, topics: Collection[str] = TOPICS) -> FlightLog:
    """Read a flight log.

    Raises:
        LogError: nothing can be read of it.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"flight log: {str(path)!r} cannot be read: {error.strerror}") from error
    if data[: len(MAGIC)] != MAGIC:
        raise LogError(f"flight log: {str(path)!r} is no ULog: it begins with {data[:8]!r}")
    whole, damaged = whole_part(data)
    log = FlightLog(path, len(data))
    raw = _parsed(path, data, whole, log)
    if whole < len(data) and not log.notes:
        what = "is damaged at" if damaged else "is cut off at"
        log.notes.append(f"it {what} byte {whole} of {len(data)}; all that could be read is shown")
    log.cut = bool(log.notes)
    _fill(log, raw, topics)
    return log


def whole_part(data: bytes) -> tuple[int, bool]:
    """Return up to which byte a log consists of whole messages, and whether what follows makes no sense."""
    at, end = _HEADER, len(data)
    while at + 3 <= end:
        size, kind = struct.unpack_from("<HB", data, at)
        if kind not in _KINDS:
            return at, True
        if at + 3 + size > end:
            return at, False
        at += 3 + size
    return min(at, end), False


def _parsed(path: Path, data: bytes, whole: int, log: FlightLog) -> ULog:
    """Return what pyulog reads: of all, or else of the part before the damage.

    Raises:
        LogError: pyulog can read neither.
    """
    reason: Exception | None = None
    for part in (data, data[:whole]):
        try:
            return ULog(io.BytesIO(part))
        except Exception as error:  # pyulog raises many kinds for a damaged file
            reason = error
            log.notes = [f"it is damaged behind byte {whole} of {len(data)} ({error}); what is before was read"]
    raise LogError(f"flight log: {str(path)!r} cannot be read: {reason}") from reason


def _fill(log: FlightLog, raw: ULog, topics: Collection[str]) -> None:
    start = raw.start_timestamp
    log.duration = max(0.0, (raw.last_timestamp - start) * 1e-6)
    log.info = {key: value for key, value in raw.msg_info_dict.items() if isinstance(value, str | int | float)}
    for dataset in raw.data_list:
        time = (dataset.data["timestamp"].astype(np.int64) - start) * 1e-6
        log.counts[dataset.name, dataset.multi_id] = len(time)
        if dataset.name in topics and len(time):
            order = np.argsort(time, kind="stable")
            fields = {name: values[order] for name, values in dataset.data.items() if name != "timestamp"}
            log.topics[dataset.name, dataset.multi_id] = time[order], fields
    if (status := log.series("vehicle_status", "nav_state", "arming_state")) is not None:
        for time, state, arming in zip(status.time.tolist(), *status.value.T.astype(int).tolist(), strict=True):
            mode, armed = _STATES.get(state, f"state {state}"), arming == _ARMED
            if not log.modes or log.modes[-1][1] != mode:
                log.modes.append((time, mode))
            if not log.armed or log.armed[-1][1] != armed:
                log.armed.append((time, armed))
    log.texts = [((m.timestamp - start) * 1e-6, m.log_level_str(), m.message.rstrip("\t")) for m in raw.logged_messages]
    log.dropouts = [((d.timestamp - start) * 1e-6, d.duration * 1e-3) for d in raw.dropouts]
    if log.dropouts:
        lost = sum(length for _, length in log.dropouts)
        log.notes.append(f"the logger lost data {len(log.dropouts)} times, {lost:.2f} s in all")
    defaults = raw.get_default_parameters(0) if raw.has_default_parameters else {}
    # a default is logged only where the value differs
    for name, value in sorted(raw.initial_parameters.items()):
        if name in defaults and defaults[name] != value:
            log.changed.append((name, value, defaults[name]))
    log.changed += [(f"{name} (at {(time - start) * 1e-6:.1f} s)", value, None)
                    for time, name, value in raw.changed_parameters]  # fmt: skip


def euler(quaternion: Array) -> Array:
    """Return roll, pitch and yaw, degrees, of quaternions (w, x, y, z), shape (t, 4)."""
    w, x, y, z = quaternion.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(np.column_stack([roll, pitch, yaw]))
