"""Stop simulated time between two ticks while an operator's action takes effect, so that it does so at a known tick.

A command of a program outside the lockstep takes effect in the tick in which it arrives, which depends on wall time.
While time stands still between two ticks, the whole command arrives before the next one. A step of one tick, after
which the simulator pauses, changes no result of a flight.
"""

from __future__ import annotations

from dataclasses import dataclass

from std_srvs.srv import Trigger, TriggerRequest
from xtdrone_msgs.msg import SimulationStatus
from xtdrone_msgs.srv import GetStatus, GetStatusRequest, Step, StepRequest

from xtdrone_interaction.sim_cli import SimError, call, parameter

_STEP_LIMIT = 2.0  # s of wall time for a tick; a participant at a breakpoint takes longer
_AUTOPILOT = "/simulator/autopilot"
_NEEDS_TIME = "hil"  # an external PX4 answers only while time advances


@dataclass(frozen=True)
class Instant:
    """The simulated time at which an action takes effect.

    Attributes:
        tick: number of ticks since the simulator started; None without a simulator.
        time: simulated time, s.
        held: whether time stands still between two ticks.
        stopped: whether the action has stopped it, so that it must resume afterwards.
    """

    tick: int | None = None
    time: float = 0.0
    held: bool = False
    stopped: bool = False


def hold(master: str, *, is_stepping: bool = False) -> Instant:
    """Stop time between two ticks, if there is a simulator that supports it; blocks.

    Args:
        master: URI of the ROS master.
        is_stepping: an operator's step is under way, whether the simulator has begun it or not; time is not stopped.
    """
    try:
        status = status_of(master)
        if parameter(master, _AUTOPILOT) == _NEEDS_TIME or status.stepping or is_stepping:
            return _instant(status, held=False, stopped=False)
        if status.paused or status.tick == 0:
            return _instant(status, held=True, stopped=False)
    except (SimError, OSError):  # a real vehicle
        return Instant()
    try:
        done = bool(call(master, "/simulator/step", Step, StepRequest(ticks=1), _STEP_LIMIT).success)
        return _instant(status_of(master), held=done, stopped=done)  # a rejected step has stopped nothing
    except SimError:
        return _instant(status, held=False, stopped=True)  # continue: the step may still follow


def let_go(master: str, instant: Instant) -> None:
    """Resume time after an action, if the action has stopped it; blocks."""
    if not instant.stopped:
        return
    try:
        call(master, "/simulator/resume", Trigger, TriggerRequest())
    except SimError:
        return  # the simulator has ended


def status_of(master: str) -> SimulationStatus:
    """Return the simulator's status.

    Raises:
        SimError: there is no simulator.
    """
    return call(master, "/simulator/get_status", GetStatus, GetStatusRequest()).status


def _instant(status: SimulationStatus, *, held: bool, stopped: bool) -> Instant:
    return Instant(int(status.tick), status.sim_time.to_sec(), held, stopped)
