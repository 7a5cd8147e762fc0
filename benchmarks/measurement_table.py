"""The table of all measurements of ``./xtdrone bench``: command, default numbers, limits, and columns.

A measurement's command gets a case (a number of vehicles, an image size, ...) and returns a row of figures: a
:class:`~benchmarks.measurement_runner.Program`, a :class:`~benchmarks.measurement_runner.Flight`, or a function. A new
measurement is one more entry of :data:`MEASUREMENTS`; its goal is an entry of ``goals.GOALS``.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from benchmarks.flights.free_running_flights import measure_free
from benchmarks.flights.search_flights import SEARCHERS, search_arguments, search_figures
from benchmarks.flights.sensing_flights import SENSORS, limiting, sensing_arguments, sensing_figures
from benchmarks.flights.stack_and_formation_flights import (
    formation_arguments,
    formation_figures,
    formation_probe,
    probe_figures,
    stack_arguments,
    stack_figures,
)
from benchmarks.flights.web_flights import CLIENTS, measure_web
from benchmarks.goals import goal_of
from benchmarks.measurement_runner import Bench, Case, Flight, Program, Row
from benchmarks.programs.effects import EFFECTS
from benchmarks.tables.table_columns import (
    DRAWING_PROGRAMS,
    Field,
    flight_time,
    frame_cpu,
    input_size,
    median,
    share,
    spread,
)
from xtdrone_common.fleet import MAX_VEHICLES

_MESSAGES = ("PositionTarget", "PoseStamped", "Imu", "Odometry", "TFMessage", "ModelStates")
_CODEC_METHODS = ("encode", "genpy_encode", "decode", "genpy_decode")
_FILMS = ((1280, 720, True), (1280, 720, False), (640, 360, True))  # width and height in pixels, antialiasing
_BACKENDS = ("egl", "tiny")
_LIDARS = ("scan", "spinning", "pattern")
_SCAN_WORKS = ("odometry", "local_map", "octree")
_PARTICIPANTS = ("python", "cpp")
_NO_PARTICIPANTS = "none"
_STATIONS = 1  # ground stations of each vehicle
_MOST_PER_UAV = 60  # vehicles; more are flown with a process per UAV only where that is chosen: 2 processes each

Cases = Callable[[str, int, Sequence[str]], Iterator[Case]]
"""Yields the cases of a part (its name) for a number and for the modes of the formation."""


# ---- cases


def _vehicles(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    yield Case(part, _title(count), {"vehicles": count}, str(count))


def _title(count: int) -> str:
    return f"{count} {'vehicle' if count == 1 else 'vehicles'}"


def _workers(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    yield Case(part, f"{count} workers", {"workers": count}, str(count))


def _widths(part: str, width: int, modes: Sequence[str]) -> Iterator[Case]:
    yield Case(part, f"{width} px wide", {"width": width}, str(width))


def _pictures(part: str, width: int, modes: Sequence[str]) -> Iterator[Case]:
    for height in (width * 9 // 16, width * 3 // 4):
        for backend in _BACKENDS:
            known = {"width": width, "height": height, "backend": backend}
            yield Case(part, f"{width} x {height} px, {backend}", known, f"{width}x{height}-{backend}")


def _lidars(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    for kind in _LIDARS:
        yield Case(part, f"{count} {kind}", {"lidars": count, "kind": kind}, f"{count}-{kind}")


def _effects(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    for effect in EFFECTS:
        yield Case(part, f"{_title(count)}, {effect}", {"vehicles": count, "effect": effect}, f"{count}-{effect}")


def _sensors(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    for sensors in SENSORS:
        known = {"vehicles": count, "sensors": sensors}
        yield Case(part, f"{_title(count)}, {sensors}", known, f"{count}-{sensors.replace(' ', '')}")


def _scan_works(part: str, rings: int, modes: Sequence[str]) -> Iterator[Case]:
    for kind in _SCAN_WORKS:
        yield Case(part, f"{kind.replace('_', ' ')}, {rings} rings", {"rings": rings, "kind": kind}, f"{rings}-{kind}")


def _films(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    for width, height, smooth in _FILMS:
        known = {"vehicles": count, "width": width, "height": height, "antialiasing": smooth}
        suffix = f"{count}-{width}x{height}{'' if smooth else '-rough'}"
        yield Case(part, _film_label(known), known, suffix)


def _bags(part: str, megabytes: int, modes: Sequence[str]) -> Iterator[Case]:
    yield Case(part, f"bag of {megabytes} MB", {"megabytes": megabytes}, str(megabytes))


def _messages(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    for name in _MESSAGES:
        yield Case(part, f"{name}, {_title(count)}", {"message": name, "vehicles": count}, f"{count}-{name}")


def _participants(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    for kind in _PARTICIPANTS if count else (_NO_PARTICIPANTS,):
        title = f"{count} participants" + (f", {kind}" if count else "")
        yield Case(part, title, {"participants": count, "kind": kind}, f"{count}-{kind}")


def _links(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    yield Case(part, _title(count), {"vehicles": count, "stations": _STATIONS}, str(count))


def _formations(part: str, count: int, modes: Sequence[str]) -> Iterator[Case]:
    for mode in modes:
        if mode != "shared" and count > _MOST_PER_UAV and len(modes) > 1:
            continue
        title = f"{_title(count)}, processes {mode.replace('_', ' ')}"
        yield Case(part, title, {"vehicles": count, "mode": mode}, f"{count}-{mode}")


def _rates(part: str, rate: int, modes: Sequence[str]) -> Iterator[Case]:
    yield Case(part, f"{rate} Hz", {"vehicles": SEARCHERS, "camera_rate": rate}, str(rate))


# ---- labels and summaries


def _vehicle_label(row: Row) -> str:
    return str(row["vehicles"])


def _film_label(row: Row) -> str:
    size = f"{row['width']} x {row['height']} px"
    return f"{row['vehicles']} vehicles, {size}{'' if row['antialiasing'] else ', rough'}"


def _effect_label(row: Row) -> str:
    return f"{row['vehicles']} {row['effect']}"


def _sensors_label(row: Row) -> str:
    return f"{row['vehicles']} {row['sensors']}"


def _formation_label(row: Row) -> str:
    return f"{row['vehicles']} {row['mode'].replace('_', '-')}"


def _message_label(row: Row) -> str:
    return f"{row['message']}, {_title(row['vehicles'])}"


def _participant_label(row: Row) -> str:
    return f"{row['participants']} {row['kind']}"


def _first(heading: str, label: Callable[[Row], str]) -> Field:
    return heading, lambda rows: label(rows[0])


def _speed_summary(row: Row) -> str:
    return f"{row['real_time_factor']:.2f} x real time"


def _picture_summary(row: Row) -> str:
    return f"{row['milliseconds']:.1f} ms per image"


def _free_summary(row: Row) -> str:
    exact, free = row["exact_real_time_factor"], row["free_real_time_factor"]
    return f"{exact:.2f} x real time, free-running {free:.2f} x"


def _web_summary(row: Row) -> str:
    cost = f"{row['cost']:.1%} more CPU time"
    return f"{row['station_cores']:.3f} cores, {cost}, {row['kept']:.2f} of the real-time factor"


def _analysis_summary(row: Row) -> str:
    return f"{row['megabytes_per_second']:.0f} MB/s, {row['memory_bytes'] * 1e-6:.0f} MB of memory"


def _per_participant(rows: Sequence[Row]) -> str:
    count = rows[0]["participants"]
    return f"{statistics.median(row['median_us'] for row in rows) / count:.2f}" if count else ""


def _per_second(rows: Sequence[Row], milliseconds: str) -> str:
    """Return the rate per second that follows from the median of a time."""
    return f"{1e3 / statistics.median(row[milliseconds] for row in rows):.0f}"


_VEHICLES = _first("vehicles", _vehicle_label)

# ---- the table


@dataclass(frozen=True)
class Measurement:
    """One part of the benchmark.

    Attributes:
        name: of the part.
        title: of its table.
        command: measures a case.
        numbers: measured by default.
        limits: lowest and highest number that is allowed.
        fields: columns of its table after the first one.
        summary: main figures of a row, for the line that follows a measurement.
        counted: the thing that is counted; vehicles and participants are given for all parts at once.
        multiple_of: divisor of every number.
        cases: the cases of a number.
        label: name of a row's case.
        first: first column, which names the case.
    """

    name: str
    title: str
    command: Callable[[Bench, Case], Row]
    numbers: tuple[int, ...]
    limits: tuple[int, int]
    fields: tuple[Field, ...]
    summary: Callable[[Row], str] = _speed_summary
    cases: Cases = _vehicles
    label: Callable[[Row], str] = _vehicle_label
    first: Field = _VEHICLES
    counted: str = "vehicles"
    multiple_of: int = 1

    @property
    def counts_vehicles(self) -> bool:
        """Whether a number without the name of a part applies to this part."""
        return self.counted in ("vehicles", "participants")


_CORE_SECONDS = {"seconds": "core_seconds"}
_SPEED: Field = ("real-time\nfactor", spread("real_time_factor", " x"))
_OVERLAP: Field = ("cores\nused", median("overlap", ".0%"))
_PROCESSES: tuple[Field, ...] = (
    ("start\ns", median("startup_seconds", ".1f")),
    ("memory\nMB", median("memory_bytes", ".0f", 1e-6)),
    ("pro-\ncesses", median("processes", ".0f")),
)


_TABLE = (
    Measurement(
        name="core",
        title="Core: physics, sensors, autopilots; no ROS",
        command=Program("core", _CORE_SECONDS),
        numbers=(1, 9, 30, 100),
        limits=(1, MAX_VEHICLES),
        fields=(
            _SPEED,
            goal_of("core"),
            ("vehicle-steps/s", median("vehicle_steps_per_second", ".0f")),
            ("us/vehicle-step", median("microseconds_per_vehicle_step", ".2f")),
        ),
    ),
    Measurement(
        name="simplified",
        title="Simplified simulator: vehicles, consensus, avoidance; no ROS, one core",
        command=Program("simplified", _CORE_SECONDS),
        numbers=(9, 100, 1000),
        limits=(2, 10_000),
        fields=(
            _SPEED,
            goal_of("simplified"),
            ("us/vehicle-turn", median("microseconds_per_vehicle_turn", ".2f")),
        ),
    ),
    Measurement(
        name="drawing",
        title="Drawing of the simplified simulator, off-screen",
        command=Program("drawing", _CORE_SECONDS),
        numbers=(9, 100, 1000),
        limits=(2, 10_000),
        fields=(("pictures/s", spread("pictures_per_second")), goal_of("drawing")),
        summary=lambda row: f"{row['pictures_per_second']:.1f} images per second",
    ),
    Measurement(
        name="sweep",
        title="Sweep: flights of nine simplified vehicles through three patterns",
        command=Program("sweep", {"seconds": "sweep_seconds"}),
        numbers=(2,),
        limits=(2, 64),
        fields=(
            ("runs/s", spread("runs_per_second")),
            ("with one\nworker", spread("one_worker")),
            ("speed-up", spread("speed_up", " x")),
            goal_of("sweep"),
        ),
        summary=lambda row: (
            f"{row['runs_per_second']:.1f} runs per second, {row['speed_up']:.2f} x those of one worker"
        ),
        cases=_workers,
        label=lambda row: f"{row['workers']} workers",
        first=_first("workers", lambda row: str(row["workers"])),
        counted="workers",
    ),
    Measurement(
        name="detector",
        title="Detector of people on one core, by the width of its input",
        command=Program("detector", _CORE_SECONDS),
        numbers=(320, 416, 640),
        limits=(32, 2048),
        fields=(("ms/picture", spread("milliseconds")),),
        summary=_picture_summary,
        cases=_widths,
        label=lambda row: f"{row['width']} px wide",
        first=("input\npx", input_size),
        counted="widths",
        multiple_of=32,
    ),
    Measurement(
        name="renderer",
        title="Images of the world outdoor, one process",
        command=Program("renderer", _CORE_SECONDS),
        numbers=(320, 640),
        limits=(16, 4096),
        fields=(
            ("CPU\nms/picture", spread("milliseconds")),
            ("wall\nms/picture", spread("wall_milliseconds")),
            ("depth\n1/s", lambda rows: _per_second(rows, "depth_milliseconds")),
            ("stereo\npairs/s", lambda rows: _per_second(rows, "stereo_milliseconds")),
        ),
        summary=_picture_summary,
        cases=_pictures,
        label=lambda row: f"{row['width']} x {row['height']} px, {row['backend']}",
        first=_first("picture", lambda row: f"{row['width']} x {row['height']} px, {row['backend']}"),
        counted="widths",
    ),
    Measurement(
        name="rays",
        title="Scans of lidars in the world outdoor at 10 Hz, one core",
        command=Program("rays", _CORE_SECONDS),
        numbers=(1, 6),
        limits=(1, 100),
        fields=(
            ("million\nrays/s", spread("million_rays_per_second")),
            _SPEED,
            goal_of("rays"),
        ),
        summary=lambda row: f"{row['million_rays_per_second']:.2f} million rays per second",
        cases=_lidars,
        label=lambda row: f"{row['lidars']} {row['kind']}",
        first=_first("lidars", lambda row: f"{row['lidars']} {row['kind']}"),
        counted="lidars",
    ),
    Measurement(
        name="effects",
        title="Air: each effect on vehicles in flight; us per vehicle and step of 4 ms",
        command=Program("effects", _CORE_SECONDS),
        numbers=(1, 6, 30),
        limits=(1, MAX_VEHICLES),
        fields=(
            ("the\neffect", spread("effect_microseconds")),
            ("the whole\nflight", spread("microseconds_per_vehicle_step")),
            _SPEED,
        ),
        summary=lambda row: f"{row['effect_microseconds']:.2f} us per vehicle and step",
        cases=_effects,
        label=_effect_label,
        first=_first("vehicles", _effect_label),
    ),
    Measurement(
        name="planning",
        title="Planning in a forest, a lidar of 32 x 512 rays; CPU ms of one vehicle",
        command=Program("planning", _CORE_SECONDS),
        numbers=(1, 4),
        limits=(1, 10),
        fields=(
            ("a plan\nms", spread("plan_milliseconds")),
            ("95 %\nms", spread("plan_p95")),
            ("a map\nupdate ms", spread("map_milliseconds")),
            ("95 %\nms", spread("map_p95")),
            goal_of("planning"),
        ),
        summary=lambda row: (
            f"{row['plan_milliseconds']:.1f} ms per plan, {row['map_milliseconds']:.1f} ms per map update"
        ),
        counted="planners",
    ),
    Measurement(
        name="odometry",
        title="Work on a scan of 1024 columns: lidar odometry, local map, octree; one core",
        command=Program("odometry", _CORE_SECONDS),
        numbers=(16,),
        limits=(1, 128),
        fields=(
            ("CPU\nms/scan", spread("milliseconds")),
            ("most", median("most_milliseconds", ".1f")),
            goal_of("odometry"),
        ),
        summary=lambda row: f"{row['milliseconds']:.1f} ms per scan",
        cases=_scan_works,
        label=lambda row: f"{row['kind']}, {row['rings']} rings",
        first=_first("work", lambda row: f"{row['kind'].replace('_', ' ')}, {row['rings']} rings"),
        counted="rings",
    ),
    Measurement(
        name="rviz",
        title="Films of rviz without a screen, the formation's view; CPU ms per frame",
        command=Program("rviz", _CORE_SECONDS),
        numbers=(9, 30),
        limits=(1, MAX_VEHICLES),
        fields=(
            ("frames/s", spread("frames_per_second")),
            *((name, frame_cpu(name)) for name in DRAWING_PROGRAMS),
            ("others", frame_cpu()),
        ),
        summary=lambda row: f"{row['frames_per_second']:.1f} frames per second",
        cases=_films,
        label=_film_label,
        first=_first("film", _film_label),
    ),
    Measurement(
        name="analyse",
        title="Analysis of a bag of poses, velocities and states, not packed",
        command=Program("analysis"),
        numbers=(1000,),
        limits=(1, 20_000),
        fields=(
            ("reading\nMB/s", spread("megabytes_per_second")),
            goal_of("analyse"),
            ("CPU\ns", spread("cpu_seconds")),
            ("messages", median("messages", ".0f")),
            ("memory\nMB", median("memory_bytes", ".0f", 1e-6)),
            ("report\ns", median("report_seconds", ".1f")),
        ),
        summary=_analysis_summary,
        cases=_bags,
        label=lambda row: f"{row['megabytes']} MB",
        first=_first("bag", lambda row: f"{row['megabytes']} MB"),
        counted="megabytes",
    ),
    Measurement(
        name="codecs",
        title="Codecs of ROS messages, compiled and genpy's: us per message",
        command=Program("codecs", {"seconds": "core_seconds"}),
        numbers=(9,),
        limits=(1, MAX_VEHICLES),
        fields=tuple((name.replace("_", "\n"), spread(name)) for name in _CODEC_METHODS),
        summary=lambda row: f"encode {row['encode']:.2f} us, decode {row['decode']:.2f} us",
        cases=_messages,
        label=_message_label,
        first=_first("message", _message_label),
    ),
    Measurement(
        name="barrier",
        title="Barrier of the lockstep, participants that do nothing: us per tick",
        command=Program("barrier", {"seconds": "barrier_seconds", "ticks": "barrier_ticks"}),
        numbers=(0, 1, 9, 20, 60),
        limits=(0, MAX_VEHICLES),
        fields=(
            ("median", median("median_us", ".1f")),
            ("of each", _per_participant),
            ("mean", median("mean_us", ".1f")),
            ("p99", median("p99_us", ".1f")),
            ("server\nCPU", median("server_cpu_us", ".1f")),
            ("their\nCPU", median("participants_cpu_us", ".1f")),
            ("ticks", median("ticks", ".0f")),
        ),
        summary=lambda row: f"{row['median_us']:.0f} us per tick",
        cases=_participants,
        label=_participant_label,
        first=_first("participants", lambda row: _participant_label(row) if row["participants"] else "0"),
        counted="participants",
    ),
    Measurement(
        name="telemetry",
        title="MAVLink server at the default rates, two clients each",
        command=Program("telemetry", {"seconds": "telemetry_seconds"}),
        numbers=(9, 30, 100),
        limits=(1, MAX_VEHICLES),
        fields=(
            ("datagrams a\nsimulated s", median("messages", ".0f")),
            ("ns/datagram", median("microseconds", ".0f", 1e3)),
            ("datagrams a\nCPU s", lambda rows: f"{1e6 / statistics.median(r['microseconds'] for r in rows):.0f}"),
            ("share of a core\nat real time", spread("share")),
            ("setpoint\nns", median("setpoint", ".0f", 1e3)),
            ("MAVROS\nns", median("read", ".0f", 1e3)),
        ),
        summary=lambda row: f"{row['microseconds'] * 1e3:.0f} ns per datagram",
        cases=_links,
    ),
    Measurement(
        name="stack",
        title="Stack: simulator, MAVROS layer, one client",
        command=Flight("bench.launch", stack_arguments, stack_figures),
        numbers=(1, 9, 30, 100),
        limits=(1, MAX_VEHICLES),
        fields=(
            _SPEED,
            goal_of("stack"),
            ("messages/s", median("messages_per_second", ".0f")),
            _OVERLAP,
            *_PROCESSES,
        ),
    ),
    Measurement(
        name="sensing",
        title="Stack with a sensor on each vehicle, 10 Hz, world outdoor",
        command=Flight("bench.launch", sensing_arguments, sensing_figures),
        numbers=(6,),
        limits=(1, MAX_VEHICLES),
        fields=(
            _SPEED,
            goal_of("sensing"),
            ("frames a\nsim. s", median("frames_per_simulated_second", ".1f")),
            _OVERLAP,
            ("most\ncores", limiting),
        ),
        cases=_sensors,
        label=_sensors_label,
        first=_first("vehicles", _sensors_label),
    ),
    Measurement(
        name="formation",
        title="Formation flight",
        command=Flight("formation.launch", formation_arguments, formation_figures, formation_probe, probe_figures),
        numbers=(9, 30),
        limits=(2, MAX_VEHICLES),
        fields=(
            _SPEED,
            goal_of("formation"),
            ("flight\ns", flight_time),
            _OVERLAP,
            *_PROCESSES,
        ),
        cases=_formations,
        label=_formation_label,
        first=_first("vehicles", _formation_label),
    ),
    Measurement(
        name="search",
        title="Search with six cameras, film and bag; shares of its CPU time",
        command=Flight("bench_search.launch", search_arguments, lambda events, began: search_figures(events)),
        numbers=(2, 5),
        limits=(1, 10),
        fields=(
            _SPEED,
            goal_of("search"),
            *((name, share(name)) for name in ("cameras", "yolo", "simulator", "mavros", "others")),
        ),
        cases=_rates,
        label=lambda row: f"{row['camera_rate']} Hz",
        first=_first("rate", lambda row: f"{row['camera_rate']} Hz"),
        counted="rates",
    ),
    Measurement(
        name="free",
        title="Formation in lockstep, and free-running",
        command=measure_free,
        numbers=(9, 30),
        limits=(2, MAX_VEHICLES),
        fields=(
            ("in lockstep", spread("exact_real_time_factor", " x")),
            ("free-running", spread("free_real_time_factor", " x")),
            ("share", spread("exact_share")),
            goal_of("free"),
        ),
        summary=_free_summary,
    ),
    Measurement(
        name="web",
        title=f"Station in the browser with {CLIENTS} clients, and without, in a formation flight",
        command=measure_web,
        numbers=(30,),
        limits=(2, MAX_VEHICLES),
        fields=(
            ("with\nclients", spread("real_time_factor", " x")),
            ("without", spread("alone", " x")),
            ("share", spread("kept")),
            goal_of("web"),
            ("station\ncores", median("station_cores", ".3f")),
            ("more\nCPU time", median("cost", ".1%")),
            ("frames/s", median("frame_rate", ".1f")),
            ("bytes", median("frame_bytes", ".0f")),
        ),
        summary=_web_summary,
    ),
)
MEASUREMENTS: dict[str, Measurement] = {measurement.name: measurement for measurement in _TABLE}
"""All measurements by name, in the order of execution."""
