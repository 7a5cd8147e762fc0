"""``xtdrone gcs status``: the states of vehicles as a table or JSON, once or live."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from xtdrone_common.settings import Settings, setting
from xtdrone_interaction.gcs.exchanges.exchange import request_state
from xtdrone_interaction.gcs.station import GroundStation
from xtdrone_interaction.gcs.vehicle_addresses import GcsError
from xtdrone_interaction.gcs.vehicle_state import VehicleState

from .arguments import Commands, add_settings, select_vehicles
from .terminal_output import Screen, print_errors, redraws

_REDRAW = 0.25  # s between two updates on a terminal
_REQUEST_PERIOD = 2.0  # s without telemetry before a state is requested: simulated time may stand still
_SILENT = 3.0  # s without a message before a vehicle is shown as silent

Row = tuple[str, ...]
_TITLES: Row = ("VEHICLE", "SYS", "TYPE", "ARMED", "MODE", "X Y Z", "HEIGHT", "SPEED", "BATTERY", "GPS", "EKF", "TEXT")
_RIGHT = ("SYS", "HEIGHT", "SPEED", "BATTERY")
_DROPPED = (
    "TYPE",
    "SYS",
    "TEXT",
    "GPS",
    "EKF",
    "SPEED",
    "X Y Z",
    "BATTERY",
    "HEIGHT",
)  # columns left out of a narrow terminal, in order
_USUAL_WIDTHS = {"ARMED": 6, "MODE": 12, "X Y Z": 17, "HEIGHT": 7, "SPEED": 8, "GPS": 5}  # so that columns rarely move


@dataclass(frozen=True)
class StatusSettings(Settings):
    """Settings of the live table."""

    period: float = setting(
        1.0, low=0.1, high=3600.0, unit="s", metavar="S", text="time between updates without a terminal"
    )


def _format(value: Any, form: str) -> str:
    return "-" if value is None else form.format(value)


def _arming(state: VehicleState) -> str:
    if state.armed is None:
        return "-"
    return "armed" if state.armed else "ready" if state.ready else "no"


def row(state: VehicleState, now: float) -> Row:
    """Return the row of a vehicle; ``now``: s of the monotonic clock."""
    silent = now - state.heard
    if not math.isfinite(silent):
        return (state.name, _format(state.system or None, "{}"), *["-"] * 9, "no message yet")
    local = state.local
    place = "-" if local is None else " ".join(f"{value:.1f}" for value in local)
    if local is None and state.latitude is not None:
        place = f"{state.latitude:.6f} {state.longitude:.6f}"
    gps = "-" if state.gps is None else f"{state.gps} {_format(state.satellites, '{}')}"
    text = state.texts[-1][1] if state.texts else ""
    return (
        state.name,
        str(state.system),
        _format(state.kind, "{}"),
        "silent" if silent >= _SILENT else _arming(state),
        _format(state.mode, "{}"),
        place,
        _format(state.height, "{:.1f} m"),
        _format(state.speed, "{:.1f} m/s"),
        _format(state.battery, "{} %"),
        gps,
        _format(state.estimator, "{}"),
        f"(silent for {silent:.0f} s) {text}".rstrip() if silent >= _SILENT else text,
    )


def table(states: Sequence[VehicleState], now: float, columns: int | None = None) -> list[str]:
    """Return the lines of the table.

    Args:
        states: of the vehicles.
        now: s of the monotonic clock.
        columns: width of the terminal; columns without room are left out, and the latest texts follow the table. None
            for unlimited.
    """
    rows = [_TITLES, *(row(state, now) for state in states)]
    widths = {title: max(map(len, cells)) for title, cells in zip(_TITLES, zip(*rows, strict=True), strict=True)}
    shown = list(_TITLES)
    if columns is not None:
        widths = {title: max(width, _USUAL_WIDTHS.get(title, 0)) for title, width in widths.items()}
        for title in _DROPPED:
            if sum(widths[each] + 2 for each in shown) - 2 > columns:
                shown.remove(title)
    lines = []
    for entry in rows:
        cells = ((title, cell) for title, cell in zip(_TITLES, entry, strict=True) if title in shown)
        lines.append("  ".join(_cell(title, cell, widths[title]) for title, cell in cells).rstrip())
    below = [] if "TEXT" in shown else [f"{entry[0]}: {entry[-1]}" for entry in rows[1:] if entry[-1]]
    return [*lines, *below]


def _cell(title: str, text: str, width: int) -> str:
    return f"{text:>{width}}" if title in _RIGHT else f"{text:<{width}}"


def _as_json(states: Sequence[VehicleState], now: float) -> str:
    return json.dumps([state.as_json(now) for state in states], allow_nan=False)


def _status(arguments: argparse.Namespace) -> int:
    peers = select_vehicles(arguments, or_all=True)
    with GroundStation(peers, heartbeat=not arguments.once and not arguments.no_heartbeat) as station:
        if arguments.once:
            return _once(station, arguments)
        if station.peers:
            print_errors(station.errors.values())
        _live(station, arguments)
    return 1


def _once(station: GroundStation, arguments: argparse.Namespace) -> int:
    results: dict[str, Any] = station.run(dict.fromkeys(station.peers, request_state), patience=arguments.patience)
    states, now = station.states(), time.monotonic()
    if arguments.json:
        print(_as_json(states, now))
    else:  # a vehicle that has answered is not silent just because others have delayed the output
        told = [s if isinstance(results.get(s.name), GcsError) else replace(s, heard=now) for s in states]
        print("\n".join(table(told, now)))
    return print_errors([*station.errors.values(), *results.values()])


def _live(station: GroundStation, arguments: argparse.Namespace) -> None:
    """Show the states until all connections have ended."""
    screen = Screen(sys.stdout) if redraws(sys.stdout) and not arguments.json else None
    period = _REDRAW if screen else arguments.period
    asked = dict.fromkeys(station.peers, -math.inf)
    shown = time.monotonic() - period + _REDRAW  # first update as soon as answers may have arrived
    while station.peers:
        now = time.monotonic()
        states = station.states()
        for peer, state in zip(station.peers, states, strict=True):
            if now - max(state.told, asked[peer]) >= _REQUEST_PERIOD:
                asked[peer] = now
                station.submit(peer, request_state, patience=_REQUEST_PERIOD)
        if now - shown >= period:
            shown = now
            if screen:
                screen.draw(table(states, now, screen.columns))
            else:
                print(_as_json(states, now) if arguments.json else "\n".join(table(states, now)), flush=True)
        station.poll(max(shown + period - time.monotonic(), 0.0))
    raise GcsError("\n".join(map(str, station.errors.values())))


def add_to(commands: Commands) -> None:
    """Add this command to the command line."""
    status = commands.add("status", _status, "a live table of the vehicles' states (default: all that answer)")
    status.add_argument("--once", action="store_true", help="print it once, for a simulation that may be paused")
    status.add_argument("--json", action="store_true", help="print a JSON list of vehicles per update")
    add_settings(status, StatusSettings, "period")
    status.add_argument("--no-heartbeat", action="store_true",
                        help="do not count as a ground station for PX4's NAV_DLL_ACT")  # fmt: skip
