"""A MAVROS plugin and, behind its socket, the MAVLink services of a vehicle, in the test's thread."""

from __future__ import annotations

import threading
import time
from typing import Any

from mavros_fakes import Bench
from service_fakes import Served

from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_mavros.uas import Plugin

_WALL_LIMIT = 120.0  # s; only a broken run takes so long


class Pair:
    """A plugin, a vehicle's services, and the messages between them.

    Attributes:
        bench: the plugin's side.
        served: the vehicle's services.
        lost: messages of the autopilot that are not delivered.
    """

    def __init__(self, plugin: type[Plugin]) -> None:
        """Begin with nothing lost."""
        self.bench = Bench([plugin])
        self.served = Served(Parameters({"MAV_SYS_ID": 1}), system=1)
        self.lost = 0

    def call(self, service: str, request: Any) -> Any:
        """Call a service in a thread, as rospy does, and run the autopilot until the call returns."""
        results: list[Any] = []
        handler = self.bench.ros.services[f"/iris_0/mavros/{service}"]
        thread = threading.Thread(target=lambda: results.append(handler(request)), daemon=True)
        thread.start()
        end = time.monotonic() + _WALL_LIMIT
        while thread.is_alive():
            assert time.monotonic() < end, "the service hangs"
            self.turn()
            thread.join(0.001)
        return results[0]

    def turn(self) -> None:
        """Run the autopilot for 20 ms: receive, advance, send."""
        for message in self.bench.received():
            self.served.ask(bytes(message.get_msgbuf()))
            self._deliver()
        self.served.autopilot.time_us += 20_000
        self.served.link.frames.clear()
        self.served.receiver.update(self.served.autopilot.time_us)
        self._deliver()

    def _deliver(self) -> None:
        for frame in self.served.link.frames:
            if self.lost:
                self.lost -= 1
            else:
                self.bench.send_raw(frame)
        self.served.link.frames.clear()
