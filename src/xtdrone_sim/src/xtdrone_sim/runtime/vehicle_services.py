"""Services that change single vehicles of the running simulation.

==============================  ==========================  ==========================================================
/simulator/reset_vehicle        xtdrone_msgs/ResetVehicle   stand at the start or a given pose, as after a reboot
==============================  ==========================  ==========================================================

rospy calls the handlers in its own threads; each change is made in the simulator's thread, between two ticks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import rospy
from xtdrone_msgs.srv import ResetVehicle, ResetVehicleResponse

from xtdrone_control.fleet import StartPose, start_pose
from xtdrone_sim.runtime.backend import SimulatorBackend
from xtdrone_sim.runtime.control import Change, Control, ControlError
from xtdrone_sim.runtime.mailbox import ClosedError, Mailbox


class VehicleServices:
    """Advertises the services; its methods may be called in any thread but the simulator's."""

    def __init__(self, control: Control, mailbox: Mailbox, backend: SimulatorBackend) -> None:
        """Advertise the services.

        Args:
            control: makes changes between ticks.
            mailbox: passes requests to the simulator's thread.
            backend: the simulated vehicles.
        """
        self._control = control
        self._mailbox = mailbox
        self._backend = backend
        rospy.Service("~reset_vehicle", ResetVehicle, self._on_reset)

    def reset_vehicle(self, name: str, pose: StartPose | None, caller: str) -> str:
        """Put a vehicle back; see ``SimulatorBackend.reset_vehicle``.

        Returns:
            A description of the change.

        Raises:
            ControlError, ClosedError: it was not made; the message gives the reason.
        """

        def make() -> str:
            self._backend.reset_vehicle(name, pose)
            return f"{name}: stands {'where it started' if pose is None else 'at the given pose'}, rebooted"

        return self._ask(Change(f"reset of {name}", make), caller)

    def _ask(self, change: Change, caller: str) -> str:
        asked = self._mailbox.put(lambda answer: self._control.ask_change(change, caller, answer))
        return str(asked.result())

    def _on_reset(self, request: Any) -> ResetVehicleResponse:
        return ResetVehicleResponse(
            *_answered(lambda: self.reset_vehicle(request.name, _pose(request.pose), _caller(request)))
        )


def _answered(act: Callable[[], str]) -> tuple[bool, str]:
    try:
        return True, act()
    except (ValueError, ControlError, ClosedError) as error:
        return False, str(error)


def _pose(numbers: Sequence[float]) -> StartPose | None:
    return start_pose(list(numbers)) if numbers else None


def _caller(request: Any) -> str:
    return str(request._connection_header["callerid"])
