#!/usr/bin/env python3
"""The ground station of a launch file: uploads each vehicle's plan over MAVLink, then resumes the simulation.

Services called:
    /gazebo/unpause_physics (std_srvs/Empty): when all plans are uploaded.

Parameters:
    /xtdrone/fleet (as ``typhoon_h480:6``): the vehicles.
    /xtdrone/instance (default 0): of the simulations on this machine.
    ~plans: folder with VEHICLE.plan for each vehicle, in QGroundControl's format.

Exit status: 0 when all plans are uploaded, 1 when a vehicle has rejected its plan or not responded (time stays paused),
2 for invalid parameters or files.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import rospy
from std_srvs.srv import Empty

from xtdrone_autopilot.plans import qgc_plan
from xtdrone_common.fleet import FleetError, check_instance, parse_fleet
from xtdrone_common.programs.node_command_line import check_no_arguments, run_program
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_interaction.gcs import GcsError, upload_plans

_RESUME = "/gazebo/unpause_physics"
_PATIENCE = 60.0  # s of wall time without a response: the simulator may still be loading


def main(arguments: Sequence[str]) -> int:
    """Upload and return the exit status."""
    check_no_arguments(arguments)
    init_plain_node("upload_plans", disable_rostime=True)  # simulated time is paused until the upload is complete
    try:
        fleet = str(rospy.get_param("/xtdrone/fleet"))
        instance = check_instance(rospy.get_param("/xtdrone/instance", 0))
        folder = Path(str(rospy.get_param("~plans")))
        plans = {vehicle.name: qgc_plan.read(folder / f"{vehicle.name}.plan") for vehicle in parse_fleet(fleet)}
    except KeyError as error:
        rospy.logfatal("ground station: parameter %s is not set", error)
        return 2
    except (FleetError, qgc_plan.PlanError, OSError) as error:
        rospy.logfatal("ground station: %s", error)
        return 2
    rospy.wait_for_service(_RESUME)  # from then on the vehicles accept connections
    try:
        upload_plans(plans, fleet=fleet, patience=_PATIENCE, instance=instance)
    except GcsError as error:
        rospy.logfatal("ground station: plans were not uploaded, time stays paused: %s", error)
        return 1
    rospy.loginfo("ground station: uploaded %d plans, time runs", len(plans))
    rospy.ServiceProxy(_RESUME, Empty)()
    return 0


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "upload_plans.py"))
