"""``xtdrone gcs arm``, ``takeoff``, ``goto`` and the other flight commands."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from xtdrone_common.settings import Settings, setting
from xtdrone_interaction.gcs.exchanges import commands_and_refusals
from xtdrone_interaction.gcs.exchanges.commands_and_refusals import Target
from xtdrone_interaction.gcs.exchanges.exchange import Exchange, Heartbeat
from xtdrone_interaction.gcs.vehicle_addresses import Peer

from .arguments import Commands, UsageError, run_shown, select_vehicles
from .terminal_output import Display

_FAR = 100_000.0  # m
_PLACES = "X Y Z, m, or --lat, --lon and one of --alt and --height"


def _coordinate(text: str) -> Any:
    return setting(None, low=-_FAR, high=_FAR, unit="m", text=text, positional=True)


@dataclass(frozen=True)
class TakeoffOptions(Settings):
    """Arguments of ``takeoff``."""

    height: float = setting(
        ...,
        low=0.1,
        high=_FAR,
        unit="m",
        text="above the ground; PX4 accepts NAV_MC_ALT_RAD below that as reached",
        positional=True,
    )


@dataclass(frozen=True)
class GotoOptions(Settings):
    """Arguments of ``goto``; lat, lon and one of alt and height give the target unless the command has X Y Z."""

    x: float | None = _coordinate("east of the local frame's origin (the simulator's map frame)")
    y: float | None = _coordinate("north of it")
    z: float | None = _coordinate("above it")
    lat: float | None = setting(None, low=-90.0, high=90.0, unit="degrees", text="latitude", metavar="DEG")
    lon: float | None = setting(None, low=-180.0, high=180.0, unit="degrees", text="longitude", metavar="DEG")
    alt: float | None = setting(None, low=-_FAR, high=_FAR, unit="m", text="altitude above sea level", metavar="M")
    height: float | None = setting(None, low=-_FAR, high=_FAR, unit="m", text="height above home", metavar="M")
    speed: float | None = setting(
        None, low=0.1, high=1000.0, unit="m/s", text="ground speed (default: the vehicle's own)", metavar="M/S"
    )
    spacing: float | None = setting(
        None,
        low=0.5,
        high=1000.0,
        unit="m",
        text="for several vehicles: height difference between consecutive vehicles",
        metavar="M",
    )


Action = Callable[[Heartbeat], Exchange[Any]]


def _command(arguments: argparse.Namespace, action: Action, done: str) -> int:
    """Run one exchange with all selected vehicles and return the exit status."""
    return _command_each(arguments, dict.fromkeys(select_vehicles(arguments), action), lambda *_: done)


def _command_each(
    arguments: argparse.Namespace, actions: Mapping[Peer, Action], text: Callable[[str, Any], str]
) -> int:
    status, _ = run_shown(arguments, list(actions), lambda peer, _, heartbeat: actions[peer](heartbeat), text)
    return status


def _arm(arguments: argparse.Namespace, armed: bool) -> int:
    action = partial(commands_and_refusals.arm, armed=armed, force=arguments.force)
    return _command(arguments, action, "armed" if armed else "disarmed")


def _takeoff(arguments: argparse.Namespace) -> int:
    def describe(_name: str, height: float) -> str:
        least = f", the minimum; {arguments.height:g} m were requested" if height > arguments.height else ""
        return f"armed, takes off to {height:g} m{least}"

    action = partial(commands_and_refusals.take_off, height=arguments.height)
    return _command_each(arguments, dict.fromkeys(select_vehicles(arguments), action), describe)


def _goto(arguments: argparse.Namespace) -> int:
    options = GotoOptions.from_arguments(arguments)
    target = _target(options)
    peers = select_vehicles(arguments)
    if len(peers) > 1 and options.spacing is None:
        raise UsageError(
            f"goto: {len(peers)} vehicles would collide there; --spacing M separates their heights by M metres"
        )
    heights = [i * (options.spacing or 0.0) for i in range(len(peers))]
    if arguments.avoid:
        return _hand_to_planners(arguments, target, dict(zip(peers, heights, strict=True)))
    actions = {
        peer: partial(commands_and_refusals.go_to, target=target.raised(height))
        for peer, height in zip(peers, heights, strict=True)
    }
    return _command_each(arguments, actions, lambda *_: "goes there")


def _hand_to_planners(arguments: argparse.Namespace, target: Target, heights: Mapping[Peer, float]) -> int:
    """Hand the target, raised by ``heights`` (m), to the vehicles' planners; return the exit status."""
    if target.local is None or not math.isnan(target.speed):
        raise UsageError("goto: --avoid needs X Y Z and excludes --speed, which the planner sets (~speed)")
    from .planner_goals import send_goals  # the only command that needs ROS

    x, y, z = target.local
    try:
        goals = {peer.name: (x, y, z + height) for peer, height in heights.items()}
        results = send_goals(goals, arguments.master or "")
    except argparse.ArgumentTypeError as error:
        raise UsageError(str(error)) from error
    display = Display([peer.name for peer in heights])
    return display.results(list(heights), results, lambda *_: "its planner flies there")


