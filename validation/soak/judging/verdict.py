"""Verdict on a soak: its findings held against ``limits``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from validation.soak.judging.limits import (
    ALLOWANCES,
    LEAST_FLIGHTS,
    LOAD_ALLOWANCE,
    PACE_ALLOWANCE,
    PARTICIPANTS_ALLOWANCE,
    ROS_ALLOWANCES,
    WARM_UP,
    WARM_UP_HOURS,
)
from validation.soak.judging.robust_fits import Growth, Pace, Stretch, growth, pace
from validation.soak.resource_samples import PROCESSES

MIB = 1 << 20
UNITS = {"rss": "MiB", "anonymous": "MiB"}
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
        scale = MIB if name.split()[-1] in UNITS else 1
        kept = [row for row in resting if row.get(column) not in (None, "")]
        times = [row["soak_time"] / 3600.0 for row in kept]
        found[name] = growth(times, [row[column] / scale for row in kept], limit, warm_up)
    return found
