"""A ROS master for one test, and the processes that the test starts."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
import xmlrpc.client
from pathlib import Path

PATIENCE = 120.0  # s of wall time; bounds a broken run
ROSMASTER = shutil.which("rosmaster")


class Graph:
    """A ROS master for one test and the processes that it starts; the test plays the simulator."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            port = sock.getsockname()[1]
        uri = f"http://127.0.0.1:{port}"
        self.folder = folder
        self.env = {**os.environ, "ROS_MASTER_URI": uri, "ROS_HOSTNAME": "127.0.0.1", "ROS_HOME": str(folder)}
        self.processes: list[subprocess.Popen] = []
        self.start(str(ROSMASTER), "--core", "-p", str(port))
        self.master = xmlrpc.client.ServerProxy(uri)
        end = time.monotonic() + PATIENCE
        while not self._answers():
            assert time.monotonic() < end, "the master does not answer"
            time.sleep(0.02)

    def _answers(self) -> bool:
        try:
            return self.master.getPid("/test")[0] == 1
        except OSError:
            return False

    def start(self, *command: str) -> subprocess.Popen:
        with open(self.folder / "output", "a") as out:
            self.processes.append(subprocess.Popen(command, env=self.env, stdout=out, stderr=subprocess.STDOUT))
        return self.processes[-1]

    def run(self, *command: str) -> subprocess.CompletedProcess:
        return subprocess.run(command, env=self.env, capture_output=True, text=True, timeout=PATIENCE, check=False)

    def stop(self) -> None:
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.wait()
