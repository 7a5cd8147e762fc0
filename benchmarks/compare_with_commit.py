"""Comparison of this tree with another commit: ``./xtdrone bench --baseline COMMIT``.

The commit is checked out into a git worktree of its own below ``.setup/baselines`` and set up there; both are kept for
the next comparison. Each case is then measured alternately by the ``./xtdrone bench`` of either tree, each a program of
its own, so that a drift of the machine's speed changes both alike. A case that the older benchmark does not have is
shown as such.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measurement_runner import Bench, BenchError, Row
from benchmarks.measurement_table import MEASUREMENTS
from benchmarks.tables.printed_tables import MIN_CPU, grouped
from xtdrone_interaction.command_options import OptionError, repository
from xtdrone_interaction.launching.process_tree import ProcessTree
from xtdrone_interaction.launching.scripted_launch import PATIENCE, cause, log_text

BASELINE, THIS = "baseline", "this"
"""The names of the two trees in the results."""
_POLL = 0.1  # s of wall time
_GIT_LIMIT = 60.0  # s of wall time for a query of the repository
_PREFIX = 12  # characters of the commit in the name of its folder
_ANY_MODE = ("shared",)
_REQUIREMENTS = "requirements.txt"
_CONTEXT = ("repeat", "request", "load_before", "others_cpu", "ticks", "dropped")  # numbers that are not figures


@dataclass(frozen=True)
class Tree:
    """A checked-out commit.

    Attributes:
        name: ``baseline`` or ``this``.
        folder: of the workspace.
        commit: full hash.
        changed: whether files differ from the commit.
    """

    name: str
    folder: Path
    commit: str
    changed: bool = False

    def __str__(self) -> str:
        return f"{self.commit[:_PREFIX]}{' with changes' * self.changed}"


@dataclass(frozen=True)
class Request:
    """The options of one case, for the benchmark of either tree.

    Attributes:
        part: to measure.
        number: of vehicles, workers, ...
        options: further options of ``./xtdrone bench``.
    """

    part: str
    number: int
    options: tuple[str, ...]

    def words(self, file: Path) -> list[str]:
        """Return the command line after ``./xtdrone``; ``file`` is for the results."""
        return [
            "bench", "--only", self.part, "--vehicles", f"{self.part}={self.number}", *self.options, "--json", str(file)
        ]  # fmt: skip


def resolve(name: str, root: Path | None = None) -> tuple[Tree, Tree]:
    """Return the baseline, which need not be checked out yet, and this tree.

    Raises:
        OptionError: no such commit, or no git repository.
    """
    root = root or repository()
    here = _git(root, "rev-parse", "--verify", "--quiet", "HEAD^{commit}")
    if here is None:
        raise OptionError(
            f"baseline: {str(root)!r} is not a git repository with commits, one of which the baseline must be"
        )
    commit = _git(root, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{name}^{{commit}}")
    if commit is None:
        raise OptionError(
            f"baseline: {name!r} is not a commit of this repository; a hash, a branch or a tag is allowed"
        )
    folder = root / ".setup" / "baselines" / commit[:_PREFIX]
    changed = bool(_git(root, "status", "--porcelain", "--untracked-files=no"))
    return Tree(BASELINE, folder, commit), Tree(THIS, root, here, changed)


def prepare(baseline: Tree, this: Tree, bench: Bench) -> None:
    """Check out and set up the baseline, except for steps completed by an earlier comparison.

    Raises:
        BenchError: git or the set-up failed.
    """
    if not baseline.folder.exists():
        bench.progress("checking out the commit")
        _check_out(baseline, this, bench)
    elif not _is_whole(baseline):
        raise BenchError(f"baseline: {baseline.folder} was changed after its checkout; remove that folder")
    _share_environment(this.folder, baseline.folder)
    bench.progress("setting up the baseline, which takes minutes the first time")
    _run(bench, [str(baseline.folder / "xtdrone"), "setup"], bench.folder / "setup.log", "set-up")


def _check_out(baseline: Tree, this: Tree, bench: Bench) -> None:
    baseline.folder.parent.mkdir(parents=True, exist_ok=True)
    words = ["worktree", "add", "--force", "--detach", str(baseline.folder), baseline.commit]
    try:
        _run(bench, ["git", "-C", str(this.folder), *words], bench.folder / "checkout.log", "check-out")
    except BaseException:  # Stopped, too
        shutil.rmtree(baseline.folder, ignore_errors=True)
        raise


def _is_whole(tree: Tree) -> bool:
    """Return whether a worktree is at its commit, without changes."""
    if not (tree.folder / ".git").is_file() or _git(tree.folder, "rev-parse", "HEAD") != tree.commit:
        return False
    return _git(tree.folder, "status", "--porcelain", "--untracked-files=no") == ""


def _share_environment(this: Path, baseline: Path) -> None:
    """Give the baseline this tree's Python packages, by hard links, where both require the same and it has none yet.

    pip replaces files and never writes into one, so that either environment can be changed afterwards.
    """
    source, target = this / ".venv", baseline / ".venv"
    same = (this / _REQUIREMENTS).read_bytes() == _content(baseline / _REQUIREMENTS)
    stamp = source / f".{Path(_REQUIREMENTS).stem}.installed"
    if target.exists() or not same or not stamp.is_file():
        return
    part = target.with_name(".venv.part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        shutil.copytree(source, part, symlinks=True, copy_function=os.link)
    except (OSError, shutil.Error):  # the set-up makes an environment of its own
        shutil.rmtree(part, ignore_errors=True)
        return
    for name, text in ((".made-for", str(target)), (stamp.name, stamp.read_text(encoding="utf-8"))):
        (part / name).unlink(missing_ok=True)  # the set-up writes into stamps
        (part / name).write_text(text, encoding="utf-8")
    part.rename(target)


def _content(file: Path) -> bytes | None:
    return file.read_bytes() if file.is_file() else None


def measured_rows(tree: Tree, request: Request, bench: Bench) -> list[Row]:
    """Return the rows of a case by the benchmark of a tree, or one with ``error``; adds ``tree`` and ``request``."""
    folder = bench.folder / f"{tree.name}-{request.part}-{request.number}"
    file, log = folder / "bench.json", folder / "output.log"
    file.unlink(missing_ok=True)
    bench.progress("measuring")
    added = {"tree": tree.name, "request": request.number}
    try:
        # Python may look for the module `benchmarks` in the working directory first, so that must be the tree's own.
        command = ["env", "-C", str(tree.folder), str(tree.folder / "xtdrone"), *request.words(file)]
        status = _run(bench, command, log, request.part, (0, 1, 2))
    except BenchError as error:
        return [added | {"error": str(error)}]
    if status == 2:
        return [added | {"error": f"not measured by its benchmark: {_last_line(log)}"}]
    try:
        rows: list[Row] = json.loads(file.read_text(encoding="utf-8"))[request.part]
    except (OSError, ValueError, KeyError):
        return [added | {"error": f"no results: {cause(log)}"}]
    return [row | added for row in rows]


def _last_line(log: Path) -> str:
    return log_text(log).strip().rpartition("\n")[2]


def _run(bench: Bench, command: Sequence[str], log: Path, thing: str, allowed: Sequence[int] = (0,)) -> int:
    """Run a program to its end, with all that it starts, and return its exit status.

    Raises:
        BenchError: another exit status than the allowed ones.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    tree = ProcessTree(command, {**os.environ, "GIT_TERMINAL_PROMPT": "0"}, log)
    try:
        while not tree.wait(_POLL):
            bench.stop.check()
    finally:
        tree.stop(PATIENCE)
    status = tree.process.returncode
    if status not in allowed:
        raise BenchError(f"baseline: {thing} ended with status {tree.status}; {cause(log)}; log: {log}")
    return int(status)


