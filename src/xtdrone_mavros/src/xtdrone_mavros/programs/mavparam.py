"""``mavparam``: read and write the autopilot's parameters, one at a time or all in a file."""

from __future__ import annotations

import argparse
import sys
from typing import Any

import rospy
from mavros_msgs.msg import ParamValue
from mavros_msgs.srv import ParamGet, ParamPull, ParamPush, ParamSet

from xtdrone_autopilot.parameters import former_parameters
from xtdrone_autopilot.parameters.parameter_file import as_float32

from . import parameter_formats
from .parameter_formats import MAVPROXY, MISSION_PLANNER, QGC, FormatError, Number
from .shared_arguments_and_calls import STANDARD, Mavros, ProgramError, new_parser, read_file, write_file
from .shared_arguments_and_calls import main as run_program

_OPTIONS = (
    ("-mp", "--mission-planner", MISSION_PLANNER, "Mission Planner's"),
    ("-qgc", "--qgroundcontrol", QGC, "QGroundControl's"),
    ("-mavpx", "--mavproxy", MAVPROXY, "MAVProxy's"),
)


def parser() -> argparse.ArgumentParser:
    """Return the command-line parser."""
    found = new_parser("Read and write the autopilot's parameters.")
    verbs = found.add_subparsers(required=True, metavar="VERB")

    load = verbs.add_parser("load", help="set the parameters in a file")
    load.set_defaults(run=_load)
    load.add_argument("file", help="the file; -: standard input")
    _add_formats(load, "detected from the content")

    dump = verbs.add_parser("dump", help="write all parameters into a file")
    dump.set_defaults(run=_dump)
    dump.add_argument("file", help="the file; -: standard output")
    dump.add_argument("-f", "--force", action="store_true", help="read from the autopilot instead of MAVROS's cache")
    _add_formats(dump, "QGroundControl's for *.txt, else Mission Planner's")

    get = verbs.add_parser("get", help="print a parameter")
    get.set_defaults(run=_get)
    get.add_argument("param_id", help="its name")

    change = verbs.add_parser("set", help="set a parameter and print the resulting value")
    change.set_defaults(run=_set)
    change.add_argument("param_id", help="its name")
    change.add_argument("value", help="an integer, or a number with a decimal point for a float")
    return found


def _add_formats(verb: argparse.ArgumentParser, default: str) -> None:
    group = verb.add_mutually_exclusive_group()
    for short, long, kind, owner in _OPTIONS:
        words = f"{owner} format (default: {default})"
        group.add_argument(short, long, dest="format", action="store_const", const=kind, default="", help=words)


def _load(mavros: Mavros, arguments: argparse.Namespace) -> None:
    name = arguments.file
    try:
        values = parameter_formats.read(read_file(name), name, arguments.format, _say_skipped)
    except FormatError as error:
        raise ProgramError(str(error)) from error
    _pull(mavros, False)  # so that MAVROS has each name and type
    for key, value in values.items():
        rospy.set_param(mavros.topic(f"param/{key}"), value)
    answer = mavros.call("param/push", ParamPush)
    if not answer.success:
        raise ProgramError("param/push: MAVROS has not sent the parameters; see MAVROS's log")
    mavros.note(f"Parameters transfered: {answer.param_transfered}")
    _check_accepted(mavros, values)


def _say_skipped(row: str) -> None:
    print(f"mavparam: skipped: {row}", file=sys.stderr)


def _check_accepted(mavros: Mavros, values: dict[str, Number]) -> None:
    """Verify the loaded parameters.

    Raises:
        ProgramError: the autopilot does not have some of them, or with other values; the others are set.
    """
    wrong = []
    for name, value in values.items():
        answer = mavros.call("param/get", ParamGet, param_id=name)
        if not answer.success:
            wrong.append(f"{name} does not exist{former_parameters.hint(name)}")
        elif as_float32(_number(answer)) != as_float32(value):
            wrong.append(f"{name} stays {_number(answer)}")
    if wrong:
        raise ProgramError(f"{len(wrong)} of {len(values)} parameters were not accepted: {'; '.join(wrong)}")


def _dump(mavros: Mavros, arguments: argparse.Namespace) -> None:
    mavros.note(f"Parameters received: {_pull(mavros, arguments.force)}")
    found: Any = rospy.get_param(mavros.topic("param"), {})
    values = {name: value for name, value in found.items() if isinstance(value, (int, float))}
    kind = arguments.format or parameter_formats.format_of(arguments.file)
    system = rospy.get_param(mavros.topic("target_system_id"), 1)
    write_file(arguments.file, parameter_formats.write(values, kind, system))
    if arguments.file != STANDARD:
        mavros.note(f"{len(values)} parameters written to {arguments.file}")


def _get(mavros: Mavros, arguments: argparse.Namespace) -> None:
    answer = mavros.call("param/get", ParamGet, param_id=arguments.param_id)
    if not answer.success:
        raise ProgramError(f"{arguments.param_id}: the autopilot has no such parameter, or does not answer")
    print(_number(answer))


def _set(mavros: Mavros, arguments: argparse.Namespace) -> None:
    try:
        value = parameter_formats.number_of(arguments.value)
    except ValueError as error:
        raise ProgramError(f"{arguments.param_id}: {arguments.value!r} is not allowed, {error}") from error
    asked = ParamValue(real=value) if isinstance(value, float) else ParamValue(integer=value)
    answer = mavros.call("param/set", ParamSet, param_id=arguments.param_id, value=asked)
    if not answer.success:
        raise ProgramError(f"{arguments.param_id}: the autopilot has not accepted {value}; see MAVROS's log")
    print(_number(answer))


def _pull(mavros: Mavros, force: bool) -> int:
    """Request that MAVROS copy all parameters to the ROS parameter server; return their number.

    Raises:
        ProgramError: the list is incomplete.
    """
    answer = mavros.call("param/pull", ParamPull, force_pull=force)
    if not answer.success:
        raise ProgramError("param/pull: the autopilot has not sent all its parameters; see MAVROS's log")
    return int(answer.param_received)


def _number(answer: Any) -> Number:
    """Return the value of a response; MAVROS sets the unused one of its two fields to 0."""
    if answer.value.integer:
        return int(answer.value.integer)
    return float(answer.value.real) if answer.value.real else 0


def main() -> int:
    """Run the program; return its exit status."""
    return run_program("mavparam", parser())
