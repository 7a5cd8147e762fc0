"""A ROS master and nodes in lockstep with a test that acts as the simulator."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable
from pathlib import Path

from ros_master import RosMaster

from xtdrone_lockstep.server import LockstepServer

PATIENCE = 120.0  # s of wall time


class Stack:
    """A master, the lockstep server, and the nodes started by a test.

    Attributes:
        record: output file of a recording node, one JSON line per message.
    """

    def __init__(self, folder: Path) -> None:
        self._ros_master = RosMaster()
        self.folder = folder
        self.record = folder / "record"
        self.processes: dict[str, subprocess.Popen] = {}
        paths = [str(Path(__file__).parent), *(path for path in sys.path if path)]
        self.environment = {
            **os.environ,
            "ROS_MASTER_URI": self._ros_master.uri,
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_LOG_DIR": str(folder),
            "PYTHONPATH": os.pathsep.join(paths),
        }
        self.master = xmlrpc.client.ServerProxy(self._ros_master.uri)
        self.server = LockstepServer(hang_limit=PATIENCE)
        self.set("/lockstep/uri", self.server.uri)

    def set(self, name: str, value: object) -> None:
        self.master.setParam("/test", name, value)

    def start(self, name: str, *command: str) -> subprocess.Popen:
        with open(self.folder / f"{name}.out", "w") as out:
            self.processes[name] = subprocess.Popen(
                command, env=self.environment, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT
            )
        return self.processes[name]

    def output(self, name: str) -> str:
        return (self.folder / f"{name}.out").read_text()

    def lines(self) -> list[dict]:
        return [json.loads(line) for line in self.record.read_text().splitlines()]

    def wait_for(self, *names: str) -> None:
        """Wait until nodes have joined the lockstep."""
        assert self.server.wait_for(names, timeout=PATIENCE), (self.server.missing(names), self.outputs())

    def outputs(self) -> dict[str, str]:
        return {name: self.output(name)[-2000:] for name in self.processes}

    def run(self, until: float) -> None:
        """Advance simulated time."""
        now: int | None = self.server.next_due_us(-1)
        while now is not None and now < until * 1e6:
            self.server.tick(now)
            now = self.server.next_due_us(now)
        assert now is not None, self.outputs()

    def end(self, name: str) -> None:
        """End the simulation and check that a node ends without error."""
        self.server.close()
        assert self.processes[name].wait(PATIENCE) == 0, self.outputs()
        assert "Traceback" not in self.output(name)

    def stop(self) -> None:
        self.server.close()
        for process in self.processes.values():
            process.kill()
            process.wait()
        self._ros_master.close()


def wait_until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"timed out waiting until {what}"
        time.sleep(0.02)
