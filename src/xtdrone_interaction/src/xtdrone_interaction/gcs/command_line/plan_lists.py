"""``xtdrone gcs fence`` and ``rally``: a single list of a plan; the vehicle's other lists stay unchanged."""

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
from xtdrone_interaction.gcs.command_line.terminal_output import Display

from ..exchanges import plans as plan_exchanges
from ..exchanges.exchange import Exchange, Heartbeat
from ..exchanges.plans import KINDS
from ..station import progress_of
from ..vehicle_addresses import GcsError, Peer
from .arguments import Adder, Runner, UsageError, run, select_vehicles
from .plans import assign, owners, read_plans


def _store(kind: int, lists: dict[Peer, Items], arguments: argparse.Namespace, cleared: str = "") -> int:
    display = Display([peer.name for peer in lists])

    def store(peer: Peer, heartbeat: Heartbeat) -> Exchange[list[str]]:
        progress = progress_of(peer.name, display.watch)
        return plan_exchanges.upload_list(heartbeat.system, kind, lists[peer], progress, heartbeat.autopilot)

    results = run({peer: partial(store, peer) for peer in lists}, arguments, plan_exchanges.cancel_transfers)
    counts = {peer.name: f"{len(items)} items of {KINDS[kind]}" for peer, items in lists.items()}
    return display.results(
        list(lists),
        results,
        lambda name, altered: cleared or f"{counts[name]}: {plan_exchanges.outcome(altered)}",
    )


def _upload(kind: int, arguments: argparse.Namespace) -> int:
    content = read_plans(arguments.files)
    empty = [file for file, found in content.items() if not found.items(kind)]
    if empty:
        raise UsageError(f"{empty[0]}: no {KINDS[kind]} in it; 'clear' empties the vehicle's")
    peers = select_vehicles(arguments) if arguments.vehicle else []
    plans = assign(content, [peer.name for peer in peers])
    lists = {peer: plans[peer.name].items(kind) for peer in peers or owners(plans, arguments)}
    return _store(kind, lists, arguments)


def _clear(kind: int, arguments: argparse.Namespace) -> int:
    return _store(kind, dict.fromkeys(select_vehicles(arguments), ()), arguments, f"no {KINDS[kind]} any more")


def _download(kind: int, arguments: argparse.Namespace) -> int:
    peers = select_vehicles(arguments)
    display = Display([peer.name for peer in peers])

    def fetch(name: str, heartbeat: Heartbeat) -> Exchange[Items]:
        return plan_exchanges.download_list(
            heartbeat.system, kind, progress_of(name, display.watch), heartbeat.autopilot
        )

    jobs = {peer: partial(fetch, peer.name) for peer in peers}
    results: dict[str, Any] = run(jobs, arguments, plan_exchanges.cancel_transfers)
    for name, items in results.items():
        if not isinstance(items, GcsError):
            try:
                _write(arguments.to / f"{name}{qgc_plan.SUFFIX}", kind, items)
            except (PlanError, OSError) as error:
                results[name] = GcsError(f"{name}: its {KINDS[kind]} cannot be written: {error}")
    return display.results(peers, results, lambda name, items: f"{len(items)} items of {KINDS[kind]}: "
                           f"{arguments.to / name}{qgc_plan.SUFFIX}")  # fmt: skip


def _write(path: Path, kind: int, items: Items) -> None:
    """Write a list into a plan file, keeping the other lists of an existing file.

    Raises:
        PlanError, OSError: the existing file cannot be read, or the new one not written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    content = qgc_plan.read(path) if path.exists() else Plan(())
    qgc_plan.write(path, replace(content, fence=items) if kind == plan.FENCE else replace(content, rally=items))


def add_to(add: Adder) -> None:
    """Add these commands to the command line."""
    for word, kind in (("fence", plan.FENCE), ("rally", plan.RALLY)):
        what = KINDS[kind]
        group = add.group(word, f"only the {what}: upload, download, clear")

        def bound(action: Any, kind: int = kind) -> Runner:
            return partial(action, kind)

        upload = group(
            "upload", bound(_upload), f"upload the {what} of plan files to the vehicles that the files are named after"
        )
        upload.add_argument("files", type=Path, nargs="+", metavar="FILE", help="plan files, or folders of them")
        download = group(
            "download", bound(_download), f"download the vehicles' {what} into NAME.plan, keeping its other lists"
        )
        download.add_argument("--to", type=Path, default=Path(), metavar="FOLDER",
                              help="folder to write to (default: here)")  # fmt: skip
        group("clear", bound(_clear), f"clear the vehicles' {what}")
