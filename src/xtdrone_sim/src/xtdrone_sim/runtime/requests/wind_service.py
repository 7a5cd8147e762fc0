"""The service /simulator/set_wind (xtdrone_msgs/SetWind): the world's wind of a running simulation.

rospy calls the handler in its own thread; the change is made in the simulator's thread, between two ticks.
"""

from __future__ import annotations

from typing import Any

import rospy
from xtdrone_msgs.srv import SetWind, SetWindResponse

from xtdrone_sim.runtime.requests.mailbox import Mailbox
from xtdrone_sim.runtime.requests.simulation_control import Change, Control
from xtdrone_sim.runtime.requests.vehicle_services import answered, caller_of
from xtdrone_sim.runtime.simulator_interface import SimulatorBackend


class WindService:
    """Advertises the service."""

    def __init__(self, control: Control, mailbox: Mailbox, backend: SimulatorBackend) -> None:
        """Advertise the service.

        Args:
            control: makes changes between ticks.
            mailbox: passes requests to the simulator's thread.
            backend: the simulated vehicles.
        """
        self._control, self._mailbox, self._backend = control, mailbox, backend
        rospy.Service("~set_wind", SetWind, self._on_set_wind)

    def _on_set_wind(self, request: Any) -> SetWindResponse:
        x, y, z = request.velocity.x, request.velocity.y, request.velocity.z

        def make() -> str:
            self._backend.set_wind((x, y, z))
            return f"the wind is ({x:g}, {y:g}, {z:g}) m/s"

        def ask() -> str:
            change = Change("change of the wind", make)
            put = self._mailbox.put(lambda answer: self._control.ask_change(change, caller_of(request), answer))
            return str(put.result())

        return SetWindResponse(*answered(ask))
