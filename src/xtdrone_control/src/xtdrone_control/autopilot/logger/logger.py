"""PX4's logger: one ULog per vehicle and arming, for a whole fleet at the cost of a few copies a step.

At each step the records of all vehicles are copied as they are; once a simulated second what was copied becomes
messages, topic by topic for all vehicles at once (``topics``), and is appended to the vehicles' files. So a file lags
by a second at most, and holds whole messages only: what a crash leaves is a log. In a file a topic's messages rise in
time; of different topics those of one second lie in blocks.

When a log is written says SDLOG_MODE: -1 never, 0 while armed, 1 from boot until disarming and then while armed, 2 from
boot until the end, 4 from the first arming until the end. A log ends a second after disarming.
"""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.autopilot.parameters.parameters import NAMES as PARAMETER_NAMES
from xtdrone_control.autopilot.parameters.parameters import Parameters, describe

from . import status, ulog
from .folder import LogFolder, log_name
from .messages import message_format
from .status import StatusTopics
from .topics import EPOCH_US, TOPICS, Samples, Topic
from .ulog import Format, UlogWriter

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot
    from xtdrone_control.autopilot.commander.commander import Commander, CommandListener

STEP_US = 4000
BASE_PERIOD_US = 20_000  # shortest period of all topics but those of the sensors
_FLUSH_US = 1_000_000
_STOP_DELAY_US = 1_000_000
_FAST_ROWS = _FLUSH_US // STEP_US
_BASE_ROWS = _FLUSH_US // BASE_PERIOD_US

_NEVER, _WHILE_ARMED, _BOOT_UNTIL_DISARM, _BOOT_UNTIL_END, _ARMED_UNTIL_END = -1, 0, 1, 2, 4  # SDLOG_MODE
_INFO, _CRITICAL = 6, 2  # MAV_SEVERITY
_VERSION = 0x010E03FF  # 1.14.3 release: whose topics these are
_NO_HASH = "0" * 40  # of the sources: not one of PX4's

_log = logging.getLogger("rosout.logger")


class _Schedule:
    """Which of the copies topics take that are sampled alike: the first in each period."""

    def __init__(self, period_us: int, fresh: str) -> None:
        """Take a sample each ``period_us`` (0: each), of those in which the field ``fresh`` of SENSORS is set."""
        self.fast = period_us == 0 or bool(fresh)
        self.fresh = fresh
        self._period_us = period_us
        self._last_slot = -1

    def rows(self, time_us: NDArray[np.int64], fresh: NDArray[np.bool_] | None) -> NDArray[np.int64]:
        """Return the rows taken of ``time_us``; ``fresh`` says where there are samples, None: everywhere."""
        rows = np.arange(len(time_us)) if fresh is None else np.flatnonzero(fresh)
        if self._period_us and len(rows):
            slots = time_us[rows] // self._period_us
            rows = rows[np.diff(slots, prepend=self._last_slot) > 0]
            self._last_slot = int(slots[-1])
        return rows


class _Sampled:
    """A sampled topic in the making."""

    def __init__(self, topic: Topic, message_id: int) -> None:
        self.topic = topic
        self.format = message_format(topic.name)
        self._template = ulog.data_template(self.format, message_id)
        for name, value in topic.constants:
            self._template["record"][name] = value
        self._has_sample_time = "timestamp_sample" in (self.format.dtype.names or ())

    def messages(self, samples: Samples) -> np.ndarray:
        """Return the messages of all vehicles, shape (vehicles, times)."""
        count = len(samples.rotors)
        out = np.empty((count, len(samples.time_us)), self._template.dtype)
        out[...] = self._template
        columns = out["record"].T
        columns["timestamp"] = samples.time_us[:, None]
        if self._has_sample_time:
            columns["timestamp_sample"] = samples.time_us[:, None]
        self.topic.fill(columns, samples)
        return out


def _as_slice(rows: NDArray[np.int64]) -> slice | NDArray[np.int64]:
    """Return evenly spaced rows as a slice, which takes no copy."""
    if len(rows) == 1:
        return slice(int(rows[0]), int(rows[0]) + 1)
    steps = np.diff(rows)
    if np.all(steps == steps[0]):
        return slice(int(rows[0]), int(rows[-1]) + 1, int(steps[0]))
    return rows


def _write_parameter(writer: UlogWriter, parameters: Parameters, name: str) -> None:
    """Write a parameter's value, and those of its defaults from which it differs, as PX4 does."""
    value = parameters.get(name)
    writer.add_parameter(name, value)
    system, setup = type(value)(describe(name).default), parameters.default(name)
    defaults: tuple[tuple[int, int | float], ...]
    if system == setup:
        defaults = ((ulog.SYSTEM_DEFAULT | ulog.SETUP_DEFAULT, system),)
    else:
        defaults = ((ulog.SYSTEM_DEFAULT, system), (ulog.SETUP_DEFAULT, setup))
    for kinds, default in defaults:
        if default != value:
            writer.add_default_parameter(name, default, kinds)


