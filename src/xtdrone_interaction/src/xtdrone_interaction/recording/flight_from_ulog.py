"""Read PX4's flight logs (ULog) with pyulog, also truncated and damaged ones.

Frames are PX4's: NED positions and velocities; roll, pitch and yaw angles. Times are s since the log
began.
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyulog import ULog

from xtdrone_common import modes
from xtdrone_common.rotation import to_eulers
from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series, armed_span

NAMELESS = "vehicle"
"""Name of a vehicle whose recording does not give one."""
MAGIC = b"ULog\x01\x12\x35"
TOPICS = (
    "actuator_motors",
    "actuator_outputs",
    "battery_status",
    "cpuload",
    "estimator_selector_status",
    "estimator_status",
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
    "vehicle_local_position",
    "vehicle_local_position_setpoint",
    "vehicle_rates_setpoint",
    "vehicle_status",
)
"""Topics that are read; PX4 v1.11 to v1.16 have these names, older versions lack some."""
_VALID = {"x": "xy_valid", "y": "xy_valid", "z": "z_valid", "vx": "v_xy_valid", "vy": "v_xy_valid", "vz": "v_z_valid"}
"""Fields of vehicle_local_position, and their validity flags."""
_ARMED = 2  # vehicle_status.arming_state
_STATES = {mode.state: mode.name for mode in modes.ALL} | {
    19: "AUTO.FOLLOW_TARGET",
    21: "ORBIT",
    22: "AUTO.VTOL_TAKEOFF",
}
_KINDS = frozenset(b"BFIMPQADRSOLC")  # of messages, by letter
_HEADER = 16  # bytes
_FLAGS = struct.Struct("<HB8sB7x3Q")  # flag bits message: size, kind, compatible, incompatible flags, offsets
_APPENDED = 1  # incompatible flag: data are appended at the offsets, behind an incomplete message
_RELEASES = {0: " (development)", 64: " (alpha)", 128: " (beta)", 192: " (release candidate)", 255: ""}
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")  # escape sequences of terminals


class LogError(ValueError):
    """A file that cannot be read as a flight log."""


@dataclass
class FlightLog:
    """A flight log.

    Attributes:
        path: of the file.
        size: bytes.
        notes: unreadable or doubtful parts, as sentences.
        whole: whether all of it could be read.
        cut: whether it ends before its writer finished it.
        duration: s.
        info: information messages, such as sys_name, ver_sw; "release" is ver_sw_release as text.
        counts: number of messages by topic and instance, of all topics.
        topics: of TOPICS, by name and instance: time (t,) in s, and fields by name, each (t,).
        modes, armed: time and new value of each change.
        texts: time, severity, text.
        changed: parameters that differ from their defaults: name, value, default (None if unknown).
        dropouts: time and length, s.
    """

    path: Path
    size: int
    notes: list[str] = field(default_factory=list)
    whole: bool = True
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
        """Return fields of a topic side by side; None if it was not logged or lacks one of them."""
        time, columns = self.topics.get((topic, instance), (np.empty(0), {}))
        if not len(time) or any(name not in columns for name in fields):
            return None
        return Series(time, np.column_stack([columns[name].astype(np.float64) for name in fields]))

    def array(self, topic: str, name: str, count: int) -> Series | None:
        """Return an array field of a topic, shape (t, count); None as for :meth:`series`."""
        return self.series(topic, *(f"{name}[{i}]" for i in range(count)))

    def flown_series(self, topic: str, *fields: str) -> Series | None:
        """Return :meth:`series` while flown and known: before, the estimator may not know its position."""
        series = self.series(topic, *fields)
        if series is None:
            return None
        start, end = self.flown
        part = (series.time >= start) & (series.time <= end) & np.isfinite(series.value).all(axis=1)
        return Series(series.time[part], series.value[part]) if part.any() else None

    @property
    def flown(self) -> tuple[float, float]:
        """Times of the first arming and the last disarming, s; the whole log if never armed."""
        return armed_span(self.armed, self.duration)

    @property
    def flown_words(self) -> str:
        """Description of :attr:`flown`, for titles."""
        return "while armed" if any(armed for _, armed in self.armed) else "over the whole log, which was never armed"


def is_log(path: Path) -> bool:
    """Return whether a file begins as a ULog does."""
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
    log.whole = not log.notes
    log.cut = whole < len(data) and not damaged
    _fill(log, raw, topics)
    return log


def whole_part(data: bytes) -> tuple[int, bool]:
    """Return up to which byte a log consists of whole messages, and whether invalid data follow.

    A vehicle that crashed may have appended data to its last log: they begin at an offset given in the flag bits
    message, and the message before that offset may be incomplete.
    """
    at = _HEADER
    for end in [*_appended(data), len(data)]:
        while at + 3 <= end:
            size, kind = struct.unpack_from("<HB", data, at)
            if kind not in _KINDS:
                return at, True
            if at + 3 + size > end:
                break
            at += 3 + size
        if end < len(data):
            at = end
    return min(at, len(data)), False


def _appended(data: bytes) -> list[int]:
    """Return the offsets of appended data."""
    if len(data) < _HEADER + _FLAGS.size:
        return []
    _, kind, _, flags, *offsets = _FLAGS.unpack_from(data, _HEADER)
    if kind != ord("B") or not flags & _APPENDED:
        return []
    return sorted(offset for offset in offsets if _HEADER < offset < len(data))


def _parsed(path: Path, data: bytes, whole: int, log: FlightLog) -> ULog:
    """Parse the whole log, else the part before the damage.

    Raises:
        LogError: pyulog can read neither.
    """
    reason: Exception | None = None
    for part in (data, data[:whole]):
        said = io.StringIO()
        try:
            with contextlib.redirect_stdout(said):  # it prints its warnings
                raw = ULog(io.BytesIO(part))
            if (doubts := said.getvalue().splitlines()) and not log.notes and whole == len(data):
                log.notes.append(f"it is damaged; what could be read is shown (pyulog: {doubts[0].strip()})")
            return raw
        except Exception as error:  # pyulog raises many kinds for a damaged file
            reason = error
            log.notes = [f"it is damaged behind byte {whole} of {len(data)} ({error}); what is before was read"]
    raise LogError(f"flight log: {str(path)!r} cannot be read: {reason}") from reason


def _fill(log: FlightLog, raw: ULog, topics: Collection[str]) -> None:
    start = raw.start_timestamp
    datasets = [dataset for dataset in raw.data_list if "timestamp" in dataset.data]  # else the format is damaged
    times = {
        (dataset.name, dataset.multi_id): (dataset.data["timestamp"].astype(np.int64) - start) * 1e-6
        for dataset in datasets
    }
    # a single message may carry any time, such as that of a mission stored earlier
    running = [time for time in times.values() if len(time) > 1] or list(times.values())
    log.duration = max((float(time.max()) for time in running if len(time)), default=0.0)
    log.info = {key: value for key, value in raw.msg_info_dict.items() if isinstance(value, str | int | float)}
    if isinstance(release := log.info.get("ver_sw_release"), int):
        log.info["release"] = _release(release)
    for dataset in datasets:
        key = dataset.name, dataset.multi_id
        log.counts[key] = len(times[key])
        if dataset.name in topics and len(times[key]):
            log.topics[key] = _in_time(log, dataset.name, times[key], dataset.data)
    if (status := log.series("vehicle_status", "nav_state", "arming_state")) is not None:
        for time, state, arming in zip(status.time.tolist(), *status.value.T.astype(int).tolist(), strict=True):
            mode, armed = _STATES.get(state, f"state {state}"), arming == _ARMED
            if not log.modes or log.modes[-1][1] != mode:
                log.modes.append((time, mode))
            if not log.armed or log.armed[-1][1] != armed:
                log.armed.append((time, armed))
    log.texts = [
        ((m.timestamp - start) * 1e-6, m.log_level_str(), _COLOURS.sub("", m.message).rstrip("\t"))
        for m in raw.logged_messages
    ]
    log.dropouts = [((d.timestamp - start) * 1e-6, d.duration * 1e-3) for d in raw.dropouts]
    if log.dropouts:
        lengths = [length for _, length in log.dropouts]
        log.notes.append(
            f"the logger lost data {len(lengths)} times, {sum(lengths):.2f} s in total, {max(lengths):.2f} s at most"
        )
    defaults = raw.get_default_parameters(0) if raw.has_default_parameters else {}
    # defaults are logged only where the value differs
    for name, value in sorted(raw.initial_parameters.items()):
        if name in defaults and defaults[name] != value and isinstance(value, int | float):
            log.changed.append((name, value, defaults[name]))
    log.changed += [(f"{name} (at {(time - start) * 1e-6:.1f} s)", value, None)
                    for time, name, value in raw.changed_parameters if isinstance(value, int | float)]  # fmt: skip


def _in_time(
    log: FlightLog, topic: str, time: Array, data: dict[str, NDArray[Any]]
) -> tuple[Array, dict[str, NDArray[Any]]]:
    """Return a topic sorted by time.

    Of messages before the beginning of the log only the last is kept, at time 0. Invalid estimates are NaN.
    """
    if (back := int((np.diff(time) < 0).sum())) > 0:
        log.notes.append(f"in {topic}, time goes back {back} times; it is shown in order of time")
    order = np.argsort(time, kind="stable")
    time = time[order]
    first = max(0, int(np.searchsorted(time, 0.0, "right")) - 1)
    part = slice(first, int(np.searchsorted(time, log.duration, "right")))
    fields = {name: values[order][part] for name, values in data.items() if name != "timestamp"}
    if topic == "vehicle_local_position":
        for name, valid in _VALID.items():
            if name in fields and valid in fields:
                fields[name] = np.where(fields[valid] != 0, fields[name], np.nan)
    return np.maximum(time[part], 0.0), fields


def _release(number: int) -> str:
    """Return a release as text, from one byte each for major, minor, patch version and stage."""
    major, minor, patch, kind = number.to_bytes(4, "big", signed=False) if 0 <= number < 1 << 32 else (0, 0, 0, 0)
    words = _RELEASES[max(least for least in _RELEASES if least <= kind)]
    return f"v{major}.{minor}.{patch}{words}"


def euler(quaternion: Array) -> Array:
    """Return roll, pitch and yaw, degrees, shape (t, 3), of quaternions (w, x, y, z), shape (t, 4)."""
    return np.degrees(np.column_stack(to_eulers(quaternion)))
