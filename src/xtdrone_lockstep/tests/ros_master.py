"""A ROS master in the process of the test: it is there at once, and a test has its own for a few milliseconds."""

from __future__ import annotations

import threading
from typing import Any

try:
    from rosgraph.xmlrpc import ThreadingXMLRPCServer
    from rosmaster.master_api import ROSMasterHandler
except ImportError:
    pass  # callers skip their tests without ROS

_POLL = 0.02  # s in which the server notices its end


class RosMaster:
    """A running master.

    Not rosgraph's ``XmlRpcNode``: after its end, its thread polls the closed socket for ever, at full load.

    Attributes:
        uri: its address on this machine.
    """

    def __init__(self, handler: Any = None) -> None:
        """Start it; ``handler`` answers requests, by default as any master does."""
        self._handler = handler or ROSMasterHandler(3)
        self._server = ThreadingXMLRPCServer(("127.0.0.1", 0), 0)
        self.uri = f"http://127.0.0.1:{self._server.server_address[1]}"
        self._server.register_multicall_functions()
        self._server.register_instance(self._handler)
        self._handler._ready(self.uri)
        self._thread = threading.Thread(target=self._server.serve_forever, args=(_POLL,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it; ignored if it has ended."""
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
            self._server.server_close()
            self._handler._shutdown("the test is over")
