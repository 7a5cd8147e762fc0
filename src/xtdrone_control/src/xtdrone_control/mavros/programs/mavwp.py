"""``mavwp``: show the vehicle's mission, load and dump it as a file, clear it, choose the current item."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from typing import Any

from mavros_msgs.msg import CommandCode, Waypoint, WaypointList
from mavros_msgs.srv import WaypointClear, WaypointPull, WaypointPush, WaypointSetCurrent

from xtdrone_control.autopilot.navigator.plan import PlanItem
from xtdrone_control.plans import waypoint_file
from xtdrone_control.plans.waypoint_file import Row, WaypointFileError

from .client import Ear, Mavros, ProgramError, new_parser, read_file, write_file
from .client import main as run_program

_TOPIC = "mission/waypoints"
_LIMIT = 30.0  # s for a list on the topic, as MAVROS's
_LATCHED_LIMIT = 0.3  # s for one that was published before
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
    """Return the program's command line."""
    found = new_parser("Show and change the vehicle's mission.")
    verbs = found.add_subparsers(required=True, metavar="VERB")

    show = verbs.add_parser("show", help="print the mission as a table")
    show.set_defaults(run=_show)
    show.add_argument("-f", "--follow", action="store_true", help="print it again whenever it changes")
    show.add_argument("-p", "--pull", action="store_true", help="ask the vehicle first")

    load = verbs.add_parser("load", help="give the vehicle the mission of a file")
    load.set_defaults(run=_load)
    load.add_argument("-p", "--preserve-home", action="store_true", help="keep the vehicle's item 0 (ArduPilot's home)")
    load.add_argument("-s", "--start-index", type=int, default=0, help="first item that is sent (ArduPilot alone)")
    load.add_argument("-e", "--end-index", type=int, default=0, help="item before which to stop (0: to the end)")
    load.add_argument("file", help="in the format QGC WPL; -: standard input")

    verbs.add_parser("pull", help="have MAVROS ask the vehicle for its mission").set_defaults(run=_pull_alone)

    dump = verbs.add_parser("dump", help="write the vehicle's mission into a file")
    dump.set_defaults(run=_dump)
    dump.add_argument("file", help="in the format QGC WPL 120; -: standard output")

    verbs.add_parser("clear", help="take the vehicle's mission away").set_defaults(run=_clear)

    current = verbs.add_parser("setcur", aliases=["set"], help="choose the current item")
    current.set_defaults(run=_set_current)
    current.add_argument("seq", type=int, help="its index")
    return found


def to_waypoint(row: Row) -> Waypoint:
    """Return a line of a file as MAVROS's message."""
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
    """Return MAVROS's message as a line of a file."""
    params = waypoint.param1, waypoint.param2, waypoint.param3, waypoint.param4
    place = waypoint.x_lat, waypoint.y_long, waypoint.z_alt
    item = PlanItem(waypoint.command, waypoint.frame, params, *place, bool(waypoint.autocontinue))
    return Row(item, bool(waypoint.is_current))


def table(rows: Iterable[Row]) -> str:
    """Return a mission as a table with a frame of characters around it."""
    lines = [_COLUMNS, *(_cells(index, row) for index, row in enumerate(rows))]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    rule = "+".join(["", *("-" * (width + 2) for width in widths), ""])
    body = ["|".join(["", *map(_centred, line, widths), ""]) for line in lines]
    return "\n".join([rule, body[0], rule, *body[1:], *([rule] if body[1:] else [])])


def _centred(text: str, width: int) -> str:
    return f" {text:^{width}} "


def _cells(index: int, row: Row) -> tuple[str, ...]:
    item = row.item
    flags = ("Yes" if flag else "No" for flag in (row.current, item.autocontinue))
    frame = f"{_FRAMES.get(item.frame, 'UNK')} ({item.frame})"
    numbers = (str(value) for value in (*item.params, item.x, item.y, item.z))
    return str(index), *flags, frame, f"{_command_name(item.command)} ({item.command})", *numbers


def _command_name(command: int) -> str:
    """Return a MAV_CMD's name as MAVROS's table has it, as TAKEOFF or DO-JUMP."""
    for prefix in _PREFIXES:
        for name, value in vars(CommandCode).items():
            if name.startswith(prefix) and value == command:
                return name.removeprefix("NAV_").replace("_", "-")
    return "UNK"


# ---- what the verbs do


def _pull(mavros: Mavros) -> int:
    answer = mavros.call("mission/pull", WaypointPull)
    if not answer.success:
        raise ProgramError("mission/pull: the vehicle has not told its mission; MAVROS's log says more")
    mavros.note(f"Waypoints received: {answer.wp_received}")
    return int(answer.wp_received)


def _pull_alone(mavros: Mavros, _: argparse.Namespace) -> None:
    _pull(mavros)


def _fresh(mavros: Mavros, ear: Ear) -> Sequence[Any]:
    """Return the mission that the vehicle has now; ``ear`` hears the topic.

    Raises:
        ProgramError: it does not come.
    """
    if ear.connected():
        ear.next(_LATCHED_LIMIT)  # an older list, latched
    count = _pull(mavros)
    found = ear.next(_LIMIT, lambda message: len(message.waypoints) == count)
    if found is None:
        raise ProgramError(f"{mavros.topic(_TOPIC)}: no list within {_LIMIT:g} s; does time stand still?")
    waypoints: Sequence[Any] = found.waypoints
    return waypoints


def _known(mavros: Mavros, ear: Ear) -> Sequence[Any]:
    """Return the mission that MAVROS has published last, the vehicle's if none; real MAVROS asks when it connects.

    Raises:
        ProgramError: it does not come.
    """
    found = ear.next(_LATCHED_LIMIT) if ear.connected() else None
    waypoints: Sequence[Any] = _fresh(mavros, ear) if found is None else found.waypoints
    return waypoints


def _show(mavros: Mavros, arguments: argparse.Namespace) -> None:
    ear = mavros.ear(_TOPIC, WaypointList)
    waypoints = _fresh(mavros, ear) if arguments.pull else _known(mavros, ear)
    print(table(map(to_row, waypoints)), flush=True)
    while arguments.follow and (message := ear.next(None)) is not None:
        print(table(map(to_row, message.waypoints)), flush=True)
    ear.close()


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
        ear = mavros.ear(_TOPIC, WaypointList)
        present = _known(mavros, ear)
        ear.close()
        if not present:
            raise ProgramError("preserve home: the vehicle has no item 0 to keep")
        waypoints[0] = present[0]
        mavros.note(f"Home: latitude {present[0].x_lat}, longitude {present[0].y_long}, altitude {present[0].z_alt}")
    _push(mavros, 0, waypoints)


def _push(mavros: Mavros, start: int, waypoints: Sequence[Any]) -> None:
    answer = mavros.call("mission/push", WaypointPush, start_index=start, waypoints=waypoints)
    if not answer.success:
        told = f"{answer.wp_transfered} of {len(waypoints)} items sent"
        raise ProgramError(f"mission/push: the vehicle has not taken the mission, {told}; MAVROS's log says more")
    mavros.note(f"Waypoints transfered: {answer.wp_transfered}")


def _dump(mavros: Mavros, arguments: argparse.Namespace) -> None:
    ear = mavros.ear(_TOPIC, WaypointList)
    rows = list(map(to_row, _fresh(mavros, ear)))
    ear.close()
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
