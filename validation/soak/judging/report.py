"""Results of a soak: report.json, a figure, and a table for the terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from validation.soak.judging.verdict import MIB, UNITS, Outcome, Verdict
from validation.soak.resource_samples import PROCESSES
from xtdrone_control.files import write_whole

_TOP_WARNINGS = 40
_QUOTED = 50  # maximum number of tracebacks and the like in the report
_SHOWN = 8  # of each on the terminal


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
    write_whole(folder / "report.json", text + "\n")
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

    from xtdrone_interaction.pictures.picture_style import save_figure

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
    save_figure(figure, path, dpi=110)


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
            unit = UNITS.get(name.split()[-1], "")
            judged = found.verdict != "not judged"
            slope = f"{found.slope:+.3f} {unit}" if judged else "-"
            within = f"{found.low:+.3f} .. {found.high:+.3f}" if judged else "-"
            growth_table.add_row(name, slope, within, f"{found.allowance:g}", found.verdict)
        console.print(growth_table)
    files = ", ".join(f"{count} {name}" for name, count in counts["files"].items()) or "none"
    lines = [
        f"{outcome.hours:.2f} h simulated in {outcome.wall / 3600:.2f} h of wall time: "
        f"{outcome.hours * 3600 / max(outcome.wall, 1e-3):.1f} x overall",
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
