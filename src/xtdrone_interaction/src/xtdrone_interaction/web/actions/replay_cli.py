"""``./xtdrone replay-actions BAG``: repeat the operators' actions of a recorded session, tick by tick.

Exit status: 0 when all actions were repeated, 1 when one was not, 2 for an invalid value.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from pathlib import Path

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.simulation_services import RUNS, SimError, choose_master, master_uri
from xtdrone_interaction.web.actions.recorded_actions import ActionError, read_actions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Repeat the commands that were given on the page of a recorded flight on a simulation that was launched in the "
        "same way with paused:=true. Each acts at the same tick, so that the flight is the same to the last bit."
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="bag, or the bags of a split recording")
    parser.add_argument(
        "--master",
        type=master_uri,
        metavar="PORT|URI",
        help="the flight's ROS master (default: ROS_MASTER_URI; without a simulator there, the newest flight)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Repeat the actions and return the exit status."""
    try:
        actions = read_actions(arguments.bags)
        master, origin = choose_master(
            arguments.master or "", os.environ.get("ROS_MASTER_URI", ""), [Path("runs"), RUNS]
        )
    except (ActionError, BagError, SimError) as error:
        print(f"xtdrone replay-actions: {error}", file=sys.stderr)
        return 1
    if origin:
        print(f"xtdrone replay-actions: {origin}, ROS master {master}", file=sys.stderr)
    os.environ["ROS_MASTER_URI"] = master
    if not {"ROS_IP", "ROS_HOSTNAME"} & os.environ.keys():
        os.environ["ROS_IP"] = "127.0.0.1"
    import rospy

    from xtdrone_common.programs.plain_node import init_plain_node
    from xtdrone_interaction.web.actions.replay import NAME, replay

    init_plain_node(NAME, anonymous=True, disable_signals=True)
    try:
        asyncio.run(replay(actions, print))
    except (ActionError, SimError) as error:
        print(f"xtdrone replay-actions: {error}", file=sys.stderr)
        return 1
    finally:
        rospy.signal_shutdown("the replay ends")
    return 0
