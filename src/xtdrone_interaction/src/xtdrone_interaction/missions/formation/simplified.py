"""The formation flight on the simplified simulator: in one process, or on ROS, with film and comparison."""

from __future__ import annotations

import contextlib
import inspect
import math
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from xtdrone_common.programs.node_command_line import speed_setting
from xtdrone_common.settings import Settings, setting
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_interaction.command_options import (
    MAX_SWARM,
    clearance_setting,
    patterns_setting,
    seed_setting,
    vehicles_setting,
)
from xtdrone_interaction.launching.supervised_launch import DemoError, Interrupted, escape, raise_on_signals
from xtdrone_interaction.missions.formation.cli import FormationSettings, show_event
from xtdrone_interaction.missions.formation.cli import fly as run_ros_demo
from xtdrone_interaction.missions.formation.criteria import waive_setting
from xtdrone_interaction.missions.formation.record import FormationRecord, read_formation, save_formation
from xtdrone_interaction.missions.formation.swarm_flight import FormationFlight, outcome_of
from xtdrone_interaction.monitoring.progress_display import Display, LineDisplay, LiveDisplay
from xtdrone_interaction.recording.recorded_flight import RecordError

if TYPE_CHECKING:
    from xtdrone_coordination.network import NetworkOptions
    from xtdrone_interaction.missions.mission import FlightReport
    from xtdrone_swarm import Swarm

SIMPLIFIED_TRUTH = "truth (simplified simulator, in one process)"
FULL_TRUTH = "truth (full physics, in one process)"
FULL_IN_PROCESS = "the same flight in full physics, in one process, with the same assignments"
MOST_COMPARED = 50  # vehicles; larger flights are compared only on request
_DELAY = 0.25  # s of wall time, the longest delay that a paced flight catches up: longer than a picture, unlike a pause
_END = object()


@dataclass(frozen=True)
class FilmSettings:
    """Film and window of a flight.

    Attributes:
        file: .mp4, .gif or .png; None for no film.
        window: whether to open a live window.
    """

    file: Path | None
    window: bool


@dataclass(frozen=True, kw_only=True)
class SwarmSettings(Settings):
    """Settings of a formation flight in one process.

    Attributes:
        pattern_file: YAML file with the user's patterns, or empty.
        follower: class of the followers.
        leader: class of the leader.
        out: folder of the results.
        model: ``first-order``, ``second-order``, a YAML file, or empty for the default of the type.
        network: communication between the vehicles; None for an ideal network.
        compare: also fly in full physics, and compare.
        compare_with: file of the same flight in the full simulator, to compare with; None for none.
        recorded: content of ``compare_with``.
    """

    n: int = vehicles_setting(high=MAX_SWARM)
    kind: str = setting("iris", option="--type", metavar="TYPE", text="vehicle type")
    patterns: tuple[str, ...] = patterns_setting()
    pattern_file: str = ""
    follower: type[Follower] = Follower
    leader: type[Leader] = Leader
    control: str = setting("vel", choices=("vel", "accel"), text="what followers command")
    clearance: float = clearance_setting()
    seed: int = seed_setting("seed of the network and, in full physics, of all noise")
    speed: float = speed_setting("target speed (default: 10 with a window, else unlimited)")
    waive: tuple[str, ...] = waive_setting()
    out: Path = Path()
    headless: bool = setting(False, text="no window, no live display; print a progress line every few seconds")
    model: str = setting(
        "",
        metavar="MODEL",
        text="first-order, second-order, or a YAML file with its parameters (default: that of the type)",
    )
    network: NetworkOptions | None = None
    compare: bool = False
    compare_with: Path | None = None
    recorded: FormationRecord | None = None

    def stored(self) -> dict[str, Any]:
        """Return the settings stored in the report."""
        left_out = ("out", "headless", "follower", "leader", "network", "recorded")
        values = {k: v for k, v in vars(self).items() if k not in left_out}
        values["follower"] = f"{self.follower.__module__}:{self.follower.__qualname__}"
        values["leader"] = f"{self.leader.__module__}:{self.leader.__qualname__}"
        values["compare_with"] = str(self.compare_with) if self.compare_with else ""
        if self.network is not None:  # JSON has no infinity
            values["network"] = {k: v if np.isfinite(v) else "unlimited" for k, v in asdict(self.network).items()}
        values["simulator"] = "simplified"
        return values


# in one process


