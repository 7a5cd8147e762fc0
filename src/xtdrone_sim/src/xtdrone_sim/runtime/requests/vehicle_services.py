"""Services that change single vehicles, or the wind, of the running simulation.

==============================  ==========================  ==========================================================
/simulator/reset_vehicle        xtdrone_msgs/ResetVehicle   return to the start or a given pose, as after a reboot
/simulator/add_vehicle          xtdrone_msgs/AddVehicle     join at a free place; ``reserve`` keeps places free
/simulator/remove_vehicle       xtdrone_msgs/RemoveVehicle  leave, in flight or not; the place is then free
/simulator/set_wind             xtdrone_msgs/SetWind        change the world's wind
==============================  ==========================  ==========================================================

rospy calls the handlers in its own threads; each change is made in the simulator's thread, between two ticks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import rospy
from xtdrone_msgs.srv import (
    AddVehicle,
    AddVehicleResponse,
    RemoveVehicle,
    RemoveVehicleResponse,
    ResetVehicle,
    ResetVehicleResponse,
    SetWind,
    SetWindResponse,
)

from xtdrone_common.fleet import StartPose, start_pose
from xtdrone_lockstep.protocol import printable
from xtdrone_sim.mailbox import ClosedError, Mailbox
from xtdrone_sim.runtime.requests.simulation_control import Control, ControlError, WorldChange
from xtdrone_sim.runtime.simulator_interface import SimulatorBackend


class VehicleServices:
    """Advertises the services; its methods may be called in any thread but the simulator's."""

    def __init__(
        self, control: Control, mailbox: Mailbox, backend: SimulatorBackend, followed: Callable[[], None]
    ) -> None:
        """Advertise the services.

        Args:
            control: makes changes between ticks.
            mailbox: passes requests to the simulator's thread.
            backend: the simulated vehicles.
            followed: function called in the simulator's thread after a vehicle has joined or left.
        """
        self._control = control
        self._mailbox = mailbox
        self._backend = backend
        self._followed = followed
        rospy.Service("~reset_vehicle", ResetVehicle, self._on_reset)
        rospy.Service("~add_vehicle", AddVehicle, self._on_add)
        rospy.Service("~remove_vehicle", RemoveVehicle, self._on_remove)
        rospy.Service("~set_wind", SetWind, self._on_set_wind)

    def reset_vehicle(self, name: str, pose: StartPose | None, caller: str) -> str:
        """Reset a vehicle; see ``SimulatorBackend.reset_vehicle``.

        Returns:
            A description of the change.

        Raises:
            ControlError, ClosedError: it was not made; the message gives the reason.
        """

        def make() -> str:
            self._backend.reset_vehicle(name, pose)
            return f"{name}: stands {'where it started' if pose is None else 'at the given pose'}, rebooted"

        return self._ask(WorldChange(f"reset of {name}", make), caller)

    def add_vehicle(self, name: str, model: str, pose: StartPose | None, caller: str) -> str:
        """Add a vehicle in flight; see ``SimulatorBackend.add_vehicle``, and ``reset_vehicle`` for the rest."""

        def make() -> str:
            self._backend.add_vehicle(name, model, pose)
            self._followed()
            return f"{name} has joined, {self._count()} in the simulation"

        return self._ask(WorldChange(f"join of {printable(name)}", make), caller)

    def remove_vehicle(self, name: str, caller: str) -> str:
        """Remove a vehicle from the simulation; see ``add_vehicle``."""

        def make() -> str:
            self._backend.remove_vehicle(name)
            self._followed()
            return f"{name} has left, {self._count()} in the simulation"

        return self._ask(WorldChange(f"leave of {printable(name)}", make), caller)

    def _count(self) -> str:
        count = len(self._backend.names)
        return "1 vehicle is" if count == 1 else f"{count} vehicles are"

    def _ask(self, change: WorldChange, caller: str) -> str:
        asked = self._mailbox.put(lambda answer: self._control.ask_change(change, caller, answer))
        return str(asked.result())

    def _on_reset(self, request: Any) -> ResetVehicleResponse:
        return ResetVehicleResponse(
            *answered(lambda: self.reset_vehicle(request.name, _pose(request.pose), caller_of(request)))
        )

    def _on_add(self, request: Any) -> AddVehicleResponse:
        return AddVehicleResponse(
            *answered(lambda: self.add_vehicle(request.name, request.model, _pose(request.pose), caller_of(request)))
        )

    def _on_remove(self, request: Any) -> RemoveVehicleResponse:
        return RemoveVehicleResponse(*answered(lambda: self.remove_vehicle(request.name, caller_of(request))))

    def _on_set_wind(self, request: Any) -> SetWindResponse:
        x, y, z = request.velocity.x, request.velocity.y, request.velocity.z

        def make() -> str:
            self._backend.set_wind((x, y, z))
            return f"the wind is ({x:g}, {y:g}, {z:g}) m/s"

        return SetWindResponse(
            *answered(lambda: self._ask(WorldChange("change of the wind", make), caller_of(request)))
        )


def answered(act: Callable[[], str]) -> tuple[bool, str]:
    """Return whether a change was made, and a description of it or the reason why not."""
    try:
        return True, act()
    except (ValueError, OSError, ControlError, ClosedError) as error:
        return False, str(error)


def _pose(numbers: Sequence[float]) -> StartPose | None:
    return start_pose(list(numbers)) if numbers else None


def caller_of(request: Any) -> str:
    """Return the name of the node that calls a service."""
    return str(request._connection_header["callerid"])
