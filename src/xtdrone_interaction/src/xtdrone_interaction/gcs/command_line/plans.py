"""``xtdrone gcs upload``, ``download``, ``clear`` and ``check``: QGroundControl's plans for vehicles."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

from xtdrone_control.autopilot.navigator import feasibility, geofence, plan
from xtdrone_control.autopilot.navigator.feasibility import Situation
from xtdrone_control.autopilot.parameters import parameter_file
from xtdrone_control.geodesy import projection
from xtdrone_control.plans import qgc_plan
from xtdrone_control.plans.qgc_plan import Plan, PlanError
from xtdrone_interaction.gcs.command_line.terminal_output import Display

from ..exchanges import plans as plan_exchanges
from ..exchanges.exchange import Exchange, Heartbeat
from ..station import progress_of
from ..vehicle_addresses import GcsError, Peer
from .arguments import Adder, UsageError, run, select_named, select_vehicles
from .parameters import check_file

_FIRST_DISTANCE = 900.0  # m, PX4's default of MIS_DIST_1WP


def _summary(content: Plan) -> str:
    """Describe the content of a plan."""
    counts = [len(content.items(kind)) for kind in plan.KINDS]
    words = [f"{counts[plan.MISSION]} items"]
    words += [f"{count} of {what}" for count, what in zip(counts[1:], ("fence", "rally points"), strict=True) if count]
    return ", ".join(words)


# files


def _find_files(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Return the plan files in ``paths``, files and folders, and the errors of the other paths, one line each."""
    found: list[Path] = []
    wrong = []
    for path in paths:
        if path.is_dir():
            inside = sorted(file for file in path.iterdir() if file.suffix in qgc_plan.SUFFIXES)
            if not inside:
                wrong.append(f"{path}: no {' or '.join(qgc_plan.SUFFIXES)} file is in this folder")
            found += inside
        elif path.exists():
            found.append(path)
        else:
            wrong.append(f"{path}: no such file or folder")
    return found, wrong


def _read_valid(paths: Sequence[Path]) -> tuple[dict[Path, Plan], list[str]]:
    """Read plan files; return those that are valid, and the errors of the others, one line each."""
    plans: dict[Path, Plan] = {}
    files, wrong = _find_files(paths)
    for file in files:
        try:
            content = qgc_plan.read(file)
            too_long = plan_exchanges.check_capacity(content)
            if too_long:
                wrong.append(f"{file}: {too_long}")
            else:
                plans[file] = content
        except PlanError as error:
            wrong.append(str(error))
    return plans, wrong


def read_plans(paths: Sequence[Path]) -> dict[Path, Plan]:
    """Read the plan files in ``paths``, files and folders, that are sent together, or not at all.

    Raises:
        UsageError: missing or invalid files; one line each.
    """
    plans, wrong = _read_valid(paths)
    if wrong:
        raise UsageError("\n".join(wrong))
    _name_foreign(plans)
    return plans


def _name_foreign(plans: dict[Path, Plan]) -> None:
    for file, content in plans.items():
        if content.drawn_for:
            print(
                f"{file}: drawn for {content.drawn_for}, its items are interpreted as PX4 interprets them",
                file=sys.stderr,
            )


def assign(plans: dict[Path, Plan], vehicles: Sequence[str]) -> dict[str, Plan]:
    """Assign plans to vehicles.

    Args:
        plans: by file, which is named after its vehicle.
        vehicles: names; a single file is for all of them, whatever its name. Empty for the vehicles of all files.

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


def owners(plans: dict[str, Plan], arguments: argparse.Namespace) -> list[Peer]:
    """Return the vehicles that the files are named after.

    Raises:
        UsageError: unknown name.
    """
    try:
        return select_named(plans, arguments)
    except UsageError as error:
        raise UsageError(f"{error}; a file has its vehicle's name, or --vehicle selects the vehicle") from error


def problems(content: Plan) -> tuple[list[str], bool]:
    """Check a mission as PX4 does before it starts from the planned home position.

    Returns:
        PX4's texts, which may be warnings only, and whether PX4 accepts the mission; it accepts a plan without one.
    """
    if not content.mission:
        return [], True
    home = content.home
    said: list[str] = []

    def to_plane(latitude: float, longitude: float) -> tuple[float, float]:
        return projection.project(latitude, longitude, home[0], home[1])

    fence = geofence.build(content.fence, to_plane)
    now = Situation(
        home_altitude=home[2],
        location=home[:2],
        landed=True,
        first_distance=_FIRST_DISTANCE,
        required=0,
        fence_allows=lambda latitude, longitude, _altitude: fence.allows(to_plane(latitude, longitude)),
    )
    good = feasibility.check(content.mission, now, lambda _severity, text, *_, **__: said.append(text))
    count = len(content.mission)
    for i, item in enumerate(content.mission, 1):
        if item.command == plan.JUMP and not 0 <= plan.jump(item.params)[0] < count:
            target = plan.jump(item.params)[0] + 1
            said.append(f"Warning: item {i} jumps to item {target} of {count}, where PX4 ends the mission")
    return said, good


def path_length(content: Plan) -> float:
    """Return the length of the mission's path, m, without jumps."""
    places = [item for item in content.mission if item.has_position]
    length = 0.0
    for a, b in pairwise(places):
        length += math.hypot(*projection.project(b.x, b.y, a.x, a.y), b.z - a.z if a.relative == b.relative else 0.0)
    return length


