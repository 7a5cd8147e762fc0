"""``xtdrone gcs params``: single parameters of vehicles, and QGroundControl's .params files."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

from xtdrone_autopilot.parameters import former_parameters
from xtdrone_autopilot.parameters.parameter_file import (
    SUFFIX,
    ParameterFile,
    ParameterFileError,
    Value,
    as_float32,
    read,
    shown,
    write,
)
from xtdrone_autopilot.parameters.parameters import INDEX, describe
from xtdrone_interaction.gcs.exchanges import parameters
from xtdrone_interaction.gcs.exchanges.exchange import Exchange, Heartbeat
from xtdrone_interaction.gcs.vehicle_addresses import GcsError, Peer

from .arguments import Commands, UsageError, run, run_shown, select_vehicles
from .terminal_output import print_errors

_WILD = frozenset("*?[")


def _value(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; a finite number")
    return value


def _fetch(heartbeat: Heartbeat, names: Sequence[str]) -> Exchange[dict[str, Value]]:
    """Read parameters by names, which may have wildcards; all parameters for no names."""
    if names and not any(_WILD & set(name) for name in names):
        return (yield from parameters.fetch(heartbeat, names))
    present = yield from parameters.fetch_all(heartbeat)
    return {name: present[name] for name in sorted(present)
            if not names or any(fnmatchcase(name, pattern) for pattern in names)}  # fmt: skip


def _get(arguments: argparse.Namespace) -> int:
    peers = select_vehicles(arguments)
    results = run(dict.fromkeys(peers, partial(_fetch, names=arguments.names)), arguments)
    for peer in peers:
        found = results[peer.name]
        for name, value in ({} if isinstance(found, GcsError) else found).items():
            print(f"{peer.name}  {name:<16}  {shown(*value)}")
    return print_errors(results.values())


def _set(arguments: argparse.Namespace) -> int:
    name, value = arguments.name, arguments.value
    status, _ = run_shown(
        arguments,
        select_vehicles(arguments),
        lambda _peer, _progress, heartbeat: parameters.change(heartbeat, name, value),
        lambda _, change: f"{name}: {shown(*change[1])}, was {shown(*change[0])}",
    )
    return status


def _read_files(
    arguments: argparse.Namespace, peers: Sequence[Peer]
) -> tuple[dict[Peer, ParameterFile], list[GcsError]]:
    """Read the file for all vehicles, or from a folder the file of each vehicle.

    Returns:
        Files by vehicle, and the errors of the files of a folder that cannot be used.

    Raises:
        UsageError: no file can be used.
    """
    path: Path = arguments.file
    paths = {peer: path / f"{peer.name}{SUFFIX}" if path.is_dir() else path for peer in peers}
    found: dict[Path, ParameterFile] = {}
    wrong: list[GcsError] = []
    for file in dict.fromkeys(paths.values()):
        try:
            found[file] = read(file)
        except ParameterFileError as error:
            wrong.append(GcsError(str(error)))
    if not found:
        raise UsageError("\n".join(map(str, wrong)))
    return {peer: found[file] for peer, file in paths.items() if file in found}, wrong


def _diff(arguments: argparse.Namespace) -> int:
    peers = select_vehicles(arguments)
    files, wrong = _read_files(arguments, peers)
    results = run(dict.fromkeys(files, parameters.fetch_all), arguments)
    different = False
    for peer, content in files.items():
        found = results[peer.name]
        if isinstance(found, GcsError):
            continue
        for name, (value, there) in parameters.differences(content, found).items():
            different = True
            print(f"{peer.name}  {name:<16}  {'none' if there is None else shown(*there)}  file: {shown(*value)}")
    return print_errors([*results.values(), *wrong]) or int(different)


def _load(arguments: argparse.Namespace) -> int:
    files, wrong = _read_files(arguments, select_vehicles(arguments))
    status, results = run_shown(
        arguments,
        list(files),
        lambda peer, progress, heartbeat: parameters.load(heartbeat, files[peer], arguments.of_another, progress),
        lambda _, loaded: _summary(loaded),
    )
    for name, loaded in results.items():
        if isinstance(loaded, GcsError):
            continue
        for parameter, (old, new) in loaded.changed.items():
            print(f"{name}  {parameter:<16}  {shown(*new)}, was {shown(*old)}")
        for text in loaded.skipped:
            print(f"{name}: skipped: {text}", file=sys.stderr)
    return print_errors(wrong) or status


def _summary(loaded: parameters.Loaded) -> str:
    if not loaded.skipped:
        return f"{len(loaded.changed)} parameters set, the rest is the same"
    return f"{len(loaded.changed)} parameters set, {len(loaded.skipped)} rows of the file skipped, the rest is the same"


def _save(arguments: argparse.Namespace) -> int:
    peers = select_vehicles(arguments)
    path: Path = arguments.file
    into_folder = path.is_dir() or len(peers) > 1
    if into_folder and path.exists() and not path.is_dir():
        raise UsageError(f"{path}: a folder is needed for {len(peers)} vehicles")

    def store(name: str, content: ParameterFile) -> str:
        target = path / f"{name}{SUFFIX}" if into_folder else path
        try:
            write(target, content)
        except OSError as error:
            raise GcsError(f"{name}: {target} cannot be written: {error.strerror}") from error
        return f"{len(content.values)} parameters: {target}"

    return run_shown(arguments, peers, lambda _, progress, beat: parameters.save(beat, progress), store)[0]


def check_file(path: Path) -> bool:
    """Print the parameters of a file that are stored without an effect in this simulation; return whether it is valid.

    Only values other than PX4's defaults are listed: the others do what they do on a vehicle, nothing.
    """
    try:
        values = read(path).values
    except ParameterFileError as error:
        print(error, file=sys.stderr)
        return False
    idle = {name: value for name, value in values.items() if name in INDEX and not describe(name).has_effect}
    idle = {name: value for name, value in idle.items() if value[0] != as_float32(describe(name).default)}
    print(f"{path}: {len(values)} parameters, {len(idle)} other than PX4's default are stored without effect here")
    for name, value in idle.items():
        print(f"{path}: {name:<16}  {shown(*value)}, PX4's default {shown(describe(name).default, value[1])}")
    for name in values:
        if name not in INDEX:
            print(f"{path}: {name:<16}  does not exist{former_parameters.hint(name)}")
    return True


def add_to(commands: Commands) -> None:
    """Add these commands to the command line."""
    group = commands.add_group("params", "parameters: get, set, diff, load, save")
    get = group.add("get", _get, "show parameters")
    get.add_argument("names", nargs="*", metavar="NAME", help="names such as MPC_XY_VEL_MAX or 'MPC_*' (default: all)")
    set_ = group.add("set", _set, "set a parameter")
    set_.add_argument("name", metavar="NAME", help="its name")
    set_.add_argument("value", type=_value, metavar="VALUE", help="its value")
    diff = group.add("diff", _diff, "show differences between vehicles and a file; exit status 1 if there are any")
    load = group.add("load", _load, "set the parameters of a file; those that the vehicle does not have are listed")
    load.add_argument("--of-another", action="store_true",
                      help="accept the file of another vehicle, without the parameters that identify it")  # fmt: skip
    save = group.add("save", _save, "save all parameters of vehicles")
    for one in (diff, load):
        one.add_argument("file", type=Path, metavar="FILE", help="file, or folder with NAME.params for each vehicle")
    save.add_argument("file", type=Path, metavar="FILE", help="file, or folder for NAME.params of each vehicle")
