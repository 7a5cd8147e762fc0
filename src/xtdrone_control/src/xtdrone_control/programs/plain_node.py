"""Nodes outside the lockstep."""

from __future__ import annotations

from typing import Any

import rospy

# Its import also keeps rospy from losing publishers that the master has named.
from xtdrone_control.lockstep.transport.rospy_internals import lengthen_connection_queue


def init_plain_node(name: str, **options: Any) -> None:
    """Initialise a node outside the lockstep, in place of ``rospy.init_node``.

    Args:
        name: Node name.
        options: Passed to ``rospy.init_node``.
    """
    rospy.init_node(name, **options)
    lengthen_connection_queue()
