"""Strict lockstep between the simulator and ROS nodes.

A node uses this package in rospy's place: `init_node`, `Publisher`, `Subscriber`, `start`, `Rate`, `spin`. The
simulator's side is `xtdrone_control.lockstep.server.LockstepServer`, which imports no rospy; therefore the names below
are loaded only when they are used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .client import (
        Host,
        Publisher,
        Rate,
        Subscriber,
        UncountedPublisher,
        add_reset_hook,
        datagrams_sent,
        declare_udp,
        exit_status,
        host,
        init_node,
        is_active,
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
    "host",
    "init_node",
    "is_active",
    "needs_time",
    "sleep",
    "spin",
    "start",
]


def __getattr__(name: str) -> Any:
    """Loads the node's side, and rospy with it, at first use."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import client

    return getattr(client, name)
