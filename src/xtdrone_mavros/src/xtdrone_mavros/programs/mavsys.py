"""``mavsys``: set the flight mode and the rates of MAVLink messages, in groups or one at a time."""

from __future__ import annotations

import argparse

from mavros_msgs.msg import State
from mavros_msgs.srv import MessageInterval, SetMode, StreamRate, StreamRateRequest

from .shared_arguments_and_calls import Mavros, ProgramError, new_parser
from .shared_arguments_and_calls import main as run_program

_MODE_LIMIT = 5.0  # s, as MAVROS's
_STREAMS = {
    "all": StreamRateRequest.STREAM_ALL,
    "raw-sensors": StreamRateRequest.STREAM_RAW_SENSORS,
    "ext-status": StreamRateRequest.STREAM_EXTENDED_STATUS,
    "rc-channels": StreamRateRequest.STREAM_RC_CHANNELS,
    "raw-controller": StreamRateRequest.STREAM_RAW_CONTROLLER,
    "position": StreamRateRequest.STREAM_POSITION,
    "extra1": StreamRateRequest.STREAM_EXTRA1,
    "extra2": StreamRateRequest.STREAM_EXTRA2,
    "extra3": StreamRateRequest.STREAM_EXTRA3,
}


def parser() -> argparse.ArgumentParser:
    """Return the command-line parser."""
    found = new_parser("Set flight mode and message rates.")
    verbs = found.add_subparsers(required=True, metavar="VERB")

    mode = verbs.add_parser("mode", help="set the flight mode")
    mode.set_defaults(run=_mode)
    group = mode.add_mutually_exclusive_group(required=True)
    group.add_argument("-b", "--base-mode", type=int, help="MAV_MODE number, instead of a name")
    group.add_argument("-c", "--custom-mode", default="", help="mode name as in the state topic, or its number")

    rate = verbs.add_parser("rate", help="set the rate of message groups, Hz; 0 stops one")
    rate.set_defaults(run=_rate)
    for name in _STREAMS:
        rate.add_argument(f"--{name}", type=int, metavar="RATE", help=f"of the group {name.upper().replace('-', '_')}")
    rate.add_argument("--stream-id", type=int, nargs=2, metavar=("ID", "RATE"), help="of a group by its number")

    interval = verbs.add_parser("message_interval", help="set the rate of one message")
    interval.set_defaults(run=_message_interval)
    interval.add_argument("--id", type=int, required=True, help="MAVLink message number")
    interval.add_argument("--rate", type=float, required=True, help="Hz; 0: default rate, -1: off")
    return found


def _mode(mavros: Mavros, arguments: argparse.Namespace) -> None:
    mode, base_mode = arguments.custom_mode.upper(), arguments.base_mode or 0
    states = mavros.subscribe("state", State)
    if not mavros.call("set_mode", SetMode, base_mode=base_mode, custom_mode=mode).mode_sent:
        raise ProgramError(f"mode {mode or base_mode} is unknown to MAVROS; its log lists the modes")
    if not mode or mode.isdigit():
        return  # the state topic has no name to compare
    seen = "unknown"

    def is_set(state: State) -> bool:
        nonlocal seen
        if state.mode != seen:
            seen = state.mode
            mavros.note(f"Current mode: {seen}")
        return bool(seen == mode)

    if states.next(_MODE_LIMIT, is_set) is None:
        raise ProgramError(f"mode {mode}: the vehicle stays in {seen}; see MAVROS's log")
    print("Mode changed.")


def _rate(mavros: Mavros, arguments: argparse.Namespace) -> None:
    asked = [(number, getattr(arguments, name.replace("-", "_"))) for name, number in _STREAMS.items()]
    if arguments.stream_id is not None:
        asked.append(tuple(arguments.stream_id))
    for number, rate in asked:
        if rate is not None:
            mavros.call("set_stream_rate", StreamRate, stream_id=number, message_rate=rate, on_off=rate != 0)


def _message_interval(mavros: Mavros, arguments: argparse.Namespace) -> None:
    mavros.command("set_message_interval", MessageInterval, message_id=arguments.id, message_rate=arguments.rate)


def main() -> int:
    """Run the program; return its exit status."""
    return run_program("mavsys", parser())
