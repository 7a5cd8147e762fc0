"""Processor time of telemetry: ``python -m benchmarks.programs.telemetry --vehicles 30``.

A fleet hovers, and clients listen on the offboard and the ground-station port of every vehicle. The program prints the
processor time of ``MavlinkServer.send_streams`` per second of simulated time at the default rates, with one or more
clients on the ground-station port; and the processor time of both ends for each received message: of the MAVROS layer
for telemetry, of the simulator for setpoints.
"""

from __future__ import annotations

import argparse
import cProfile
import math
import pstats
import socket
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_autopilot.autopilot import STEP_US, Autopilot
from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.control.control_allocator import RotorLayout
from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_autopilot.mavlink.udp_port_and_clients import LOOPBACK
from xtdrone_autopilot.mavlink.wire.codec import decoder
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.geodesy.projection import Datum
from xtdrone_mavros.link.autopilot_links import AutopilotLink, FcuUrl

_SPAN = 2_000_000  # us of simulated time between two heartbeats of the clients
_ARM = 0.2  # m, rotor arms along x and y
_ROUNDS = 500  # of received messages
_VELOCITY_ONLY = 0b0000110111000111  # POSITION_TARGET_TYPEMASK
_TELEMETRY = (
    mavlink.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
    mavlink.MAVLink_attitude_quaternion_message(1, 1.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
    mavlink.MAVLink_global_position_int_message(1, 2, 3, 4, 5, 6, 7, 8, 9),
    mavlink.MAVLink_highres_imu_message(1, *[0.1] * 13, 63),
    mavlink.MAVLink_local_position_ned_message(1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
)


@dataclass(frozen=True)
class Cost:
    """Result of a measurement.

    Attributes:
        share: processor seconds in ``send_streams`` a simulated second: the share of a core at real time.
        messages: messages sent a simulated second.
        microseconds: processor time a message.
        read: processor time of the MAVROS layer for a received message, us, until it is decoded.
        setpoint: processor time of the simulator for a received setpoint, us, until it is held for its tick.
    """

    share: float
    messages: float
    microseconds: float
    read: float
    setpoint: float


def _layout() -> RotorLayout:
    places = [(_ARM, _ARM), (-_ARM, -_ARM), (_ARM, -_ARM), (-_ARM, _ARM)]
    positions = np.array([(x, y, 0.0) for x, y in places])
    return RotorLayout(positions, np.array([0.06, 0.06, -0.06, -0.06]))


def _hover(autopilot: Autopilot, generator: np.random.Generator) -> None:
    """Fill the records with the values of a hovering fleet."""
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

    def exchange(self) -> None:
        """Send a heartbeat from every client, and read the messages it has received."""
        beat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mavlink.MAVLink(None, srcSystem=255))
        for client, port in self._clients:
            _drain(client)
            client.sendto(beat, (LOOPBACK, port))
        self.server.receive(1.0)
        _hover(self.autopilot, self._generator)

    def span(self) -> tuple[float, int]:
        """Advance by ``_SPAN``; return its processor time, s, and the number of messages sent."""
        before, spent = self._sent(), 0.0
        for _ in range(_SPAN // STEP_US):
            self.autopilot.time_us += STEP_US
            began = time.process_time()
            self.server.send_streams(self.autopilot.time_us)
            spent += time.process_time() - began
        return spent, self._sent() - before

    def setpoint_time(self) -> float:
        """Return the processor time, us, of a setpoint received from a lockstep participant."""
        ports = [port for port in self.server.ports if port.name.endswith("offboard link")]
        self.server.reserve({port.remote_port: [LOOPBACK] for port in ports})
        clients = {port: client for client, port in self._clients}
        spent = []
        for _ in range(_ROUNDS):
            self.autopilot.time_us += STEP_US
            self.server.hold_setpoints()
            for port in ports:
                clients[port.local_port].sendto(_setpoint(port.system_id), (LOOPBACK, port.local_port))
            began = time.process_time()
            self.server.receive()
            spent.append(time.process_time() - began)
            self.server.release_setpoints()
        return 1e6 * statistics.median(spent) / len(ports)

    def _sent(self) -> int:
        return sum(link.sent for port in self.server.ports for link in port.links)


def _setpoint(system: int) -> bytes:
    zeros = [0.0] * 8
    message = mavlink.MAVLink_set_position_target_local_ned_message(
        0, system, 1, 1, _VELOCITY_ONLY, 0.0, 0.0, 0.0, *zeros
    )
    return bytes(message.pack(mavlink.MAVLink(None, srcSystem=255)))


def read_time() -> float:
    """Return the processor time, us, in which a link of the MAVROS layer reads and decodes a telemetry message.

    Raises:
        LinkError: the link's port is taken.
    """
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    frames = [bytes(message.pack(packer)) for message in _TELEMETRY]
    decoders = {message.id: decoder(message.msgname) for message in _TELEMETRY}
    spent = []
    with (
        closing(AutopilotLink("iris_0", FcuUrl(LOOPBACK, 24540, LOOPBACK, 34580))) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot,
    ):
        link.wanted = frozenset(decoders)
        for _ in range(_ROUNDS):
            for frame in frames:
                autopilot.sendto(frame, (LOOPBACK, link.port))
            began = time.process_time()
            link.read()
            for number, frame in link.drain():
                decoders[number](frame)
            spent.append(time.process_time() - began)
    return 1e6 * statistics.median(spent) / len(frames)


def _drain(client: socket.socket) -> None:
    while True:
        try:
            client.recv(65535)
        except BlockingIOError:
            return


def measure(vehicles: int, stations: int, seconds: float, profile: Any = None) -> Cost:
    """Measure the processor time of ``send_streams`` and of received messages.

    Args:
        vehicles: number of vehicles, each with one client on its offboard port.
        stations: clients on the ground-station port of each.
        seconds: of simulated time.
        profile: a ``cProfile.Profile`` of the measured part.

    Raises:
        LinkError: a port is taken, as by a running simulation.
    """
    spent, messages = 0.0, 0
    spans = max(math.ceil(seconds * 1e6 / _SPAN), 1)
    with ExitStack() as stack:
        bench = _Bench(vehicles, stations, stack)
        bench.exchange()
        bench.span()  # the first message of each kind costs more
        for _ in range(spans):
            bench.exchange()
            if profile is not None:
                profile.enable()
            cpu, sent = bench.span()
            if profile is not None:
                profile.disable()
            spent, messages = spent + cpu, messages + sent
        setpoint = bench.setpoint_time()
    simulated = spans * _SPAN * 1e-6
    return Cost(spent / simulated, messages / simulated, 1e6 * spent / messages, read_time(), setpoint)


COLUMNS = (
    Column("vehicles", "{vehicles}"),
    Column("stations each", "{stations}"),
    Column("messages/s", "{messages:.0f}"),
    Column("us/message", "{microseconds:.2f}"),
    Column("share of a core", "{share:.3f}"),
    Column("us/received", "{read:.2f}"),
    Column("us/setpoint", "{setpoint:.2f}"),
)


def main() -> int:
    """Measure the fleet sizes of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0].split(":")[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 9, 30], help="fleet sizes, 1 to 250")
    parser.add_argument("--stations", type=int, nargs="+", default=[1, 4], help="ground stations per vehicle, 0 to 15")
    parser.add_argument("--seconds", type=float, default=10.0, help="simulated time of one measurement, s")
    parser.add_argument("--profile", action="store_true", help="print where the time is spent")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    for vehicles in arguments.vehicles:
        parse_fleet(f"iris:{vehicles}")
    for vehicles in arguments.vehicles:
        for stations in arguments.stations:
            profile = cProfile.Profile() if arguments.profile else None
            cost = measure(vehicles, stations, arguments.seconds, profile)
            yield {"vehicles": vehicles, "stations": stations, **asdict(cost)}
            if profile is not None:
                pstats.Stats(profile).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    sys.exit(main())
