"""Start roslaunch with the zygote of its nodes, which imports their modules while roslaunch reads its files."""

from __future__ import annotations

import os

_MODULES = (
    "xtdrone_sim.runtime.full_simulation",
    "xtdrone_control.mavros.mavros_node",
    "xtdrone_control.communication.multirotor",
    "xtdrone_coordination.follower",
)
"""Imported in this order as long as no node waits; those that the simulation waits for come first."""


def roslaunch_words(program: str) -> list[str]:
    """Return the first words of a command line of roslaunch.

    Args:
        program: path of roslaunch. Without the launcher of a built workspace it is started directly.
    """
    launcher = os.environ.get("XTDRONE_NODE_LAUNCHER", "")
    if not os.access(launcher, os.X_OK):
        return [program]
    return [launcher, "--ahead", ",".join(_MODULES), program]
