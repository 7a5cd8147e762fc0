"""A ROS master for one test, and the processes that a test of a lockstep node starts."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from xtdrone_control.lockstep.server import LockstepServer

try:
    import xtdrone_msgs.msg
except ImportError:
    xtdrone_msgs = None

ROSMASTER = shutil.which("rosmaster")
PATIENCE = 120.0  # s of wall time for actions that take a few

needs_ros = pytest.mark.skipif(ROSMASTER is None or xtdrone_msgs is None, reason="needs ROS 1 and the built workspace")


class Graph:
    """A ROS master for one test, and the processes that the test starts."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            port = sock.getsockname()[1]
        self.folder = folder
        self.processes: dict[str, subprocess.Popen] = {}
        self.env = {
            **os.environ,
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_LOG_DIR": str(folder),
            "ROS_HOME": str(folder),
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        self.start("master", str(ROSMASTER), "--core", "-p", str(port))
        self.master = xmlrpc.client.ServerProxy(self.env["ROS_MASTER_URI"])
        wait_until(self._master_answers, "the master answers")

    def _master_answers(self) -> bool:
        try:
            return self.master.getPid("/test")[0] == 1
        except OSError:
            return False

    def set_param(self, name: str, value: object) -> None:
        self.master.setParam("/test", name, value)

    def start(self, name: str, *command: str, stdin: int | None = None) -> subprocess.Popen:
        with open(self.folder / f"{name}.out", "w") as out:
            self.processes[name] = subprocess.Popen(
                command, env=self.env, stdin=stdin, stdout=out, stderr=subprocess.STDOUT
            )
        return self.processes[name]

    def role(self, file: str, name: str, *arguments: str, stdin: int | None = None) -> subprocess.Popen:
        return self.start(name, sys.executable, file, name, *arguments, stdin=stdin)

    def output(self) -> str:
        return "\n".join(f"{path.name}: {path.read_text()[-1500:]}" for path in self.folder.glob("*.out"))

    def stop(self) -> None:
        for process in self.processes.values():
            process.kill()
        for process in self.processes.values():
            process.wait()


def wait_until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"in vain waited until {what}"
        time.sleep(0.02)


def running_graph(tmp_path: Path) -> Iterator[Graph]:
    """Yield a graph, which is stopped afterwards."""
    graph = Graph(tmp_path)
    yield graph
    graph.stop()


def running_server(graph: Graph) -> Iterator[LockstepServer]:
    """Yield a lockstep server for the nodes of the graph."""
    server = LockstepServer(hang_limit=PATIENCE)
    graph.set_param("/lockstep/uri", server.uri)
    graph.set_param("/xtdrone/world", "empty")
    yield server
    server.close()


def run_ticks(graph: Graph, server: LockstepServer, begin_us: int, end_us: int, participants: int) -> None:
    now: int | None = begin_us
    while now is not None and now < end_us:
        server.tick(now)
        assert len(server.participants) == participants, graph.output()
        now = server.next_due_us(now)


def wait_for_nodes(graph: Graph, server: LockstepServer, names: Sequence[str]) -> None:
    assert server.wait_for(names, timeout=PATIENCE), server.missing(names) + graph.output()


def read_notes(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()]