# commands; each returns the exit status


def _upload(arguments: argparse.Namespace) -> int:
    content = read_plans(arguments.files)
    peers = select_vehicles(arguments) if arguments.vehicle else []
    plans = assign(content, [peer.name for peer in peers])
    peers = peers or owners(plans, arguments)
    display = Display([peer.name for peer in peers])

    def store(name: str, heartbeat: Heartbeat) -> Exchange[list[str]]:
        progress = progress_of(name, display.watch)
        return plan_exchanges.upload_plan(heartbeat.system, plans[name], progress, heartbeat.autopilot)

    results = run({peer: partial(store, peer.name) for peer in peers}, arguments, plan_exchanges.cancel_transfers)
    return display.results(
        peers, results, lambda name, altered: f"{_summary(plans[name])}: {plan_exchanges.outcome(altered)}"
    )


def _download(arguments: argparse.Namespace) -> int:
    peers = select_vehicles(arguments)
    folder: Path = arguments.to
    display = Display([peer.name for peer in peers])

    def fetch(name: str, heartbeat: Heartbeat) -> Exchange[Plan]:
        return plan_exchanges.download_plan(heartbeat.system, progress_of(name, display.watch), heartbeat.autopilot)

    results = run({peer: partial(fetch, peer.name) for peer in peers}, arguments, plan_exchanges.cancel_transfers)
    for name, result in results.items():
        if isinstance(result, Plan):
            try:
                folder.mkdir(parents=True, exist_ok=True)
                qgc_plan.write(folder / f"{name}{qgc_plan.SUFFIX}", result)
            except (PlanError, OSError) as error:
                results[name] = GcsError(f"{name}: its plan cannot be written: {error}")
    return display.results(peers, results, lambda name, result: f"{_summary(result)}: {folder / name}{qgc_plan.SUFFIX}")


def _clear(arguments: argparse.Namespace) -> int:
    peers = select_vehicles(arguments)
    display = Display([peer.name for peer in peers])

    def clear(name: str, heartbeat: Heartbeat) -> Exchange[None]:
        return plan_exchanges.clear_plan(heartbeat.system, progress_of(name, display.watch), heartbeat.autopilot)

    results = run({peer: partial(clear, peer.name) for peer in peers}, arguments, plan_exchanges.cancel_transfers)
    return display.results(peers, results, lambda *_: "mission, fence and rally points are cleared")


def _check(arguments: argparse.Namespace) -> int:
    tables = [file for file in arguments.files if file.suffix == parameter_file.SUFFIX]
    valid = [check_file(file) for file in tables]
    files = [file for file in arguments.files if file not in tables]
    plans, wrong = _read_valid(files)
    _name_foreign(plans)
    status = 0 if all(valid) and not wrong else 2
    for file, content in plans.items():
        said, good = problems(content)
        print(f"{file}: {_summary(content)}; {path_length(content):.0f} m of path")
        for text in said:
            print(f"{file}: {text}", file=sys.stderr)
        status = status if good else max(status, 1)
    for line in wrong:
        print(f"xtdrone gcs: {line}", file=sys.stderr)
    return status


def add_to(add: Adder) -> None:
    """Add these commands to the command line."""
    files = "plan files, or folders of them"
    upload = add(
        "upload", _upload, "upload plan files to the vehicles that they are named after, and compare the stored plans"
    )
    upload.add_argument("files", type=Path, nargs="+", metavar="FILE", help=f"{files}; NAME.plan goes to vehicle NAME")
    download = add("download", _download, "download the vehicles' plans into NAME.plan")
    download.add_argument(
        "--to", type=Path, default=Path(), metavar="FOLDER", help="folder to write to (default: here)"
    )
    add("clear", _clear, "clear the vehicles' missions, fences and rally points")
    check = add(
        "check", _check, "check plan files as PX4 does, list a .params file's parameters without effect; no vehicle is "
        "needed", False
    )  # fmt: skip
    check.add_argument("files", type=Path, nargs="+", metavar="FILE", help=f"{files}; NAME.params")
