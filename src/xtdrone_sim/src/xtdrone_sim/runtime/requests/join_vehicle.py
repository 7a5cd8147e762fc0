"""The node that lets a vehicle join the running simulation; see ``nodes/join_vehicle.py``."""

from __future__ import annotations

import signal
import threading
from collections.abc import Sequence
from typing import Any

import rospy
from xtdrone_msgs.srv import AddVehicle, RemoveVehicle

from xtdrone_common.programs.node_command_line import ArgumentError, check_no_arguments
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_common.programs.under_roslaunch import announce

_PATIENCE = 60.0  # wall s to wait for the simulator
_ADD, _REMOVE = "/simulator/add_vehicle", "/simulator/remove_vehicle"


def main(arguments: Sequence[str]) -> None:
    """Add the vehicle to the simulation, and remove it after SIGINT or SIGTERM.

    Raises:
        ArgumentError: invalid arguments or parameters, no simulator, or the simulator rejects the vehicle.
    """
    check_no_arguments(arguments)
    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.set())
    init_plain_node("join_vehicle", disable_signals=True)  # the service is called after a signal
    name, model, pose = str(rospy.get_param("~vehicle", "")), str(rospy.get_param("~model", "")), _pose()
    if not name:
        raise ArgumentError("vehicle: no name is given, as ~vehicle:=iris_9")
    try:
        rospy.wait_for_service(_ADD, _PATIENCE)
    except rospy.ROSException as error:
        raise ArgumentError(f"{name} cannot join: no simulator offers {_ADD} after {_PATIENCE:g} s") from error
    announce(f"simulator: {_accepted(_ADD, AddVehicle, name, model, pose)}")
    try:
        rospy.on_shutdown(over.set)
        over.wait()
    finally:
        _leave(name)
        rospy.signal_shutdown("the vehicle has left")


def _pose() -> list[float]:
    given = rospy.get_param("~pose", []) or []
    if not isinstance(given, list) or not all(isinstance(one, int | float) for one in given):
        raise ArgumentError(f"pose: {str(given)[:80]} is not allowed, a list of x, y, z, roll, pitch, yaw (m, rad)")
    return [float(one) for one in given]


def _accepted(service: str, kind: Any, *request: Any) -> str:
    """Call a service and return its message.

    Raises:
        ArgumentError: the service rejects the request or does not respond.
    """
    try:
        answer = rospy.ServiceProxy(service, kind)(*request)
    except (rospy.ServiceException, OSError) as error:
        raise ArgumentError(f"{service} has failed: {error}") from error
    if not answer.success:
        raise ArgumentError(str(answer.message))
    return str(answer.message)


def _leave(name: str) -> None:
    """Remove the vehicle, unless the simulation has already ended."""
    try:
        announce(f"simulator: {_accepted(_REMOVE, RemoveVehicle, name)}")
    except ArgumentError as error:
        rospy.logdebug("join_vehicle: %s", error)