class _Ring:
    """Copies of one array at successive times."""

    def __init__(self, source: np.ndarray, rows: int) -> None:
        self.copies: Any = np.zeros((rows, *source.shape), source.dtype)
        if source.dtype.names is None:
            self._rows, self._source = self.copies, source
        else:  # as bytes: numpy copies records field by field
            self._rows = self.copies.view(np.uint8).reshape(rows, -1)
            self._source = source.view(np.uint8).reshape(-1)

    def keep(self, row: int) -> None:
        self._rows[row] = self._source


class _PartRing:
    """Copies of a record array without one of its fields, which is large."""

    def __init__(self, source: np.ndarray, left_out: str, rows: int) -> None:
        dtype = source.dtype
        assert dtype.fields is not None
        start = dtype.fields[left_out][1]
        end = start + dtype.fields[left_out][0].itemsize
        size = dtype.itemsize - (end - start)
        names = [name for name in dtype.fields if name != left_out]
        places = [dtype.fields[name][1] for name in names]
        self.copies: Any = np.zeros(
            (rows, len(source)),
            np.dtype(
                {
                    "names": names,
                    "formats": [dtype.fields[name][0] for name in names],
                    "offsets": [place if place < start else place - (end - start) for place in places],
                    "itemsize": size,
                }
            ),
        )
        copied = self.copies.view(np.uint8).reshape(rows, len(source), size)
        whole = source.view(np.uint8).reshape(len(source), -1)
        self._halves = ((copied[:, :, :start], whole[:, :start]), (copied[:, :, start:], whole[:, end:]))

    def keep(self, row: int) -> None:
        for copied, source in self._halves:
            copied[row] = source


class _VehicleLog:
    """The log of one vehicle that is being written."""

    def __init__(self, path: Path, file: BinaryIO, start_us: int) -> None:
        self.path = path
        self.writer = UlogWriter(file, start_us)
        self.stop_us: int | None = None
        self.reported_us, self.reported_bytes = start_us, 0
        self._file = file

    def close(self) -> None:
        with contextlib.suppress(OSError):  # a disk that is full has been told of
            self._file.close()


