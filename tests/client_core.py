"""The simulation core with its MAVLink server, without ROS; the tests with real clients connect to it.

``client_core.py COUNT FIRST SPEED [LOGS [TYPE [PORTS]]]``: COUNT vehicles of TYPE (iris) from global index FIRST on
(which fixes system ids and ports), at SPEED times real time (0: as fast as possible), flight logs below the folder
LOGS, offboard links on PORTS (xtdrone, px4).
Writes ``ready`` when it runs, and ends when its standard input does.
"""

from __future__ import annotations

import select
import sys
import time
from functools import partial
from pathlib import Path

from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_common.fleet import XTDRONE, Vehicle, with_ports
from xtdrone_sim.autopilots.builtin_autopilot import BuiltinAutopilot
from xtdrone_sim.runtime.requests.pacing import Pacer
from xtdrone_sim.simulation import Simulation

CHUNK_US = 8000  # simulated time between two polls of the sockets


def main(count: int, first: int, speed: float, logs: str = "", kind: str = "iris", ports: str = XTDRONE) -> None:
    """Run until standard input ends."""
    fleet = with_ports([Vehicle(kind, i, first + i) for i in range(count)], ports)
    simulation = Simulation(fleet, seed=1, autopilots=partial(BuiltinAutopilot, logs=Path(logs) if logs else None))
    server = MavlinkServer(fleet, simulation.autopilot, simulation.commanders)
    pacer = Pacer(speed)
    simulation.step()  # compiles missing kernels
    print("ready", flush=True)
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        until = simulation.time_us + CHUNK_US
        while simulation.time_us < until:
            simulation.step()
            if simulation.time_us >= server.next_due_us:
                server.send_streams(simulation.time_us)
        server.keep_alive()
        server.receive(0.0)
        while (delay := pacer.delay(simulation.time_us, time.monotonic())) > 0.0:
            server.receive(delay)
    server.close()
    simulation.close()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), *sys.argv[4:])
