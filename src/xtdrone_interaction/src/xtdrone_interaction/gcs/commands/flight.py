"""``xtdrone gcs arm``, ``takeoff``, ``goto`` and the other flight commands."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from functools import partial

from ..exchanges import flight
from ..exchanges.flight import Target
from ..exchanges.protocol import Exchange, Heartbeat
from ..peers import Peer
from .arguments import Adder, UsageError, run, select_vehicles
from .display import Display

_FAR = 100_000.0  # m
_PLACES = "X Y Z, m, or --lat, --lon and one of --alt and --height"


def _number(name: str, low: float, high: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not allowed; {name}, {low:g} to {high:g}")
        return value

    return parse


Action = Callable[[Heartbeat], Exchange[None]]


def _all(arguments: argparse.Namespace, action: Action, done: str) -> int:
    """Run one exchange with all selected vehicles and return the exit status."""
    return _each(arguments, dict.fromkeys(select_vehicles(arguments), action), done)


def _each(arguments: argparse.Namespace, actions: Mapping[Peer, Action], done: str) -> int:
    display = Display([peer.name for peer in actions])
    return display.results(list(actions), run(actions, arguments), lambda *_: done)


def _arm(arguments: argparse.Namespace) -> int:
    return _all(arguments, partial(flight.arm, armed=True, force=arguments.force), "armed")


def _disarm(arguments: argparse.Namespace) -> int:
    return _all(arguments, partial(flight.arm, armed=False, force=arguments.force), "disarmed")


def _takeoff(arguments: argparse.Namespace) -> int:
    peers = select_vehicles(arguments)
    display = Display([peer.name for peer in peers])
    results = run(dict.fromkeys(peers, partial(flight.take_off, height=arguments.height)), arguments)

    def said(_name: str, height: float) -> str:
        least = f", the least it does; {arguments.height:g} m were asked for" if height > arguments.height else ""
        return f"armed, takes off to {height:g} m{least}"

    return display.results(peers, results, said)


def _goto(arguments: argparse.Namespace) -> int:
    target = _target(arguments)
    peers = select_vehicles(arguments)
    if len(peers) > 1 and arguments.spacing is None:
        raise UsageError(
            f"goto: {len(peers)} vehicles would meet there; --spacing M keeps so many metres between heights"
        )
    heights = [i * (arguments.spacing or 0.0) for i in range(len(peers))]
    actions = {
        peer: partial(flight.go_to, target=target.raised(height)) for peer, height in zip(peers, heights, strict=True)
    }
    return _each(arguments, actions, "goes there")


def _target(arguments: argparse.Namespace) -> Target:
    """Return the target of ``goto``.

    Raises:
        UsageError: it is incomplete or ambiguous.
    """
    options = ("lat", "lon", "alt", "height")
    given = [f"--{name}" for name in options if getattr(arguments, name) is not None]
    if arguments.place:
        if len(arguments.place) != 3 or given:
            words = " and ".join([f"{len(arguments.place)} of X Y Z", *given])
            raise UsageError(f"goto: {words} is not allowed, {_PLACES}")
        x, y, z = arguments.place
        return Target(local=(x, y, z), speed=arguments.speed)
    if given not in (["--lat", "--lon", "--alt"], ["--lat", "--lon", "--height"]):
        raise UsageError(f"goto: {' and '.join(given) or 'no place'} is not allowed, {_PLACES}")
    over_home = arguments.alt is None
    altitude = arguments.height if over_home else arguments.alt
    return Target(None, (arguments.lat, arguments.lon), altitude, over_home, arguments.speed)


def _mode(arguments: argparse.Namespace) -> int:
    return _all(arguments, partial(flight.set_mode, name=arguments.name), f"in mode {arguments.name}")


def add_to(add: Adder) -> None:
    """Add these commands to the command line."""
    force = "arm despite failed checks"
    add("arm", _arm, "arm").add_argument("--force", action="store_true", help=force)
    force = "disarm also in flight: the motors stop and the vehicle falls"
    add("disarm", _disarm, "disarm").add_argument("--force", action="store_true", help=force)
    takeoff = add("takeoff", _takeoff, "arm and climb straight up")
    reached = "m above the ground; PX4 accepts NAV_MC_ALT_RAD below that as reached"
    takeoff.add_argument("height", type=_number("m over the ground", 0.1, _FAR), help=reached)
    goto = add("goto", _goto, "go to a position and hold there; the vehicle has to be in the air")
    goto.add_argument("place", nargs="*", type=_number("m", -_FAR, _FAR), metavar="X Y Z",
                      help="m east, north, up from the local frame's origin (the simulator's map frame)")  # fmt: skip
    goto.add_argument("--lat", type=_number("degrees", -90.0, 90.0), metavar="DEG", help="latitude")
    goto.add_argument("--lon", type=_number("degrees", -180.0, 180.0), metavar="DEG", help="longitude")
    goto.add_argument("--alt", type=_number("m over the sea", -_FAR, _FAR), metavar="M", help="m above sea level")
    goto.add_argument("--height", type=_number("m over home", -_FAR, _FAR), metavar="M", help="m above home")
    goto.add_argument("--speed", type=_number("m/s", 0.1, 1000.0), default=math.nan, metavar="M/S",
                      help="ground speed (default: the vehicle's own)")  # fmt: skip
    goto.add_argument("--spacing", type=_number("m", 0.5, 1000.0), metavar="M",
                      help="for several vehicles: height of each one above the one before")  # fmt: skip
    mode = add("mode", _mode, "set the mode by its PX4 or ArduPilot name, such as MISSION, POSCTL, GUIDED")
    mode.add_argument("name", metavar="NAME", help="the mode")
    add("hold", lambda arguments: _all(arguments, flight.hold, "holds"), "hold the position")
    add("rtl", lambda arguments: _all(arguments, flight.rtl, "returns home"), "return home")
    add("land", lambda arguments: _all(arguments, flight.land, "lands"), "land at the position")
