"""Simulated time: its state, the participants that hold the tick, and pause, step, speed and reset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import rospy
from std_srvs.srv import Empty, EmptyRequest, Trigger, TriggerRequest
from xtdrone_msgs.msg import SimulationStatus
from xtdrone_msgs.srv import ResetVehicle, ResetVehicleRequest, SetSpeed, SetSpeedRequest, Step, StepRequest

from xtdrone_common.programs.node_command_line import LEAST_SPEED
from xtdrone_common.settings import Settings, setting
from xtdrone_interaction.simulation_services import SimError, call
from xtdrone_interaction.web.commands.vehicle_commands import chosen_vehicles
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.server.methods import CallError, Method, Params
from xtdrone_interaction.web.server.session import Session

_STEP_LIMIT = 50.0  # s of wall time; a page waits 60 s
_LOOK = 1.0  # s of wall time between two looks whether the simulator is still there


@dataclass(frozen=True)
class TimeCommand(Settings):
    """A command to the simulator."""

    action: str = setting("", choices=("pause", "resume", "step", "speed"), text="command")
    ticks: int = setting(1, low=1, high=100_000, text="ticks of a step")
    factor: float = setting(1.0, low=0.0, high=1000.0, text="target real-time factor; 0: as fast as it goes")


class TimeControl:
    """Passes the simulator's status to the pages, and their requests to the simulator."""

    def __init__(self, context: StationContext, fleet: FleetWatch) -> None:
        self._context = context
        self._fleet = fleet
        self._status: dict[str, Any] | None = None
        self._subscriber = rospy.Subscriber("/simulator/status", SimulationStatus, self._on_status, queue_size=1)
        context.every(_LOOK, self._note_end)

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [
            Method("time.status", self._describe),
            Method("time.control", self._control, "operate", "time"),
            Method("time.reset", self._reset, "operate"),
        ]

    def _on_status(self, message: SimulationStatus) -> None:
        self._status = status_for_page(message)
        self._context.in_loop(self._context.push_all, "time.status", self._status)

    def _note_end(self) -> None:
        """Forget the status of a simulator that has ended: it would be shown as running."""
        if self._status is not None and not self._subscriber.get_num_connections():
            self._status = None
            self._context.push_all("time.status", None)

    def _describe(self, _session: Session, _params: Params) -> dict[str, Any] | None:
        return self._status

    async def _control(self, _session: Session, params: Params) -> str:
        command = TimeCommand.from_mapping(dict(params), "command")
        if command.action == "speed" and 0.0 < command.factor < LEAST_SPEED:
            raise CallError(f"factor: {command.factor} is not allowed, 0 or at least {LEAST_SPEED}")
        return await self._asked(self._ask, command)

    async def _reset(self, _session: Session, params: Params) -> str:
        """Reset a vehicle, or all and time."""
        vehicle = params.get("vehicle", "")
        if vehicle != "":  # null or 0 must not reset all
            chosen_vehicles([vehicle], self._fleet.roster.vehicles)
        return await self._asked(self._set_back, vehicle)

    async def _asked(self, ask: Callable[..., str], argument: Any) -> str:
        try:
            return await self._context.blocking(ask, argument)
        except SimError as error:
            raise CallError(str(error)) from error

    def _ask(self, command: TimeCommand) -> str:
        master = self._context.master
        if command.action in ("pause", "resume"):
            return _accepted(call(master, f"/simulator/{command.action}", Trigger, TriggerRequest()))
        if command.action == "step":
            return _accepted(call(master, "/simulator/step", Step, StepRequest(ticks=command.ticks), _STEP_LIMIT))
        return _accepted(call(master, "/simulator/set_speed", SetSpeed, SetSpeedRequest(speed=command.factor)))

    def _set_back(self, vehicle: str) -> str:
        master = self._context.master
        if vehicle:
            request = ResetVehicleRequest(vehicle, [])
            return _accepted(call(master, "/simulator/reset_vehicle", ResetVehicle, request))
        call(master, "/gazebo/reset_simulation", Empty, EmptyRequest())
        return "reset: vehicles are at their places, simulated time is 0"


def status_for_page(status: SimulationStatus) -> dict[str, Any]:
    """Return the simulator's status; ``held``: whether it waits for participants now."""
    return {
        "time": status.sim_time.to_sec(),
        "tick": status.tick,
        "speed": status.speed,
        "measured": status.measured_speed,
        "paused": bool(status.paused and not status.stepping),
        "stepping": bool(status.stepping),
        "participants": sorted(status.participants),
        "waiting_for": sorted(status.waiting_for),
        "waiting": status.waiting.to_sec(),
        "reason": str(status.reason),
    }


def _accepted(response: Any) -> str:
    if not response.success:
        raise CallError(str(response.message))
    return str(response.message)
