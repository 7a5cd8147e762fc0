"""A ROS master for one test, and the processes that the test starts."""

from __future__ import annotations

import os
import subprocess
import sys
import xmlrpc.client
from pathlib import Path

from ros_master import RosMaster

PATIENCE = 120.0  # s of wall time; bounds a broken run


class Graph:
    """A ROS master for one test and the processes that it starts; the test plays the simulator."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ros_master = RosMaster()
        self.env = {
            **os.environ,
            "ROS_MASTER_URI": self.ros_master.uri,
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_HOME": str(folder),
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        self.processes: list[subprocess.Popen] = []
        self.master = xmlrpc.client.ServerProxy(self.ros_master.uri)

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
        self.ros_master.close()