def make_swarm(settings: SwarmSettings, *, full: bool, leader: type[Leader] | None = None) -> Swarm:
    """Return the swarm of a flight, on the ground.

    Args:
        settings: of the flight.
        full: in full physics instead of simplified.
        leader: class of the leader; None for that of the settings.

    Raises:
        PatternError, ModelError, FleetError, ValueError: a value that is not allowed.
    """
    from xtdrone_swarm import Swarm

    vehicles = None
    if full:
        from xtdrone_swarm.full_vehicles import CoreVehicles  # imports pybullet

        vehicles = CoreVehicles(settings.n, kind=settings.kind, seed=settings.seed)
    network: dict[str, Any] = {} if settings.network is None else {"network": settings.network}
    return Swarm(
        settings.n,
        follower=settings.follower,
        leader=leader or settings.leader,
        kind=settings.kind,
        model=settings.model or None,
        vehicles=vehicles,
        airborne=False,
        pattern_file=settings.pattern_file or None,
        follower_options={"mode": settings.control},
        seed=settings.seed,
        record=False,
        **network,
    )


def run_in_process(settings: SwarmSettings, film: FilmSettings, console: Console) -> int:
    """Fly in one process, and make report, pictures, film and comparison.

    Returns:
        The exit status: 0 for a good flight, 1 for one that failed or missed a limit, 128 + signal when stopped.
    """
    begin = time.monotonic()
    settings.out.mkdir(parents=True, exist_ok=True)
    console.print(f"Results: {settings.out}", highlight=False, soft_wrap=True)

    def fly() -> int:
        record = _fly(settings, film, console)
        save_formation(record, settings.out / "flight.npz")
        _check_outcome(record)
        return _conclude(record, settings, film, begin, console)

    try:
        return _run_reported(fly, console)
    finally:
        with contextlib.suppress(OSError):  # it is not empty
            settings.out.rmdir()


def _fly(
    settings: SwarmSettings, film: FilmSettings, console: Console, *, like: FormationRecord | None = None
) -> FormationRecord:
    """Fly once, showing the progress; return a failed flight, too.

    Args:
        settings: Settings of the flight.
        film: Film and window.
        console: Console for the progress.
        like: If given, fly in full physics with the assignments of this flight.
    """
    full = like is not None
    leader = None
    if like is not None:
        from xtdrone_interaction.missions.formation.compare_simulators import with_assignments_of  # imports Matplotlib

        leader = with_assignments_of(like, settings.leader)
    swarm = make_swarm(settings, full=full, leader=leader)
    begin = "flying the same in full physics" if full else "taking off"
    plain = settings.headless or not console.is_terminal
    display: Display = LineDisplay(console, begin) if plain else LiveDisplay(console, begin)
    flight = FormationFlight(
        swarm,
        settings.patterns,
        clearance=settings.clearance,
        source=FULL_TRUTH if full else SIMPLIFIED_TRUTH,
        progress=display.update,
        on_event=lambda event: show_event(event, display),
    )
    turns = flight.turns()
    pacing = _Pacing(0.0 if full else settings.speed)
    try:
        if film.window and not full:
            _show(swarm, turns, settings.speed, display)
        for _ in turns:  # all turns, or the remaining ones after the window was closed
            pacing.wait(swarm.time)
    except Exception as error:
        fault = _own_fault(error, settings)
        if not fault:
            raise
        raise DemoError(f"at {swarm.time:.1f} s: {fault}") from error
    finally:
        display.close()
        swarm.vehicles.close()
    return flight.record()


def _own_fault(error: Exception, settings: SwarmSettings) -> str:
    """Describe an error raised in a class of the user, with file and line; return "" for other errors."""
    shipped = {Path(inspect.getfile(cls)) for cls in (Follower, Leader)}
    files = {Path(inspect.getfile(cls)) for cls in (settings.follower, settings.leader)} - shipped
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename) in files]
    if not own:
        return ""
    last = own[-1]
    return f"{type(error).__name__}: {error} ({last.filename}, line {last.lineno}, in {last.name}: {last.line})"


def _check_outcome(record: FormationRecord, where: str = "") -> None:
    """Raise DemoError for a failed flight; ``where`` is a prefix of the reason."""
    outcome, reason = outcome_of(record)
    if outcome != "done":
        raise DemoError(f"{where}{reason}")


class _Pacing:
    """Paces a flight at a real-time factor; 0 for unlimited."""

    def __init__(self, factor: float) -> None:
        self._factor = factor
        self._start: float | None = None

    def ahead(self, sim_time: float) -> float:
        """Return the wall time left until ``sim_time``, both in s; a long delay is not caught up."""
        if not self._factor:
            return 0.0
        now = time.monotonic()
        if self._start is None or now > self._start + sim_time / self._factor + _DELAY:
            self._start = now - sim_time / self._factor
        return self._start + sim_time / self._factor - now

    def wait(self, sim_time: float) -> None:
        """Wait until the wall clock reaches ``sim_time``, s."""
        ahead = self.ahead(sim_time)
        if ahead > 0.0:
            time.sleep(ahead)


