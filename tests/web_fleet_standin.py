"""The station's server with vehicles that fly circles by a formula: the page with a hundred, without their simulation.

Server, page, shapes and frames are the station's own; only the vehicles' positions are not simulated.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tornado.ioloop import IOLoop, PeriodicCallback

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.web.fleet.fleet_frame import CHANNEL, pack_fleet_frame
from xtdrone_interaction.web.fleet.model_states_bytes import COLUMNS
from xtdrone_interaction.web.fleet.shapes_for_page import ShapeStore, describe_vehicle
from xtdrone_interaction.web.server.credentials import Credentials
from xtdrone_interaction.web.server.methods import Method, Params
from xtdrone_interaction.web.server.session import Session
from xtdrone_interaction.web.server.station_server import Address, StationServer
from xtdrone_interaction.web.station_node import PAGE
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.worlds.sdf import load_world_file

_RATE = 10.0  # Hz
_SPACING = 3.0  # m between vehicles
_CIRCLE = 1.0  # m
_TURN = 0.8  # rad/s
_STATUS = {"mode": "OFFBOARD", "armed": True, "link": True, "battery": 0.9, "estimator": [], "findings": []}


def circling(count: int, time: float) -> NDArray[np.float64]:
    """Return rows of a fleet's frame at a time, s: vehicles of a square pattern, each on a circle of 1 m."""
    side = int(np.ceil(count**0.5))
    number = np.arange(count)
    rows = np.zeros((count, COLUMNS))
    angle = _TURN * time + number
    rows[:, 0] = _SPACING * (number % side) + _CIRCLE * np.cos(angle)
    rows[:, 1] = _SPACING * (number // side) + _CIRCLE * np.sin(angle)
    rows[:, 2] = 4.0 + 0.5 * np.sin(angle)
    rows[:, 3], rows[:, 6] = np.cos(0.5 * angle), np.sin(0.5 * angle)
    return rows


class FleetStandIn:
    """Serves the page.

    Attributes:
        names: of the vehicles.
        url: of the page.
        still: whether the frames have ended, as when time is paused.
    """

    def __init__(self, fleet: str, world: str) -> None:
        self._fleet = parse_fleet(fleet)
        self._store = ShapeStore()
        self._models = [
            {
                "name": model.name,
                "pose": [*model.pose.position, *model.pose.orientation],
                "shapes": [self._store.describe(v, link.pose) for link in model.links for v in link.visuals],
            }
            for model in load_world_file(world).models
        ]
        self.names = [vehicle.name for vehicle in self._fleet]
        self.url = ""
        self.still = False
        self._time = 0.0
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stand-in", daemon=True)

    def start(self) -> None:
        """Serve in a thread."""
        self._thread.start()
        assert self._ready.wait(60.0)

    def stop(self) -> None:
        """End the serving."""
        self._loop.add_callback(self._loop.stop)
        self._thread.join(60.0)

    def _run(self) -> None:
        asyncio.set_event_loop(asyncio.new_event_loop())
        self._loop = IOLoop.current()
        self._server = StationServer(Address("127.0.0.1", 0, Credentials()), PAGE, self._methods())
        port = self._server.start()
        self.url = self._server.address.urls(port)["operate"]
        timer = PeriodicCallback(self._send, 1000.0 / _RATE)
        timer.start()
        self._ready.set()
        self._loop.start()
        timer.stop()
        self._server.stop()

    def _methods(self) -> list[Method]:
        roster = {
            "version": 1,
            "vehicles": [{"name": v.name, "type": v.type, "model": v.model} for v in self._fleet],
            "movers": [],
            "places": {},
        }
        world = {"name": "stand-in", "models": self._models, "people": [], "trouble": ""}
        offsets = (circling(len(self.names), 0.0)[1:, :3] - circling(len(self.names), 0.0)[0, :3]).tolist()
        links = [[0, number] for number in range(1, len(self.names))]
        answers: dict[str, Any] = {
            "fleet.roster": roster,
            "world.describe": world,
            "fleet.formation": {"offsets": offsets, "links": links},
            "layers.list": {"layers": []},
            "time.status": None,
            "swarm.patterns": {},
        }
        plain = [Method(name, _answering(value)) for name, value in answers.items()]
        return [
            *plain,
            Method("world.vehicle", lambda _s, params: describe_vehicle(load_vehicle(params["model"]), self._store)),
            Method("world.mesh", lambda _s, params: self._store.mesh(params["number"])),
            Method("world.texture", lambda _s, params: self._store.texture(params["number"])),
        ]

    def _send(self) -> None:
        if self.still:
            return
        self._time += 1.0 / _RATE
        number = round(self._time * _RATE)
        frame = pack_fleet_frame(circling(len(self.names), self._time), np.empty((0, COLUMNS)), self._time, 1, number)
        for session in list(self._server.sessions.values()):
            session.push_latest(CHANNEL, frame)
            if number % 10 == 0:
                session.push("fleet.status", {"vehicles": dict.fromkeys(self.names, _STATUS), "trouble": ""})


def _answering(value: Any) -> Callable[[Session, Params], Any]:
    return lambda _session, _params: value


@contextmanager
def fleet_standin(fleet: str, world: str) -> Iterator[FleetStandIn]:
    """Serve the page of a fleet, such as ``iris:100``, in the world of a file."""
    standin = FleetStandIn(fleet, world)
    standin.start()
    yield standin
    standin.stop()
