"""``xtdrone gcs``: plans of QGroundControl to vehicles and back, over MAVLink as any ground station does it.

Exit status: 0 when all was done, 1 when some vehicle has not done it, 2 for a value or file that is not allowed, 130
after Ctrl-C.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from xtdrone_control import qgc_plan
from xtdrone_control.autopilot import feasibility, geo, geofence, plan
from xtdrone_control.autopilot.feasibility import Situation
from xtdrone_control.fleet import FleetError, parse_fleet
from xtdrone_control.qgc_plan import Plan, PlanError

from . import exchanges, station
from .station import GcsError, Peer

_FIRST_DISTANCE = 900.0  # m, PX4's default of MIS_DIST_1WP


class UsageError(ValueError):
    """What was asked for is not allowed."""


# ---- what is shown


class Display:
    """A line for each vehicle: redrawn on a terminal, else one when it is done."""

    def __init__(self, names: Sequence[str], file: Any = None) -> None:
        """Show ``names`` on ``file``, standard output unless given."""
        self._file = file or sys.stdout
        self._lines = {name: "waiting" for name in names}
        self._live = bool(getattr(self._file, "isatty", lambda: False)())
        self._width = max(map(len, names), default=0) + 2
        self._drawn = False

    def watch(self, name: str, what: str, done: int, total: int) -> None:
        """Take a vehicle's progress."""
        self._set(name, f"{what} {done}/{total}", final=False)

    def end(self, name: str, text: str) -> None:
        """Take a vehicle's last line."""
        self._set(name, text, final=True)

    def _set(self, name: str, text: str, final: bool) -> None:
        self._lines[name] = text
        if self._live:
            self._draw()
        elif final:
            print(f"{name:<{self._width}}{text}", file=self._file, flush=True)

    def _draw(self) -> None:
        if self._drawn:
            print(f"\x1b[{len(self._lines)}A", end="", file=self._file)
        self._drawn = True
        for name, text in self._lines.items():
            print(f"\x1b[2K{name:<{self._width}}{text}", file=self._file)
        self._file.flush()


def _summary(content: Plan) -> str:
    """Return what a plan holds, in words."""
    counts = [len(content.items(kind)) for kind in plan.KINDS]
    words = [f"{counts[plan.MISSION]} items"]
    words += [f"{count} of {what}" for count, what in zip(counts[1:], ("fence", "rally points"), strict=True) if count]
    return ", ".join(words)


# ---- files


def find_files(paths: Sequence[Path]) -> list[Path]:
    """Return the plan files that ``paths``, files and folders, name.

    Raises:
        UsageError: one is not there, or is a folder without any.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(path.glob(f"*{qgc_plan.SUFFIX}"))
            if not inside:
                raise UsageError(f"{path}: no {qgc_plan.SUFFIX} file is in this folder")
            found += inside
        elif path.exists():
            found.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    return found


def read_plans(files: Sequence[Path]) -> dict[Path, Plan]:
    """Return the plans in files.

    Raises:
        UsageError: one cannot be used; a line for each of those.
    """
    plans: dict[Path, Plan] = {}
    wrong = []
    for file in files:
        try:
            plans[file] = qgc_plan.read(file)
            too_long = exchanges.check_kinds(plans[file])
            wrong += [f"{file}: {too_long}"] if too_long else []
        except PlanError as error:
            wrong.append(str(error))
    if wrong:
        raise UsageError("\n".join(wrong))
    return plans


def assign(plans: dict[Path, Plan], vehicles: Sequence[str]) -> dict[str, Plan]:
    """Return which vehicle gets which plan.

    Args:
        plans: by file; a file's name without ending is its vehicle's.
        vehicles: only these; a single file goes to all of them whatever it is called. Empty for every file's.

    Raises:
        UsageError: two files for one vehicle, or none.
    """
    if vehicles and len(plans) == 1:
        return dict.fromkeys(vehicles, next(iter(plans.values())))
    found: dict[str, Plan] = {}
    for file, content in plans.items():
        if file.stem in found:
            raise UsageError(f"{file}: a second plan for {file.stem}")
        found[file.stem] = content
    missing = [name for name in vehicles if name not in found]
    if missing:
        raise UsageError(f"vehicle: no file {missing[0]}{qgc_plan.SUFFIX} is among those given")
    return {name: content for name, content in found.items() if not vehicles or name in vehicles}


def problems(content: Plan) -> tuple[list[str], bool]:
    """Return what PX4 says of a mission before it flies it from the planned home, and whether it would.

    Warnings are said of missions that are flown, too.
    """
    home = content.home
    said: list[str] = []

    def to_plane(latitude: float, longitude: float) -> tuple[float, float]:
        return geo.project(latitude, longitude, home[0], home[1])

    fence = geofence.build(content.fence, to_plane)
    now = Situation(
        home_altitude=home[2],
        place=home[:2],
        landed=True,
        first_distance=_FIRST_DISTANCE,
        required=0,
        fence_allows=lambda latitude, longitude, _altitude: fence.allows(to_plane(latitude, longitude)),
    )
    good = feasibility.check(content.mission, now, lambda _severity, text, *_, **__: said.append(text))
    return said or ([] if good else ["the mission has no items"]), good


def way_length(content: Plan) -> float:
    """Return how long the mission's way is, m, from place to place, jumps not counted."""
    places = [item for item in content.mission if item.has_position]
    length = 0.0
    for a, b in pairwise(places):
        length += math.hypot(*geo.project(b.x, b.y, a.x, a.y), b.z - a.z if a.relative == b.relative else 0.0)
    return length


# ---- commands; each returns the exit status


