#!/usr/bin/env python3
"""Send an actor of the world to a position: ``control_actor.py id x y [v]``.

``id`` is the actor's index in the order of the world, from 0; x, y the target, m, map; v the speed, m/s: 0: stop;
omitted or negative: the actor's speed in the world. The program exits after the simulator has received the command.

Exit status: 0, 1 if there is no such actor (or the simulator has ended), 2 for invalid arguments.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import rospy
from ros_actor_cmd_pose_plugin_msgs.msg import ActorMotion

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import run_program

LIMIT = 3.0  # simulated s to wait for the actor's subscriber


def main(arguments: Sequence[str]) -> int:
    """Send the command to the simulator; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("id", type=int, help="number in the world's order, from 0")
    parser.add_argument("x", type=float, help="m, map")
    parser.add_argument("y", type=float, help="m, map")
    parser.add_argument("v", type=float, nargs="?", default=-1.0, help="m/s")
    options = parser.parse_args(arguments)
    if options.id < 0:
        parser.error(f"id: {options.id} is not allowed, at least 0")
    lockstep.init_node(f"control_actor_{options.id}", rate=10.0)
    topic = f"/actor_{options.id}/cmd_motion"
    publisher = lockstep.Publisher(topic, ActorMotion)
    lockstep.start()
    rate = lockstep.Rate()
    end = rospy.Time.now() + rospy.Duration.from_sec(LIMIT)
    while not publisher.get_num_connections():
        if rospy.Time.now() > end:
            print(f"control_actor: no subscriber of {topic}: the world has no person {options.id}", file=sys.stderr)
            return 1
        rate.sleep()
    publisher.publish(ActorMotion(options.x, options.y, options.v))
    rate.sleep()
    return 0


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, "control_actor.py ID X Y [V]"))
