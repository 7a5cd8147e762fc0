"""Ends a node when its main thread is ready for it.

rospy's own signal handler takes the node's topics back at once, on top of whatever the main thread does. If that was a
log call, which asks the master for a parameter, the handler waits for ever for the lock of the master's proxy.
"""

from __future__ import annotations

import signal
from typing import Any

import rospy


class Stop:
    """Notes that the node is to end. Its ``init_node`` needs ``disable_signals=True``."""

    def __init__(self) -> None:
        """Listen to SIGINT and SIGTERM."""
        self._signalled = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def requested(self) -> bool:
        """Say whether a signal has come or ROS shuts down."""
        return self._signalled or rospy.is_shutdown()

    def _note(self, *_: Any) -> None:
        self._signalled = True
