"""State of each vehicle in the table, besides its motion: mode, arming, link, battery, estimator, problems.

The MAVROS layer is queried by the doctor's service, once for all vehicles: with thirty vehicles, three
subscriptions to each would cost more than the whole page. Vehicles without a MAVROS layer of this project are shown by
their topics alone; ``./xtdrone doctor`` listens longer.
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
from xtdrone_msgs.msg import SimulationStatus

from xtdrone_interaction.doctor.findings import ESTIMATES, Finding, Graph, Simulator, Vehicle, examine_vehicle
from xtdrone_interaction.doctor.graph import Master, read_master
from xtdrone_interaction.doctor.readings import read_asked_vehicles, simulator_of
from xtdrone_interaction.simulation_services import SimError
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch

PERIOD = 1.0  # s of wall time, at least
_LONGEST_PERIOD = 5.0
_SHARE = 0.02  # of a core, limit for the queries to the MAVROS layers
_GRAPH_PERIOD = 10.0  # s of wall time between two queries of all nodes, at least
_LONGEST_GRAPH_PERIOD = 30.0
_GRAPH_SHARE = 0.02  # of the time, limit for such a query, which also loads the ROS master
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
        self._asked: dict[str, Vehicle] = {}
        self._due = -math.inf  # time of the next status, s
        self._master = Master(context.master, Graph())
        self._master_due = -math.inf
        self._simulation: SimulationStatus | None = None
        self._of_simulation = rospy.Subscriber("/simulator/status", SimulationStatus, self._on_simulation, queue_size=1)
        context.every(PERIOD, self._send)

    async def _send(self) -> None:
        names = self._fleet.names if self._context.sessions else []
        if not names:
            await self._context.blocking(self._subscribe, [])
        elif time.monotonic() >= self._due:
            self._context.push_all("fleet.status", await self._context.blocking(self._read, names))

    def _on_simulation(self, message: SimulationStatus) -> None:
        self._simulation = message

    def _simulator(self) -> Simulator | None:
        """Return the state of the simulator; None without one."""
        message = self._simulation
        return simulator_of(message) if message is not None and self._of_simulation.get_num_connections() else None

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
        begin, simulator, trouble = time.thread_time(), self._simulator(), ""
        try:
            self._look_at_graph(simulator)
            self._asked = {vehicle.name: vehicle for vehicle in read_asked_vehicles(self._master, telemetry=True)}
            self._subscribe([name for name in names if name not in self._asked])
        except SimError as error:  # the last answers are shown, with the reason
            log.info("state of the vehicles: %s", error)
            trouble = str(error)
        graph = self._master.graph
        vehicles = {name: self._heard(name, self._asked.get(name), simulator, graph) for name in names}
        period = (time.thread_time() - begin) / _SHARE
        self._due = time.monotonic() + min(period, _LONGEST_PERIOD) - 0.5 * PERIOD  # the timer's call may come early
        return {"vehicles": vehicles, "trouble": trouble}

    def _look_at_graph(self, simulator: Simulator | None) -> None:
        """Read the nodes and topics, unless they have been read lately.

        Raises:
            SimError: the master does not answer.
        """
        begin = time.monotonic()
        if begin < self._master_due:
            return
        # participants need not be asked: the lockstep drops those that have died
        self._master = read_master(self._context.master, simulator.participants if simulator else ())
        end = time.monotonic()
        period = max(_GRAPH_PERIOD, (end - begin) / _GRAPH_SHARE)
        self._master_due = end + min(period, _LONGEST_GRAPH_PERIOD)

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
            "battery": asked.battery if asked else self._battery(name),
            "estimator": _missing(asked.estimates) if asked else self._missing_estimates(name),
            "findings": [_as_json(finding) for finding in findings],
        }

    def _battery(self, name: str) -> float | None:
        message = self._message(name, _TOPICS[0])
        return None if message is None or not 0.0 <= message.percentage <= 1.0 else float(message.percentage)

    def _missing_estimates(self, name: str) -> list[str] | None:
        """Return the estimates that the vehicle lacks; None if it has not reported."""
        message = self._message(name, _TOPICS[1])
        return None if message is None else [word for flag, _, word in ESTIMATES if not getattr(message, flag)]

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


def _missing(estimates: tuple[str, ...] | None) -> list[str] | None:
    return None if estimates is None else [word for _, _, word in ESTIMATES if word not in estimates]


def _as_json(finding: Finding) -> Mapping[str, str]:
    return {"what": finding.what, "text": finding.text, "remedy": finding.remedy}
