"""``xtdrone gcs fence`` and ``rally``: one list of a plan alone, the vehicle's others stay as they are."""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from xtdrone_control.autopilot.navigator import plan
from xtdrone_control.autopilot.navigator.plan import Items
from xtdrone_control.plans import qgc_plan
from xtdrone_control.plans.qgc_plan import Plan, PlanError

from . import exchanges, station
from .arguments import Adder, Runner, UsageError, chosen, run
from .display import Display
from .exchanges import KINDS, Beat
from .peers import GcsError, Peer
from .plan_command import assign, find_files, owners, read_plans


def _store(kind: int, lists: dict[Peer, Items], arguments: argparse.Namespace, done: str) -> int:
    display = Display([peer.name for peer in lists])

    def store(peer: Peer, beat: Beat) -> exchanges.Exchange[None]:
        progress = station.progress_of(peer.name, display.watch)
        return exchanges.store(beat.system, kind, lists[peer], progress, beat.autopilot)

    results = run({peer: partial(store, peer) for peer in lists}, arguments, exchanges.cancel)
    counts = {peer.name: len(items) for peer, items in lists.items()}
    return display.results(list(lists), results, lambda name, _: done.format(counts[name]))


def _upload(kind: int, arguments: argparse.Namespace) -> int:
    content = read_plans(find_files(arguments.files))
    empty = [file for file, found in content.items() if not found.items(kind)]
    if empty:
        raise UsageError(f"{empty[0]}: no {KINDS[kind]} in it; 'clear' empties the vehicle's")
    peers = chosen(arguments) if arguments.vehicle else []
    plans = assign(content, [peer.name for peer in peers])
    lists = {peer: plans[peer.name].items(kind) for peer in peers or owners(plans, arguments)}
    return _store(kind, lists, arguments, f"{{}} items of {KINDS[kind]}: sent, and come back the same")


def _clear(kind: int, arguments: argparse.Namespace) -> int:
    return _store(kind, dict.fromkeys(chosen(arguments), ()), arguments, f"no {KINDS[kind]} any more")


def _download(kind: int, arguments: argparse.Namespace) -> int:
    peers = chosen(arguments)
    display = Display([peer.name for peer in peers])

    def fetch(name: str, beat: Beat) -> exchanges.Exchange[Items]:
        return exchanges.fetch(beat.system, kind, station.progress_of(name, display.watch), beat.autopilot)

    jobs = {peer: partial(fetch, peer.name) for peer in peers}
    results: dict[str, Any] = run(jobs, arguments, exchanges.cancel)
    for name, items in results.items():
        if not isinstance(items, GcsError):
            try:
                _write(arguments.to / f"{name}{qgc_plan.SUFFIX}", kind, items)
            except (PlanError, OSError) as error:
                results[name] = GcsError(f"{name}: its {KINDS[kind]} cannot be written: {error}")
    return display.results(peers, results, lambda name, items: f"{len(items)} items of {KINDS[kind]}: "
                           f"{arguments.to / name}{qgc_plan.SUFFIX}")  # fmt: skip


def _write(path: Path, kind: int, items: Items) -> None:
    """Write a list into a plan file; what else the plan that is there holds stays in it.

    Raises:
        PlanError, OSError: the plan that is there cannot be read, or none be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    content = qgc_plan.read(path) if path.exists() else Plan(())
    qgc_plan.write(path, replace(content, fence=items) if kind == plan.FENCE else replace(content, rally=items))


def add_to(add: Adder) -> None:
    """Add these commands to the command line."""
    for word, kind in (("fence", plan.FENCE), ("rally", plan.RALLY)):
        what = KINDS[kind]
        group = add.group(word, f"the {what} alone: upload, download, clear")

        def bound(action: Any, kind: int = kind) -> Runner:
            return partial(action, kind)

        upload = group("upload", bound(_upload), f"give each vehicle the {what} of the plan in the file of its name")
        upload.add_argument("files", type=Path, nargs="+", metavar="FILE", help="plan files, or folders with some")
        download = group("download", bound(_download), f"write the vehicles' {what} into NAME.plan, beside the rest")
        download.add_argument("--to", type=Path, default=Path(), metavar="FOLDER",
                              help="folder to write to (default: here)")  # fmt: skip
        group("clear", bound(_clear), f"empty the vehicles' {what}")
