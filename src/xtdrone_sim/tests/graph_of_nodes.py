"""A ROS master for one test, and the processes that a test of a lockstep node starts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from ros_master import RosMaster

from xtdrone_lockstep.server import LockstepServer

try:
    import xtdrone_msgs.msg
except ImportError:
    xtdrone_msgs = None

PATIENCE = 120.0  # s of wall time for actions that take a few

needs_ros = pytest.mark.skipif(xtdrone_msgs is None, reason="needs ROS 1 and the built workspace")


class Graph:
    """A ROS master for one test, and the processes that the test starts."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen] = {}
        self.ros_master = RosMaster()
        self.env = {
            **os.environ,
            "ROS_MASTER_URI": self.ros_master.uri,
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_LOG_DIR": str(folder),
            "ROS_HOME": str(folder),
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        self.master = xmlrpc.client.ServerProxy(self.ros_master.uri)

    def set_param(self, name: str, value: object) -> None:
        self.master.setParam("/test", name, value)

    def start(self, name: str, *command: str, stdin: int | None = None) -> subprocess.Popen:
        with open(self.folder / f"{name}.out", "w") as out:
            self.processes[name] = subprocess.Popen(
                command, env=self.env, stdin=stdin, stdout=out, stderr=subprocess.STDOUT
            )
        return self.processes[name]

    def role(self, file: str, name: str, *arguments: str, stdin: int | None = None) -> subprocess.Popen:
        """Run a test file as a node."""
        return self.start(name, sys.executable, file, name, *arguments, stdin=stdin)

    def output(self) -> str:
        return "\n".join(f"{path.name}: {path.read_text()[-1500:]}" for path in self.folder.glob("*.out"))

    def stop(self) -> None:
        for process in self.processes.values():
            process.kill()
        for process in self.processes.values():
            process.wait()
        self.ros_master.close()


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
