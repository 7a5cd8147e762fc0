"""Nodes under roslaunch: log lines on its terminal, and a normal shutdown of the whole launch."""

from __future__ import annotations

import contextlib
import http.client
import os
import re
import signal
import socket
import stat
import sys
import xml.parsers.expat
import xmlrpc.client
from typing import Any
from urllib.parse import urlparse

import rosgraph
import rosgraph.network
import rospy

_LIMIT = 2.0  # s for roslaunch to respond
_NUMBER = re.compile(r"-\d+$")  # roslaunch's process is "iris_0/mavros-2"
_NO_XMLRPC = (xmlrpc.client.Error, http.client.HTTPException, xml.parsers.expat.ExpatError)


def announce(text: str) -> None:
    """Log a text at INFO, and also print it on roslaunch's terminal, which shows only the warnings of most nodes."""
    rospy.loginfo("%s", text)
    if stat.S_ISREG(os.fstat(1).st_mode) and not os.path.sameopenfile(1, 2):  # output="log"
        print(text, file=sys.stderr, flush=True)


def end_launch() -> None:
    """Interrupt the roslaunch that has started this node as a required one, as Ctrl-C does.

    roslaunch reports the end of a required node as an error, in red, even if the node has finished.
    """
    for uri in _launch_uris():
        pid = _requiring(uri)
        if pid:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGINT)
            return


def _launch_uris() -> list[str]:
    """Return the addresses of the launches on this master that run on this machine."""
    try:
        uris = rosgraph.Master(rospy.get_name()).getParam("/roslaunch/uris")
    except (rosgraph.MasterException, OSError):
        return []
    here = {"localhost", "127.0.0.1", socket.gethostname(), rosgraph.network.get_local_address()}
    return [uri for uri in uris.values() if urlparse(uri).hostname in here] if isinstance(uris, dict) else []


class _Timed(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = _LIMIT
        return connection


def _requiring(uri: str) -> int:
    """Return the process id of the roslaunch at ``uri`` if this node is one of its required nodes, else 0."""
    launch: Any = xmlrpc.client.ServerProxy(uri, transport=_Timed())
    own = rospy.get_name().strip("/")
    try:
        _, _, (active, _) = launch.list_processes()
        names = [name for name, _ in active if _NUMBER.sub("", name) == own]
        required = any(launch.process_info(name)[2].get("required") for name in names)
        return int(launch.get_pid()[2]) if required else 0
    except (OSError, ValueError, TypeError, AttributeError, *_NO_XMLRPC):
        return 0
