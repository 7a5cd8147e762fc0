"""A ROS master and nodes in lockstep with a test that acts as the simulator."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable
from pathlib import Path

from xtdrone_control.lockstep.server import LockstepServer

ROSMASTER = shutil.which("rosmaster")
PATIENCE = 120.0  # s of wall time


class Stack:
    """A master, the lockstep server, and the nodes started by a test.

    Attributes:
        record: output file of a recording node, one JSON line per message.
    """

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.folder = folder
        self.record = folder / "record"
        self.processes: dict[str, subprocess.Popen] = {}
        paths = [str(Path(__file__).parent), *(path for path in sys.path if path)]
        self.environment = {
            **os.environ,
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_LOG_DIR": str(folder),
            "PYTHONPATH": os.pathsep.join(paths),
        }
        self.start("master", str(ROSMASTER), "--core", "-p", str(port))
        self.master = xmlrpc.client.ServerProxy(self.environment["ROS_MASTER_URI"])
        wait_until(self._answers, "the master answers")
        self.server = LockstepServer(hang_limit=PATIENCE)
        self.set("/lockstep/uri", self.server.uri)

    def _answers(self) -> bool:
        try:
            return self.master.getPid("/test")[0] == 1
        except OSError:
            return False

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


def wait_until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"timed out waiting until {what}"
        time.sleep(0.02)
