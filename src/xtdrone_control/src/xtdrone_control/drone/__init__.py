"""Fly vehicles from a script, over MAVROS::

    from xtdrone_control.drone import connect

    with connect("iris_0") as drone:
        drone.arm()
        drone.takeoff(3.0)
        drone.go_to(5.0, 0.0, 3.0)
        drone.set_velocity(1.0, 0.0, 0.0)
        drone.wait(4.0)
        drone.land()

``connect_all()`` returns the same verbs for every vehicle of ``/xtdrone/fleet`` at once. The script needs a ROS master
and a MAVROS of each vehicle, ours or the real one; it uses only topics and services of MAVROS's standard plugins. No
other node may command the same vehicle meanwhile.

Positions are in m, ENU, in the vehicle's local frame (by default, the simulator uses one map frame for all vehicles);
velocities are in m/s, headings in rad (0 is east, counter-clockwise), times in s of ROS time. A verb blocks until it is
done, and raises ``DroneError`` with vehicle, verb and reason; ``TimedOutError``, ``RejectedError`` and ``FaultError``
are subclasses of it.

Two ways to run:

- In lockstep, the default of a script beside our simulator: the script is a participant. Simulated time passes only
  while a verb runs, so every run of a script is the same flight. Name its node in the launch argument ``participants``
  (``/mavros,/drone_script``) so that time does not start without it. ``drone.wait(seconds)`` lets time pass.
- Free-running, the default at an interactive prompt, with real MAVROS and without our simulator: a thread streams
  setpoints at 30 Hz, and vehicles keep flying while the script computes.

When the script ends, by its last line, an exception or Ctrl-C, vehicles in OFFBOARD are switched to AUTO.LOITER: they
hold position, and a warning names them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .drones import Drone, DroneGroup
from .verbs import DroneError, FaultError, GroupError, RejectedError, TimedOutError

if TYPE_CHECKING:
    from .script_node import connect, connect_all

__all__ = [
    "Drone",
    "DroneError",
    "DroneGroup",
    "FaultError",
    "GroupError",
    "RejectedError",
    "TimedOutError",
    "connect",
    "connect_all",
]


def __getattr__(name: str) -> Any:
    """Import the ROS-dependent part, and rospy with it, on first use."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import script_node

    return getattr(script_node, name)
