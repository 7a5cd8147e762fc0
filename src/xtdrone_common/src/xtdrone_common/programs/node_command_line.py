"""Main functions and command lines of ROS nodes.

Programs for several vehicles of one type name them as ``iris 0``, ``iris 0-8``, ``iris 1,3,5`` or ``iris all``.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from xtdrone_common.fleet import MAX_VEHICLES, FleetError, Vehicle, parse_fleet
from xtdrone_common.settings import SettingError, setting

MULTIROTORS = ("iris", "solo", "typhoon_h480")
OTHER_VEHICLES = ("plane", "rover", "standard_vtol", "tiltrotor", "tailsitter")

exit_statuses: list[Callable[[], int]] = []
"""Functions that return an exit status for a program whose main function has returned; the lockstep adds its own."""


class ArgumentError(ValueError):
    """An invalid command line or ROS parameter."""


def parse_count(text: str) -> int:
    """Parse a number of vehicles.

    Raises:
        ArgumentError: not a whole number from 1 to 250.
    """
    if not re.fullmatch(r"-?\d+", text) or not 1 <= int(text) <= MAX_VEHICLES:
        raise ArgumentError(f"number of vehicles: {text!r} is not allowed, 1 to {MAX_VEHICLES}")
    return int(text)


def parse_ids(text: str, first: int, last: int | None, name: str = "id") -> list[int]:
    """Parse vehicle indices.

    Args:
        text: a number, a range ``0-8``, a comma-separated list of these, or ``all``.
        first: lowest index allowed.
        last: highest index allowed; None if the number of vehicles is unknown, then ``all`` is rejected.
        name: Name of the argument, for messages.

    Returns:
        The indices, ascending.

    Raises:
        ArgumentError: malformed, out of range, or empty.
    """
    highest = MAX_VEHICLES - 1 if last is None else last
    if text == "all":
        if last is None:
            raise ArgumentError(f"{name}: 'all' needs the parameter /xtdrone/fleet, as iris:9; give a range, as 0-8")
        if last < first:
            raise ArgumentError(f"{name}: 'all' names no vehicle, ids would begin at {first}")
        return list(range(first, last + 1))
    ids: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+))?\s*", part)
        if match is None or (match[2] is not None and int(match[2]) < int(match[1])):
            raise ArgumentError(f"{name}: {text!r} is none of a number, a range as 0-8, a list as 1,3,5 and 'all'")
        low, high = int(match[1]), int(match[2] or match[1])
        for value in (low, high):
            if not first <= value <= highest:
                raise ArgumentError(f"{name}: {value} is out of range, {first} to {highest} are allowed")
        ids.update(range(low, high + 1))
    return sorted(ids)


def fleet_of(text: str | None) -> tuple[Vehicle, ...] | None:
    """Parse the parameter ``/xtdrone/fleet``.

    Args:
        text: the parameter, None if it is not set.

    Returns:
        The fleet, None if the parameter is not set.

    Raises:
        ArgumentError: the parameter is malformed.
    """
    if text is None:
        return None
    try:
        return parse_fleet(str(text))
    except FleetError as error:
        raise ArgumentError(f"/xtdrone/fleet: {error}") from error


def needed_fleet(text: str | None) -> tuple[Vehicle, ...]:
    """Parse the parameter ``/xtdrone/fleet`` of a program that requires it.

    Raises:
        ArgumentError: the parameter is not set (``text`` is None), or malformed.
    """
    fleet = fleet_of(text)
    if fleet is None:
        raise ArgumentError("parameter /xtdrone/fleet is not set; it lists the vehicles, such as iris:9,typhoon_h480:2")
    return fleet


def check_no_arguments(arguments: Sequence[str]) -> None:
    """Reject arguments of a program that takes none.

    Raises:
        ArgumentError: there is an argument.
    """
    if arguments:
        raise ArgumentError(f"no arguments are needed, {len(arguments)} were given")


def check_multirotor(kind: str, fleet: tuple[Vehicle, ...] | None) -> int | None:
    """Return the number of vehicles of a multirotor type in the fleet.

    Args:
        kind: vehicle type, such as ``iris``.
        fleet: all vehicles; None if unknown.

    Raises:
        ArgumentError: not a multirotor, or not in the fleet.
    """
    if kind in OTHER_VEHICLES:
        raise ArgumentError(f"type: {kind!r} is no multirotor; allowed are {', '.join(MULTIROTORS)}")
    if fleet is None:
        if kind not in MULTIROTORS:
            raise ArgumentError(f"type: unknown vehicle {kind!r}; allowed are {', '.join(MULTIROTORS)}")
        return None
    count = sum(vehicle.type == kind for vehicle in fleet)
    if not count:
        types = ", ".join(sorted({vehicle.type for vehicle in fleet}))
        raise ArgumentError(f"type: {kind!r} is not in the fleet (/xtdrone/fleet); it has {types}")
    return count


class Served(NamedTuple):
    """The vehicles of one process.

    Attributes:
        type: vehicle type.
        ids: indices, ascending.
        name: prefix of the node's name: ``iris_0`` for one vehicle, ``iris_0_8`` with the first and last of several.
    """

    type: str
    ids: list[int]
    name: str


def served_vehicles(arguments: Sequence[str], fleet: str | None) -> Served:
    """Parse the command line ``TYPE ID``.

    Args:
        arguments: type and indices, see :func:`parse_ids`.
        fleet: the parameter ``/xtdrone/fleet``, None if it is not set.

    Raises:
        ArgumentError: wrong number of arguments, or an invalid type, index or fleet.
    """
    if len(arguments) != 2:
        raise ArgumentError(f"2 arguments are needed, {len(arguments)} were given")
    kind, text = arguments
    vehicles = fleet_of(fleet)
    check_multirotor(kind, vehicles)
    ids = parse_ids(text, 0, None) if vehicles is None else _ids_in(vehicles, kind, text)
    return Served(kind, ids, f"{kind}_{ids[0]}" if len(ids) == 1 else f"{kind}_{ids[0]}_{ids[-1]}")


def _ids_in(fleet: Sequence[Vehicle], kind: str, text: str) -> list[int]:
    """Return the indices of vehicles of a type; see :func:`parse_ids`."""
    there = [vehicle.index for vehicle in fleet if vehicle.type == kind]
    ids = there if text == "all" else parse_ids(text, 0, max(there))
    for index in ids:
        if index not in there:
            raise ArgumentError(f"id: {index} is not allowed, {kind}_{index} is not in the fleet (/xtdrone/fleet)")
    return sorted(ids)


def run_program(main: Callable[[Sequence[str]], int | None], arguments: Sequence[str], usage: str) -> int:
    """Run a node's main function and return the exit status.

    Args:
        main: Called with the arguments without ROS remappings; returns an exit status, or None for 0.
        arguments: the command line with the program's name.
        usage: printed after an invalid command line.

    Returns:
        That of ``main`` after a normal end; 1 without a ROS master, or if the simulator rejects or drops the node or
        crashes; 2 for an invalid command line or parameter. The reason goes to standard error.
    """
    import rosgraph  # here: this module can be imported without ROS
    import rospy

    arguments = rospy.myargv(list(arguments))[1:]
    if not rosgraph.is_master_online():
        print(
            f"no ROS master answers at {rosgraph.get_master_uri()}: start roscore or a launch file first",
            file=sys.stderr,
        )
        return 1
    try:
        status = main(arguments)
    except (ArgumentError, SettingError) as error:
        print(f"{error}\nusage: {usage}", file=sys.stderr)
        return 2
    except rospy.ROSInitException as error:
        print(error, file=sys.stderr)
        return 1
    except rospy.ROSInterruptException:
        status = 0  # shut down
    except KeyboardInterrupt:
        return 0
    return status or max((add() for add in exit_statuses), default=0)


LEAST_SPEED = 0.01
"""Minimum target real-time factor; below it a 20 ms tick would take more than two seconds."""


def speed_setting(
    text: str = "target speed (default: unlimited)", *, default: Any = 0.0, positional: bool = False
) -> Any:
    """Declare a target real-time factor; 0 for ``unlimited``."""
    return setting(
        default,
        parse=_parse_speed,
        allowed=f"a real-time factor of at least {LEAST_SPEED}, or 'unlimited'",
        metavar="FACTOR",
        text=text,
        positional=positional,
    )


def _parse_speed(text: object) -> float:
    if text == "unlimited":
        return 0.0
    value = float(text) if isinstance(text, (str, int, float)) else math.nan
    if not (math.isfinite(value) and value >= LEAST_SPEED):
        raise ValueError
    return value
