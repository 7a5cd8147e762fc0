"""The doctor's report as lines; vehicles in the same state share one entry, so that a fleet fits on a screen."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from xtdrone_interaction.doctor.findings import Finding, Simulator, Vehicle, listed

OK, BAD, PLAIN = "ok", "bad", ""
_ABILITIES = ("link", "arming", "OFFBOARD")
_FAILED = {"MAVROS": _ABILITIES, "link": _ABILITIES}  # the abilities that a finding makes impossible, besides its own
_INDENT = 10


@dataclass(frozen=True)
class Line:
    """A line of the report.

    Attributes:
        text: without colours.
        kind: OK, BAD or PLAIN.
    """

    text: str
    kind: str = PLAIN


def wrapped(line: Line, width: int) -> str:
    """Return a line's text cut into lines of at most ``width`` characters, further ones indented below its text."""
    indent = len(line.text) - len(line.text.lstrip())
    hang = " " * (indent + 3 if line.text.lstrip().startswith("->") else indent + _INDENT)
    return textwrap.fill(
        line.text, width, subsequent_indent=hang, break_long_words=False, break_on_hyphens=False, drop_whitespace=True
    )


def simulator_lines(uri: str, fleet: str, world: str, simulator: Simulator | None) -> list[Line]:
    """Return the lines about the running simulation or MAVROS."""
    if simulator is None:
        return [Line(_entry("MAVROS", f"without a simulator, on wall time; ROS master {uri}"))]
    target = f"of {simulator.speed:g} x" if simulator.speed else "as fast as it goes"
    speed = f"{simulator.measured_speed:.2f} x real time ({target})"
    count = len(simulator.participants)
    return [
        Line(_entry("running", "; ".join(filter(None, (fleet, world and f"world {world}", f"ROS master {uri}"))))),
        Line(_entry("time", f"{simulator.time:.1f} s, {speed}; lockstep of {count} node{'s' * (count != 1)}")),
    ]


def finding_lines(findings: Sequence[Finding]) -> list[Line]:
    """Return each finding with its remedy below it."""
    lines = []
    for finding in findings:
        lines += [
            Line(_entry(finding.what, finding.text), BAD),
            Line(f"{'':{_INDENT}}-> {finding.remedy}"),
        ]
    return lines


def vehicle_lines(examined: Sequence[tuple[Vehicle, list[Finding]]]) -> list[Line]:
    """Return an entry for each group of vehicles with the same state and findings."""
    groups: dict[tuple[object, ...], list[tuple[Vehicle, list[Finding]]]] = {}
    for vehicle, findings in examined:
        groups.setdefault(_state(vehicle, findings), []).append((vehicle, findings))
    lines = []
    for members in groups.values():
        vehicle, findings = members[0]
        lines += _group_lines([member.name for member, _ in members], vehicle, findings)
    return lines


def _state(vehicle: Vehicle, findings: Sequence[Finding]) -> tuple[object, ...]:
    kind, index = vehicle.kind

    own = re.compile(rf"\b{re.escape(vehicle.name)}\b|\b{re.escape(f'{kind} {index}')}\b")

    def general(text: str) -> str:
        return own.sub("*", text).replace(vehicle.fcu_url or "*", "*")

    words = tuple((finding.what, general(finding.text), general(finding.remedy)) for finding in findings)
    return vehicle.mode, vehicle.armed, vehicle.connected, words


def _group_lines(names: Sequence[str], vehicle: Vehicle, findings: Sequence[Finding]) -> list[Line]:
    state = f"{vehicle.mode or 'mode unknown'}, {'armed' if vehicle.armed else 'disarmed'}"
    title = names[0] if len(names) == 1 else f"{listed(names)} ({len(names)} vehicles; shown for {names[0]})"
    head = f"{title}: {state}" if vehicle.connected else title
    bad = {what for finding in findings for what in (finding.what, *_FAILED.get(finding.what, ()))}
    fine = [ability for ability in _ABILITIES if ability not in bad]
    lines = [Line(head)]
    if fine:
        lines.append(Line(_entry("  ok", ", ".join(fine)), OK))
    return lines + [Line(f"  {line.text}", line.kind) for line in finding_lines(findings)]


def _entry(name: str, text: str) -> str:
    return f"{name:<{_INDENT}}{text}"
