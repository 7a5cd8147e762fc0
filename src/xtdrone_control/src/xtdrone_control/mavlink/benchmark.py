"""What telemetry costs: ``python -m xtdrone_control.mavlink.benchmark --vehicles 30``.

A fleet stands in the air, and a client listens on the offboard and on the ground-station port of every vehicle. Printed
is the processor time that ``MavlinkServer.send_streams`` takes for a second of simulated time at the default rates, and
at the default rates with further clients on the ground-station port.
"""

from __future__ import annotations

import argparse
import cProfile
import math
import pstats
import socket
import time
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.autopilot import STEP_US, Autopilot, RotorLayout
from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.autopilot.parameters.parameters import Parameters
from xtdrone_control.fleet import FleetError, parse_fleet
from xtdrone_control.geodesy.datum import Datum

from .port import LOOPBACK
from .server import MavlinkServer

_SPAN = 2_000_000  # us of simulated time between two heartbeats of the clients
_ARM = 0.2  # m, rotor arms along x and y


@dataclass(frozen=True)
class Cost:
    """What was measured.

    Attributes:
        share: processor seconds in ``send_streams`` a simulated second: the share of a core at real time.
        messages: messages sent a simulated second.
        microseconds: processor time a message.
    """

    share: float
    messages: float
    microseconds: float


def _layout() -> RotorLayout:
    places = [(_ARM, _ARM), (-_ARM, -_ARM), (_ARM, -_ARM), (-_ARM, _ARM)]
    positions = np.array([(x, y, 0.0) for x, y in places])
    return RotorLayout(positions, np.array([0.06, 0.06, -0.06, -0.06]))


def _hover(autopilot: Autopilot, generator: np.random.Generator) -> None:
    """Fill the records with what a hovering fleet's would hold."""
    e, s, c = autopilot.estimator, autopilot.sensors, autopilot.control
    count = len(e)
    for field in ("initialised", "position_valid", "altitude_valid"):
        e[field] = 1
    yaw = generator.uniform(-math.pi, math.pi, count)
    e["q"][:, 0], e["q"][:, 3] = np.cos(yaw / 2), np.sin(yaw / 2)
    e["position"] = generator.normal(0.0, 20.0, (count, 3)) - (0.0, 0.0, 50.0)
    e["velocity"] = generator.normal(0.0, 0.1, (count, 3))
    e["rates"] = generator.normal(0.0, 0.01, (count, 3))
    e["P"] = 0.01 * np.eye(e["P"].shape[1])
    s["gps_fix"], s["gps_satellites"] = 3, 10
    s["gps_lat"], s["gps_lon"], s["gps_alt"] = 47.397742, 8.545594, 538.0
    s["accel"] = generator.normal(0.0, 0.1, (count, 3)) - (0.0, 0.0, 9.81)
    s["gyro"] = e["rates"]
    c["sp_q"] = e["q"]
    c["sp_position"] = e["position"]
    c["sp_thrust"] = 0.6
    c["actuators"][:, :4] = 0.6


class _Bench:
    """A fleet with its clients."""

    def __init__(self, vehicles: int, stations: int, stack: ExitStack) -> None:
        fleet = parse_fleet(f"iris:{vehicles}")
        parameters = [Parameters({"MAV_SYS_ID": vehicle.system_id}) for vehicle in fleet]
        self.autopilot = Autopilot([_layout()] * vehicles, Datum(47.397742, 8.545594, 488.0))
        self._generator = np.random.default_rng(0)
        _hover(self.autopilot, self._generator)
        commanders = [
            Commander(v, self.autopilot, p, i) for i, (v, p) in enumerate(zip(fleet, parameters, strict=True))
        ]
        for commander in commanders:
            commander.update()
        self.server = MavlinkServer(fleet, self.autopilot, commanders)
        stack.callback(self.server.close)
        self._clients: list[tuple[socket.socket, int]] = []
        for vehicle in fleet:
            self._join(vehicle.offboard_remote_port, vehicle.offboard_local_port, stack)
            for _ in range(stations):
                self._join(0, vehicle.gcs_local_port, stack)

    def _join(self, own: int, port: int, stack: ExitStack) -> None:
        client = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        client.bind((LOOPBACK, own))
        client.setblocking(False)
        self._clients.append((client, port))

    def speak(self) -> None:
        """Let every client send a heartbeat, and read what it has been sent."""
        beat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mavlink.MAVLink(None, srcSystem=255))
        for client, port in self._clients:
            _drain(client)
            client.sendto(beat, (LOOPBACK, port))
        self.server.receive(1.0)
        _hover(self.autopilot, self._generator)

    def span(self) -> tuple[float, int]:
        """Let ``_SPAN`` pass; return the processor time of it, s, and how many messages were sent."""
        before, spent = self._sent(), 0.0
        for _ in range(_SPAN // STEP_US):
            self.autopilot.time_us += STEP_US
            began = time.process_time()
            self.server.send_streams(self.autopilot.time_us)
            spent += time.process_time() - began
        return spent, self._sent() - before

    def _sent(self) -> int:
        return sum(link.sent for port in self.server.ports for link in port.links)


def _drain(client: socket.socket) -> None:
    while True:
        try:
            client.recv(65535)
        except BlockingIOError:
            return


def measure(vehicles: int, stations: int, seconds: float, profile: Any = None) -> Cost:
    """Return what ``send_streams`` costs.

    Args:
        vehicles: how many fly, each with one client on its offboard port.
        stations: clients on the ground-station port of each.
        seconds: of simulated time.
        profile: a ``cProfile.Profile`` that is to see what is measured.

    Raises:
        LinkError: a port is taken, as by a running simulation.
    """
    spent, messages = 0.0, 0
    spans = max(math.ceil(seconds * 1e6 / _SPAN), 1)
    with ExitStack() as stack:
        bench = _Bench(vehicles, stations, stack)
        bench.speak()
        bench.span()  # the first of each message costs more
        for _ in range(spans):
            bench.speak()
            if profile is not None:
                profile.enable()
            cpu, sent = bench.span()
            if profile is not None:
                profile.disable()
            spent, messages = spent + cpu, messages + sent
    simulated = spans * _SPAN * 1e-6
    return Cost(spent / simulated, messages / simulated, 1e6 * spent / messages)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="What telemetry costs.")
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 9, 30], help="fleet sizes, 1 to 250")
    parser.add_argument("--stations", type=int, nargs="+", default=[1, 4], help="ground stations a vehicle, 0 to 15")
    parser.add_argument("--seconds", type=float, default=10.0, help="simulated time of one measurement, s")
    parser.add_argument("--profile", action="store_true", help="say where the time goes")
    arguments = parser.parse_args()
    try:
        for vehicles in arguments.vehicles:
            parse_fleet(f"iris:{vehicles}")
    except FleetError as error:
        parser.error(str(error))
    print(f"{'vehicles':>8} {'stations each':>13} {'messages/s':>11} {'us/message':>11} {'share of a core':>16}")
    for vehicles in arguments.vehicles:
        for stations in arguments.stations:
            profile = cProfile.Profile() if arguments.profile else None
            cost = measure(vehicles, stations, arguments.seconds, profile)
            print(
                f"{vehicles:8d} {stations:13d} {cost.messages:11.0f} {cost.microseconds:11.2f} {cost.share:16.3f}",
                flush=True,
            )
            if profile is not None:
                pstats.Stats(profile).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    main()
