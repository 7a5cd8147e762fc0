"""The keyboard's command line: ``iris 9 vel`` as in XTDrone, or ``iris:3,typhoon_h480:2 accel`` for mixed fleets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from xtdrone_common.fleet import FleetError, Vehicle, parse_fleet
from xtdrone_common.programs.node_command_line import ArgumentError, check_multirotor, parse_count

USAGE = "multirotor_keyboard_control.py TYPE NUM [vel|accel]   (or TYPE:NUM,TYPE:NUM,... [vel|accel])"
MODES = ("vel", "accel")


@dataclass(frozen=True)
class Request:
    """A parsed command line.

    Attributes:
        vehicles: to be controlled.
        mode: ``vel`` or ``accel``.
    """

    vehicles: tuple[Vehicle, ...]
    mode: str

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the vehicles, such as ``iris_0``."""
        return tuple(vehicle.name for vehicle in self.vehicles)

    @property
    def counts(self) -> dict[str, int]:
        """Number of vehicles by type, in the given order."""
        types = [vehicle.type for vehicle in self.vehicles]
        return {kind: types.count(kind) for kind in dict.fromkeys(types)}

    @property
    def formation(self) -> int:
        """Number of vehicles in the leader's formation, those of the first type."""
        return next(iter(self.counts.values()))


def parse_arguments(arguments: Sequence[str], fleet: tuple[Vehicle, ...] | None) -> Request:
    """Parse the arguments.

    Args:
        arguments: without those of ROS.
        fleet: the running vehicles; None if unknown.

    Raises:
        ArgumentError: wrong number of arguments, invalid mode, type or number, or more vehicles than in the fleet.
    """
    vehicles, mode = list(arguments), "vel"
    if len(vehicles) == 3 or (len(vehicles) == 2 and (vehicles[1] in MODES or ":" in vehicles[0])):
        mode = vehicles.pop()
    if not 1 <= len(vehicles) <= 2:
        raise ArgumentError(f"1 to 3 arguments are needed, {len(arguments)} were given")
    if mode not in MODES:
        raise ArgumentError(f"mode: {mode!r} is not allowed, one of {', '.join(MODES)}")
    text = vehicles[0] if len(vehicles) == 1 else f"{vehicles[0]}:{parse_count(vehicles[1])}"
    try:
        request = Request(parse_fleet(text), mode)
    except FleetError as error:
        raise ArgumentError(str(error)) from error
    for kind, count in request.counts.items():
        there = check_multirotor(kind, fleet)
        if there is not None and count > there:
            raise ArgumentError(
                f"number of vehicles: {count}, but the fleet (/xtdrone/fleet) has {there} of type {kind}"
            )
    return request