def _target(options: GotoOptions) -> Target:
    """Return the target of ``goto``.

    Raises:
        UsageError: the target is incomplete or ambiguous.
    """
    given = [f"--{name}" for name in ("lat", "lon", "alt", "height") if getattr(options, name) is not None]
    speed = math.nan if options.speed is None else options.speed
    place = [value for value in (options.x, options.y, options.z) if value is not None]
    if place:
        if len(place) != 3 or given:
            words = " and ".join([f"{len(place)} of X Y Z", *given])
            raise UsageError(f"goto: {words} is not allowed, {_PLACES}")
        x, y, z = place
        return Target(local=(x, y, z), speed=speed)
    altitude = options.height if options.alt is None else options.alt
    if options.lat is None or options.lon is None or altitude is None or len(given) != 3:
        raise UsageError(f"goto: {' and '.join(given) or 'no place'} is not allowed, {_PLACES}")
    return Target(None, (options.lat, options.lon), altitude, options.alt is None, speed)


def _mode(arguments: argparse.Namespace) -> int:
    return _command(
        arguments, partial(commands_and_refusals.set_mode, name=arguments.name), f"in mode {arguments.name}"
    )


def add_to(commands: Commands) -> None:
    """Add these commands to the command line."""
    force = "arm despite failed checks"
    commands.add("arm", partial(_arm, armed=True), "arm").add_argument("--force", action="store_true", help=force)
    force = "disarm also in flight: the motors stop and the vehicle falls"
    commands.add("disarm", partial(_arm, armed=False), "disarm").add_argument(
        "--force", action="store_true", help=force
    )
    takeoff = commands.add("takeoff", _takeoff, "arm and climb straight up")
    TakeoffOptions.add_arguments(takeoff)
    goto = commands.add("goto", _goto, "go to a position and hold there; the vehicle has to be in the air")
    GotoOptions.add_arguments(goto)
    goto.add_argument("--avoid", action="store_true",
                      help="fly by the vehicle's planner, around obstacles that its sensor sees; planner.py must be "
                          "running")  # fmt: skip
    goto.add_argument("--master", metavar="MASTER", help="with --avoid: port or URI of the ROS master (default: "
                      "ROS_MASTER_URI, or the newest flight of this workspace)")  # fmt: skip
    mode = commands.add("mode", _mode, "set the mode by its PX4 name, such as MISSION, POSCTL, AUTO.LOITER")
    mode.add_argument("name", metavar="NAME", help="the mode")
    for name, action, done, text in (
        ("hold", commands_and_refusals.hold, "holds", "hold the position"),
        ("rtl", commands_and_refusals.rtl, "returns home", "return home"),
        ("land", commands_and_refusals.land, "lands", "land at the position"),
    ):
        commands.add(name, partial(_command, action=action, done=done), text)