def turns(trees: Sequence[Tree], repeat: int) -> Iterator[Tree]:
    """Yield the trees in the order of measurement: alternately, in every second round the other way round."""
    for number in range(repeat):
        yield from trees if number % 2 == 0 else reversed(trees)


# ---- figures


def figures(row: Row) -> dict[str, float]:
    """Return the numbers of a row that are results, those of an inner table under ``name program``."""
    found = {}
    for key, value in row.items():
        if key in _CONTEXT:
            continue
        inner = value.items() if isinstance(value, dict) else [("", value)]
        for name, number in inner:
            if isinstance(number, (int, float)) and not isinstance(number, bool):
                found[f"{key} {name}".rstrip()] = float(number)
    return found


def comparison_table(part: str, rows: Sequence[Row]) -> Table:
    """Return the table of one part: figure by figure the median and range of either tree, and their ratio.

    Args:
        part: its name.
        rows: of both trees; ``tree`` names it.
    """
    measurement = MEASUREMENTS[part]
    table = Table(title=measurement.title, title_justify="left", title_style="bold")
    for heading in ("case", "figure", BASELINE, "this tree", "ratio"):
        justify: Any = "left" if heading in ("case", "figure") else "right"
        table.add_column(heading, justify=justify, overflow="fold")
    for group in grouped(measurement, rows):
        label = measurement.label(group[0])
        values = {name: _values([row for row in group if row["tree"] == name]) for name in (BASELINE, THIS)}
        known = next(measurement.cases(part, group[0]["request"], _ANY_MODE)).known
        for figure in values[BASELINE] | values[THIS]:
            if figure in known:
                continue
            either = [values[name].get(figure, []) for name in (BASELINE, THIS)]
            if _is_negligible(figure, either):
                continue
            table.add_row(label, figure, *map(_spread, either), _ratio(*either))
            label = ""
    return table


def _values(rows: Sequence[Row]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for row in rows:
        for name, value in figures(row).items():
            found.setdefault(name, []).append(value)
    return found


def _is_negligible(figure: str, either: Sequence[Sequence[float]]) -> bool:
    values = [value for each in either for value in each]
    return figure.startswith("cpu_per_simulated_second ") and max(values) < MIN_CPU


def _spread(values: Sequence[float]) -> str:
    if not values:
        return ""
    text = f"{statistics.median(values):.4g}"
    return text if len(values) == 1 else f"{text}\n{min(values):.4g} to {max(values):.4g}"


def _ratio(baseline: Sequence[float], this: Sequence[float]) -> str:
    """Return this tree's median by the baseline's."""
    if not baseline or not this or not (before := statistics.median(baseline)):
        return ""
    return f"{statistics.median(this) / before:.3f}"


def print_comparison(results: dict[str, Any], console: Console) -> None:
    """Print the tables, and what failed."""
    for part, rows in results["rows"].items():
        good = [row for row in rows if "error" not in row]
        if good:
            console.print(comparison_table(part, good))
        for row in rows:
            if "error" in row:
                text = f"{part}, {row['request']}, {row['tree']}: {row['error']}"
                console.print(f"[yellow]Note:[/yellow] {text.replace('[', chr(92) + '[')}", highlight=False)


def _git(folder: Path, *words: str) -> str | None:
    """Return the output of git, or None if it failed."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words], capture_output=True, text=True, check=True, timeout=_GIT_LIMIT
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
