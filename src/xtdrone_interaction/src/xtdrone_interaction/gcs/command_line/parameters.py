"""``xtdrone gcs params``: single parameters of vehicles, and QGroundControl's .params files."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

from xtdrone_control.autopilot.parameters import former_parameters
from xtdrone_control.autopilot.parameters.parameter_file import (
    SUFFIX,
    ParameterFile,
    ParameterFileError,
    Value,
    as_float32,
    read,
    shown,
    write,
)
from xtdrone_control.autopilot.parameters.parameters import INDEX, describe
from xtdrone_interaction.gcs.command_line.terminal_output import Display, print_errors

from ..exchanges import parameters
from ..exchanges.exchange import Exchange, Heartbeat
from ..station import progress_of
from ..vehicle_addresses import GcsError, Peer
from .arguments import Adder, UsageError, run, select_vehicles

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
    peers = select_vehicles(arguments)
    display = Display([peer.name for peer in peers])
    name = arguments.name
    results = run(dict.fromkeys(peers, partial(parameters.change, name=name, value=arguments.value)), arguments)
    return display.results(peers, results, lambda _, found: f"{name}: {shown(*found[1])}, was {shown(*found[0])}")


def _files(arguments: argparse.Namespace, peers: Sequence[Peer]) -> tuple[dict[Peer, ParameterFile], list[GcsError]]:
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
    files, wrong = _files(arguments, peers)
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
    peers = select_vehicles(arguments)
    files, wrong = _files(arguments, peers)
    display = Display([peer.name for peer in files])
    jobs = {
        peer: partial(
            parameters.load,
            content=content,
            of_another=arguments.of_another,
            progress=progress_of(peer.name, display.watch),
        )
        for peer, content in files.items()
    }
    results = run(jobs, arguments)
    status = display.results(list(files), results, lambda _, loaded: _summary(loaded))
    for peer in files:
        loaded = results[peer.name]
        if isinstance(loaded, GcsError):
            continue
        for name, (old, new) in loaded.changed.items():
            print(f"{peer.name}  {name:<16}  {shown(*new)}, was {shown(*old)}")
        for text in loaded.skipped:
            print(f"{peer.name}: skipped: {text}", file=sys.stderr)
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
    display = Display([peer.name for peer in peers])
    jobs = {peer: partial(parameters.save, progress=progress_of(peer.name, display.watch)) for peer in peers}
    results: dict[str, Any] = run(jobs, arguments)
    paths = {peer.name: path / f"{peer.name}{SUFFIX}" if into_folder else path for peer in peers}
    for name, found in results.items():
        if isinstance(found, GcsError):
            continue
        try:
            write(paths[name], found)
        except OSError as error:
            results[name] = GcsError(f"{name}: {paths[name]} cannot be written: {error.strerror}")
    return display.results(peers, results, lambda name, found: f"{len(found.values)} parameters: {paths[name]}")


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


def add_to(add: Adder) -> None:
    """Add these commands to the command line."""
    add_group = add.group("params", "parameters: get, set, diff, load, save")
    get = add_group("get", _get, "show parameters")
    get.add_argument("names", nargs="*", metavar="NAME", help="names such as MPC_XY_VEL_MAX or 'MPC_*' (default: all)")
    set_ = add_group("set", _set, "set a parameter")
    set_.add_argument("name", metavar="NAME", help="its name")
    set_.add_argument("value", type=_value, metavar="VALUE", help="its value")
    diff = add_group("diff", _diff, "show differences between vehicles and a file; exit status 1 if there are any")
    load = add_group("load", _load, "set the parameters of a file; those that the vehicle does not have are listed")
    load.add_argument("--of-another", action="store_true",
                      help="accept the file of another vehicle, without the parameters that identify it")  # fmt: skip
    save = add_group("save", _save, "save all parameters of vehicles")
    for one in (diff, load):
        one.add_argument("file", type=Path, metavar="FILE", help="file, or folder with NAME.params for each vehicle")
    save.add_argument("file", type=Path, metavar="FILE", help="file, or folder for NAME.params of each vehicle")
