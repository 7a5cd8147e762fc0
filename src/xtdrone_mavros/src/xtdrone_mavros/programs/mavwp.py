"""``mavwp``: show the vehicle's mission, load or dump it as a file, clear it, set the current item."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from typing import Any

from mavros_msgs.msg import CommandCode, Waypoint, WaypointList
from mavros_msgs.srv import WaypointClear, WaypointPull, WaypointPush, WaypointSetCurrent

from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.plans import waypoint_file
from xtdrone_autopilot.plans.waypoint_file import Row, WaypointFileError

from .shared_arguments_and_calls import Mavros, ProgramError, Subscription, new_parser, read_file, write_file
from .shared_arguments_and_calls import main as run_program

_TOPIC = "mission/waypoints"
_LIMIT = 30.0  # s, timeout of a list on the topic, as MAVROS's
_LATCHED_LIMIT = 0.3  # s, timeout of a list published before
_FRAMES = {
    Waypoint.FRAME_GLOBAL: "GAA",
    Waypoint.FRAME_GLOBAL_REL_ALT: "GRA",
    Waypoint.FRAME_LOCAL_ENU: "LOC-ENU",
    Waypoint.FRAME_LOCAL_NED: "LOC-NED",
    Waypoint.FRAME_MISSION: "MIS",
}
_PREFIXES = ("NAV_", "CONDITION_", "DO_")  # of CommandCode's names
_COLUMNS = ("#", "Curr", "Auto", "Frame", "Command", "P1", "P2", "P3", "P4", "X Lat", "Y Long", "Z Alt")


def parser() -> argparse.ArgumentParser:
    """Return the command-line parser."""
    found = new_parser("Show and change the vehicle's mission.")
    verbs = found.add_subparsers(required=True, metavar="VERB")

    show = verbs.add_parser("show", help="print the mission as a table")
    show.set_defaults(run=_show)
    show.add_argument("-f", "--follow", action="store_true", help="print it again after each change")
    show.add_argument("-p", "--pull", action="store_true", help="read it from the vehicle first")

    load = verbs.add_parser("load", help="send a mission file to the vehicle")
    load.set_defaults(run=_load)
    load.add_argument("-p", "--preserve-home", action="store_true", help="keep the vehicle's item 0 (ArduPilot's home)")
    load.add_argument("-s", "--start-index", type=int, default=0, help="first item to send (ArduPilot only)")
    load.add_argument("-e", "--end-index", type=int, default=0, help="item before which to stop (0: to the end)")
    load.add_argument("file", help="in QGC WPL format; -: standard input")

    verbs.add_parser("pull", help="have MAVROS read the mission from the vehicle").set_defaults(run=_pull_alone)

    dump = verbs.add_parser("dump", help="write the vehicle's mission into a file")
    dump.set_defaults(run=_dump)
    dump.add_argument("file", help="in QGC WPL 120 format; -: standard output")

    verbs.add_parser("clear", help="delete the vehicle's mission").set_defaults(run=_clear)

    current = verbs.add_parser("setcur", aliases=["set"], help="set the current item")
    current.set_defaults(run=_set_current)
    current.add_argument("seq", type=int, help="its index")
    return found


def to_waypoint(row: Row) -> Waypoint:
    """Convert a row of a file to MAVROS's message."""
    item = row.item
    values = dict(zip(("param1", "param2", "param3", "param4"), item.params, strict=True))
    return Waypoint(
        frame=item.frame,
        command=item.command,
        is_current=row.current,
        autocontinue=item.autocontinue,
        x_lat=item.x,
        y_long=item.y,
        z_alt=item.z,
        **values,
    )


def to_row(waypoint: Any) -> Row:
    """Convert MAVROS's message to a row of a file."""
    params = waypoint.param1, waypoint.param2, waypoint.param3, waypoint.param4
    place = waypoint.x_lat, waypoint.y_long, waypoint.z_alt
    item = PlanItem(waypoint.command, waypoint.frame, params, *place, bool(waypoint.autocontinue))
    return Row(item, bool(waypoint.is_current))


def table(rows: Iterable[Row]) -> str:
    """Return a mission as a framed text table."""
    lines = [_COLUMNS, *(_cells(index, row) for index, row in enumerate(rows))]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    rule = "+".join(["", *("-" * (width + 2) for width in widths), ""])
    body = ["|".join(["", *map(_centre, line, widths), ""]) for line in lines]
    return "\n".join([rule, body[0], rule, *body[1:], *([rule] if body[1:] else [])])


def _centre(text: str, width: int) -> str:
    return f" {text:^{width}} "


def _cells(index: int, row: Row) -> tuple[str, ...]:
    item = row.item
    flags = ("Yes" if flag else "No" for flag in (row.current, item.autocontinue))
    frame = f"{_FRAMES.get(item.frame, 'UNK')} ({item.frame})"
    numbers = (str(value) for value in (*item.params, item.x, item.y, item.z))
    return str(index), *flags, frame, f"{_command_name(item.command)} ({item.command})", *numbers


