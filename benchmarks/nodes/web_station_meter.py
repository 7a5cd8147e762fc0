#!/usr/bin/env python3
"""Node that measures the cost of the browser station for a formation flight, alternately with and without browsers.

A plain rospy node outside the lockstep, with the parameters, events and exit status of
``formation_speed_meter.py``; ``~plan`` has ``window`` (s of wall time), ``clients`` and ``rounds``. It writes
``window`` for each window: ``clients`` (0 or the plan's), ``real_time_factor``, ``station``, ``readers`` and ``flight``
(CPU s of the station, of the clients, and of all other programs of the launch but this one), ``programs`` (CPU s of
each of these), ``simulated`` and ``elapsed`` (s), ``others_cpu`` (cores); and after one with clients ``received``:
``clients``, ``frames`` and ``bytes`` of the fleet's frames, ``elapsed`` (s).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time

import rospy

from benchmarks.nodes.formation_speed_meter import SETTLING, ProbeError, SpeedProbe, run_probe
from benchmarks.process_use import CpuSample
from xtdrone_interaction.web.station_node import NAME, URL_PARAMETER

STATION = "web_station"  # its program
READERS = "benchmarks.nodes.web_clients"
_NOT_THE_FLIGHT = (STATION, READERS, "web_station_meter")


class Browsers:
    """A process of clients that read the station's frames."""

    def __init__(self, url: str, number: int) -> None:
        """Connect; returns when all receive frames."""
        command = [sys.executable, "-m", READERS, url, str(number)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        if self._process.stdout.readline().strip() != "reading":
            self._process.communicate()
            raise ProbeError(f"the station at {url} sends no frames")

    def end(self) -> dict[str, float]:
        """Disconnect, and return what was received since the start."""
        output, _ = self._process.communicate("")
        return dict(json.loads(output))


class WebProbe(SpeedProbe):
    """Measurement of one flight."""

    def _measure(self) -> None:
        self._await(self._flying)
        url = rospy.get_param(f"/{NAME}/{URL_PARAMETER.removeprefix('~')}", None)  # the station sets it when it listens
        if url is None:
            raise ProbeError("the station has not begun to listen")
        self._wait(SETTLING)
        for _ in range(int(self._plan["rounds"])):
            self._measure_without()
            self._measure_with(str(url), int(self._plan["clients"]))

    def _measure_without(self) -> None:
        self._wait(SETTLING)
        self._measure_station(0)

    def _measure_with(self, url: str, clients: int) -> None:
        browsers = Browsers(url, clients)
        try:
            self._measure_station(clients)
        finally:
            received = browsers.end()
        self._event("received", **received)

    def _measure_station(self, clients: int) -> None:
        """Measure a window.

        Raises:
            ProbeError: the flight ends, or simulated time does not advance.
        """
        root = os.getppid()  # roslaunch
        start, start_wall, cpu = rospy.get_time(), time.perf_counter(), CpuSample.take(root)
        self._wait(self._window)
        simulated, elapsed = rospy.get_time() - start, time.perf_counter() - start_wall
        use = CpuSample.take(root).since(cpu)
        if simulated <= 0.0:
            raise ProbeError(f"simulated time advanced by {simulated:.3f} s within {elapsed:.1f} s")
        if STATION not in use.programs:
            raise ProbeError(f"no {STATION} among the programs {', '.join(sorted(use.programs))}")
        self._event(
            "window",
            clients=clients,
            real_time_factor=simulated / elapsed,
            station=use.programs[STATION],
            readers=use.programs.get(READERS, 0.0),
            flight=sum(seconds for name, seconds in use.programs.items() if name not in _NOT_THE_FLIGHT),
            programs=use.programs,
            simulated=simulated,
            elapsed=elapsed,
            others_cpu=use.others / elapsed,
        )


if __name__ == "__main__":
    try:
        sys.exit(run_probe("web_station_meter", WebProbe))
    except rospy.ROSInterruptException:
        sys.exit(1)
