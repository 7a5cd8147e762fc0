"""Results of a soak: verdicts, report.json, a figure, and a table for the terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from validation.soak.fit import Growth, Pace, Stretch, growth, pace
from validation.soak.samples import PROCESSES

MIB = 1 << 20
ALLOWANCES = {"rss": 2.0, "anonymous": 2.0, "descriptors": 0.5, "threads": 0.25, "sockets": 0.5}
"""Growth that is allowed, per simulated hour: MiB of memory, counts of the rest."""
ROS_ALLOWANCES = {"rss": 6.0, "anonymous": 6.0, "descriptors": 2.0, "threads": 1.0, "sockets": 2.0}
"""The same of ROS's own master and log collector, which keep something of every node that ever was."""
PARTICIPANTS_ALLOWANCE = 0.1
"""Growth of the number of lockstep participants that is allowed, per simulated hour."""
PACE_ALLOWANCE = 0.2
"""Fraction by which an episode's real-time factor may fall, or its processor time grow, from first to last quarter."""
LOAD_ALLOWANCE = 0.2
"""Maximum increase of the cores used by other programs at which real-time factors are compared."""
LEAST_FLIGHTS = 0.9
"""Required fraction of the requested takeoffs."""
WARM_UP = 0.1
"""Fraction of the soak, at most WARM_UP_HOURS, that is not judged: memory is still being filled for the first time."""
WARM_UP_HOURS = 0.5
_TOP_WARNINGS = 40
_QUOTED = 50  # maximum number of tracebacks and the like in the report
_SHOWN = 8  # of each on the terminal
_UNITS = {"rss": "MiB", "anonymous": "MiB"}
_OWN = ("simulator", "mavros")


@dataclass
class Outcome:
    """Findings of the runner.

    Attributes:
        settings: of the soak, with the facts of the machine.
        end: reason of an early end; empty after a complete run.
        rows: the samples.
        stretches: of the episodes.
        hours: simulated time, h.
        wall: wall time, s.
        counts: further figures of the report by name.
        tracebacks: of processes that were not killed.
        wrong: failures of nodes.
        damaged: descriptions of the files that cannot be read to their end.
        unread: number of files that were not judged.
        judge_growth: whether growth and pace are judged; a short soak is insufficient.
    """

    settings: Mapping[str, Any]
    end: str
    rows: Sequence[Mapping[str, Any]]
    stretches: Sequence[Stretch]
    hours: float
    wall: float
    counts: Mapping[str, Any]
    tracebacks: Sequence[str]
    wrong: Sequence[str]
    damaged: Sequence[str]
    unread: int
    judge_growth: bool = True


@dataclass
class Verdict:
    """Verdicts on a soak.

    Attributes:
        growths: by process and figure, as ``simulator rss``.
        paces: by kind of episode.
        failures: one sentence each; empty for a good soak.
    """

    growths: dict[str, Growth] = field(default_factory=dict)
    paces: dict[str, Pace] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)


def judge(outcome: Outcome) -> Verdict:
    """Judge a soak."""
    verdict = Verdict()
    if outcome.judge_growth:
        verdict.growths = growths(outcome.rows, outcome.hours)
        kinds = dict.fromkeys(stretch.kind for stretch in outcome.stretches)
        for kind in kinds:
            own = [stretch for stretch in outcome.stretches if stretch.kind == kind]
            verdict.paces[kind] = pace(own, outcome.hours * 3600.0, PACE_ALLOWANCE, LOAD_ALLOWANCE)
    fail = verdict.failures.append
    for name, found in verdict.growths.items():
        if found.verdict == "growing":
            fail(f"{name} grows by {found.slope:.2f} an hour, {found.allowance:g} are allowed")
    for kind, compared in verdict.paces.items():
        if compared.verdict == "slower":
            fail(
                f"{kind} became slower: {compared.first:.2f} to {compared.last:.2f} x real time, "
                f"{compared.cpu_first:.4f} to {compared.cpu_last:.4f} processor seconds a simulated second"
            )
    verdict.failures += [f"traceback: {text.splitlines()[0]} {text.splitlines()[-1]}" for text in outcome.tracebacks]
    verdict.failures += [f"node: {text}" for text in outcome.wrong]
    verdict.failures += [f"file: {text}" for text in outcome.damaged]
    expected, flights = outcome.counts["expected"], outcome.counts["flights"]
    if flights < LEAST_FLIGHTS * expected:
        fail(f"only {flights} of {expected} vehicles took off when commanded")
    if outcome.unread:
        fail(f"{outcome.unread} files were not read to their end in time")
    if outcome.end:
        fail(outcome.end)
    return verdict


