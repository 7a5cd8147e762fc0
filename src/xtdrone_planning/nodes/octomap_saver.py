#!/usr/bin/env python3
"""Save the octree of a vehicle: ``octomap_saver.py [-f] FILE VEHICLE``, as octomap_server's program of this name.

FILE.bt has free and occupied space, FILE.ot (or ``-f``) log-odds; octomap's tools and octovis open both.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import rospy
from octomap_msgs.srv import GetOctomap

from xtdrone_common.programs.node_command_line import ArgumentError, run_program
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_planning.octree.octree_format import OctreeError, file_of
from xtdrone_planning.octree.octree_messages import octree_of

USAGE = "octomap_saver.py [-f] FILE VEHICLE   (FILE: .bt, or .ot)"
_PATIENCE = 10.0  # s


def main(arguments: Sequence[str]) -> None:
    """Save the map returned by the vehicle's octomap service."""
    full = "-f" in arguments
    words = [word for word in arguments if word != "-f"]
    if len(words) != 2 or Path(words[0]).suffix not in (".bt", ".ot"):
        raise ArgumentError("a .bt or .ot file and the name of a vehicle are needed")
    file, vehicle = Path(words[0]), words[1].strip("/")
    full |= file.suffix == ".ot"
    init_plain_node("octomap_saver", anonymous=True)
    service = f"/{vehicle}/octomap_{'full' if full else 'binary'}"
    try:
        rospy.wait_for_service(service, _PATIENCE)
    except rospy.ROSException as error:
        raise ArgumentError(f"{service}: no octomap_server.py offers this service") from error
    try:
        found = octree_of(rospy.ServiceProxy(service, GetOctomap)().map)
        file.write_bytes(file_of(found))
    except (rospy.ServiceException, OctreeError) as error:
        raise ArgumentError(f"{service}: {error}") from error
    except OSError as error:
        raise ArgumentError(f"{file}: the map was not saved: {error.strerror}") from error
    print(f"{file}: {len(found.data)} bytes, voxels of {found.resolution:g} m")


if __name__ == "__main__":
    sys.exit(run_program(main, sys.argv, USAGE))
