"""Stop simulated time between two ticks while an operator's action takes effect, so that it does so at a known tick.

A command of a program outside the lockstep takes effect in the tick in which it arrives, which depends on wall time.
While time stands still between two ticks, the whole command arrives before the next one, which changes no result of a
flight. The simulator ends such a hold when the connection closes that asked for it, so also when the station is killed.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field

from xtdrone_msgs.msg import SimulationStatus
from xtdrone_msgs.srv import GetStatus, GetStatusRequest, Hold, HoldRequest

from xtdrone_interaction.service_client import ServiceConnection, ServiceError
from xtdrone_interaction.simulation_services import SimError, call, find_service, parameter

_TICK_LIMIT = 2.0  # s of wall time for a tick; a participant at a breakpoint takes longer
_CALLER = "/operator_action"
_SERVICE = "/simulator/hold"
_AUTOPILOT = "/simulator/autopilot"
_NEEDS_TIME = "hil"  # an external PX4 answers only while time advances


@dataclass(frozen=True)
class Instant:
    """The simulated time at which an action takes effect.

    Attributes:
        tick: number of ticks since the simulator started; None without a simulator.
        time: simulated time, s.
        held: whether time stands still between two ticks.
        connection: holds the time; None if it is not held by this instant.
    """

    tick: int | None = None
    time: float = 0.0
    held: bool = False
    connection: ServiceConnection | None = field(default=None, compare=False)


def hold(master: str, *, is_stepping: bool = False) -> Instant:
    """Stop time between two ticks, if there is a simulator that supports it; blocks.

    Args:
        master: URI of the ROS master.
        is_stepping: an operator's step is under way, whether the simulator has begun it or not; time is not stopped.
    """
    try:
        status = status_of(master)
        address = None
        if not (parameter(master, _AUTOPILOT) == _NEEDS_TIME or status.stepping or is_stepping):
            address = find_service(master, _SERVICE)
    except (SimError, OSError):  # a real vehicle
        return Instant()
    if address is None:
        return Instant(int(status.tick), status.sim_time.to_sec())
    try:
        connection = ServiceConnection(address, _SERVICE, (Hold._type, Hold._md5sum), _CALLER)
    except ServiceError:
        return Instant(int(status.tick), status.sim_time.to_sec())
    try:
        answer = connection.call(Hold, HoldRequest(True), _TICK_LIMIT)
    except ServiceError:
        connection.close()  # which ends a hold that may still follow
        return Instant(int(status.tick), status.sim_time.to_sec())
    return Instant(int(answer.tick), answer.sim_time.to_sec(), bool(answer.success), connection)


def let_go(instant: Instant) -> None:
    """Let time go on after an action, if it was held for that; blocks."""
    if instant.connection is None:
        return
    with contextlib.closing(instant.connection), contextlib.suppress(ServiceError):  # the simulator has ended
        instant.connection.call(Hold, HoldRequest(False), _TICK_LIMIT)


def status_of(master: str) -> SimulationStatus:
    """Return the simulator's status.

    Raises:
        SimError: there is no simulator.
    """
    return call(master, "/simulator/get_status", GetStatus, GetStatusRequest()).status
