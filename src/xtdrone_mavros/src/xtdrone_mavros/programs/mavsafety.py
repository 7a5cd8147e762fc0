"""``mavsafety``: arm, disarm, stop the motors immediately, set the safety area."""

from __future__ import annotations

import argparse
import time

import rospy
from geometry_msgs.msg import Point32, PolygonStamped
from mavros_msgs.srv import CommandBool, CommandLong

from .shared_arguments_and_calls import Mavros, ProgramError, new_parser
from .shared_arguments_and_calls import main as run_program

_ARM_DISARM, _FORCE = 400, 21196.0  # MAV_CMD_COMPONENT_ARM_DISARM, and its param2 that forces it in flight
_SUBSCRIBER_LIMIT = 3.0  # s of wall time, as MAVROS's
_SLICE = 0.05  # s between checks for a subscriber


def parser() -> argparse.ArgumentParser:
    """Return the command-line parser."""
    found = new_parser("Arm and disarm the vehicle, set its safety area.")
    verbs = found.add_subparsers(required=True, metavar="VERB")
    verbs.add_parser("arm", help="arm the motors").set_defaults(run=_arm, arm=True)
    verbs.add_parser("disarm", help="disarm the motors").set_defaults(run=_arm, arm=False)
    verbs.add_parser("kill", help="stop the motors immediately, even in flight").set_defaults(run=_kill)
    area = verbs.add_parser("safetyarea", help="set the safety area by two corners")
    area.set_defaults(run=_safety_area)
    for name in ("-p1", "-p2"):
        area.add_argument(name, type=float, nargs=3, metavar=("X", "Y", "Z"), required=True, help="a corner, m")
    return found


def _arm(mavros: Mavros, arguments: argparse.Namespace) -> None:
    mavros.command("cmd/arming", CommandBool, value=arguments.arm)


def _kill(mavros: Mavros, _: argparse.Namespace) -> None:
    mavros.command("cmd/command", CommandLong, command=_ARM_DISARM, param2=_FORCE)


def _safety_area(mavros: Mavros, arguments: argparse.Namespace) -> None:
    topic = mavros.topic("safety_area/set")
    publisher = rospy.Publisher(topic, PolygonStamped, queue_size=10, latch=True)
    message = PolygonStamped()
    message.header.frame_id = "mavsafety"
    message.header.stamp = rospy.get_rostime()
    message.polygon.points = [Point32(*arguments.p1), Point32(*arguments.p2)]
    publisher.publish(message)
    end = time.monotonic() + _SUBSCRIBER_LIMIT
    while not publisher.get_num_connections():
        if time.monotonic() > end or rospy.is_shutdown():
            raise ProgramError(f"{topic}: no MAVROS subscribes to it; the safety area is not set")
        time.sleep(_SLICE)


def main() -> int:
    """Run the program; return its exit status."""
    return run_program("mavsafety", parser())
