"""``xtdrone gcs upload``, ``download``, ``clear`` and ``check``: plans of QGroundControl to vehicles and back."""

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
from xtdrone_control.geodesy import geo
from xtdrone_control.plans import qgc_plan
from xtdrone_control.plans.qgc_plan import Plan, PlanError

from . import exchanges, station
from .arguments import Adder, UsageError, chosen, named, run
from .display import Display
from .exchanges import Beat
from .peers import GcsError, Peer

_FIRST_DISTANCE = 900.0  # m, PX4's default of MIS_DIST_1WP


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
    for file, content in plans.items():
        if content.drawn_for:
            print(f"{file}: drawn for {content.drawn_for}, its items are taken as PX4 takes them", file=sys.stderr)
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


def owners(plans: dict[str, Plan], arguments: argparse.Namespace) -> list[Peer]:
    """Return the vehicles after which files are called.

    Raises:
        UsageError: a name that leads nowhere.
    """
    try:
        return named(plans, arguments)
    except UsageError as error:
        raise UsageError(f"{error}; a file has its vehicle's name, or --vehicle says whose it is") from error


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
    content = read_plans(find_files(arguments.files))
    peers = chosen(arguments) if arguments.vehicle else []
    plans = assign(content, [peer.name for peer in peers])
    peers = peers or owners(plans, arguments)
    display = Display([peer.name for peer in peers])

    def store(name: str, beat: Beat) -> exchanges.Exchange[None]:
        progress = station.progress_of(name, display.watch)
        return exchanges.store_plan(beat.system, plans[name], progress, beat.autopilot)

    results = run({peer: partial(store, peer.name) for peer in peers}, arguments, exchanges.cancel)
    return display.results(peers, results, lambda name, _: f"{_summary(plans[name])}: sent, and come back the same")


def _download(arguments: argparse.Namespace) -> int:
    peers = chosen(arguments)
    folder: Path = arguments.to
    display = Display([peer.name for peer in peers])

    def fetch(name: str, beat: Beat) -> exchanges.Exchange[Plan]:
        return exchanges.fetch_plan(beat.system, station.progress_of(name, display.watch), beat.autopilot)

    results = run({peer: partial(fetch, peer.name) for peer in peers}, arguments, exchanges.cancel)
    for name, result in results.items():
        if isinstance(result, Plan):
            try:
                folder.mkdir(parents=True, exist_ok=True)
                qgc_plan.write(folder / f"{name}{qgc_plan.SUFFIX}", result)
            except (PlanError, OSError) as error:
                results[name] = GcsError(f"{name}: its plan cannot be written: {error}")
    return display.results(peers, results, lambda name, result: f"{_summary(result)}: {folder / name}{qgc_plan.SUFFIX}")


def _clear(arguments: argparse.Namespace) -> int:
    peers = chosen(arguments)
    display = Display([peer.name for peer in peers])

    def clear(name: str, beat: Beat) -> exchanges.Exchange[None]:
        return exchanges.clear(beat.system, station.progress_of(name, display.watch), beat.autopilot)

    results = run({peer: partial(clear, peer.name) for peer in peers}, arguments, exchanges.cancel)
    return display.results(peers, results, lambda *_: "mission, fence and rally points are cleared")


def _check(arguments: argparse.Namespace) -> int:
    status = 0
    for file, content in read_plans(find_files(arguments.files)).items():
        said, good = problems(content)
        print(f"{file}: {_summary(content)}; {way_length(content):.0f} m of way")
        for text in said:
            print(f"{file}: {text}", file=sys.stderr)
        status = status if good else 1
    return status


def add_to(add: Adder) -> None:
    """Add these commands to the command line."""
    files = "plan files, or folders with some"
    upload = add("upload", _upload, "give each vehicle the plan in the file of its name, and compare what comes back")
    upload.add_argument("files", type=Path, nargs="+", metavar="FILE", help=f"{files}; NAME.plan goes to vehicle NAME")
    download = add("download", _download, "write the vehicles' plans into NAME.plan")
    download.add_argument(
        "--to", type=Path, default=Path(), metavar="FOLDER", help="folder to write to (default: here)"
    )
    add("clear", _clear, "empty the vehicles' missions, fences and rally points")
    check = add("check", _check, "read plan files and say what PX4 would say of them; no vehicle is needed", False)
    check.add_argument("files", type=Path, nargs="+", metavar="FILE", help=files)