def _show(swarm: Swarm, turns: Iterator[None], speed: float, display: Display) -> None:
    """Fly in a live window until the flight ends or the window is closed; print a note if none can be opened.

    Args:
        swarm: Vehicles to show.
        turns: Turns of the flight.
        speed: Real-time factor, 0 for unlimited.
        display: Display that prints the note.
    """
    from xtdrone_swarm.view import WindowError  # imports Matplotlib
    from xtdrone_swarm.view.view_of_swarm import play

    try:
        play(swarm, lambda: next(turns, _END) is not _END, speed=speed or math.inf)
    except WindowError as error:
        display.note(f"  {escape(str(error))}")


# results of a flight


def _conclude(
    record: FormationRecord, settings: SwarmSettings, film: FilmSettings, begin: float, console: Console
) -> int:
    from xtdrone_interaction.missions.formation.report import FormationMission  # imports Matplotlib, which is slow
    from xtdrone_interaction.missions.mission import make_report
    from xtdrone_interaction.report.html_page import print_page

    stored = {**settings.stored(), "command_wall": begin}
    made = make_report(FormationMission(), settings.out / "flight.npz", stored)
    print_page(made.page, console)
    return _compare_and_save(made, record, settings, film, console)


def _compare_and_save(
    made: FlightReport, record: FormationRecord, settings: SwarmSettings, film: FilmSettings, console: Console
) -> int:
    """Compare with a full flight if wanted, write the report, and return the exit status."""
    from xtdrone_interaction.missions.mission import REPORT, save_report
    from xtdrone_interaction.report.report_json import write_report

    write_report(made.data, settings.out / REPORT)  # first, in case a later step fails
    try:
        if settings.compare or settings.compare_with:
            _add_comparison(made, record, *_full_flight(record, settings, console), console)
    except (DemoError, RecordError):
        save_report(made, settings.out, console)
        raise
    status = save_report(made, settings.out, console, film.file)
    return 1 if film.file is not None and not film.file.is_file() else status


def _full_flight(record: FormationRecord, settings: SwarmSettings, console: Console) -> tuple[FormationRecord, str]:
    if settings.recorded is not None:
        return settings.recorded, str(settings.compare_with)
    full = _fly(settings, FilmSettings(None, window=False), console, like=record)
    _check_outcome(full, "in full physics: ")
    return full, FULL_IN_PROCESS


def _add_comparison(
    made: FlightReport, record: FormationRecord, full: FormationRecord, what: str, console: Console
) -> None:
    """Add a comparison with a full flight to a report, and print it.

    Raises:
        RecordError: the two cannot be compared.
    """
    from xtdrone_interaction.missions.formation.compare_simulators import (
        as_data,
        compare,
        comparison_figures,
        comparison_table,
        summarise_comparison,
    )
    from xtdrone_interaction.report.report_tables import print_table

    differences = compare(record, full)
    table, text = comparison_table(differences), summarise_comparison(differences)
    print_table(table, console)
    console.print(escape(text), highlight=False)
    made.data["comparison"] = as_data(differences, what)
    made.page.tables.append(table)
    made.page.summary += f"\n{text}"
    made.figures = chain(made.figures, comparison_figures(record, full))


# on ROS


def run_on_ros(demo: FormationSettings, settings: SwarmSettings, film: FilmSettings, console: Console) -> int:
    """Fly on ROS with the simplified simulator, then compare and film; see :func:`run_in_process`."""
    from xtdrone_interaction.missions.formation.report import FormationMission  # imports Matplotlib, which is slow
    from xtdrone_interaction.missions.mission import REPORT, make_report_again

    status = run_ros_demo(demo, console)
    if status not in (0, 1) or not (demo.out / REPORT).is_file():
        return status

    def conclude() -> int:
        bag = demo.out / "flight.bag"
        made = make_report_again(FormationMission(), bag)
        return max(status, _compare_and_save(made, read_formation(bag), settings, film, console))

    return _run_reported(conclude, console) if settings.compare or settings.compare_with or film.file else status


def _run_reported(run: Callable[[], int], console: Console) -> int:
    """Call ``run`` and return its exit status; print an error or a signal, and return its status."""
    with raise_on_signals():
        try:
            return run()
        except (DemoError, RecordError, OSError) as error:
            console.print(f"[red]Error:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
            return 1
        except Interrupted as signalled:
            console.print(f"stopped by {signalled}", highlight=False)
            return 128 + signalled.number
