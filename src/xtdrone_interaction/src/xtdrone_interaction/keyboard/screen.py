"""What the person sees, as lines of text; no terminal and no ROS here."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from .pilot import AXES, NO_PATTERN, Target

SILENT = 3.0  # s without a word from a vehicle after which that is said
_JOINED = "\xa0"  # a space at which no line ends
_LEAST_TABLE = 4  # vehicles that are worth more than the help
_FULL = 76  # columns that all headings and units take

_UNITS = {"vel": "m/s", "accel": "m/s^2"}


@dataclass(frozen=True)
class Sight:
    """A vehicle as it is seen.

    Attributes:
        name: as ``iris_0``.
        armed: whether its motors may turn; None: it has not said so.
        mode: PX4's, empty: not said.
        height: local z, m; None: not said.
        speed: m/s; None: not said.
        silence: s since its last word of any kind; None: there was none.
        listened: whether anybody takes commands for it.
    """

    name: str
    armed: bool | None = None
    mode: str = ""
    height: float | None = None
    speed: float | None = None
    silence: float | None = None
    listened: bool = True

    @property
    def trouble(self) -> str:
        """What is wrong, in a few words; empty: nothing."""
        if not self.listened:
            return "takes no commands"
        if self.silence is None:
            return "not heard of"
        return f"silent for {self.silence:.0f} s" if self.silence > SILENT else ""


@dataclass(frozen=True)
class View:
    """All that there is to show.

    Attributes:
        fleet: the vehicles in words, as ``iris 9``.
        mode: ``vel`` or ``accel``.
        target: who is steered.
        leader_listens: whether anybody takes commands for the leader.
        speeds: forward, left, up in m/s (m/s^2), turn in rad/s.
        note: what was done last; empty: nothing to say.
        page: the vehicles in sight.
        first: number of the first of them, from 0.
        count: of all vehicles.
        patterns: name by digit.
    """

    fleet: str
    mode: str
    target: Target
    leader_listens: bool
    speeds: tuple[float, float, float, float]
    note: str
    page: Sequence[Sight]
    first: int
    count: int
    patterns: Mapping[str, str]


@dataclass(frozen=True)
class Layout:
    """How the screen is divided.

    Attributes:
        rows: vehicles on a page, at least 1.
        help: whether the keys are shown.
    """

    rows: int
    help: bool


def layout(columns: int, rows: int, count: int, patterns: Mapping[str, str], wanted: bool | None) -> Layout:
    """Divide the screen between vehicles and help.

    Args:
        columns: of the terminal.
        rows: of the terminal.
        count: of vehicles.
        patterns: name by digit, as the help lists them.
        wanted: whether help was asked for; None: if there is room.
    """
    free = rows - len(_heading(columns)) - 2  # the table's head and foot
    needed = len(help_lines(columns, patterns))
    shown = free - needed >= min(count, _LEAST_TABLE) if wanted is None else wanted
    return Layout(max(1, min(count, free - needed if shown else free)), shown)


def _heading(columns: int) -> list[str]:
    """What stands above the table; without its contents here."""
    return [""] * (4 if columns < _FULL else 3)


def frame(view: View, columns: int, rows: int, shown: Layout) -> list[str]:
    """Return the screen's lines, at most ``rows``, none longer than ``columns`` - 1: a full line may wrap."""
    note = view.note or next((f"{sight.name} {sight.trouble}" for sight in view.page if sight.trouble), "")
    lines = [*_title(view, columns), *_steering(view, columns), note, *table(view.page, columns)]
    lines.append(_foot(view, shown, columns))
    if shown.help:
        lines += help_lines(columns, view.patterns)
    return [line[: max(0, columns - 1)].rstrip() for line in lines[:rows]]


def _title(view: View, columns: int) -> Iterator[str]:
    who = "leader" if view.target is Target.LEADER else "all"
    absent = view.target is Target.LEADER and not view.leader_listens
    if columns < _FULL:
        yield f"{view.fleet}, {view.mode}: {'no ' if absent else ''}{who}"
    else:
        hint = ", but none is there: start leader.py" if absent else ""
        yield f"XTDrone keyboard: {view.fleet}, steering {who}{hint}"


