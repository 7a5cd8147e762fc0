"""Signal handling that ends a node only when its main thread is ready.

rospy's own handler unregisters the node's topics within the signal, interrupting the main thread. If that was inside a
log call, which reads a parameter from the master, the handler deadlocks on the lock of the master's proxy.
"""

from __future__ import annotations

import signal
from typing import Any

import rospy


class Stop:
    """Records requests to shut down. The node's ``init_node`` needs ``disable_signals=True``."""

    def __init__(self) -> None:
        """Install the handler of SIGINT and SIGTERM."""
        self._signalled = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def requested(self) -> bool:
        """Return whether a signal has arrived or ROS is shutting down."""
        return self._signalled or rospy.is_shutdown()

    def _note(self, *_: Any) -> None:
        self._signalled = True
