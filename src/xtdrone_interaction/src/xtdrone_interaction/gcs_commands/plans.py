"""``xtdrone gcs upload``, ``download``, ``clear`` and ``check``: QGroundControl's plans for vehicles.

``xtdrone gcs fence`` and ``rally`` do the same with a single list; the vehicle's other lists stay unchanged.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from xtdrone_autopilot.navigator import feasibility, geofence, plan
from xtdrone_autopilot.navigator.feasibility import Situation
from xtdrone_autopilot.parameters import parameter_file
from xtdrone_autopilot.plans import qgc_plan
from xtdrone_autopilot.plans.qgc_plan import Plan, PlanError
from xtdrone_common.geodesy import projection
from xtdrone_interaction.gcs.exchanges import plans as plan_exchanges
from xtdrone_interaction.gcs.exchanges.exchange import Exchange, Heartbeat, Progress
from xtdrone_interaction.gcs.exchanges.plans import KINDS
from xtdrone_interaction.gcs.vehicle_addresses import GcsError, Peer

from .arguments import Commands, UsageError, run_shown, select_named, select_vehicles
from .parameters import check_file

_FIRST_DISTANCE = 900.0  # m, PX4's default of MIS_DIST_1WP
_FILES = "plan files, or folders of them"
_FIELDS = {plan.FENCE: "fence", plan.RALLY: "rally"}  # of a plan, by MAV_MISSION_TYPE


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


def _upload(arguments: argparse.Namespace, kind: int | None = None) -> int:
    """Upload plan files; ``kind``: the only list of them to upload."""
    content = read_plans(arguments.files)
    for file, found in content.items():
        if kind is not None and not found.items(kind):
            raise UsageError(f"{file}: no {KINDS[kind]} in it; 'clear' empties the vehicle's")
    peers = select_vehicles(arguments) if arguments.vehicle else []
    plans = assign(content, [peer.name for peer in peers])

    def describe(name: str) -> str:
        return _summary(plans[name]) if kind is None else f"{len(plans[name].items(kind))} items of {KINDS[kind]}"

    return _store(
        arguments,
        {peer: plans[peer.name] for peer in peers or owners(plans, arguments)},
        plan.KINDS if kind is None else (kind,),
        lambda name, altered: f"{describe(name)}: {plan_exchanges.outcome(altered)}",
    )


def _store(
    arguments: argparse.Namespace,
    plans: Mapping[Peer, Plan],
    kinds: Sequence[int],
    text: Callable[[str, Any], str],
) -> int:
    def store(peer: Peer, progress: Progress, heartbeat: Heartbeat) -> Exchange[list[str]]:
        return plan_exchanges.upload_plan(heartbeat.system, plans[peer], progress, kinds)

    return run_shown(arguments, list(plans), store, text, plan_exchanges.cancel_transfers)[0]


def _download(arguments: argparse.Namespace, kind: int | None = None) -> int:
    """Download plans; ``kind``: the only list of them to download, which keeps the other lists of an existing file."""

    def fetch(_peer: Peer, progress: Progress, heartbeat: Heartbeat) -> Exchange[Any]:
        if kind is None:
            return plan_exchanges.download_plan(heartbeat.system, progress)
        return plan_exchanges.download_list(heartbeat.system, kind, progress)

    def write(name: str, found: Any) -> str:
        file: Path = arguments.to / f"{name}{qgc_plan.SUFFIX}"
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            if kind is None:
                content, text = found, _summary(found)
            else:
                before = qgc_plan.read(file) if file.exists() else Plan(())
                content, text = replace(before, **{_FIELDS[kind]: found}), f"{len(found)} items of {KINDS[kind]}"
            qgc_plan.write(file, content)
        except (PlanError, OSError) as error:
            what = "plan" if kind is None else KINDS[kind]
            raise GcsError(f"{name}: its {what} cannot be written: {error}") from error
        return f"{text}: {file}"

    return run_shown(arguments, select_vehicles(arguments), fetch, write, plan_exchanges.cancel_transfers)[0]


def _clear(arguments: argparse.Namespace, kind: int | None = None) -> int:
    """Clear plans; ``kind``: the only list of them to clear."""
    peers = select_vehicles(arguments)
    if kind is not None:
        return _store(arguments, dict.fromkeys(peers, Plan(())), (kind,), lambda *_: f"no {KINDS[kind]} any more")

    def clear(_peer: Peer, progress: Progress, heartbeat: Heartbeat) -> Exchange[None]:
        return plan_exchanges.clear_plan(heartbeat.system, progress)

    text = "mission, fence and rally points are cleared"
    return run_shown(arguments, peers, clear, lambda *_: text, plan_exchanges.cancel_transfers)[0]


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


def add_to(commands: Commands) -> None:
    """Add these commands to the command line."""
    _add_transfers(
        commands,
        None,
        "upload plan files to the vehicles that they are named after, and compare the stored plans",
        "download the vehicles' plans into NAME.plan",
        "clear the vehicles' missions, fences and rally points",
    )
    check = commands.add(
        "check", _check, "check plan files as PX4 does, list a .params file's parameters without effect; no vehicle is "
        "needed", False
    )  # fmt: skip
    check.add_argument("files", type=Path, nargs="+", metavar="FILE", help=f"{_FILES}; NAME.params")


def add_lists_to(commands: Commands) -> None:
    """Add the groups of commands for a single list."""
    for kind, word in _FIELDS.items():
        what = KINDS[kind]
        _add_transfers(
            commands.add_group(word, f"only the {what}: upload, download, clear"),
            kind,
            f"upload the {what} of plan files to the vehicles that the files are named after",
            f"download the vehicles' {what} into NAME.plan, keeping its other lists",
            f"clear the vehicles' {what}",
        )


def _add_transfers(commands: Commands, kind: int | None, upload: str, download: str, clear: str) -> None:
    """Add the transfers of whole plans (``kind`` None) or of one list, with the help text of each."""
    files = f"{_FILES}; NAME.plan goes to vehicle NAME" if kind is None else _FILES
    command = commands.add("upload", partial(_upload, kind=kind), upload)
    command.add_argument("files", type=Path, nargs="+", metavar="FILE", help=files)
    command = commands.add("download", partial(_download, kind=kind), download)
    command.add_argument("--to", type=Path, default=Path(), metavar="FOLDER",
                         help="folder to write to (default: here)")  # fmt: skip
    commands.add("clear", partial(_clear, kind=kind), clear)
