"""Repeat a session's actions on another simulation, each at the tick of the recorded session."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

import rosgraph
import rospy
from std_srvs.srv import Trigger, TriggerRequest
from xtdrone_msgs.msg import SimulationStatus
from xtdrone_msgs.srv import Step, StepRequest

from xtdrone_interaction.simulation_services import SimError, call
from xtdrone_interaction.web.actions.held_time import status_of
from xtdrone_interaction.web.actions.operator_actions import OperatorActions
from xtdrone_interaction.web.actions.recorded_actions import ActionError, RecordedAction
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.rooms import methods_of_rooms
from xtdrone_interaction.web.server.methods import MethodTable, invoke
from xtdrone_interaction.web.server.session import Session
from xtdrone_interaction.web.station_settings import StationSettings

NAME = "replay_actions"
_FLEET_LIMIT = 20.0  # s of wall time until the rooms have read the fleet
_LOOK = 0.05  # s
_NEAR = 1e-6  # s, of two simulated times that are the same
_MOST_TICKS = 100_000  # of one step


class _NoPage:
    """Stands in for a page's session, and drops all messages."""

    def send(self, _data: str | bytes, done: Callable[[], None]) -> None:
        """Drop a message."""
        done()

    def close(self) -> None:
        """Do nothing."""


async def replay(actions: Sequence[RecordedAction], tell: Callable[[str], None]) -> None:
    """Repeat actions on the simulation of this node's master, paused before the first of them.

    Time resumes after the last one.

    Args:
        actions: in their order.
        tell: prints a line.

    Raises:
        ActionError: time is beyond the first action or runs, the flight is another one, or an action is refused that
            was carried out in the recorded session, or the other way round.
        SimError: there is no simulator, or it has ended.
    """
    context = StationContext(rosgraph.get_master_uri(), rospy.get_name())
    context.act = OperatorActions(context).carry_out
    try:
        await _replay(context, actions, tell)
    finally:
        context.close()


async def _replay(context: StationContext, actions: Sequence[RecordedAction], tell: Callable[[str], None]) -> None:
    methods = MethodTable(methods_of_rooms(context, StationSettings()))
    sessions = {number: _session(number) for number in sorted({action.page for action in actions})}
    context.sessions.update(sessions)
    _check_start(await context.blocking(status_of, context.master), actions[0])
    await _fleet_is_known(methods, next(iter(sessions.values())))
    for action in actions:
        await _advance(context, action)
        result = await _repeat(context, methods, sessions[action.page], action)
        exact = "" if action.exact else ", perhaps at another tick: time ran during it in the recorded session"
        tell(f"{action.time:9.3f} s  {action.method}: {result}{exact}")
    context.sessions.clear()
    await context.blocking(call, context.master, "/simulator/resume", Trigger, TriggerRequest())


async def _repeat(context: StationContext, methods: MethodTable, session: Session, action: RecordedAction) -> str:
    """Carry out an action and return its result in short.

    Raises:
        ActionError: it is refused and was not in the recorded session, or the other way round.
    """
    name = f"action {action.number}, {action.method}"
    try:
        result = await context.act(methods.find(action.method, "operate"), session, action.params)
    except (ValueError, TimeoutError) as error:
        if not action.refused:
            raise ActionError(f"{name}: {error}") from error
        return f"refused as in the recorded session: {error}"
    if action.refused:
        raise ActionError(f"{name}: it was refused in the recorded session, and is carried out here")
    return _in_short(result)


def _session(number: int) -> Session:
    loop = asyncio.get_running_loop()

    def in_loop(action: Callable[[], None]) -> None:
        loop.call_soon_threadsafe(action)

    return Session(number, "operate", _NoPage(), in_loop)


def _check_start(status: SimulationStatus, first: RecordedAction) -> None:
    if not status.paused:
        raise ActionError("simulation: it is already running; launch it with paused:=true")
    if status.tick > first.tick:
        raise ActionError(
            f"simulation: it is at tick {status.tick}, and the first action is at tick {first.tick}; "
            "launch it again with paused:=true"
        )


async def _fleet_is_known(methods: MethodTable, session: Session) -> None:
    """Wait until the rooms, which poll the fleet's parameter, have read it."""
    roster = methods.find("fleet.roster", "operate")
    end = asyncio.get_running_loop().time() + _FLEET_LIMIT
    while not (await invoke(roster, session, {}))["vehicles"]:
        if asyncio.get_running_loop().time() > end:
            raise ActionError("simulation: no fleet is known, parameter /xtdrone/fleet")
        await asyncio.sleep(_LOOK)


async def _advance(context: StationContext, action: RecordedAction) -> None:
    """Advance to the tick of an action.

    Raises:
        ActionError: that tick has a different time in this simulation.
    """
    status = await context.blocking(status_of, context.master)
    while status.tick < action.tick:
        request = StepRequest(ticks=min(int(action.tick - status.tick), _MOST_TICKS))
        answer = await context.blocking(call, context.master, "/simulator/step", Step, request, None)
        if not answer.success:
            raise SimError(f"simulator: {answer.message}")
        status = await context.blocking(status_of, context.master)
    here = status.sim_time.to_sec()
    if action.exact and abs(here - action.time) > _NEAR:
        raise ActionError(
            f"simulation: tick {action.tick} is at {here:.3f} s here and was at {action.time:.3f} s in the recorded "
            "session; launch it with the same vehicles and nodes"
        )


def _in_short(result: Any) -> str:
    if isinstance(result, dict) and all(isinstance(value, dict) and "ok" in value for value in result.values()):
        refused = [f"{name}: {value['text']}" for name, value in result.items() if not value["ok"]]
        return "; ".join(refused) or f"done by {', '.join(result)}"
    return "done" if result is None else str(result)[:100]
