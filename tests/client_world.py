"""Shared by the tests with real clients: the simulation core in its own process, and its ports."""

from __future__ import annotations

import select
import socket
import subprocess
import sys
from pathlib import Path

from xtdrone_common.fleet import XTDRONE, Vehicle

CORE = Path(__file__).with_name("client_core.py")
START_LIMIT = 180.0  # s of wall time for the core to start: it may have to compile its kernels
CLIENT_LIMIT = 120.0  # s of wall time for a client's action; simulated time runs several times as fast


class Core:
    """A running simulation.

    Attributes:
        vehicles: the vehicles and their ports.
        logs: folder with flight logs.
    """

    def __init__(
        self,
        first: int,
        logs: Path,
        count: int = 1,
        speed: float = 5.0,
        kind: str = "iris",
        ports: str = XTDRONE,
    ) -> None:
        """Start it and wait until it runs.

        Args:
            first: the first vehicle's global index, which fixes ports; each test file uses others.
            logs: folder for flight logs.
            count: number of vehicles.
            speed: simulated seconds a second of wall time.
            kind: vehicle type.
            ports: of the offboard links.
        """
        self.vehicles = [Vehicle(kind, i, first + i, ports=ports) for i in range(count)]
        self.logs = logs
        self._output = logs / "core.log"
        with self._output.open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, str(CORE), str(count), str(first), str(speed), str(logs), kind, ports],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=output,
            )
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], START_LIMIT)
        line = self._process.stdout.readline() if ready else b"nothing in time"
        while line and b"ready" not in line:  # pybullet prints its build time
            line = self._process.stdout.readline()
        assert b"ready" in line, (line, self._output.read_text())

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        assert self._process.wait(CLIENT_LIMIT) == 0, self._output.read_text()


def free_port() -> int:
    """Return an unused TCP port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
