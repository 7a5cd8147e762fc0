"""Commands to selected vehicles, by the exchanges of the ground station (``./xtdrone gcs``)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import rospy
from gazebo_msgs.srv import GetModelState, GetModelStateRequest

from xtdrone_common.fleet import FleetError, Vehicle, parse_fleet
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_interaction.gcs import station
from xtdrone_interaction.gcs.exchanges import commands_and_refusals
from xtdrone_interaction.gcs.exchanges.commands_and_refusals import Target
from xtdrone_interaction.gcs.vehicle_addresses import GcsError, Peer
from xtdrone_interaction.simulation_services import SimError, call
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.server.methods import CallError, Method, Params
from xtdrone_interaction.web.server.session import Session

_PATIENCE = 5.0  # s of wall time without an answer
_FAR = 100_000.0  # m
ACTIONS = ("arm", "disarm", "takeoff", "land", "rtl", "hold", "goto", "mode", "kill")


@dataclass(frozen=True)
class VehicleCommand(Settings):
    """A command to vehicles.

    Attributes:
        place: goal of ``goto``; with several vehicles, the goal of the group's centre, and the group keeps its shape.
    """

    action: str = setting("", choices=ACTIONS, text="command to the vehicles")
    height: float = setting(3.0, low=0.5, high=1000.0, unit="m", text="height above the ground that takeoff climbs to")
    mode: str = setting("", text="mode by its PX4 name")
    place: tuple[float, float, float] | None = setting(None, low=-_FAR, high=_FAR, unit="m", text="goal, map frame")
    speed: float | None = setting(None, low=0.1, high=100.0, unit="m/s", text="ground speed of goto")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action == "goto" and self.place is None:
            raise SettingError("place", None, "x, y, z of the goal, m")
        if self.action == "mode" and not self.mode:
            raise SettingError("mode", self.mode, "the name of a mode, as AUTO.LOITER")


class VehicleCommands:
    """Carries out the commands of pages."""

    def __init__(self, context: StationContext, fleet: FleetWatch) -> None:
        self._context = context
        self._fleet = fleet

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [Method("vehicles.command", self._command, "operate")]

    async def _command(self, _session: Session, params: Params) -> dict[str, Any]:
        given = dict(params)
        vehicles = chosen_vehicles(given.pop("vehicles", None), self._fleet.roster.vehicles)
        command = VehicleCommand.from_mapping(given, "command")
        goals: Mapping[str, Sequence[float]] = {}
        if command.place is not None:
            goals = goals_of(command.place, await self._context.blocking(self._places, vehicles))
        results = await self._context.blocking(self._run, vehicles, command, goals)
        return {name: {"ok": not isinstance(result, GcsError), "text": str(result)} for name, result in results.items()}

    def _run(
        self, names: Sequence[str], command: VehicleCommand, goals: Mapping[str, Sequence[float]]
    ) -> dict[str, Any]:
        peers = peers_now(names)
        results = station.run({peer: job_of(command, goals.get(peer.name)) for peer in peers}, patience=_PATIENCE)
        done = {"takeoff": "climbs to {:g} m"}.get(command.action, command.action)
        return {name: r if isinstance(r, GcsError) else done.format(r) for name, r in results.items()}

    def _places(self, names: Sequence[str]) -> dict[str, tuple[float, ...] | None]:
        """Return the positions of vehicles, m ENU, requested from the simulator: the pages' frame is slightly older."""
        return {name: self._place(name) for name in names} if len(names) > 1 else dict.fromkeys(names)

    def _place(self, name: str) -> tuple[float, ...] | None:
        request = GetModelStateRequest(name, "")
        try:
            answer = call(self._context.master, "/gazebo/get_model_state", GetModelState, request)
        except SimError:
            return None
        at = answer.pose.position
        return (at.x, at.y, at.z) if answer.success else None


def chosen_vehicles(names: object, fleet: Sequence[Vehicle]) -> list[str]:
    """Return vehicles that a page names.

    Raises:
        CallError: no list, none, or one that is not in the fleet.
    """
    known = [vehicle.name for vehicle in fleet]
    if not isinstance(names, list) or not names:
        raise CallError("vehicles: none is selected, at least one is needed")
    wrong = [name for name in names if name not in known]
    if wrong:
        raise CallError(
            f"vehicles: {str(wrong[0])[:80]!r} is not allowed, one of {', '.join(known) or 'an empty fleet'}"
        )
    return list(dict.fromkeys(names))


def peers_now(names: Sequence[str]) -> list[Peer]:
    """Return the ground-station links of vehicles of the running simulation.

    Raises:
        CallError: the fleet is not known.
    """
    try:
        fleet = parse_fleet(str(rospy.get_param("/xtdrone/fleet")), int(rospy.get_param("/xtdrone/instance", 0)))
    except (KeyError, FleetError) as error:
        raise CallError(f"vehicles: the fleet is not known: {error}") from error
    return [Peer.of(vehicle) for vehicle in fleet if vehicle.name in names]


def goals_of(place: Sequence[float], places: Mapping[str, Sequence[float] | None]) -> dict[str, tuple[float, ...]]:
    """Return the goal of each vehicle, m ENU: the group's centre goes to ``place``, and the group keeps its shape.

    Args:
        place: goal, m ENU.
        places: of the vehicles, m ENU; None: unknown.

    Raises:
        CallError: several vehicles, and the position of one is unknown.
    """
    if len(places) == 1:
        return {name: tuple(place) for name in places}
    known: dict[str, Sequence[float]] = {}
    for name, own in places.items():
        if own is None:
            raise CallError(f"goto: the position of {name} is unknown, and without it the vehicles could collide")
        known[name] = own
    middle = [math.fsum(own[axis] for own in known.values()) / len(known) for axis in range(3)]
    return {name: tuple(place[k] + own[k] - middle[k] for k in range(3)) for name, own in known.items()}


def job_of(command: VehicleCommand, goal: Sequence[float] | None) -> Callable[..., Any]:
    """Return the exchange that carries out a command."""
    if command.action == "goto" and goal is not None:
        x, y, z = goal
        target = Target(local=(x, y, z), speed=math.nan if command.speed is None else command.speed)
        return partial(commands_and_refusals.go_to, target=target)
    jobs: dict[str, Callable[..., Any]] = {
        "arm": partial(commands_and_refusals.arm, armed=True),
        "disarm": partial(commands_and_refusals.arm, armed=False),
        "kill": partial(commands_and_refusals.arm, armed=False, force=True),
        "takeoff": partial(commands_and_refusals.take_off, height=command.height),
        "land": commands_and_refusals.land,
        "rtl": commands_and_refusals.rtl,
        "hold": commands_and_refusals.hold,
        "mode": partial(commands_and_refusals.set_mode, name=command.mode),
    }
    return jobs[command.action]
