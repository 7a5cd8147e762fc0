"""Nodes of a test file as forks of a process that has imported the file, which takes 0.6 s of processor time.

A node is a child of the test's process, as one started by ``subprocess``. Run as a program, this file is the process
that forks: ``forked_nodes.py FILE DESCRIPTOR`` serves requests of the socket DESCRIPTOR until its other end is closed.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

_PR_SET_CHILD_SUBREAPER = 36  # <linux/prctl.h>
_MOST = 1 << 17  # bytes of a request


class ForkedNode:
    """A running node.

    Attributes:
        pid: its process id.
        stdin: the other end of its standard input, if requested.
        returncode: as that of ``subprocess.Popen``.
    """

    def __init__(self, pid: int, stdin: IO[bytes] | None) -> None:
        self.pid = pid
        self.stdin = stdin
        self.returncode: int | None = None
        self._end = os.pidfd_open(pid)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the node's end and return its exit status; ``subprocess.TimeoutExpired`` after ``timeout`` s."""
        if self.returncode is None:
            if not select.select([self._end], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(f"node {self.pid}", timeout or 0.0)
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
            os.close(self._end)
        return self.returncode

    def poll(self) -> int | None:
        """Return the exit status, None while the node runs."""
        try:
            return self.wait(0.0)
        except subprocess.TimeoutExpired:
            return None

    def send_signal(self, number: int) -> None:
        """Send a signal; ignored if the node has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


def fork_node(
    file: str, arguments: Sequence[str], environment: Mapping[str, str], output: IO[Any], stdin: int | None = None
) -> ForkedNode:
    """Run ``main()`` of a test file in a process of its own.

    Args:
        file: the test file.
        arguments: of the command line.
        environment: all variables.
        output: standard output and error.
        stdin: ``subprocess.PIPE``, or None for none.
    """
    read, write = os.pipe()
    request = json.dumps([list(arguments), dict(environment)]).encode()
    _adopt_orphans(True)  # the node's parent ends at once
    try:
        link = _forking_process(file)
        socket.send_fds(link, [request], [read, output.fileno()])
        pid = int(link.recv(_MOST))
    finally:
        _adopt_orphans(False)
        os.close(read)
    pipe = os.fdopen(write, "wb")
    if stdin is None:
        pipe.close()
    return ForkedNode(pid, None if stdin is None else pipe)


def _adopt_orphans(value: bool) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(value), 0, 0, 0)


@functools.cache
def _forking_process(file: str) -> socket.socket:
    """Start the process for a file, and return its socket."""
    own, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, __file__, file, str(its.fileno())]
    subprocess.Popen(command, pass_fds=[its.fileno()], env=environment)
    its.close()
    return own


def _serve(link: socket.socket) -> list[str] | None:
    """Fork a node for each request; return its arguments in the node, None at the end."""
    while True:
        request, descriptors, _, _ = socket.recv_fds(link, _MOST, 2)
        if not request:
            return None
        read, write = os.pipe()
        if (child := os.fork()) == 0:
            if (node := os.fork()) == 0:
                for descriptor in (read, write):
                    os.close(descriptor)
                return _become_node(link, request, descriptors)
            os.write(write, str(node).encode())
            os._exit(0)
        os.waitpid(child, 0)
        link.send(os.read(read, 20))
        for descriptor in (read, write, *descriptors):
            os.close(descriptor)


def _become_node(link: socket.socket, request: bytes, descriptors: Sequence[int]) -> list[str]:
    link.close()
    stdin, output = descriptors
    for descriptor, number in ((stdin, 0), (output, 1), (output, 2)):
        os.dup2(descriptor, number)
    for descriptor in descriptors:
        os.close(descriptor)
    arguments, environment = json.loads(request)
    os.environ.clear()
    os.environ.update(environment)
    return list(arguments)


def main() -> None:
    """Import the file and serve."""
    file, descriptor = Path(sys.argv[1]), int(sys.argv[2])
    sys.path.insert(0, str(file.parent))
    module = importlib.import_module(file.stem)
    arguments = _serve(socket.socket(fileno=descriptor))
    if arguments is not None:
        sys.argv = [str(file), *arguments]
        module.main()


if __name__ == "__main__":
    main()
