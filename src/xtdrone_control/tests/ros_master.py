"""A ROS master in the process of the test: it is there at once, and a test has its own for a few milliseconds."""

from __future__ import annotations

import time
from typing import Any

try:
    import rosgraph.xmlrpc
    import rosmaster.master_api
except ImportError:
    pass  # callers skip their tests without ROS


class RosMaster:
    """A running master.

    Attributes:
        uri: its address on this machine.
    """

    def __init__(self, handler: Any = None) -> None:
        """Start it; ``handler`` answers requests, by default as any master does."""
        self._server = rosgraph.xmlrpc.XmlRpcNode(0, handler or rosmaster.master_api.ROSMasterHandler(3))
        self._server.start()
        while not self._server.uri:
            time.sleep(0.001)
        self.uri = f"http://127.0.0.1:{self._server.port}"

    def close(self) -> None:
        """End it; ignored if it has ended."""
        self._server.shutdown("the test is over")