def growths(rows: Sequence[Mapping[str, Any]], hours: float) -> dict[str, Growth]:
    """Return the growth of the figures of each process, from the samples between episodes."""
    resting = [row for row in rows if row["resting"]]
    warm_up = min(WARM_UP * hours, WARM_UP_HOURS)
    found = {}
    series = {
        f"{process} {figure}": limit
        for process in PROCESSES
        for figure, limit in (ALLOWANCES if process in _OWN else ROS_ALLOWANCES).items()
    }
    for name, limit in {**series, "lockstep participants": PARTICIPANTS_ALLOWANCE}.items():
        column = "participants" if name.startswith("lockstep") else name.replace(" ", "_")
        scale = MIB if name.split()[-1] in _UNITS else 1
        kept = [row for row in resting if row.get(column) not in (None, "")]
        times = [row["soak_time"] / 3600.0 for row in kept]
        found[name] = growth(times, [row[column] / scale for row in kept], limit, warm_up)
    return found


def write(outcome: Outcome, verdict: Verdict, folder: Path) -> None:
    """Write report.json and soak.png."""
    content = {
        "settings": dict(outcome.settings),
        "good": not verdict.failures,
        "failures": verdict.failures,
        "simulated_hours": outcome.hours,
        "wall_hours": outcome.wall / 3600.0,
        "growth_per_hour": {name: asdict(found) for name, found in verdict.growths.items()},
        "pace": {kind: asdict(compared) for kind, compared in verdict.paces.items()},
        "counts": dict(outcome.counts),
        "tracebacks": list(outcome.tracebacks[:_QUOTED]),
        "nodes_wrong": list(outcome.wrong[:_QUOTED]),
        "files_damaged": list(outcome.damaged[:_QUOTED]),
        "files_unread": outcome.unread,
        "episodes": [asdict(stretch) for stretch in outcome.stretches],
    }
    text = json.dumps(_plain(content), indent=1, allow_nan=False)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
    if len(outcome.rows) > 1:
        draw(outcome, folder / "soak.png")


