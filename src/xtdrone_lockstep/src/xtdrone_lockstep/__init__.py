"""Strict lockstep between the simulator and ROS nodes.

A node uses this package in place of rospy: ``init_node``, ``Publisher``, ``Subscriber``, ``start``, ``Rate``, ``spin``.
The simulator uses ``xtdrone_lockstep.server.LockstepServer``, which does not depend on rospy; therefore the
names below are loaded on first use.

``client`` is the node's side, ``server`` the simulator's, ``protocol`` the frames between them, and ``transport`` the
topic connections of rospy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .client.api import (
        Host,
        Publisher,
        Rate,
        Subscriber,
        UncountedPublisher,
        add_reset_hook,
        datagrams_sent,
        declare_udp,
        exit_status,
        future_name,
        host,
        init_node,
        is_active,
        needs_time,
        registering_together,
        sleep,
        spin,
        start,
    )

__all__ = [
    "Host",
    "Publisher",
    "Rate",
    "Subscriber",
    "UncountedPublisher",
    "add_reset_hook",
    "datagrams_sent",
    "declare_udp",
    "exit_status",
    "future_name",
    "host",
    "init_node",
    "is_active",
    "needs_time",
    "registering_together",
    "sleep",
    "spin",
    "start",
]


def __getattr__(name: str) -> Any:
    """Load the node's side, and rospy with it, on first use."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .client import api

    return getattr(api, name)
