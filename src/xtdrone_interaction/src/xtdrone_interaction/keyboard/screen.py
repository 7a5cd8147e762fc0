"""The keyboard's screen as lines of text, without terminal and ROS."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from .key_bindings import AXES, NO_PATTERN, Target

SILENT = 3.0  # s without a message before a vehicle is shown as silent
_JOINED = "\xa0"  # non-breaking space
_LEAST_TABLE = 4  # vehicles that have priority over the help
_FULL = 76  # columns for all headings and units

_UNITS = {"vel": "m/s", "accel": "m/s^2"}


@dataclass(frozen=True)
class VehicleStatus:
    """State of a vehicle; None and empty texts are unknown values.

    Attributes:
        name: such as ``iris_0``.
        armed: whether it is armed.
        mode: PX4's name.
        height: local z, m.
        speed: m/s.
        silence: s since its last message; None before the first.
        has_subscriber: whether a node receives commands for it.
    """

    name: str
    armed: bool | None = None
    mode: str = ""
    height: float | None = None
    speed: float | None = None
    silence: float | None = None
    has_subscriber: bool = True

    @property
    def trouble(self) -> str:
        """Short description of a problem; empty for none."""
        if not self.has_subscriber:
            return "takes no commands"
        if self.silence is None:
            return "no messages"
        return f"silent for {self.silence:.0f} s" if self.silence > SILENT else ""


@dataclass(frozen=True)
class ScreenContent:
    """Content of the screen.

    Attributes:
        fleet: description of the vehicles, such as ``iris 9``.
        mode: ``vel`` or ``accel``.
        target: receiver of the commands.
        leader_has_subscriber: whether a node receives commands for the leader.
        speeds: forward, left, up in m/s (m/s^2), turn in rad/s.
        note: the last action; may be empty.
        page: the visible vehicles.
        first: index of the first visible vehicle.
        count: of all vehicles.
        patterns: name by digit.
    """

    fleet: str
    mode: str
    target: Target
    leader_has_subscriber: bool
    speeds: tuple[float, float, float, float]
    note: str
    page: Sequence[VehicleStatus]
    first: int
    count: int
    patterns: Mapping[str, str]


@dataclass(frozen=True)
class Layout:
    """Layout of the screen.

    Attributes:
        rows: number of vehicles on a page, at least 1.
        help: whether the help is shown.
    """

    rows: int
    help: bool


def layout(columns: int, rows: int, count: int, patterns: Mapping[str, str], wanted: bool | None) -> Layout:
    """Divide the screen between vehicles and help.

    Args:
        columns: of the terminal.
        rows: of the terminal.
        count: of vehicles.
        patterns: name by digit, for the help.
        wanted: whether to show the help; None to show it if there is room.
    """
    free = rows - len(_heading(columns)) - 2  # header and footer of the table
    needed = len(help_lines(columns, patterns))
    shown = free - needed >= min(count, _LEAST_TABLE) if wanted is None else wanted
    return Layout(max(1, min(count, free - needed if shown else free)), shown)


def _heading(columns: int) -> list[str]:
    """Return empty lines in place of those above the table."""
    return [""] * (4 if columns < _FULL else 3)


def frame(view: ScreenContent, columns: int, rows: int, shown: Layout) -> list[str]:
    """Return at most ``rows`` lines of at most ``columns`` - 1 characters, because a full line may wrap."""
    note = view.note or next((f"{status.name} {status.trouble}" for status in view.page if status.trouble), "")
    lines = [*_title(view, columns), *_steering(view, columns), note, *table(view.page, columns)]
    lines.append(_foot(view, shown, columns))
    if shown.help:
        lines += help_lines(columns, view.patterns)
    return [line[: max(0, columns - 1)].rstrip() for line in lines[:rows]]


def _title(view: ScreenContent, columns: int) -> Iterator[str]:
    who = "leader" if view.target is Target.LEADER else "all"
    absent = view.target is Target.LEADER and not view.leader_has_subscriber
    if columns < _FULL:
        yield f"{view.fleet}, {view.mode}: {'no ' if absent else ''}{who}"
    else:
        hint = ", but none is running: start leader.py" if absent else ""
        yield f"XTDrone keyboard: {view.fleet}, steering {who}{hint}"


def _steering(view: ScreenContent, columns: int) -> Iterator[str]:
    parts = [f"{name} {value:+.2f}" for name, value in zip(AXES, view.speeds, strict=True)]
    unit = _UNITS[view.mode]
    if columns < _FULL:
        yield "  ".join(parts[:2])
        yield f"{'  '.join(parts[2:])}"
    else:
        yield f"{'  '.join(parts[:3])} {unit}   {parts[3]} rad/s"


def table(page: Sequence[VehicleStatus], columns: int) -> list[str]:
    """Return a header and a line for each vehicle."""
    width = max([7, *(len(status.name) for status in page)])
    if columns < _FULL:
        return [f"{'vehicle':{width}} A {'mode':8} {'m':>6} {'m/s':>5}", *(_short_row(s, width) for s in page)]
    head = f"{'vehicle':{width}}  {'':8} {'mode':14}  {'height':>8}  {'speed':>9}"
    return [head, *(_row(status, width) for status in page)]


def _row(status: VehicleStatus, width: int) -> str:
    armed = {True: "armed", False: "disarmed", None: "?"}[status.armed]
    height, speed = _figure(status.height, 2, " m"), _figure(status.speed, 2, " m/s")
    return (
        f"{status.name:{width}}  {armed:8} {status.mode or '?':14}  {height:>8}  {speed:>9}  {status.trouble}".rstrip()
    )


def _short_row(status: VehicleStatus, width: int) -> str:
    armed = {True: "A", False: "-", None: "?"}[status.armed]
    mode = (status.mode or "?").removeprefix("AUTO.")
    height, speed = _figure(status.height, 1), _figure(status.speed, 2)
    return f"{status.name:{width}} {armed} {mode:8.8} {height:>6} {speed:>5}{' !' if status.trouble else ''}"


def _figure(value: float | None, digits: int, unit: str = "") -> str:
    return "?" if value is None else f"{value:.{digits}f}{unit}"


def _foot(view: ScreenContent, shown: Layout, columns: int) -> str:
    page, keys, end = "", "h keys, ", "Ctrl-C ends"
    if view.count > len(view.page):
        page = f"{view.first + 1}-{view.first + len(view.page)} of {view.count}, p next, "
    whole = f"{page}{'' if shown.help else keys}{end}"
    return whole if len(whole) < columns else f"{page}{end}"


def help_lines(columns: int, patterns: Mapping[str, str]) -> list[str]:
    """Return the help text wrapped to a width."""
    # keep a digit and its pattern on one line
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


def sentence(status: VehicleStatus) -> str:
    """Describe a vehicle in one line, for terminals that cannot redraw."""
    armed = {True: "armed", False: "disarmed", None: "arming unknown"}[status.armed]
    parts = [armed, status.mode or "mode unknown"]
    if status.height is not None:
        parts.append(f"height {status.height:.2f} m")
    if status.speed is not None:
        parts.append(f"speed {status.speed:.2f} m/s")
    return f"{status.name}: {', '.join([*parts, *filter(None, [status.trouble])])}"