def _steering(view: View, columns: int) -> Iterator[str]:
    parts = [f"{name} {value:+.2f}" for name, value in zip(AXES, view.speeds, strict=True)]
    unit = _UNITS[view.mode]
    if columns < _FULL:
        yield "  ".join(parts[:2])
        yield f"{'  '.join(parts[2:])}"
    else:
        yield f"{'  '.join(parts[:3])} {unit}   {parts[3]} rad/s"


def table(page: Sequence[Sight], columns: int) -> list[str]:
    """Return a heading and a line for each vehicle."""
    width = max([7, *(len(sight.name) for sight in page)])
    if columns < _FULL:
        return [f"{'vehicle':{width}} A {'mode':8} {'m':>6} {'m/s':>5}", *(_short_row(s, width) for s in page)]
    head = f"{'vehicle':{width}}  {'':8} {'mode':14}  {'height':>8}  {'speed':>9}"
    return [head, *(_row(sight, width) for sight in page)]


def _row(sight: Sight, width: int) -> str:
    armed = {True: "armed", False: "disarmed", None: "?"}[sight.armed]
    height, speed = _figure(sight.height, 2, " m"), _figure(sight.speed, 2, " m/s")
    return f"{sight.name:{width}}  {armed:8} {sight.mode or '?':14}  {height:>8}  {speed:>9}  {sight.trouble}".rstrip()


def _short_row(sight: Sight, width: int) -> str:
    armed = {True: "A", False: "-", None: "?"}[sight.armed]
    mode = (sight.mode or "?").removeprefix("AUTO.")
    height, speed = _figure(sight.height, 1), _figure(sight.speed, 2)
    return f"{sight.name:{width}} {armed} {mode:8.8} {height:>6} {speed:>5}{' !' if sight.trouble else ''}"


def _figure(value: float | None, digits: int, unit: str = "") -> str:
    return "?" if value is None else f"{value:.{digits}f}{unit}"


def _foot(view: View, shown: Layout, columns: int) -> str:
    page, keys, end = "", "h keys, ", "Ctrl-C ends"
    if view.count > len(view.page):
        page = f"{view.first + 1}-{view.first + len(view.page)} of {view.count}, p next, "
    whole = f"{page}{'' if shown.help else keys}{end}"
    return whole if len(whole) < columns else f"{page}{end}"


def help_lines(columns: int, patterns: Mapping[str, str]) -> list[str]:
    """Return what the keys do, in lines for this width."""
    # a digit stays with its pattern where the line wraps
    chosen = ", ".join(f"{digit}{_JOINED}{name}" for digit, name in {"0": NO_PATTERN, **patterns}.items())
    items = [
        "w/x forward/back",
        "a/d left/right",
        "i/, up/down",
        "j/l turn left/right (0.01 a press)",
        "s or k hover",
        "t/y arm/disarm",
        "b OFFBOARD",
        "v take off",
        "n land",
        "r return home",
        "g all or leader",
        "p next page",
        "h these lines",
        f"leader's patterns: {chosen}",
    ]
    width = max(20, columns - 1)
    lines: list[str] = []
    for item in items:
        if lines and len(lines[-1]) + 3 + len(item) <= width:
            lines[-1] += f"   {item}"
        else:
            lines += textwrap.wrap(item, width)
    return [line.replace(_JOINED, " ") for line in lines]


def sentence(sight: Sight) -> str:
    """Return a vehicle's state as a line of its own, for terminals that cannot redraw."""
    armed = {True: "armed", False: "disarmed", None: "arming unknown"}[sight.armed]
    parts = [armed, sight.mode or "mode unknown"]
    if sight.height is not None:
        parts.append(f"height {sight.height:.2f} m")
    if sight.speed is not None:
        parts.append(f"speed {sight.speed:.2f} m/s")
    return f"{sight.name}: {', '.join([*parts, *filter(None, [sight.trouble])])}"
