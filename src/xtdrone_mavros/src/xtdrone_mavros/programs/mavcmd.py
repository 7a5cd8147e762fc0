"""``mavcmd``: send the vehicle a command: any command, home, takeoff, landing, camera trigger."""

from __future__ import annotations

import argparse

import rospy
from mavros_msgs.srv import (
    CommandHome,
    CommandInt,
    CommandLong,
    CommandTOL,
    CommandTriggerControl,
    CommandTriggerInterval,
)
from sensor_msgs.msg import NavSatFix

from .shared_arguments_and_calls import Mavros, ProgramError, Subscription, new_parser
from .shared_arguments_and_calls import main as run_program

_FIX_LIMIT = 10.0  # s, as MAVROS's
_PARAMS = tuple(f"param{i}" for i in range(1, 8))
_PLACE = {"latitude": "degrees", "longitude": "degrees", "altitude": "m AMSL"}


def parser() -> argparse.ArgumentParser:
    """Return the command-line parser."""
    found = new_parser("Send a command to the vehicle.")
    verbs = found.add_subparsers(required=True, metavar="VERB")

    verb = verbs.add_parser("long", help="any command, as COMMAND_LONG")
    verb.set_defaults(run=_long)
    verb.add_argument("-c", "--confirmation", action="store_true", help="set the field confirmation to 1")
    verb.add_argument("-b", "--broadcast", action="store_true", help="send to all systems, expect no answer")
    verb.add_argument("command", type=int, help="MAV_CMD's number")
    _add_numbers(verb, _PARAMS)

    verb = verbs.add_parser("int", help="any command, as COMMAND_INT")
    verb.set_defaults(run=_int)
    verb.add_argument("-c", "--current", action="store_true", help="set the field current to 1")
    verb.add_argument("-a", "--autocontinue", action="store_true", help="set the field autocontinue to 1")
    verb.add_argument("-f", "--frame", type=int, default=3, help="MAV_FRAME number (%(default)s)")
    verb.add_argument("command", type=int, help="MAV_CMD's number")
    _add_numbers(verb, _PARAMS[:4])
    verb.add_argument("x", type=int, help="latitude, degrees * 1e7, or x, m * 1e4")
    verb.add_argument("y", type=int, help="longitude, degrees * 1e7, or y, m * 1e4")
    verb.add_argument("z", type=float, help="altitude, m")

    verb = verbs.add_parser("sethome", help="set the home position")
    verb.set_defaults(run=_set_home)
    verb.add_argument("-c", "--current-gps", action="store_true", help="use the current position; pass 0 0 0")
    _add_numbers(verb, _PLACE)

    for name, words, numbers in (("takeoff", "take off", ("min_pitch", "yaw")), ("land", "land", ("yaw",))):
        verb = verbs.add_parser(name, help=f"{words} at a given position")
        verb.set_defaults(run=_go, service=name)
        _add_numbers(verb, numbers)
        _add_numbers(verb, _PLACE)
        verb = verbs.add_parser(f"{name}cur", help=f"{words} at the current position")
        verb.set_defaults(run=_go_here, service=name)
        verb.add_argument("-a", "--any-gps", action="store_true", help="read the position from any NavSatFix topic")
        _add_numbers(verb, (*numbers, "altitude"))

    verb = verbs.add_parser("trigger_control", help="switch the camera trigger")
    verb.set_defaults(run=_trigger_control)
    group = verb.add_mutually_exclusive_group()
    group.add_argument("-e", "--enable", dest="enable", action="store_true", default=True, help="on (default)")
    group.add_argument("-d", "--disable", dest="enable", action="store_false", help="off")
    verb.add_argument("-c", "--cycle_time", type=float, default=0.0, help="ms between images; 0: unchanged")
    return found


def _add_numbers(verb: argparse.ArgumentParser, names: tuple[str, ...] | dict[str, str]) -> None:
    for name in names:
        verb.add_argument(name, type=float, help=_PLACE.get(name))


def _numbers(arguments: argparse.Namespace, names: tuple[str, ...] | dict[str, str]) -> dict[str, float]:
    return {name: getattr(arguments, name) for name in names}


def _long(mavros: Mavros, arguments: argparse.Namespace) -> None:
    mavros.command(
        "cmd/command",
        CommandLong,
        broadcast=arguments.broadcast,
        command=arguments.command,
        confirmation=int(arguments.confirmation),
        **_numbers(arguments, _PARAMS),
    )


def _int(mavros: Mavros, arguments: argparse.Namespace) -> None:
    mavros.command(
        "cmd/command_int",
        CommandInt,
        frame=arguments.frame,
        command=arguments.command,
        current=int(arguments.current),
        autocontinue=int(arguments.autocontinue),
        x=arguments.x,
        y=arguments.y,
        z=arguments.z,
        **_numbers(arguments, _PARAMS[:4]),
    )


def _set_home(mavros: Mavros, arguments: argparse.Namespace) -> None:
    place = _numbers(arguments, _PLACE)
    mavros.command("cmd/set_home", CommandHome, current_gps=arguments.current_gps, **place)


def _go(mavros: Mavros, arguments: argparse.Namespace) -> None:
    pitch = getattr(arguments, "min_pitch", 0.0)
    place = _numbers(arguments, _PLACE)
    mavros.command(f"cmd/{arguments.service}", CommandTOL, min_pitch=pitch, yaw=arguments.yaw, **place)


def _go_here(mavros: Mavros, arguments: argparse.Namespace) -> None:
    topic = _fix_topic(mavros, arguments.any_gps)
    subscription = Subscription(topic, NavSatFix)
    fix = subscription.next(_FIX_LIMIT)
    subscription.close()
    if fix is None:
        raise ProgramError(f"{topic}: no position within {_FIX_LIMIT:g} s")
    arguments.latitude, arguments.longitude = fix.latitude, fix.longitude
    print(f"{arguments.service} at latitude {fix.latitude}, longitude {fix.longitude}")
    _go(mavros, arguments)


def _fix_topic(mavros: Mavros, any_gps: bool) -> str:
    """Return a topic with the vehicle's position.

    Raises:
        ProgramError: no such topic exists.
    """
    own = [mavros.topic("global_position/global"), mavros.topic("global_position/raw/fix")]
    there = [name for name, kind in rospy.get_published_topics() if kind == NavSatFix._type]
    found = [name for name in own if name in there] or (sorted(there) if any_gps else [])
    if not found:
        raise ProgramError(f"no topic of type {NavSatFix._type} below {mavros.namespace}; -a accepts any other, too")
    mavros.note(f"Position from {found[0]}")
    return found[0]


def _trigger_control(mavros: Mavros, arguments: argparse.Namespace) -> None:
    if arguments.cycle_time:
        mavros.command("cmd/trigger_interval", CommandTriggerInterval, cycle_time=arguments.cycle_time)
    mavros.command("cmd/trigger_control", CommandTriggerControl, trigger_enable=arguments.enable)


def main() -> int:
    """Run the program; return its exit status."""
    return run_program("mavcmd", parser())
