"""``./xtdrone sweep study.yaml``: the command.

Exit status: 0 for success, 1 if the sweep could not continue or runs have failed, 2 for an invalid argument or study,
128 + n after signal n. Finished runs are kept in all cases, and the same command continues the sweep.
"""

from __future__ import annotations

import argparse
import os
import sqlite3
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from rich.console import Console
from rich.markup import escape

from xtdrone_common.files import shortened
from xtdrone_common.settings import Settings, setting
from xtdrone_coordination.patterns import PatternError
from xtdrone_interaction import cli, command_options
from xtdrone_interaction.console import PatientConsole
from xtdrone_interaction.launching.scripted_launch import Stopped, StopRequest
from xtdrone_interaction.machine_facts import machine_facts
from xtdrone_interaction.studies.list_of_runs import Plan
from xtdrone_interaction.studies.result_store import FIGURES, Store
from xtdrone_interaction.studies.study_file import Study, read_study
from xtdrone_interaction.studies.study_parameters import StudyError
from xtdrone_interaction.sweep.progress import Progress, one_line

_SHOWN = 10  # runs in a dry run, and differences of studies
_PICTURE = "picture.png"
_REASONS = 3  # of failures, the most frequent
_FACTS = ("python", "packages", "commit", "changed_since_commit")


@dataclass(frozen=True)
class WorkerSettings(Settings):
    """Processes of a sweep on this machine."""

    workers: int | None = setting(
        None, low=1, high=1024, metavar="N", text="worker processes on this machine (default: one per core)"
    )
    dashboard: int | None = setting(
        None,
        low=1024,
        high=65535,
        metavar="PORT",
        text="serve Dask's web page on this TCP port of 127.0.0.1 (needs bokeh)",
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Fly a study: many simplified (or core, full-physics) flights over parameters and seeds. Finished runs are "
        "kept in all cases; the same command continues an interrupted sweep. See docs/simplified.md."
    )
    add = parser.add_argument
    add("study", type=Path, metavar="STUDY.yaml", help="description of the runs")
    add("--out", type=Path, metavar="FOLDER", help="folder of the results (default: runs/sweeps/<name of the study>)")
    where = parser.add_mutually_exclusive_group()
    WorkerSettings.add_arguments(where, ("workers",))
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="fly on a Dask cluster: address of its scheduler, such as tcp://host:8786",
    )
    WorkerSettings.add_arguments(parser, ("dashboard",))
    add("--dry-run", action="store_true", help="print the runs without flying them")
    add("--draw", action="store_true", help="write results and picture of the finished runs without flying more")
    add("--retry-failed", action="store_true", help="repeat the runs that have failed")
    add("--metric", metavar="NAME", help="figure in the picture (default: settling_time)")
    add("--x", metavar="PARAMETER", help="parameter along the picture's axis (default: chosen)")
    add("--by", metavar="PARAMETER", help="second parameter of the picture (default: chosen)")