def _upload(arguments: argparse.Namespace) -> int:
    plans = assign(read_plans(find_files(arguments.files)), arguments.vehicle)
    peers = _peers(plans, arguments)
    display = Display([peer.name for peer in peers])
    jobs = {
        peer: exchanges.store_plan(peer.system, plans[peer.name], station.progress_of(peer.name, display.watch))
        for peer in peers
    }
    results = _run(jobs, arguments)
    return _show(display, peers, results, lambda name, _: f"{_summary(plans[name])}: sent, and come back the same")


def _download(arguments: argparse.Namespace) -> int:
    peers = _named(arguments)
    folder: Path = arguments.to
    display = Display([peer.name for peer in peers])
    jobs = {peer: exchanges.fetch_plan(peer.system, station.progress_of(peer.name, display.watch)) for peer in peers}
    results = _run(jobs, arguments)
    folder.mkdir(parents=True, exist_ok=True)
    for name, result in results.items():
        if isinstance(result, Plan):
            try:
                qgc_plan.write(folder / f"{name}{qgc_plan.SUFFIX}", result)
            except (PlanError, OSError) as error:
                results[name] = GcsError(f"{name}: its plan cannot be written: {error}")
    return _show(display, peers, results, lambda name, result: f"{_summary(result)}: {folder / name}{qgc_plan.SUFFIX}")


def _clear(arguments: argparse.Namespace) -> int:
    peers = _named(arguments)
    display = Display([peer.name for peer in peers])
    jobs = {peer: exchanges.clear(peer.system, station.progress_of(peer.name, display.watch)) for peer in peers}
    return _show(display, peers, _run(jobs, arguments), lambda *_: "mission, fence and rally points are cleared")


def _check(arguments: argparse.Namespace) -> int:
    status = 0
    for file, content in read_plans(find_files(arguments.files)).items():
        said, good = problems(content)
        print(f"{file}: {_summary(content)}; {way_length(content):.0f} m of way")
        for text in said:
            print(f"{file}: {text}", file=sys.stderr)
        status = status if good else 1
    return status


def _run(jobs: dict[Peer, Any], arguments: argparse.Namespace) -> dict[str, Any]:
    return station.run(jobs, patience=arguments.patience)


def _show(display: Display, peers: Sequence[Peer], results: dict[str, Any], text: Callable[[str, Any], str]) -> int:
    """Show how it ended with each vehicle; return the exit status."""
    failed = 0
    for peer in peers:
        result = results[peer.name]
        if isinstance(result, GcsError):
            failed += 1
            display.end(peer.name, "failed")
            print(f"xtdrone gcs: {result}", file=sys.stderr)
        else:
            display.end(peer.name, text(peer.name, result))
    return 1 if failed else 0


def _peers(names: Any, arguments: argparse.Namespace) -> list[Peer]:
    try:
        return station.peers_of(names, arguments.fleet, arguments.host)
    except (GcsError, FleetError) as error:
        raise UsageError(str(error)) from error


def _named(arguments: argparse.Namespace) -> list[Peer]:
    """Return the vehicles of --vehicle, else all of --fleet."""
    if arguments.vehicle:
        return _peers(arguments.vehicle, arguments)
    if not arguments.fleet:
        raise UsageError("which vehicles? --vehicle NAME,... or --fleet TYPE:COUNT")
    try:
        return _peers([vehicle.name for vehicle in parse_fleet(arguments.fleet)], arguments)
    except FleetError as error:
        raise UsageError(str(error)) from error


# ---- the command line


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.1 <= value <= 3600.0:
        raise argparse.ArgumentTypeError(f"patience: {text!r} is not allowed; a number of seconds from 0.1 to 3600")
    return value


def _names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


def _parser() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--vehicle", type=_names, default=[], metavar="NAME,...",
                        help="only these vehicles, as typhoon_h480_0")  # fmt: skip
    common.add_argument("--fleet", default="", metavar="TYPE:COUNT,...",
                        help="the fleet that flies, needed where it has several types, since ports and system ids "
                        "follow from it")  # fmt: skip
    common.add_argument("--host", default=station.LOOPBACK, help="machine of the autopilots (default: %(default)s)")
    common.add_argument("--patience", type=_seconds, default=station.PATIENCE, metavar="S",
                        help="give a vehicle up that is silent for so long (default: %(default)g s)")  # fmt: skip
    parser = argparse.ArgumentParser(
        prog="xtdrone gcs", description="Plans (QGroundControl's .plan files) to vehicles and back, over MAVLink."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, run: Callable[[argparse.Namespace], int], text: str, *parents: Any) -> Any:
        command = commands.add_parser(name, parents=parents, help=text, description=text)
        command.set_defaults(run=run)
        return command

    files = "plan files, or folders with some"
    upload = add("upload", _upload, "give each vehicle the plan in the file of its name, and compare what comes back",
                 common)  # fmt: skip
    upload.add_argument("files", type=Path, nargs="+", metavar="FILE", help=f"{files}; NAME.plan goes to vehicle NAME")
    download = add("download", _download, "write the vehicles' plans into NAME.plan", common)
    download.add_argument(
        "--to", type=Path, default=Path(), metavar="FOLDER", help="folder to write to (default: here)"
    )
    add("clear", _clear, "empty the vehicles' missions, fences and rally points", common)
    check = add("check", _check, "read plan files and say what PX4 would say of them; no vehicle is needed")
    check.add_argument("files", type=Path, nargs="+", metavar="FILE", help=files)
    return parser


def main(argv: Sequence[str]) -> int:
    """Run ``xtdrone gcs`` with the arguments after "gcs"; return the exit status."""
    arguments = _parser().parse_args(list(argv))
    try:
        return int(arguments.run(arguments))
    except UsageError as error:
        for line in str(error).splitlines():
            print(f"xtdrone gcs: {line}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
