"""Names of nodes that have not registered yet."""

from __future__ import annotations

import sys

import rosgraph.names


def future_name(name: str, argv: list[str] | None = None) -> str:
    """Returns the resolved name that `rospy.init_node` will give this node.

    Args:
        name: As given to `rospy.init_node`.
        argv: The command line with its remappings; `sys.argv` if None.
    """
    mappings = rosgraph.names.load_mappings(sys.argv if argv is None else argv)
    namespace = mappings.get("__ns") or rosgraph.names.get_ros_namespace()
    return rosgraph.names.ns_join(rosgraph.names.make_global_ns(namespace), mappings.get("__name") or name)
