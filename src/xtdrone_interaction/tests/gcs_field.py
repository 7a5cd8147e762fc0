"""The autopilot's MAVLink servers over UDP while simulated time is paused, and links that lose datagrams."""

from __future__ import annotations

import random
import selectors
import socket
import threading

import numpy as np

from xtdrone_autopilot.autopilot import Autopilot
from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.control.control_allocator import RotorLayout
from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_common.fleet import Vehicle
from xtdrone_common.geodesy.projection import Datum
from xtdrone_interaction.gcs import Peer

FIRST = 200  # far from the ports of a running simulation, and of other tests
COUNT = 3
HOME = (47.397742, 8.545594)  # degrees
LAYOUT = RotorLayout(np.array([[0.2, 0.2, 0], [-0.2, -0.2, 0], [0.2, -0.2, 0], [-0.2, 0.2, 0]]),
                     np.array([0.05, 0.05, -0.05, -0.05]))  # fmt: skip


class Field:
    """Vehicles in paused time, with their MAVLink servers in a thread."""

    def __init__(self):
        self.vehicles = [Vehicle("typhoon_h480", i, FIRST + i) for i in range(COUNT)]
        autopilot = self.autopilot = Autopilot([LAYOUT] * COUNT, Datum(*HOME, 488.0))
        self.commanders = [
            Commander(vehicle, autopilot, Parameters({"MAV_SYS_ID": vehicle.system_id}), i)
            for i, vehicle in enumerate(self.vehicles)
        ]
        self.server = MavlinkServer(self.vehicles, autopilot, self.commanders)
        self.names = [vehicle.name for vehicle in self.vehicles]
        self.ports = {vehicle.name: vehicle.gcs_local_port for vehicle in self.vehicles}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while not self._ended.is_set():
            self.server.receive(0.01)
            self.server.keep_alive()

    def lists(self, index):
        return [len(items) for items in self.commanders[index].navigator.plans.items]

    def peers(self):
        return [Peer(v.name, v.system_id, "127.0.0.1", self.ports[v.name]) for v in self.vehicles]

    def close(self):
        self._ended.set()
        self._thread.join()
        self.server.close()


class LossyLine:
    """A UDP proxy before each port that loses datagrams in both directions."""

    def __init__(self, ports, loss, seed):
        self._random = random.Random(seed)
        self._loss = loss
        self.lost = 0
        self._selector = selectors.DefaultSelector()
        self.ports = {}
        self._clients = {}
        for name, port in ports.items():
            inner, outer = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
            inner.connect(("127.0.0.1", port))
            outer.bind(("127.0.0.1", 0))
            self.ports[name] = outer.getsockname()[1]
            self._selector.register(outer, selectors.EVENT_READ, (inner, None))
            self._selector.register(inner, selectors.EVENT_READ, (outer, outer))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while not self._ended.is_set():
            for key, _ in self._selector.select(0.01):
                target, outer = key.data
                datagram, sender = key.fileobj.recvfrom(65535)
                if outer is None:
                    self._clients[key.fileobj] = sender
                if self._random.random() < self._loss:
                    self.lost += 1
                elif outer is None:
                    target.send(datagram)
                else:
                    outer.sendto(datagram, self._clients[outer])

    def close(self):
        self._ended.set()
        self._thread.join()
        for key in list(self._selector.get_map().values()):
            key.fileobj.close()
        self._selector.close()
