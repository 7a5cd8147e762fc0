"""The program that opens rviz on the screen with a view of the fleet; see ``nodes/rviz_view.py``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import rospkg
import rospy

from xtdrone_common.programs.node_command_line import ArgumentError, needed_fleet
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.rviz.view_configurations import SHIPPED, make_view
from xtdrone_sim.vehicles.vehicle_model import load_vehicle


def configuration(view: str) -> Path:
    """Return the .rviz file of a view, generated for the fleet if it is one of SHIPPED.

    Args:
        view: one of SHIPPED, or an .rviz file.

    Raises:
        ArgumentError: it is neither, or no fleet is running.
    """
    if Path(view).is_file():
        return Path(view)
    names = [vehicle.name for vehicle in needed_fleet(rospy.get_param("/xtdrone/fleet", None))]
    try:
        text = make_view(view, names)
    except OptionError as error:
        raise ArgumentError(f"{error}, or an .rviz file") from error
    path = Path(rospkg.get_ros_home()) / f"xtdrone_{view}.rviz"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def set_descriptions() -> None:
    """Set missing robot descriptions, which rviz reads only once at its start."""
    for vehicle in needed_fleet(rospy.get_param("/xtdrone/fleet", None)):
        name = f"/{vehicle.name}/robot_description"
        if not rospy.has_param(name):
            rospy.set_param(name, load_vehicle(vehicle.model).urdf.text)


def main(arguments: Sequence[str]) -> None:
    """Replace this process by rviz.

    Raises:
        ArgumentError: invalid argument, or no fleet is running.
        rospy.ROSInitException: no screen, or no rviz.
    """
    if len(arguments) != 1:
        raise ArgumentError(
            f"1 argument is needed, {len(arguments)} were given; a view ({', '.join(SHIPPED)}) or a file"
        )
    if not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise rospy.ROSInitException(
            "rviz: there is no screen, DISPLAY is not set; without one ./xtdrone record-view films the flight"
        )
    path = configuration(arguments[0])
    set_descriptions()
    names = [word for word in sys.argv[1:] if ":=" in word]  # roslaunch's, as __name:=rviz
    try:
        os.execvp("rviz", ["rviz", "-d", str(path), *names])
    except OSError as error:
        raise rospy.ROSInitException(f"rviz: cannot be started: {error.strerror}") from error
