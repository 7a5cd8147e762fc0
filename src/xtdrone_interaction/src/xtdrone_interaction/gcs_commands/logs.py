"""``xtdrone gcs logs``: the vehicles' flight logs."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from xtdrone_interaction.gcs.exchanges import logs
from xtdrone_interaction.gcs.exchanges.exchange import Exchange, Heartbeat, Progress, RefusalError
from xtdrone_interaction.gcs.exchanges.logs import Log
from xtdrone_interaction.gcs.vehicle_addresses import GcsError, Peer

from .arguments import Commands, UsageError, run, run_shown, select_vehicles
from .terminal_output import print_errors

_PART = ".part"


def _list(arguments: argparse.Namespace) -> int:
    peers = select_vehicles(arguments)
    results: dict[str, Any] = run(dict.fromkeys(peers, logs.fetch_list), arguments, logs.end_transfer)
    for peer in peers:
        found = results[peer.name]
        if found == []:
            print(f"{peer.name}  no logs")
        for log in [] if isinstance(found, GcsError) else found:
            when = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(log.time)) if log.time else "undated"
            print(f"{peer.name}  {log.number:>4}  {when:<19}  {log.size:>12} bytes")
    return print_errors(results.values())


def _select(found: Sequence[Log], words: Sequence[str]) -> list[Log]:
    """Select logs by ``words``: numbers, ``all``, or nothing for the newest.

    Raises:
        RefusalError: unknown number.
    """
    if not words:
        return list(found[-1:])
    if "all" in words:
        return list(found)
    by_number = {str(log.number): log for log in found}
    unknown = [word for word in words if word not in by_number]
    if unknown:
        raise RefusalError(
            f"log {unknown[0]}: not allowed, one of the vehicle's: {', '.join(by_number) or 'none'}", True
        )
    return [by_number[word] for word in dict.fromkeys(words)]


def download(heartbeat: Heartbeat, words: Sequence[str], folder: Path, progress: Progress) -> Exchange[list[Path]]:
    """Download logs of a vehicle into a folder, continuing interrupted downloads, and return the files.

    Args:
        heartbeat: of the vehicle.
        words: selection of logs, see ``_select``.
        folder: of the files.
        progress: callback.

    Raises:
        RefusalError: the vehicle does not send a log, or a file cannot be written.
    """
    found = yield from logs.fetch_list(heartbeat)
    paths = []
    for log in _select(found, words):
        path = folder / f"{log.name}.ulg"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if not path.exists() or path.stat().st_size != log.size:
                yield from _fetch_one(heartbeat, log, path, progress)
        except OSError as error:
            raise RefusalError(f"{path}: cannot be written: {error.strerror}", True) from error
        paths.append(path)
    return paths


def _fetch_one(heartbeat: Heartbeat, log: Log, path: Path, progress: Progress) -> Exchange[None]:
    part = path.with_name(f"{path.name}.{log.size}{_PART}")  # a log of another size is another log
    with part.open("ab") as file:
        start = file.tell()
        if start > log.size:
            start = 0
            file.truncate(0)
        yield from logs.download(heartbeat, log, lambda data: _append(file, data), start, progress)
    os.replace(part, path)


def _append(file: Any, data: bytes) -> None:
    file.write(data)
    file.flush()


def _download(arguments: argparse.Namespace) -> int:
    wrong = [word for word in arguments.logs if word != "all" and not word.isdecimal()]
    if wrong:
        raise UsageError(f"logs: {wrong[0]!r} is not allowed, numbers or all")

    def fetch(peer: Peer, progress: Progress, heartbeat: Heartbeat) -> Exchange[list[Path]]:
        return download(heartbeat, arguments.logs, arguments.to / peer.name, progress)

    def describe(_name: str, paths: list[Path]) -> str:
        return ", ".join(map(str, paths)) or "it has no logs"

    return run_shown(arguments, select_vehicles(arguments), fetch, describe, logs.end_transfer)[0]


def add_to(commands: Commands) -> None:
    """Add these commands to the command line."""
    group = commands.add_group("logs", "flight logs: list, download")
    group.add("list", _list, "list the vehicles' logs")
    command = group.add("download", _download, "download logs into FOLDER/VEHICLE/, continuing interrupted downloads")
    command.add_argument("logs", nargs="*", metavar="LOG", help="numbers, or all (default: the newest)")
    command.add_argument("--to", type=Path, default=Path(), metavar="FOLDER",
                          help="folder to write to (default: here)")  # fmt: skip
