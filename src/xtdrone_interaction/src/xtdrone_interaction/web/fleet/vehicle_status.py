"""What the table tells of each vehicle besides its motion: mode, arming, link, battery, estimator, and what is wrong.

It asks the MAVROS layer by the doctor's service, which needs no simulated time and changes nothing. Where no MAVROS
layer of the project runs, only what topics tell is shown; ``./xtdrone doctor`` listens longer.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import genpy
import rospy
from mavros_msgs.msg import EstimatorStatus, State
from sensor_msgs.msg import BatteryState

from xtdrone_interaction.doctor.findings import Finding, Graph, Simulator, Vehicle, examine_vehicle
from xtdrone_interaction.doctor.graph import Master, read_master
from xtdrone_interaction.doctor.readings import read_asked_vehicles, read_simulator
from xtdrone_interaction.sim_cli import SimError
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch

PERIOD = 1.0  # s of wall time
_GRAPH_PERIOD = 10.0  # s between two looks at all nodes
_ESTIMATES = {
    "attitude_status_flag": "attitude",
    "velocity_horiz_status_flag": "velocity",
    "pos_horiz_rel_status_flag": "position",
    "pos_vert_abs_status_flag": "height",
}  # fields of mavros_msgs/EstimatorStatus
log = logging.getLogger("xtdrone.web")


@dataclass(frozen=True)
class _Topic:
    name: str
    kind: type[genpy.Message]


_TOPICS = (_Topic("battery", BatteryState), _Topic("estimator_status", EstimatorStatus), _Topic("state", State))


class VehicleStatus:
    """Sends ``fleet.status`` once a second while a page is open."""

    def __init__(self, context: StationContext, fleet: FleetWatch) -> None:
        self._context = context
        self._fleet = fleet
        self._latest: dict[str, bytes] = {}
        self._subscribers: dict[str, Any] = {}
        self._master: Master | None = None
        self._read_at = -math.inf
        context.every(PERIOD, self._send)

    async def _send(self) -> None:
        names = self._fleet.names if self._context.sessions else []
        await self._context.blocking(self._subscribe, names)
        if names:
            self._context.push_all("fleet.status", await self._context.blocking(self._read, names))

    def _subscribe(self, names: list[str]) -> None:
        wanted = {f"/{name}/mavros/{topic.name}" for name in names for topic in _TOPICS}
        for topic in set(self._subscribers) - wanted:
            self._subscribers.pop(topic).unregister()
            self._latest.pop(topic, None)
        for topic in sorted(wanted - set(self._subscribers)):
            self._subscribers[topic] = rospy.Subscriber(topic, rospy.AnyMsg, partial(self._store, topic), queue_size=1)

    def _store(self, topic: str, message: rospy.AnyMsg) -> None:
        self._latest[topic] = message._buff

    def _read(self, names: list[str]) -> dict[str, Any]:
        try:
            master = self._graph()
            simulator = read_simulator(master)
            asked = {vehicle.name: vehicle for vehicle in read_asked_vehicles(master)}
        except SimError as error:
            log.info("state of the vehicles: %s", error)
            return {"vehicles": {name: self._heard(name, None, None, Graph()) for name in names}, "trouble": str(error)}
        return {
            "vehicles": {name: self._heard(name, asked.get(name), simulator, master.graph) for name in names},
            "trouble": "",
        }

    def _graph(self) -> Master:
        now = time.monotonic()
        if self._master is None or now - self._read_at > _GRAPH_PERIOD:
            self._master, self._read_at = read_master(self._context.master), now
        return self._master

    def _heard(self, name: str, asked: Vehicle | None, simulator: Simulator | None, graph: Graph) -> dict[str, Any]:
        """Return the entry of one vehicle."""
        state = self._message(name, _TOPICS[2])
        vehicle = asked or Vehicle(
            name=name,
            prefix=f"/{name}/mavros",
            served=state is not None,
            heard=state is not None,
            connected=bool(state and state.connected),
            armed=bool(state and state.armed),
            mode=str(state.mode) if state else "",
            system_status=int(state.system_status) if state else 0,
        )
        findings = examine_vehicle(vehicle, graph, simulator) if asked or state is None else []
        return {
            "mode": vehicle.mode,
            "armed": vehicle.armed,
            "link": vehicle.connected,
            "battery": self._battery(name),
            "estimator": self._missing_estimates(name),
            "findings": [_as_json(finding) for finding in findings],
        }

    def _battery(self, name: str) -> float | None:
        message = self._message(name, _TOPICS[0])
        return None if message is None or not 0.0 <= message.percentage <= 1.0 else float(message.percentage)

    def _missing_estimates(self, name: str) -> list[str] | None:
        """Return the estimates that the vehicle lacks; None if it has not reported."""
        message = self._message(name, _TOPICS[1])
        return None if message is None else [word for flag, word in _ESTIMATES.items() if not getattr(message, flag)]

    def _message(self, name: str, topic: _Topic) -> Any:
        packed = self._latest.get(f"/{name}/mavros/{topic.name}")
        if packed is None:
            return None
        message = topic.kind()
        try:
            message.deserialize(packed)
        except (genpy.DeserializationError, UnicodeDecodeError):
            return None
        return message


def _as_json(finding: Finding) -> Mapping[str, str]:
    return {"what": finding.what, "text": finding.text, "remedy": finding.remedy}