def main(argv: Sequence[str]) -> int:
    """Run the command with the arguments after "sweep"; return its exit status."""
    return cli.main(["sweep", *argv])


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    console = PatientConsole()
    try:
        study = read_study(arguments.study)
        plan = Plan(study)
        plan.check()
        _check_picture(study, arguments)
        if arguments.dry_run:
            return _dry_run(plan, console)
        folder = arguments.out or Path("runs") / "sweeps" / study.name
        return _sweep(plan, folder, arguments, console)
    except (StudyError, PatternError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
    except sqlite3.Error as error:  # a full disk, a folder that disappears
        print(f"xtdrone: out: runs cannot be stored: {error}; what was stored is kept", file=sys.stderr)
        return 1


def _check_picture(study: Study, arguments: argparse.Namespace) -> None:
    """Reject unknown names before hours of flying; the figures of a user's metric are known only afterwards."""
    varied = [*(axis.parameter.name for axis in study.axes), "seed"]
    for thing in ("x", "by"):
        name = getattr(arguments, thing)
        if name is not None and name not in varied:
            raise StudyError(f"{thing}: {name!r} is not varied in this study; there are: {', '.join(varied)}")
    if arguments.metric and arguments.metric not in FIGURES and "metric" not in study.sources:
        raise StudyError(f"metric: {arguments.metric!r} is unknown; there are: {', '.join(FIGURES)}")


def _dry_run(plan: Plan, console: Console) -> int:
    _print_study(plan.study, console)
    for run in plan[:_SHOWN]:
        values = " ".join(f"{name}={value}" for name, value in run.varied.items())
        _print(console, f"  {run.key}  {values} seed={run.seed}")
    if len(plan) > _SHOWN:
        _print(console, f"  ... and {len(plan) - _SHOWN:,} more")
    return 0


def _print_study(study: Study, console: Console) -> None:
    _print(console, f"Study {study.name}: {study.engine} flights, {study.flight}")
    for name, value in study.constants.items():
        _print(console, f"  {name} = {value}")
    for axis in study.axes:
        if axis.sampled:
            text = f"{axis.values[0]} to {axis.values[1]}{', logarithmic' if axis.log else ''}"
        else:
            more = ", ..." if len(axis.values) > _SHOWN else ""
            text = f"{', '.join(map(str, axis.values[:_SHOWN]))}{more} ({len(axis.values)} values)"
        _print(console, f"  {axis.parameter.name}: {text}")
    for role, source in study.sources.items():
        _print(console, f"  {role}: {source.name} of {source.path}")
    _print(console, f"{study.points:,} points ({study.combine}) x {len(study.seeds):,} seeds = {study.runs:,} runs")


def _sweep(plan: Plan, folder: Path, arguments: argparse.Namespace, console: Console) -> int:
    """Fly the missing runs, write results and picture, and return the exit status."""
    header = _header(plan.study)
    with StopRequest(end_processes=False) as stop, Store(folder, columns(plan.study), header) as store:
        keys = [run.key for run in plan]
        _check_study(store, keys, header, arguments.retry_failed and not arguments.draw, console)
        store.begin()
        done = {key for key, good in store.rows.items() if good or not arguments.retry_failed}
        missing = [number for number, key in enumerate(keys) if key not in done]
        _print_study(plan.study, console)
        if len(missing) < len(keys):
            _print(console, f"{len(keys) - len(missing):,} runs exist already, {len(missing):,} are missing")
        status = _fly(plan, missing, store, arguments, stop, console) if missing and not arguments.draw else 0
        return _finish(store, keys, status, arguments, console)


def _header(study: Study) -> dict[str, Any]:
    facts = machine_facts(command_options.repository())
    return {
        "study": study.plain(),
        "sources": {role: source.plain() for role, source in study.sources.items()},
        "software": {name: facts[name] for name in _FACTS},
    }


def columns(study: Study) -> dict[str, type]:
    """Return names and types of the columns; a user's metric adds more."""
    varied = {axis.parameter.name: axis.parameter.kind for axis in study.axes}
    return {"key": str, "seed": int, **varied, "error": str, **{name: kind for name, (kind, _) in FIGURES.items()}}


def _check_study(
    store: Store, keys: Sequence[str], header: dict[str, Any], retry_failed: bool, console: Console
) -> None:
    """Reject a folder with runs that are not in this study; report differences of the studies.

    Failed runs of another version of the user's files are dropped if failed runs are to be repeated.

    Raises:
        StudyError: the folder belongs to another study.
    """
    if store.before is None:
        return
    files = file_differences(store.before.get("sources", {}), header["sources"])
    changes = differences(_without_contents(store.before), _without_contents(header))
    foreign = store.rows.keys() - set(keys)
    good = sum(store.rows[key] for key in foreign)
    if foreign and files and not changes:
        said = ", ".join(files)
        if good:
            raise StudyError(
                f"out: {store.folder}: {said} ({good:,} good runs were made with another version); "
                "choose another --out, or undo the change"
            )
        if not retry_failed:
            raise StudyError(
                f"out: {store.folder}: {said} ({len(foreign):,} runs failed with another version); "
                "--retry-failed flies them again"
            )
        store.drop(foreign)
        _print(console, f"{said}: {len(foreign):,} runs that failed with another version are dropped")
        return
    changes += files
    if foreign:
        raise StudyError(
            f"out: {store.folder} has {len(foreign):,} of {len(store.rows):,} runs that this study does not have "
            f"({'; '.join(changes) or 'another version'}); choose another --out, or undo the change"
        )
    if changes:
        new = len(set(keys) - store.rows.keys())
        _print(console, f"The study has changed ({'; '.join(changes)}): it keeps its runs, {new:,} are to be flown")
    before, now = store.before.get("software", {}).get("commit"), header["software"]["commit"]
    if before != now:
        _print(console, f"Warning: earlier runs are of another version of the software ({before} then, {now} now)")


def _without_contents(header: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of a study with the names of the user's classes and functions in place of fingerprints."""
    names = {role: source["name"] for role, source in header.get("sources", {}).items()}
    return {**header.get("study", {}), "sources": names}


def file_differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Describe changes in the contents of the user's files.

    Args:
        before, after: data of the sources by role.
    """
    both = [(before[role], after[role]) for role in after if role in before]
    files = (Path(new["path"]).name for old, new in both if old["text"] != new["text"])
    return [f"{file} has changed" for file in dict.fromkeys(files)]


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Describe the differences between the data of two studies."""
    found = []
    for name in dict.fromkeys([*before, *after]):
        old, new = before.get(name), after.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            found += [f"{name} {text}" if name != "sources" else text for text in differences(old, new)]
        elif old != new:
            found.append(f"{name}: {_short(old)} before, {_short(new)} now")
    return found[:_SHOWN]


def _short(value: Any) -> str:
    return "none" if value is None else shortened(str(value), 40)


def _fly(
    plan: Plan, missing: Sequence[int], store: Store, arguments: argparse.Namespace, stop: StopRequest, console: Console
) -> int:
    """Fly the runs of these numbers and return the exit status."""
    from xtdrone_interaction.studies.dask_execution import Executor, SweepError  # heavy, and not for --dry-run
    from xtdrone_interaction.sweep.fly_one_run import fly_batch

    study = plan.study
    common = {
        "engine": study.engine,
        "flight": study.flight,
        "constants": study.constants,
        "sources": {role: source.plain() for role, source in study.sources.items()},
    }
    try:
        with _client(arguments) as client, Progress(console, len(missing)) as progress:
            executor = Executor(client, fly_batch, common)

            def deliver(rows: list[dict[str, Any]]) -> None:
                store.add(rows)
                progress.add(rows)

            def check() -> None:
                stop.check()
                store.tick()
                progress.show(executor.workers)

            executor.run(_tasks(plan, missing), deliver, check)
    except (Stopped, SweepError) as error:
        if not stop.number:
            print(f"xtdrone: {error}", file=sys.stderr)
            return 1
        # The signal may have ended the workers, too.
        print(f"xtdrone: stopped by {Stopped(stop.number)}", file=sys.stderr)
        return 128 + stop.number
    return 0


def _tasks(plan: Plan, numbers: Sequence[int]) -> Iterator[dict[str, Any]]:
    return (plan[number].task() for number in numbers)


def _client(arguments: argparse.Namespace) -> AbstractContextManager[Any]:
    from xtdrone_interaction.studies.dask_execution import local_client, remote_client

    if arguments.scheduler:
        return remote_client(arguments.scheduler)
    settings = WorkerSettings.from_arguments(arguments)
    dashboard = None
    if settings.dashboard:
        dashboard = f"127.0.0.1:{settings.dashboard}"
        _check_bokeh()
    return local_client(settings.workers or len(os.sched_getaffinity(0)), dashboard)


def _check_bokeh() -> None:
    try:
        import bokeh  # noqa: F401
    except ImportError:
        raise StudyError("dashboard: Dask's page needs the Python package bokeh: pip install bokeh") from None


def _finish(store: Store, keys: Sequence[str], status: int, arguments: argparse.Namespace, console: Console) -> int:
    """Write the results, print a summary, draw the picture and return the exit status."""
    there = sum(key in store.rows for key in keys)
    failed = sum(not store.rows.get(key, True) for key in keys)
    _print(console, f"{there:,} of {len(keys):,} runs exist, {failed:,} of them failed")
    results = store.finish(keys)
    if not there:
        again = "--draw flies nothing" if arguments.draw else "repeat the command to fly the runs"
        _print(console, f"There are no results; {again}")
        return status or 1
    _print(console, f"Results: {results}")
    if failed:
        _print_reasons(results, console)
    if failed == there:
        results.with_name(_PICTURE).unlink(missing_ok=True)  # an older one
        _print(console, "No picture is drawn, because no run succeeded")
    elif not status:  # an interrupted sweep ends at once; --draw makes the picture
        _draw(results, arguments, console)
    if there < len(keys):
        _print(console, "Repeat the command to fly the rest, or add --draw to draw the existing ones")
        return status or 1
    if failed:
        _print(console, "The column 'error' says why each run has failed; --retry-failed flies them again")
    return status or int(failed > 0)


def _print_reasons(results: Path, console: Console) -> None:
    """Print the most frequent reasons of failures."""
    errors = pq.read_table(results, columns=["error"])["error"].drop_null().to_pylist()
    for error, count in Counter(map(one_line, errors)).most_common(_REASONS):
        _print(console, f"  {count:,} failed: {error}")


def _draw(results: Path, arguments: argparse.Namespace, console: Console) -> None:
    from xtdrone_interaction.studies.sweep_picture import save_picture

    path = results.with_name(_PICTURE)
    try:
        save_picture(results, path, arguments.metric, arguments.x, arguments.by)
    except StudyError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
    else:
        _print(console, f"Picture: {path}")


def _print(console: Console, text: str) -> None:
    console.print(escape(text), highlight=False, soft_wrap=True)