def _command_name(command: int) -> str:
    """Return a MAV_CMD's name in MAVROS's form, e.g. TAKEOFF or DO-JUMP."""
    for prefix in _PREFIXES:
        for name, value in vars(CommandCode).items():
            if name.startswith(prefix) and value == command:
                return name.removeprefix("NAV_").replace("_", "-")
    return "UNK"


# ---- actions of the verbs


def _pull(mavros: Mavros) -> int:
    answer = mavros.call("mission/pull", WaypointPull)
    if not answer.success:
        raise ProgramError("mission/pull: the vehicle has not sent its mission; see MAVROS's log")
    mavros.note(f"Waypoints received: {answer.wp_received}")
    return int(answer.wp_received)


def _pull_alone(mavros: Mavros, _: argparse.Namespace) -> None:
    _pull(mavros)


def _pull_mission(mavros: Mavros, subscription: Subscription) -> Sequence[Any]:
    """Pull and return the vehicle's current mission; ``subscription`` subscribes to the mission topic.

    Raises:
        ProgramError: no list arrives.
    """
    if subscription.connected():
        subscription.next(_LATCHED_LIMIT)  # discard an older latched list
    count = _pull(mavros)
    found = subscription.next(_LIMIT, lambda message: len(message.waypoints) == count)
    if found is None:
        raise ProgramError(f"{mavros.topic(_TOPIC)}: no list within {_LIMIT:g} s; does time stand still?")
    waypoints: Sequence[Any] = found.waypoints
    return waypoints


def _last_mission(mavros: Mavros, subscription: Subscription) -> Sequence[Any]:
    """Return the mission last published by MAVROS, or the vehicle's if none; real MAVROS pulls when it connects.

    Raises:
        ProgramError: no list arrives.
    """
    found = subscription.next(_LATCHED_LIMIT) if subscription.connected() else None
    waypoints: Sequence[Any] = _pull_mission(mavros, subscription) if found is None else found.waypoints
    return waypoints


def _show(mavros: Mavros, arguments: argparse.Namespace) -> None:
    subscription = mavros.subscribe(_TOPIC, WaypointList)
    waypoints = _pull_mission(mavros, subscription) if arguments.pull else _last_mission(mavros, subscription)
    print(table(map(to_row, waypoints)), flush=True)
    while arguments.follow and (message := subscription.next(None)) is not None:
        print(table(map(to_row, message.waypoints)), flush=True)
    subscription.close()


def _load(mavros: Mavros, arguments: argparse.Namespace) -> None:
    name = arguments.file
    try:
        waypoints = list(map(to_waypoint, waypoint_file.read(read_file(name), name)))
    except WaypointFileError as error:
        raise ProgramError(str(error)) from error
    start, end = arguments.start_index, arguments.end_index or len(waypoints)
    if not 0 <= start <= len(waypoints):
        raise ProgramError(f"start index: {start} is not allowed, 0 to {len(waypoints)}")
    if start:
        _push(mavros, start, waypoints[start : max(end, start + 1)])
        return
    if arguments.preserve_home and waypoints:
        subscription = mavros.subscribe(_TOPIC, WaypointList)
        present = _last_mission(mavros, subscription)
        subscription.close()
        if not present:
            raise ProgramError("preserve home: the vehicle has no item 0 to keep")
        waypoints[0] = present[0]
        mavros.note(f"Home: latitude {present[0].x_lat}, longitude {present[0].y_long}, altitude {present[0].z_alt}")
    _push(mavros, 0, waypoints)


def _push(mavros: Mavros, start: int, waypoints: Sequence[Any]) -> None:
    answer = mavros.call("mission/push", WaypointPush, start_index=start, waypoints=waypoints)
    if not answer.success:
        progress = f"{answer.wp_transfered} of {len(waypoints)} items sent"
        raise ProgramError(f"mission/push: the vehicle has not accepted the mission, {progress}; see MAVROS's log")
    mavros.note(f"Waypoints transfered: {answer.wp_transfered}")


def _dump(mavros: Mavros, arguments: argparse.Namespace) -> None:
    subscription = mavros.subscribe(_TOPIC, WaypointList)
    rows = list(map(to_row, _pull_mission(mavros, subscription)))
    subscription.close()
    write_file(arguments.file, waypoint_file.write(rows))


def _clear(mavros: Mavros, _: argparse.Namespace) -> None:
    mavros.command("mission/clear", WaypointClear)
    mavros.note("Waypoints cleared")


def _set_current(mavros: Mavros, arguments: argparse.Namespace) -> None:
    mavros.command("mission/set_current", WaypointSetCurrent, wp_seq=arguments.seq)
    mavros.note("Set current done.")


def main() -> int:
    """Run the program; return its exit status."""
    return run_program("mavwp", parser())
