"""A node that measures, turn by turn, with the ranging sensors of a whole fleet: lidars or UWB sensors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from xtdrone_msgs.msg import SceneModels, SceneState

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import Vehicle
from xtdrone_common.programs.node_command_line import ArgumentError
from xtdrone_common.settings import Settings
from xtdrone_sim.rays.live_rays import LiveRays
from xtdrone_sim.sensors.ranging_failures import FailureServices, RangingFailure
from xtdrone_sim.sensors.sensor_nodes import Due, read_start, run
from xtdrone_sim.topics.fleet_changes import FleetChanges, vehicles_may_join
from xtdrone_sim.vehicles.mounts.fleet_sensor import FleetSensor

TURNS = 50.0  # Hz, rate of /xtdrone/scene


@dataclass(eq=False)
class Station:
    """A sensor with its topic and its measurements that are due.

    Attributes:
        sensor: the sensor.
        publisher: its topic.
        due: its measurements.
        joins: whether its vehicle has joined in flight and has not been in a scene yet.
        last: latest measurement, which a frozen sensor repeats.
    """

    sensor: FleetSensor[Any]
    publisher: lockstep.Publisher
    due: Due
    joins: bool
    last: Any = None


_Station = TypeVar("_Station", bound=Station)


class RangingNode(ABC, Generic[_Station]):
    """Measures and publishes, turn by turn.

    Attributes:
        name: name of the node.
        kind: its sensors in messages.
    """

    name: ClassVar[str]
    kind: ClassVar[str]

    def __init__(self, fleet: Sequence[Vehicle]) -> None:
        """Advertise topics and services.

        Args:
            fleet: all vehicles, whose sensors are served.

        Raises:
            ValueError: a vehicle type or its sensors cannot be used.
        """
        self._stations: list[_Station] = []
        self._failures = FailureServices()
        self._rays = LiveRays(self.name)
        self._serve(self.find(fleet), joins=False)
        lockstep.Subscriber("/xtdrone/scene", SceneState, self._take_scene)
        lockstep.Subscriber("/xtdrone/models", SceneModels, self._rays.change)
        self._changes = FleetChanges(fleet, self._join, self._leave)
        lockstep.add_reset_hook(self._restart)

    @staticmethod
    @abstractmethod
    def find(fleet: Sequence[Vehicle]) -> tuple[FleetSensor[Any], ...]:
        """Return the sensors of vehicles.

        Raises:
            ValueError: a vehicle type or its sensors cannot be used.
        """

    @abstractmethod
    def _serve(self, sensors: Sequence[FleetSensor[Any]], *, joins: bool) -> None:
        """Add stations for sensors."""

    @abstractmethod
    def _take_scene(self, message: SceneState) -> None:
        """Store a scene."""

    @abstractmethod
    def _first_us(self, station: _Station) -> int | None:
        """Return the time of the first scene that a sensor can use, microseconds; None without one."""

    @abstractmethod
    def step(self) -> None:
        """Measure and publish what is due."""

    def begin(self, world: str) -> None:
        """Start measuring in a world, given by name or file."""
        self._rays.begin(world, self._changes.fleet)

    def _due(self, last_us: int) -> Iterator[tuple[_Station, int]]:
        """Yield the measurements that have ended by ``last_us``, microseconds, of sensors that work and are heard."""
        for station in self._stations:
            first_us = self._first_us(station)
            if first_us is None:
                continue
            station.joins = False
            for number in station.due.numbers(first_us, last_us):
                if station.publisher.get_num_connections() and self._failure(station).kind != "off":
                    yield station, number

    def _failure(self, station: _Station) -> RangingFailure:
        return self._failures[station.sensor.topic]

    def _join(self, vehicle: Vehicle) -> None:
        sensors = self.find([vehicle])
        self._rays.add_vehicle(vehicle)
        self._serve(sensors, joins=True)

    def _leave(self, vehicle: Vehicle) -> None:
        self._rays.remove_vehicle(vehicle)
        for station in [station for station in self._stations if station.sensor.vehicle == vehicle.name]:
            self._stations.remove(station)
            self._failures.remove(station.sensor.topic)
            station.publisher.unregister()

    def _restart(self) -> None:
        """Discard the state from before a reset of simulated time, except failures."""
        for station in self._stations:
            station.due.restart()
            station.last = None

    def close(self) -> None:
        """End the services."""
        self._failures.close()


def run_ranging_node(
    node: type[RangingNode[Any]], settings: type[Settings], fleet: str, arguments: Sequence[str]
) -> None:
    """Serve all sensors of a kind until shutdown.

    Args:
        node: class of the node, which is called with the vehicles and the settings.
        settings: class of its private parameters.
        fleet: fleet without ``/xtdrone/fleet``.
        arguments: arguments of the command line.

    Raises:
        ArgumentError: an argument or parameter is not allowed.
    """
    text, vehicles, given = read_start(node.name, settings, fleet, arguments)
    try:
        sensors = node.find(vehicles)
    except ValueError as error:
        raise ArgumentError(str(error)) from error
    if not sensors and not vehicles_may_join():
        raise ArgumentError(f"/xtdrone/fleet: no vehicle of {text!r} has a {node.kind}")
    lockstep.init_node(node.name, rate=TURNS)
    running = node(vehicles, given)  # type: ignore[call-arg]  # of the subclasses
    run(running.begin, running.step, running.close)
