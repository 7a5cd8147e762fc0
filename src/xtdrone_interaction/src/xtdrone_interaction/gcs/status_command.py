"""``xtdrone gcs status``: what all vehicles tell of themselves, as a table or JSON, once or again and again."""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from collections.abc import Sequence
from typing import Any, TextIO

from .arguments import Adder, chosen, seconds
from .display import tell_errors
from .exchanges import look
from .peers import GcsError
from .state import VehicleState
from .station import GroundStation

_REDRAW = 0.25  # s between two pictures on a terminal
_LOOK_PERIOD = 2.0  # s after which a vehicle that streams nothing is asked: its time may stand still
_SILENT = 3.0  # s of silence that are told of

Row = tuple[str, ...]
_TITLES: Row = ("VEHICLE", "SYS", "TYPE", "ARMED", "MODE", "X Y Z", "HEIGHT", "SPEED", "BATTERY", "GPS", "EKF", "TEXT")
_RIGHT = ("SYS", "HEIGHT", "SPEED", "BATTERY")


def _told(value: Any, form: str) -> str:
    return "-" if value is None else form.format(value)


def _arming(state: VehicleState) -> str:
    if state.armed is None:
        return "-"
    return "armed" if state.armed else "ready" if state.ready else "no"


def row(state: VehicleState, now: float) -> Row:
    """Return a vehicle's row of the table; ``now``: wall time, s."""
    silent = now - state.heard
    if not math.isfinite(silent):
        return (state.name, _told(state.system or None, "{}"), *["-"] * 9, "nothing heard yet")
    local = state.local
    place = "-" if local is None else " ".join(f"{value:.1f}" for value in local)
    if local is None and state.latitude is not None:
        place = f"{state.latitude:.6f} {state.longitude:.6f}"
    gps = "-" if state.gps is None else f"{state.gps} {_told(state.satellites, '{}')}"
    text = state.texts[-1][1] if state.texts else ""
    return (
        state.name,
        str(state.system),
        _told(state.kind, "{}"),
        _arming(state),
        _told(state.mode, "{}"),
        place,
        _told(state.height, "{:.1f} m"),
        _told(state.speed, "{:.1f} m/s"),
        _told(state.battery, "{} %"),
        gps,
        _told(state.estimator, "{}"),
        f"(silent for {silent:.0f} s) {text}".rstrip() if silent >= _SILENT else text,
    )


def table(states: Sequence[VehicleState], now: float) -> list[str]:
    """Return the table's lines, its titles first; ``now``: wall time, s."""
    rows = [_TITLES, *(row(state, now) for state in states)]
    widths = [max(len(entry[i]) for entry in rows) for i in range(len(_TITLES))]
    lines = []
    for entry in rows:
        cells = zip(_TITLES, entry, widths, strict=True)
        lines.append("  ".join(f"{c:>{w}}" if t in _RIGHT else f"{c:<{w}}" for t, c, w in cells).rstrip())
    return lines


class _Screen:
    """Redraws lines in place."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._drawn = 0

    def draw(self, lines: list[str]) -> None:
        size = shutil.get_terminal_size()
        room = max(size.lines - 1, 2)
        if len(lines) > room:
            lines = [*lines[: room - 1], f"... and {len(lines) - room + 1} more"]
        picture = f"\x1b[{self._drawn}A" if self._drawn else ""
        picture += "".join(f"\x1b[2K{line[: size.columns - 1]}\n" for line in lines)
        self._file.write(f"{picture}\x1b[J")
        self._file.flush()
        self._drawn = len(lines)


def _as_json(states: Sequence[VehicleState], now: float) -> str:
    return json.dumps([state.as_json(now) for state in states], allow_nan=False)


def _status(arguments: argparse.Namespace) -> int:
    peers = chosen(arguments, or_all=True)
    with GroundStation(peers, heartbeat=not arguments.once and not arguments.no_heartbeat) as station:
        if arguments.once:
            return _once(station, arguments)
        tell_errors(station.errors.values())
        _live(station, arguments)
    return 1


def _once(station: GroundStation, arguments: argparse.Namespace) -> int:
    results: dict[str, Any] = station.run(dict.fromkeys(station.peers, look), patience=arguments.patience)
    states, now = station.states(), time.monotonic()
    print(_as_json(states, now) if arguments.json else "\n".join(table(states, now)))
    return tell_errors([*station.errors.values(), *results.values()])


def _live(station: GroundStation, arguments: argparse.Namespace) -> None:
    """Show until all lines have ended."""
    screen = _Screen(sys.stdout) if sys.stdout.isatty() and not arguments.json else None
    period = _REDRAW if screen else arguments.period
    asked = dict.fromkeys(station.peers, -math.inf)
    shown = time.monotonic() - period + _REDRAW  # the first picture as soon as something can be in it
    while station.peers:
        now = time.monotonic()
        states = station.states()
        for peer, state in zip(station.peers, states, strict=True):
            if now - max(state.told, asked[peer]) >= _LOOK_PERIOD:
                asked[peer] = now
                station.submit(peer, look, patience=_LOOK_PERIOD)
        if now - shown >= period:
            shown = now
            lines = [_as_json(states, now)] if arguments.json else table(states, now)
            if screen:
                screen.draw(lines)
            else:
                print("\n".join(lines), flush=True)
        station.poll(max(shown + period - time.monotonic(), 0.0))
    raise GcsError("\n".join(map(str, station.errors.values())))


def add_to(add: Adder) -> None:
    """Add this command to the command line."""
    status = add("status", _status, "what the vehicles (all that are there) tell of themselves, as a live table")
    status.add_argument("--once", action="store_true", help="show it once; nothing streams then")
    status.add_argument("--json", action="store_true", help="a JSON list of vehicles, one line each time")
    status.add_argument("--period", type=seconds, default=1.0, metavar="S",
                        help="time between two tables where there is no terminal (default: %(default)g s)")  # fmt: skip
    status.add_argument("--no-heartbeat", action="store_true",
                        help="only look on: do not count as a ground station for PX4's NAV_DLL_ACT")  # fmt: skip
