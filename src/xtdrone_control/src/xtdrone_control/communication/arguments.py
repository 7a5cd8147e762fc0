"""Command lines of programs that serve one vehicle or many: ``iris 0``, ``iris 0-8``, ``iris 1,3,5``, ``iris all``."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

from xtdrone_control.fleet import MAX_VEHICLES, FleetError, Vehicle, parse_fleet

MULTIROTORS = ("iris", "solo", "typhoon_h480")
OTHER_VEHICLES = ("plane", "rover", "standard_vtol", "tiltrotor", "tailsitter")


class ArgumentError(ValueError):
    """A command line that cannot be run."""


def parse_count(text: str) -> int:
    """Return a number of vehicles.

    Raises:
        ArgumentError: not a whole number in 1..250.
    """
    if not re.fullmatch(r"-?\d+", text) or not 1 <= int(text) <= MAX_VEHICLES:
        raise ArgumentError(f"number of vehicles: {text!r} is not allowed, 1 to {MAX_VEHICLES}")
    return int(text)


def parse_ids(text: str, first: int, last: int | None, name: str = "id") -> list[int]:
    """Return the vehicle indices that ``text`` names, ascending.

    Args:
        text: a number, a range ``0-8``, a comma-separated list of these, or ``all``.
        first: least index allowed.
        last: greatest index allowed; None when the number of vehicles is not known, then ``all`` is refused.
        name: what to call the argument in messages.

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
    """Return the fleet that the parameter ``/xtdrone/fleet`` describes, None when it is not set.

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
    """Return the fleet that the parameter ``/xtdrone/fleet`` describes.

    Raises:
        ArgumentError: the parameter is not set (``text`` is None), or malformed.
    """
    fleet = fleet_of(text)
    if fleet is None:
        raise ArgumentError("parameter /xtdrone/fleet is not set: which vehicles there are, as iris:9,typhoon_h480:2")
    return fleet


def check_no_arguments(arguments: Sequence[str]) -> None:
    """Check the command line of a program that serves the whole fleet.

    Raises:
        ArgumentError: there is an argument.
    """
    if arguments:
        raise ArgumentError(f"no arguments are needed, {len(arguments)} were given")


def check_multirotor(kind: str, fleet: tuple[Vehicle, ...] | None) -> int | None:
    """Return how many vehicles of type ``kind`` fly, None when no fleet is known.

    Raises:
        ArgumentError: ``kind`` is no multirotor, or not in the fleet.
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
    """The vehicles that one process serves.

    Attributes:
        type: of all of them.
        ids: ascending.
        name: ``iris_0`` for one, ``iris_0_8`` for the first and last of several: how its node's name begins.
    """

    type: str
    ids: list[int]
    name: str


def served_vehicles(arguments: Sequence[str], fleet: str | None) -> Served:
    """Return the vehicles that a command line ``TYPE ID`` names.

    Args:
        arguments: the two; ID is as in :func:`parse_ids`.
        fleet: the parameter ``/xtdrone/fleet``, None when it is not set.

    Raises:
        ArgumentError: they are not two, or one of them or the fleet is not allowed.
    """
    if len(arguments) != 2:
        raise ArgumentError(f"2 arguments are needed, {len(arguments)} were given")
    kind, text = arguments
    count = check_multirotor(kind, fleet_of(fleet))
    ids = parse_ids(text, 0, None if count is None else count - 1)
    return Served(kind, ids, f"{kind}_{ids[0]}" if len(ids) == 1 else f"{kind}_{ids[0]}_{ids[-1]}")


def run_program(main: Callable[[Sequence[str]], None], arguments: Sequence[str], usage: str) -> int:
    """Run a node's main function with the arguments that ROS leaves; return the exit status.

    0 after a normal end, 1 without a master, when the simulator refuses or drops the node or crashes, 2 for wrong
    arguments, each with its reason on standard error.
    """
    import rosgraph  # here, so that this module can be imported without ROS
    import rospy

    from xtdrone_control import lockstep

    arguments = rospy.myargv(list(arguments))[1:]
    if not rosgraph.is_master_online():
        print(f"no ROS master at {rosgraph.get_master_uri()}: start roscore or a launch file first", file=sys.stderr)
        return 1
    try:
        main(arguments)
    except ArgumentError as error:
        print(f"{error}\nusage: {usage}", file=sys.stderr)
        return 2
    except rospy.ROSInitException as error:
        print(error, file=sys.stderr)
        return 1
    except rospy.ROSInterruptException:
        pass  # shut down
    except KeyboardInterrupt:
        return 0
    return lockstep.exit_status()