class Logger:
    """Writes the logs of all vehicles.

    ``step`` after each step of the autopilot, ``update`` at 10 Hz, ``close`` at the end.

    Attributes:
        folders: where each vehicle's logs lie.
    """

    def __init__(self, autopilot: Autopilot, commanders: Sequence[Commander], folder: Path) -> None:
        """Prepare to log; with SDLOG_MODE 1 or 2 the first ``update`` begins.

        Args:
            autopilot: holder of the records.
            commanders: one a vehicle.
            folder: each vehicle gets a folder of its name in it.
        """
        self._autopilot = autopilot
        self._commanders = list(commanders)
        count = len(self._commanders)
        self.folders = [LogFolder(folder / c.vehicle.name) for c in self._commanders]
        self._sampled = [_Sampled(topic, i) for i, topic in enumerate(TOPICS)]
        schedules: dict[tuple[int, str], list[_Sampled]] = {}
        for sampled in self._sampled:
            schedules.setdefault((sampled.topic.period_us, sampled.topic.fresh), []).append(sampled)
        self._schedules = [(_Schedule(*key), topics) for key, topics in schedules.items()]
        self._ids = {name: len(TOPICS) + i for i, name in enumerate(status.NAMES)}
        self._status = [StatusTopics(commander, self._ids) for commander in self._commanders]
        self._logs: list[_VehicleLog | None] = [None] * count
        self._has_armed = [False] * count  # since boot
        self._given_up = [False] * count  # could not be written
        self._texts: list[list[tuple[int, int, str]]] = [[] for _ in range(count)]
        self._active = 0
        self._fast_count = self._base_count = 0
        self._fast_us = np.zeros(_FAST_ROWS, np.int64)
        self._base_us = np.zeros(_BASE_ROWS, np.int64)
        self._fast = _Ring(autopilot.sensors, _FAST_ROWS)
        self._base: list[_Ring | _PartRing] = [
            _Ring(autopilot.sensors, _BASE_ROWS),
            _PartRing(autopilot.estimator, "P", _BASE_ROWS),
            _Ring(np.diagonal(autopilot.estimator["P"], axis1=1, axis2=2), _BASE_ROWS),
            _Ring(autopilot.setpoint, _BASE_ROWS),
            _Ring(autopilot.control, _BASE_ROWS),
        ]
        self._rotors = np.array([autopilot.rotor_count(i) for i in range(count)], np.int64)
        for i in range(count):
            self._listen(i)

    def _listen(self, index: int) -> None:
        commander = self._commanders[index]
        commander.on_text = self._text_taker(index)
        commander.on_command = self._command_taker(index)
        commander.parameters.on_change = self._parameter_taker(index)

    def reboot(self, index: int, commander: Commander) -> None:
        """Go on with a vehicle whose autopilot was rebooted: its log ends; with SDLOG_MODE 1 or 2 another one begins.

        Args:
            index: which vehicle.
            commander: its new one.
        """
        self.flush()
        self._end(index)
        self._commanders[index] = commander
        self._status[index] = StatusTopics(commander, self._ids)
        self._has_armed[index] = self._given_up[index] = False
        self._texts[index].clear()
        self._listen(index)

    def close(self) -> None:
        """Write what is left, and end all logs."""
        self.flush()
        for i, commander in enumerate(self._commanders):
            self._end(i)
            commander.on_text = commander.on_command = None
            commander.parameters.on_change = None

    # what is told

    def _text_taker(self, index: int) -> Callable[[int, str], None]:
        def take(severity: int, text: str) -> None:
            # a text with a tab has an event, for which readers of a log leave it out; the log has no events
            self._texts[index].append((severity, self._autopilot.time_us, text.rstrip("\t")))

        return take

    def _parameter_taker(self, index: int) -> Callable[[str, int | float], None]:
        def take(name: str, value: int | float) -> None:
            log = self._logs[index]
            if log is None:
                return
            self.flush()  # a parameter has no time of its own in a log: it counts from the message before it
            log.writer.add_parameter(name, value)
            self._status[index].parameter_changed(self._autopilot.time_us)

        return take

    def _command_taker(self, index: int) -> CommandListener:
        def take(number: int, params: Sequence[float], sender: tuple[int, int], result: int | None) -> None:
            if self._logs[index] is not None:
                self._status[index].command(number, params, sender, result, self._autopilot.time_us)

        return take

    # when

    def update(self) -> None:
        """Begin and end logs, and take what changes slowly; call at 10 Hz."""
        now_us = self._autopilot.time_us
        for i, commander in enumerate(self._commanders):
            self._start_or_stop(i, commander, now_us)
            log = self._logs[i]
            if log is None:
                self._texts[i].clear()
                continue
            if now_us > 0:  # a reader takes 0 for no time at all
                self._status[i].update(now_us)

    def _start_or_stop(self, index: int, commander: Commander, now_us: int) -> None:
        log = self._logs[index]
        wanted = self._wanted(index, commander)
        if log is None:
            if wanted:
                self._begin(index, commander, now_us)
            return
        if wanted:
            log.stop_us = None
        elif log.stop_us is None:
            log.stop_us = now_us + _STOP_DELAY_US
        elif now_us >= log.stop_us:
            self.flush()
            self._end(index)

    def _wanted(self, index: int, commander: Commander) -> bool:
        if self._given_up[index]:
            return False
        mode = int(commander.parameters.get("SDLOG_MODE"))
        if commander.armed:
            self._has_armed[index] = True
            return mode in (_WHILE_ARMED, _BOOT_UNTIL_DISARM, _BOOT_UNTIL_END, _ARMED_UNTIL_END)
        if mode == _BOOT_UNTIL_END:
            return True
        return mode == (_ARMED_UNTIL_END if self._has_armed[index] else _BOOT_UNTIL_DISARM)

    def _begin(self, index: int, commander: Commander, now_us: int) -> None:
        self.flush()  # what was copied up to now is not for this one
        offset_s = 60 * int(commander.parameters.get("SDLOG_UTC_OFFSET"))
        name = log_name((EPOCH_US + now_us) // 1_000_000 + offset_s)
        try:
            path, file = self.folders[index].create(name)
        except OSError as error:
            self._failed(index, f"log cannot be begun in {self.folders[index].root}: {error}")
            return
        log = self._logs[index] = _VehicleLog(path, file, now_us)
        self.folders[index].current = path
        self._active += 1
        self._status[index].restart()
        self._write_definitions(log.writer, commander, offset_s)
        self._write(index)
        # the name as it is without an older log in its way: what goes out must not depend on what lies on the disk
        begun = (int(part) for part in re.findall(r"\d+", name))
        commander.tell(_INFO, f"[logger] ./log/{name}", "logger_open_file_time", *begun)

    def _end(self, index: int) -> None:
        log = self._logs[index]
        if log is not None:
            log.close()
            self._logs[index] = None
            self.folders[index].current = None
            self._active -= 1

    def _failed(self, index: int, text: str) -> None:
        """Give up on a vehicle's logs until the next boot; the flight goes on."""
        commander = self._commanders[index]
        _log.error("%s: %s", commander.vehicle.name, text)
        self._given_up[index] = True
        self._end(index)
        commander.say(_CRITICAL, "[logger] failed to write the log")

    def _write_definitions(self, writer: UlogWriter, commander: Commander, offset_s: int) -> None:
        vehicle = commander.vehicle
        infos: tuple[tuple[str, str, str | int], ...] = (
            ("char", "sys_name", "PX4"),
            ("char", "ver_hw", "PX4_SITL"),
            ("char", "ver_hw_subtype", "XTDrone"),
            ("char", "ver_sw", _NO_HASH),
            ("uint32_t", "ver_sw_release", _VERSION),
            ("char", "sys_os_name", "Linux"),
            ("char", "sys_uuid", f"{vehicle.system_id:036x}"),
            ("char", "vehicle_name", vehicle.name),
            ("int32_t", "time_ref_utc", offset_s),
        )
        for info in infos:
            writer.add_info(*info)
        formats: list[tuple[int, Format]] = [(i, sampled.format) for i, sampled in enumerate(self._sampled)]
        formats += [(number, status.FORMATS[name]) for name, number in self._ids.items()]
        for _, layout in formats:
            writer.add_format(layout)
        for name in PARAMETER_NAMES:
            _write_parameter(writer, commander.parameters, name)
        for number, layout in formats:
            writer.subscribe(number, layout)

    # what

    def step(self) -> None:
        """Copy the records of this step."""
        if not self._active:
            return
        now_us = self._autopilot.time_us
        row = self._fast_count
        self._fast_us[row] = now_us
        self._fast.keep(row)
        self._fast_count = row + 1
        if now_us % BASE_PERIOD_US == 0:
            row = self._base_count
            self._base_us[row] = now_us
            for ring in self._base:
                ring.keep(row)
            self._base_count = row + 1
        if self._fast_count == _FAST_ROWS or self._base_count == _BASE_ROWS:
            self.flush()

    def flush(self) -> None:
        """Write what has been copied since the last time."""
        if not self._active:
            return
        if self._fast_count:
            self._add_sampled()
            self._fast_count = self._base_count = 0
        for i, log in enumerate(self._logs):
            if log is not None:
                self._write(i)

    def _add_sampled(self) -> None:
        fast_us, base_us = self._fast_us[: self._fast_count], self._base_us[: self._base_count]
        sensors = self._fast.copies[: self._fast_count]
        base = [ring.copies[: self._base_count] for ring in self._base]
        logs = [(i, log.writer) for i, log in enumerate(self._logs) if log is not None]
        for schedule, topics in self._schedules:
            fresh = sensors[schedule.fresh] != 0 if schedule.fresh else None
            time_us, sources = (fast_us, [sensors] * 5) if schedule.fast else (base_us, base)
            rows = schedule.rows(time_us, None if fresh is None else fresh.any(axis=1))
            if not len(rows):
                continue
            chosen = _as_slice(rows)
            parts = [source[chosen] for source in sources]
            samples = Samples(time_us[chosen], parts[0], parts[1], parts[2], parts[3], parts[4], self._rotors)
            there = None if fresh is None or fresh[chosen].all() else fresh[chosen]
            for sampled in topics:
                self._add_messages(sampled.messages(samples), there, logs)

    @staticmethod
    def _add_messages(
        messages: np.ndarray, there: NDArray[np.bool_] | None, logs: list[tuple[int, UlogWriter]]
    ) -> None:
        """Give each log its vehicle's messages, those that are ``there`` (times, vehicles), None: all."""
        if there is not None:
            for i, writer in logs:
                writer.add_messages(messages[i][there[:, i]].tobytes())
            return
        data = memoryview(messages.tobytes())
        size = messages.shape[1] * messages.itemsize
        for i, writer in logs:
            writer.add_messages(data[i * size : (i + 1) * size])

    def _write(self, index: int) -> None:
        log = self._logs[index]
        assert log is not None
        writer, topics = log.writer, self._status[index]
        now_us = self._autopilot.time_us
        for severity, time_us, text in self._texts[index]:
            writer.add_messages(ulog.logged_string(severity, time_us, text))
        self._texts[index].clear()
        seconds = (now_us - log.reported_us) * 1e-6
        if seconds >= 1.0:
            topics.written(writer.written / 1000.0, (writer.written - log.reported_bytes) / 1000.0 / seconds, now_us)
            log.reported_us, log.reported_bytes = now_us, writer.written
        writer.add_messages(topics.take())
        try:
            writer.flush()
        except OSError as error:
            self._failed(index, f"{log.path} cannot be written any more, the log ends: {error}")
