"""PX4's logger: one ULog file per vehicle and flight, for a whole fleet at the cost of a few copies per step.

Each step copies the records of all vehicles unchanged. Once per simulated second the copies are converted to messages,
topic by topic for all vehicles together (``sampled_topics``), and appended to the vehicles' files. A file therefore
lags by at most one second and holds complete messages only, so that it stays readable after a crash. Timestamps
increase within each topic; the messages of different topics are interleaved in blocks of one second.

SDLOG_MODE selects when to log: -1 never, 0 while armed, 1 from boot until disarming and then while armed, 2 from boot
until shutdown, 4 from the first arming until shutdown. A log ends one second after disarming.

A vehicle's log can also be streamed to a client, with or without a file; see ``Logger.open_stream``.
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

from xtdrone_autopilot.parameters.parameters import NAMES as PARAMETER_NAMES
from xtdrone_autopilot.parameters.parameters import Parameters, describe

from . import topics_on_change, ulog_format
from .log_folder import LogFolder, log_name
from .mavlink_log_pieces import LogStream
from .message_definitions import message_format
from .sampled_topics import EPOCH_US, TOPICS, Samples, Topic
from .topics_on_change import StatusTopics
from .ulog_format import Format, UlogWriter

if TYPE_CHECKING:
    from xtdrone_autopilot.autopilot import Autopilot
    from xtdrone_autopilot.commander.commander import Commander, CommandListener

STEP_US = 4000
BASE_PERIOD_US = 20_000  # shortest period of all topics except sensor topics
_FLUSH_US = 1_000_000
_STOP_DELAY_US = 1_000_000
_FAST_ROWS = _FLUSH_US // STEP_US
_BASE_ROWS = _FLUSH_US // BASE_PERIOD_US

_NEVER, _WHILE_ARMED, _BOOT_UNTIL_DISARM, _BOOT_UNTIL_END, _ARMED_UNTIL_END = -1, 0, 1, 2, 4  # SDLOG_MODE
_INFO, _CRITICAL = 6, 2  # MAV_SEVERITY
_VERSION = 0x010E03FF  # release 1.14.3, which defines the logged topics
_NO_HASH = "0" * 40  # source revision: this is not a build of PX4

_log = logging.getLogger("rosout.logger")


class _Schedule:
    """Sampling of topics with the same period: the first copy in each period is logged."""

    def __init__(self, period_us: int, fresh: str) -> None:
        """Sample once per ``period_us`` (0: every step) among the copies whose SENSORS field ``fresh`` is set."""
        self.fast = period_us == 0 or bool(fresh)
        self.fresh = fresh
        self._period_us = period_us
        self._last_slot = -1

    def rows(self, time_us: NDArray[np.int64], fresh: NDArray[np.bool_] | None) -> NDArray[np.int64]:
        """Return the rows of ``time_us`` to log; ``fresh`` marks rows with a new sample (None: all rows)."""
        rows = np.arange(len(time_us)) if fresh is None else np.flatnonzero(fresh)
        if self._period_us and len(rows):
            slots = time_us[rows] // self._period_us
            rows = rows[np.diff(slots, prepend=self._last_slot) > 0]
            self._last_slot = int(slots[-1])
        return rows


class _SampledTopic:
    """Message builder of one sampled topic."""

    def __init__(self, topic: Topic, message_id: int) -> None:
        self.topic = topic
        self.format = message_format(topic.name)
        self._template = ulog_format.data_template(self.format, message_id)
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
    """Return evenly spaced rows as a slice, to index without a copy."""
    if len(rows) == 1:
        return slice(int(rows[0]), int(rows[0]) + 1)
    steps = np.diff(rows)
    if np.all(steps == steps[0]):
        return slice(int(rows[0]), int(rows[-1]) + 1, int(steps[0]))
    return rows


def _write_parameter(writer: UlogWriter, parameters: Parameters, name: str) -> None:
    """Write a parameter and, as PX4 does, those of its defaults that differ from its value."""
    value = parameters.get(name)
    writer.add_parameter(name, value)
    system, setup = type(value)(describe(name).default), parameters.default(name)
    defaults: tuple[tuple[int, int | float], ...]
    if system == setup:
        defaults = ((ulog_format.SYSTEM_DEFAULT | ulog_format.SETUP_DEFAULT, system),)
    else:
        defaults = ((ulog_format.SYSTEM_DEFAULT, system), (ulog_format.SETUP_DEFAULT, setup))
    for kinds, default in defaults:
        if default != value:
            writer.add_default_parameter(name, default, kinds)


class _Ring:
    """Buffer of copies of one array at successive times."""

    def __init__(self, source: np.ndarray, rows: int) -> None:
        self.copies: Any = np.zeros((rows, *source.shape), source.dtype)
        if source.dtype.names is None:
            self._rows, self._source = self.copies, source
        else:  # copied as bytes, because numpy copies structured arrays field by field
            self._rows = self.copies.view(np.uint8).reshape(rows, -1)
            self._source = source.view(np.uint8).reshape(-1)

    def store(self, row: int) -> None:
        self._rows[row] = self._source


class _PartRing:
    """Buffer of copies of a structured array without one large field."""

    def __init__(self, source: np.ndarray, left_out: str, rows: int) -> None:
        dtype = source.dtype
        assert dtype.fields is not None
        start = dtype.fields[left_out][1]
        end = start + dtype.fields[left_out][0].itemsize
        size = dtype.itemsize - (end - start)
        names = [name for name in dtype.fields if name != left_out]
        offsets = [dtype.fields[name][1] for name in names]
        self.copies: Any = np.zeros(
            (rows, len(source)),
            np.dtype(
                {
                    "names": names,
                    "formats": [dtype.fields[name][0] for name in names],
                    "offsets": [offset if offset < start else offset - (end - start) for offset in offsets],
                    "itemsize": size,
                }
            ),
        )
        copied = self.copies.view(np.uint8).reshape(rows, len(source), size)
        whole = source.view(np.uint8).reshape(len(source), -1)
        self._halves = ((copied[:, :, :start], whole[:, :start]), (copied[:, :, start:], whole[:, end:]))

    def store(self, row: int) -> None:
        for copied, source in self._halves:
            copied[row] = source


_Text = tuple[int, int, str]
"""Text for the operator: MAV_SEVERITY, simulated time in microseconds, text."""


class _VehicleLog:
    """Open log of one vehicle.

    Attributes:
        name: path of the file, or "stream".
        writer: writer of the messages.
        status: encoder of the status messages.
        texts: texts that remain to be written.
        reported_us, reported_bytes: time of the latest logger_status, and bytes written until then.
    """

    def __init__(
        self, name: str, sink: BinaryIO | LogStream, start_us: int, status: StatusTopics, texts: list[_Text]
    ) -> None:
        self.name = name
        self.writer = UlogWriter(sink, start_us)
        self.status = status
        self.texts = texts
        self.reported_us, self.reported_bytes = start_us, 0


class _FileLog(_VehicleLog):
    """Open log file."""

    def __init__(self, path: Path, file: BinaryIO, start_us: int, status: StatusTopics, texts: list[_Text]) -> None:
        super().__init__(str(path), file, start_us, status, texts)
        self.stop_us: int | None = None
        self._file = file

    def close(self) -> None:
        with contextlib.suppress(OSError):  # a write error has been reported already
            self._file.close()


class _StreamedLog(_VehicleLog):
    """Open stream; ``has_data`` is set once the client has all definitions."""

    def __init__(self, stream: LogStream, start_us: int, status: StatusTopics) -> None:
        super().__init__("stream", stream, start_us, status, [])
        self.stream = stream
        self.has_data = False


class Logger:
    """Writer of the logs of all vehicles.

    Call ``step`` after each step of the autopilot, ``update`` at 10 Hz and ``close`` at the end.

    Attributes:
        folders: log folder of each vehicle; empty when no files are written.
    """

    def __init__(self, autopilot: Autopilot, commanders: Sequence[Commander], folder: Path | None) -> None:
        """Prepare the logs; with SDLOG_MODE 1 or 2 the first ``update`` starts them.

        Args:
            autopilot: owner of the records.
            commanders: one commander per vehicle.
            folder: parent of the vehicles' log folders, which bear their names; None writes no files.
        """
        self._autopilot = autopilot
        self._commanders = list(commanders)
        count = len(self._commanders)
        self.folders = [] if folder is None else [LogFolder(folder / c.vehicle.name) for c in self._commanders]
        self._sampled = [_SampledTopic(topic, i) for i, topic in enumerate(TOPICS)]
        schedules: dict[tuple[int, str], list[_SampledTopic]] = {}
        for sampled in self._sampled:
            schedules.setdefault((sampled.topic.period_us, sampled.topic.fresh), []).append(sampled)
        self._schedules = [(_Schedule(*key), topics) for key, topics in schedules.items()]
        self._ids = {name: len(TOPICS) + i for i, name in enumerate(topics_on_change.NAMES)}
        self._status = [StatusTopics(commander, self._ids) for commander in self._commanders] if self.folders else []
        self._logs: list[_FileLog | None] = [None] * count
        self._streams: dict[int, _StreamedLog] = {}
        self._has_armed = [False] * count  # since boot
        self._unwritable = [False] * count  # after a write error
        self._texts: list[list[_Text]] = [[] for _ in range(count)]
        self._active: list[tuple[int, _VehicleLog]] = []  # logs to which data are written, with the vehicle's index
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
        self._absent: set[int] = set()
        for i in range(len(self.folders)):
            self._attach_listeners(i)

    def _update_active(self) -> None:
        files = [(i, log) for i, log in enumerate(self._logs) if log is not None]
        self._active = [*files, *((i, log) for i, log in self._streams.items() if log.has_data)]

    def _attach_listeners(self, index: int) -> None:
        commander = self._commanders[index]
        commander.on_text = self._text_listener(index)
        commander.on_command = self._command_listener(index)
        commander.parameters.on_change = self._parameter_listener(index)

    def _detach_listeners(self, index: int) -> None:
        commander = self._commanders[index]
        commander.on_text = commander.on_command = None
        commander.parameters.on_change = None

    def reboot(self, index: int, commander: Commander) -> None:
        """End the log and the stream of a rebooted vehicle.

        With SDLOG_MODE 1 or 2 the next ``update`` starts a new log.

        Args:
            index: index of the vehicle.
            commander: the vehicle's new commander.
        """
        self.flush()
        self._end_log(index)
        self._end_stream(index)
        self._commanders[index] = commander
        self._has_armed[index] = self._unwritable[index] = False
        self._texts[index].clear()
        if self.folders:
            self._status[index] = StatusTopics(commander, self._ids)
            self._attach_listeners(index)

    def leave(self, index: int) -> None:
        """End the log and the stream of a vehicle that leaves the simulation; no new ones are started for it."""
        self.flush()
        self._end_log(index)
        self._end_stream(index)
        self._detach_listeners(index)
        self._absent.add(index)

    def join(self, index: int, commander: Commander) -> None:
        """Log a vehicle that has joined the simulation from now on, in the folder of its name."""
        self._absent.discard(index)
        self._rotors[index] = self._autopilot.rotor_count(index)
        if self.folders:
            self.folders[index] = LogFolder(self.folders[index].root.parent / commander.vehicle.name)
        self.reboot(index, commander)

    def close(self) -> None:
        """Flush and end all logs and streams, and detach the listeners."""
        self.flush()
        for i in range(len(self._commanders)):
            self._end_log(i)
            self._end_stream(i)
            self._detach_listeners(i)

    # listeners

    def _text_listener(self, index: int) -> Callable[[int, str], None]:
        def record(severity: int, text: str) -> None:
            # log readers skip a text that ends with a tab in favour of its event, but this log has no events
            entry = (severity, self._autopilot.time_us, text.rstrip("\t"))
            if self.folders:
                self._texts[index].append(entry)
            streamed = self._streams.get(index)
            if streamed is not None and streamed.has_data:
                streamed.texts.append(entry)

        return record

    def _parameter_listener(self, index: int) -> Callable[[str, int | float], None]:
        def record(name: str, value: int | float) -> None:
            logs: list[_VehicleLog | None] = [self._logs[index], self._streams.get(index)]
            if not any(logs):
                return
            self.flush()  # a parameter message has no timestamp and takes effect after the preceding message
            for log in logs:
                if log is not None:
                    log.writer.add_parameter(name, value)
                    log.status.parameter_changed(self._autopilot.time_us)

        return record

    def _command_listener(self, index: int) -> CommandListener:
        def record(number: int, params: Sequence[float], sender: tuple[int, int], result: int | None) -> None:
            for i, log in self._active:
                if i == index:
                    log.status.command(number, params, sender, result, self._autopilot.time_us)

        return record

    # start and end of logs

    def update(self) -> None:
        """Start and end logs, and log the status topics; call at 10 Hz."""
        now_us = self._autopilot.time_us
        if self._streams:
            self._update_streams(now_us)
        if not self.folders:
            return
        for i, commander in enumerate(self._commanders):
            if i in self._absent:
                continue
            self._start_or_stop(i, commander, now_us)
            log = self._logs[i]
            if log is None:
                self._texts[i].clear()
                continue
            if now_us > 0:  # log readers treat a timestamp of 0 as missing
                self._status[i].update(now_us)

    def _start_or_stop(self, index: int, commander: Commander, now_us: int) -> None:
        log = self._logs[index]
        wanted = self._wanted(index, commander)
        if log is None:
            if wanted:
                self._start_log(index, commander, now_us)
            return
        if wanted:
            log.stop_us = None
        elif log.stop_us is None:
            log.stop_us = now_us + _STOP_DELAY_US
        elif now_us >= log.stop_us:
            self.flush()
            self._end_log(index)

    def _wanted(self, index: int, commander: Commander) -> bool:
        if self._unwritable[index]:
            return False
        mode = int(commander.parameters.get("SDLOG_MODE"))
        if commander.armed:
            self._has_armed[index] = True
            return mode in (_WHILE_ARMED, _BOOT_UNTIL_DISARM, _BOOT_UNTIL_END, _ARMED_UNTIL_END)
        if mode == _BOOT_UNTIL_END:
            return True
        return mode == (_ARMED_UNTIL_END if self._has_armed[index] else _BOOT_UNTIL_DISARM)

    def _start_log(self, index: int, commander: Commander, now_us: int) -> None:
        self.flush()  # earlier copies do not belong to this log
        offset_s = 60 * int(commander.parameters.get("SDLOG_UTC_OFFSET"))
        name = log_name((EPOCH_US + now_us) // 1_000_000 + offset_s)
        try:
            path, file = self.folders[index].create(name)
        except OSError as error:
            self._give_up(
                index, f"cannot create a log in {self.folders[index].root}, logging is off until the next boot: {error}"
            )
            return
        log = self._logs[index] = _FileLog(path, file, now_us, self._status[index], self._texts[index])
        self.folders[index].current = path
        self._update_active()
        self._status[index].restart()
        self._write_definitions(log.writer, commander, offset_s)
        self._write(index, log)
        # announce the name without a number for duplicates: MAVLink output must not depend on files on the disk
        begun = (int(part) for part in re.findall(r"\d+", name))
        commander.tell(_INFO, f"[logger] ./log/{name}", "logger_open_file_time", *begun)

    def _end_log(self, index: int) -> None:
        log = self._logs[index]
        if log is not None:
            log.close()
            self._logs[index] = None
            self.folders[index].current = None
            self._update_active()

    # streams

    def open_stream(self, index: int) -> LogStream | None:
        """Begin to stream a vehicle's log from the current time, independently of files.

        The stream contains all definitions at once. Data follow from the first ``update`` at which none of them
        remain.

        Args:
            index: index of the vehicle.

        Returns:
            The stream, to be ended by its ``close``; None while another stream of this vehicle is open.
        """
        if index in self._streams and not self._streams[index].stream.closed:
            return None
        self._end_stream(index)
        commander, now_us, stream = self._commanders[index], self._autopilot.time_us, LogStream()
        log = _StreamedLog(stream, now_us, StatusTopics(commander, self._ids, topics_on_change.MAVLINK))
        self._write_definitions(log.writer, commander, 60 * int(commander.parameters.get("SDLOG_UTC_OFFSET")))
        log.writer.flush()
        stream.finish_definitions()
        self._streams[index] = log
        self._attach_listeners(index)
        return stream

    def _update_streams(self, now_us: int) -> None:
        for index, log in list(self._streams.items()):
            if log.stream.closed:
                self._end_stream(index)
                continue
            if not log.has_data and not log.stream.definitions:
                self.flush()
                log.has_data = True
                self._update_active()
            if log.has_data and now_us > 0:
                log.status.update(now_us)

    def _end_stream(self, index: int) -> None:
        log = self._streams.get(index)
        if log is None:
            return
        self.flush()
        log.stream.close()
        del self._streams[index]
        self._update_active()
        if not self.folders:
            self._detach_listeners(index)

    def _give_up(self, index: int, text: str) -> None:
        """Stop logging of a vehicle until its next boot; the flight continues."""
        commander = self._commanders[index]
        _log.error("%s: %s", commander.vehicle.name, text)
        self._unwritable[index] = True
        self._end_log(index)
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
        formats += [(number, topics_on_change.FORMATS[name]) for name, number in self._ids.items()]
        for _, layout in formats:
            writer.add_format(layout)
        for name in PARAMETER_NAMES:
            _write_parameter(writer, commander.parameters, name)
        for number, layout in formats:
            writer.subscribe(number, layout)

    # sampling

    def step(self) -> None:
        """Copy the records of the current step."""
        if not self._active:
            return
        now_us = self._autopilot.time_us
        row = self._fast_count
        self._fast_us[row] = now_us
        self._fast.store(row)
        self._fast_count = row + 1
        if now_us % BASE_PERIOD_US == 0:
            row = self._base_count
            self._base_us[row] = now_us
            for ring in self._base:
                ring.store(row)
            self._base_count = row + 1
        if self._fast_count == _FAST_ROWS or self._base_count == _BASE_ROWS:
            self.flush()

    def flush(self) -> None:
        """Write the copies made since the last flush."""
        if not self._active:
            return
        if self._fast_count:
            self._add_sampled()
            self._fast_count = self._base_count = 0
        for i, log in list(self._active):
            self._write(i, log)

    def _add_sampled(self) -> None:
        fast_us, base_us = self._fast_us[: self._fast_count], self._base_us[: self._base_count]
        sensors = self._fast.copies[: self._fast_count]
        base = [ring.copies[: self._base_count] for ring in self._base]
        logs = [(i, log.writer) for i, log in self._active]
        for schedule, topics in self._schedules:
            fresh = sensors[schedule.fresh] != 0 if schedule.fresh else None
            time_us, sources = (fast_us, [sensors] * 5) if schedule.fast else (base_us, base)
            rows = schedule.rows(time_us, None if fresh is None else fresh.any(axis=1))
            if not len(rows):
                continue
            chosen = _as_slice(rows)
            parts = [source[chosen] for source in sources]
            samples = Samples(time_us[chosen], parts[0], parts[1], parts[2], parts[3], parts[4], self._rotors)
            valid = None if fresh is None or fresh[chosen].all() else fresh[chosen]
            for sampled in topics:
                self._add_messages(sampled.messages(samples), valid, logs)

    @staticmethod
    def _add_messages(
        messages: np.ndarray, valid: NDArray[np.bool_] | None, logs: list[tuple[int, UlogWriter]]
    ) -> None:
        """Add each vehicle's messages to its log; ``valid`` (times, vehicles) selects them, None for all."""
        if valid is not None:
            for i, writer in logs:
                writer.add_messages(messages[i][valid[:, i]].tobytes())
            return
        data = memoryview(messages.tobytes())
        size = messages.shape[1] * messages.itemsize
        for i, writer in logs:
            writer.add_messages(data[i * size : (i + 1) * size])

    def _write(self, index: int, log: _VehicleLog) -> None:
        writer, topics = log.writer, log.status
        now_us = self._autopilot.time_us
        for severity, time_us, text in log.texts:
            writer.add_messages(ulog_format.logged_string(severity, time_us, text))
        log.texts.clear()
        seconds = (now_us - log.reported_us) * 1e-6
        if seconds >= 1.0:
            topics.written(writer.written / 1000.0, (writer.written - log.reported_bytes) / 1000.0 / seconds, now_us)
            log.reported_us, log.reported_bytes = now_us, writer.written
        writer.add_messages(topics.take())
        try:
            writer.flush()
        except OSError as error:
            self._give_up(index, f"cannot write {log.name}, logging is off until the next boot: {error}")