def _plain(value: Any) -> Any:
    """Return a value for JSON: None in place of NaN and infinity."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def draw(outcome: Outcome, path: Path) -> None:
    """Draw memory, descriptors, threads and real-time factor over simulated time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    resting = [row for row in outcome.rows if row["resting"]]
    figure, axes = plt.subplots(2, 2, figsize=(13, 8), sharex=True, layout="constrained")

    def curve(axis: Any, column: str, scale: float, label: str) -> None:
        drawn = axis.plot(*_column(outcome.rows, column, scale), linewidth=0.7, alpha=0.45)
        axis.plot(*_column(resting, column, scale), "o", ms=2.5, color=drawn[0].get_color(), label=label)

    for process in PROCESSES:
        curve(axes[0, 0], f"{process}_rss", MIB, process)
        curve(axes[0, 1], f"{process}_descriptors", 1, process)
        curve(axes[1, 0], f"{process}_threads", 1, process)
    axes[0, 0].set(title="Memory (resident set size)", ylabel="memory [MiB]", ylim=(0, None))
    axes[0, 1].set(title="Open file descriptors", ylabel="descriptors", ylim=(0, None))
    axes[1, 0].set(title="Threads", ylabel="threads", xlabel="simulated time [h]", ylim=(0, None))
    for kind in dict.fromkeys(stretch.kind for stretch in outcome.stretches):
        own = [s for s in outcome.stretches if s.kind == kind and s.wall > 0.0]
        axes[1, 1].plot([s.begin / 3600 for s in own], [s.seconds / s.wall for s in own], "o-", ms=3, lw=0.7,
                        label=kind.replace("_", " "))  # fmt: skip
    axes[1, 1].set(title="Real-time factor of each episode", ylabel="simulated s / wall s", ylim=(0, None),
                   xlabel="simulated time [h]")  # fmt: skip
    for axis in axes.flat:
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    settings = outcome.settings
    figure.suptitle(
        f"Soak of {settings['n']} vehicles, seed {settings['seed']}: {outcome.hours:.2f} h simulated in "
        f"{outcome.wall / 3600:.2f} h; dots: between episodes, when nothing flies and no other node runs"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _column(rows: Sequence[Mapping[str, Any]], column: str, scale: float) -> tuple[list[float], list[float]]:
    kept = [row for row in rows if row.get(column) not in (None, "")]
    return [row["soak_time"] / 3600.0 for row in kept], [row[column] / scale for row in kept]


# ---- the terminal


def show(outcome: Outcome, verdict: Verdict, folder: Path, console: Console) -> None:
    """Print the short tables and the verdict."""
    counts = outcome.counts
    headings = ("episodes", "time", "RTF", "cpu s/s", "wall s", "RTF 1st, last 1/4", "verdict")
    pace_table = Table(*headings)
    for kind, figures in counts["phases"].items():
        compared = verdict.paces.get(kind)
        judged = compared is not None and compared.verdict != "not judged"
        change = f"{compared.first:.1f}, {compared.last:.1f}" if compared and judged else "-"
        pace_table.add_row(
            f"{figures['episodes']} {kind.replace('_', ' ')}", f"{figures['share']:.0%}", f"{figures['rtf']:.1f}",
            f"{figures['cpu']:.3f}", f"{figures['wall']:.0f}", change, compared.verdict if compared else "not judged",
        )  # fmt: skip
    console.print(pace_table)
    if verdict.growths:
        growth_table = Table("per simulated hour", "slope", "99 % within", "allowed", "verdict")
        for name, found in verdict.growths.items():
            unit = _UNITS.get(name.split()[-1], "")
            judged = found.verdict != "not judged"
            slope = f"{found.slope:+.3f} {unit}" if judged else "-"
            within = f"{found.low:+.3f} .. {found.high:+.3f}" if judged else "-"
            growth_table.add_row(name, slope, within, f"{found.allowance:g}", found.verdict)
        console.print(growth_table)
    files = ", ".join(f"{count} {name}" for name, count in counts["files"].items()) or "none"
    lines = [
        f"{outcome.hours:.2f} h simulated in {outcome.wall / 3600:.2f} h of wall time: "
        f"{outcome.hours * 3600 / max(outcome.wall, 1e-3):.1f} x in all",
        f"{counts['flights']} of {counts['expected']} vehicles took off when commanded; {counts['forced']} were "
        "disarmed by force at an episode's end",
        f"files read to their end: {files}",
        f"warnings: {counts['warnings_total']}, {counts['lost']} of losses or drops; the most frequent:",
        *(f"  {count:6d} {kind}" for kind, count in list(counts["warnings"].items())[:_SHOWN]),
    ]
    if any(compared.verdict == "not comparable" for compared in verdict.paces.values()):
        lines.append("not comparable: other programs took more of the machine at the end; processor time did not grow")
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True, markup=False)
    for failure in verdict.failures[: 2 * _SHOWN]:
        console.print(f"[red]not good:[/red] {failure.replace('[', chr(92) + '[')}", highlight=False, soft_wrap=True)
    if len(verdict.failures) > 2 * _SHOWN:
        console.print(f"... and {len(verdict.failures) - 2 * _SHOWN} more, see report.json", highlight=False)
    word = "not good" if verdict.failures else "good"
    console.print(f"{word}: {folder / 'report.json'}, soak.png, samples.csv", highlight=False, soft_wrap=True)


def top(warnings: Mapping[str, int]) -> dict[str, int]:
    """Return the most frequent warnings, the most frequent first."""
    return dict(sorted(warnings.items(), key=lambda one: -one[1])[:_TOP_WARNINGS])
