"""The full simulator: physics and autopilots of all vehicles, reached by MAVLink over UDP."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import rospy
import yaml
from gazebo_msgs.msg import ModelStates

from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_common.fleet import (
    MAX_VEHICLES,
    XTDRONE,
    StartPose,
    Vehicle,
    check_instance,
    check_ports,
    fleet_text,
    parse_fleet,
    with_poses,
)
from xtdrone_common.rotation import Vector
from xtdrone_common.settings import setting
from xtdrone_lockstep.server import LockstepServer
from xtdrone_sim.autopilots.builtin_autopilot import AutopilotFactory, BuiltinAutopilot
from xtdrone_sim.autopilots.datagrams import Datagrams
from xtdrone_sim.autopilots.px4_hil_fleet import Hil
from xtdrone_sim.effects import Effect, load_effects
from xtdrone_sim.gazebo.models_by_name import Models
from xtdrone_sim.gazebo.scene_topics import ModelTopics
from xtdrone_sim.gazebo.services.model_services import GazeboServices
from xtdrone_sim.mailbox import Mailbox
from xtdrone_sim.physics.vehicle_dynamics import ABSENT
from xtdrone_sim.robots.robot_topics import RobotTopics
from xtdrone_sim.runtime.launched_vehicles import launched_world, read_launched
from xtdrone_sim.runtime.simulator_interface import HEAD_START, Idle, index_of
from xtdrone_sim.runtime.simulator_node import NodeSettings, close_all, log, run_node
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.topics.actor_topics import ActorTopics
from xtdrone_sim.topics.contact_topics import ContactTopics
from xtdrone_sim.topics.fleet_changes import FleetTopic
from xtdrone_sim.topics.imu_topics import ImuTopics
from xtdrone_sim.topics.link_topics import LinkTopics
from xtdrone_sim.topics.model_states import ModelStatesMessage
from xtdrone_worlds.worlds.catalogue import find_world
from xtdrone_worlds.worlds.robots.list_of_robots import Robot, parse_robots


@dataclass(frozen=True, kw_only=True)
class FullSettings(NodeSettings):
    """Parameters of the full simulator.

    Attributes:
        fleet: vehicles (``~fleet`` or ``/xtdrone/fleet``), on the ports of instance ``/xtdrone/instance`` and of
            ``/xtdrone/ports`` (a key of ``fleet.OFFBOARD_PORTS``), at the start poses of the fleet or of ``~poses``
            (a YAML list of [x, y, z, roll, pitch, yaw], m and rad ENU); with ``~spawned`` those that XTDrone's launch
            files spawn, see ``launched_vehicles.read_launched``.
        effects: forces and torques added to the vehicles in this order (``~effects``: a list, or its YAML as text; each
            entry ``FILE.py:NAME``, ``module:NAME`` or ``{FILE.py:NAME: {ARGUMENT: VALUE, ...}}``).
        robots: ground robots (``~robots``, see ``listing.parse_robots``).
    """

    fleet: tuple[Vehicle, ...]
    rows: int = setting(3, low=1, text="vehicles side by side on the spawn grid")
    autopilot: str = setting(
        "builtin",
        choices=("builtin", "hil"),
        text="builtin for our autopilot, hil for PX4 instances that connect to the simulator links of the vehicles",
    )
    world: str = setting("empty", text="name or file of the world; its absolute path is set as /xtdrone/world")
    seed: int = setting(0, low=0, text="seed of the sensor noise")
    overlap: bool = setting(
        True,
        text="simulate the next step while nodes work on the current one, whose setpoints then act one tick later; "
        "not with autopilot hil",
    )
    link_states_rate: float = setting(
        50.0, low=0.1, high=250.0, unit="Hz", text="rate of /gazebo/link_states in simulated time"
    )
    reserve: int = setting(0, low=0, high=MAX_VEHICLES, text="reserved places for vehicles that join later")
    shared_datum: bool = setting(
        True, text="one local frame for all vehicles; PX4 instances receive it as /xtdrone/shared_origin"
    )
    datum_known: bool = setting(
        False,
        text="vehicles without GPS know the shared frame's place on Earth from the start and thus accept AUTO.LOITER, "
        "AUTO.RTL and missions, which PX4 rejects before SET_GPS_GLOBAL_ORIGIN",
    )
    solid_people: bool = setting(False, text="vehicles and robots collide with people")
    params: str = setting("", text="folder that keeps changed vehicle parameters, empty for none")
    log_dir: str = setting("", text="folder for ULogs of the vehicles, empty for none")
    effects: tuple[Effect, ...] = ()
    robots: tuple[Robot, ...] = ()


def read_settings() -> FullSettings:
    """Read the node's parameters.

    Raises:
        ValueError: a parameter is not allowed.
    """
    instance = check_instance(rospy.get_param("/xtdrone/instance", 0))
    ports = check_ports(rospy.get_param("/xtdrone/ports", XTDRONE))
    if rospy.get_param("~spawned", False):
        fleet = _spawned(instance, ports)
    else:
        text = str(rospy.get_param("~fleet", rospy.get_param("/xtdrone/fleet", "iris:1")))
        fleet = with_poses(parse_fleet(text, instance, ports), str(rospy.get_param("~poses", "")))
    robots = parse_robots(str(rospy.get_param("~robots", "")))
    return FullSettings.from_parameters(rospy.get_param, fleet=fleet, effects=_effects("~effects"), robots=robots)


def _spawned(instance: int, ports: str) -> tuple[Vehicle, ...]:
    """Return the vehicles of the launch; add its MAVROS nodes to ``~participants`` and look its world up.

    Raises:
        FleetError, ModelError: the vehicles or the world are not allowed.
    """
    rospy.delete_param("~spawned")  # a later launch on this master may define its vehicles in another way
    launched = read_launched(rospy.get_param("/"), instance, ports)
    for warning in launched.warnings:
        rospy.logwarn("simulator: %s", warning)
    others = [name for name in str(rospy.get_param("~participants", "")).split(",") if name]
    rospy.set_param("~participants", [*launched.mavros, *others] or 0)
    rospy.set_param("~world", launched_world(str(rospy.get_param("~world", "empty"))))
    return launched.fleet


def _effects(name: str) -> tuple[Effect, ...]:
    """Return the effects listed in the parameter ``name``.

    Raises:
        ValueError: the parameter is malformed, or an effect cannot be loaded.
    """
    value, resolved = rospy.get_param(name, []), rospy.resolve_name(name)
    if isinstance(value, str):
        try:
            value = yaml.safe_load(value) or []
        except yaml.YAMLError as error:
            raise ValueError(f"{resolved}: {value!r} is not allowed, a list in YAML: {error}") from error
    return tuple(load_effects(value, resolved))


class FullSimulation:
    """Physics, autopilots and the MAVLink server of all vehicles; see ``SimulatorBackend``."""

    def __init__(self, settings: FullSettings) -> None:
        """Place the fleet on the ground and bind its ports.

        Raises:
            ValueError: a setting is invalid, or a vehicle type or the world is unknown.
            OSError: a port is in use.
        """
        self.names: Sequence[str] = [vehicle.name for vehicle in settings.fleet]
        self._idle: Idle = lambda _: None
        self._simulation = Simulation(
            settings.fleet,
            rows=settings.rows,
            world=settings.world,
            seed=settings.seed,
            shared_datum=settings.shared_datum,
            autopilots=self._factory(settings),
            effects=settings.effects,
            reserve=settings.reserve,
            solid_people=settings.solid_people,
        )
        if self._simulation.effects is not None:
            rospy.loginfo("simulator: effects on the vehicles: %s", ", ".join(self._simulation.effects.names))
        rospy.set_param("/xtdrone/fleet", fleet_text(settings.fleet))
        rospy.set_param("/xtdrone/world", str(find_world(settings.world)))
        rospy.set_param("/xtdrone/shared_origin", self._origin_for_px4s(settings))
        self.step_us = self._simulation.step_us
        self._model_states = ModelStatesMessage(self._simulation.names, self._simulation.world.model.models)
        self.actors: Sequence[str] = [actor.name for actor in self._simulation.world.model.actors]
        self._link_states_rate = settings.link_states_rate
        self._listed = settings.robots
        self._autopilots = self._simulation.autopilots
        self.overlap = settings.overlap and not self._autopilots.need_time
        self._mavlink = MavlinkServer(
            self._autopilots.served, self._simulation.autopilot, self._simulation.commanders, settings.host
        )

    def _factory(self, settings: FullSettings) -> AutopilotFactory:
        """Return the factory of the autopilot back end that the settings select."""
        factories: dict[str, AutopilotFactory] = {
            "builtin": partial(
                BuiltinAutopilot,
                params=Path(settings.params).expanduser() if settings.params else None,
                logs=Path(settings.log_dir).expanduser() if settings.log_dir else None,
                datum_known=settings.datum_known,
            ),
            "hil": partial(
                Hil,
                host=settings.host,
                hang_limit=settings.hang_limit,
                idle=lambda timeout: self._idle(timeout),
                log=log,
            ),
        }
        return factories[settings.autopilot]

    def _origin_for_px4s(self, settings: FullSettings) -> dict[str, float]:
        """Return the shared origin of the PX4s' local frames, WGS84; empty if they do not need it."""
        if settings.autopilot != "hil" or not settings.shared_datum:
            return {}
        return asdict(self._simulation.world.model.datum)

    @property
    def time_us(self) -> int:
        """Simulated time, microseconds."""
        return self._simulation.time_us

    @property
    def gravity(self) -> float:
        """Gravity, m/s^2."""
        return self._simulation.world.model.gravity

    @property
    def need_time(self) -> bool:
        """Whether the autopilots answer their clients only while simulated time advances."""
        return self._autopilots.need_time

    @property
    def descriptors(self) -> Sequence[int]:
        """File descriptors of the MAVLink server and the autopilots."""
        return (self._mavlink.fileno(), *self._autopilots.descriptors)

    @property
    def patience(self) -> float:
        """Longest time between two calls of ``serve``, given by the MAVLink links, wall s."""
        return self._mavlink.keep_alive_delay

    def open(self, server: LockstepServer, mailbox: Mailbox, idle: Idle) -> None:
        """Create the topics, and share the datagram counts with the lockstep server."""
        self._idle = idle
        self._server = server
        server.open_datagram_ports(self._simulation.local_ports, lambda: self._mavlink.sent)
        self._datagrams = Datagrams(self._mavlink, server, lambda text: rospy.logwarn("simulator: %s", text), idle)
        self._topics = LinkTopics(self._simulation, self._link_states_rate)
        for name in self.names:
            self._describe(name)
        self._actors = ActorTopics(self._simulation.actors, lambda: self.time_us)
        self._models = models = Models(self._simulation, self._actors)
        self._changes = ModelTopics(models)
        self._topics.providers += [self._actors.add_to_scene, self._changes.add_to_scene]
        self._topics.states_providers.append(self._changes.add_to_links)
        self._contacts = ContactTopics(self._simulation, lambda: models.names)
        self._imus = ImuTopics(self._simulation)
        self._fleet_topic = FleetTopic()
        self._robots = RobotTopics(self._listed, self._simulation, models, self._changes)
        self._gazebo = GazeboServices(self._simulation, models, self._changes, server)
        self._gazebo.open(mailbox)

    def missing(self) -> str:
        """Return a text on the autopilots that have not connected; "" when all have."""
        return self._autopilots.missing()

    def serve(self, ready: Collection[int]) -> None:
        """Receive MAVLink datagrams and the data of the autopilots."""
        if self._mavlink.fileno() in ready or self._mavlink.backlog:
            self._mavlink.receive(0.0)
        if any(descriptor in ready for descriptor in self._autopilots.descriptors):
            self._autopilots.serve()
        self._mavlink.keep_alive(self._datagrams.counted_ports)

    def next_due_us(self, now_us: int) -> int | None:
        """Return None: ``advance`` sends the telemetry streams between ticks."""
        return None

    def next_publication_us(self, now_us: int) -> int | None:
        """Return the next publication time of link states, microseconds; None without subscribers."""
        topics = (self._topics, self._contacts, self._imus, self._robots)
        times = [one.next_publication_us(now_us) for one in topics]
        return min((time for time in times if time is not None), default=None)

    def advance(self, until_us: int) -> None:
        """Step to ``until_us``, and send the telemetry streams that are due."""
        self._datagrams.direct()
        simulation, mavlink = self._simulation, self._mavlink
        next_stream = mavlink.next_due_us
        while simulation.time_us < until_us:
            simulation.run_until(min(until_us, max(next_stream, simulation.time_us + self.step_us)))
            if simulation.time_us >= next_stream:
                mavlink.send_streams(simulation.time_us)
                next_stream = mavlink.next_due_us
        mavlink.send_streams(simulation.time_us)

    def step(self) -> None:
        """Advance by one step."""
        self._simulation.step()

    def begin_tick(self, idle: Idle) -> None:
        """Publish link states, and begin a barrier; setpoints of participants are held until it ends."""
        self._topics.publish()
        self._contacts.publish()
        self._imus.publish()
        self._robots.publish()
        self._mavlink.hold_setpoints()
        self._server.begin_tick(self._simulation.time_us, self._mavlink.sent, idle)

    def end_tick(self, idle: Idle) -> None:
        """Wait for the end of the barrier; setpoints of participants take effect then."""
        self._server.end_tick(idle, HEAD_START)
        self._gazebo.act()
        self._datagrams.wait()
        self._mavlink.release_setpoints()

    def truth(self) -> bytes:
        """Return the plant records of the vehicles as bytes."""
        plant = self._simulation.world.plant
        there = plant["contact"] != ABSENT
        return (plant if there.all() else plant[there]).tobytes()

    def model_states(self) -> ModelStates:
        """Return the poses and velocities of all models in Gazebo's format."""
        message = self._model_states.fill(self._simulation.world.plant)
        self._actors.add_to(message)
        return self._changes.complete(message)

    def collisions(self) -> set[tuple[str, str]]:
        """Return all collisions so far, as pairs of names."""
        found = self._simulation.world.collisions
        if not found:
            return set()
        names = [*self._simulation.names, *self._models.names]
        return {(names[a], names[b]) for a, b in found}

    def restart(self, time_us: int) -> None:
        """Return the vehicles to their spawn positions and reboot all autopilots."""
        self._simulation.restart(time_us)
        self._topics.restart()
        self._contacts.restart()
        self._imus.restart()
        self._gazebo.restart()
        self._robots.restart()
        self._model_states = ModelStatesMessage(self._simulation.names, self._simulation.world.model.models)
        self._mavlink.reboot(self._simulation.autopilot, self._simulation.commanders)

    def reset_vehicle(self, name: str, pose: StartPose | None) -> None:
        """See ``SimulatorBackend``."""
        self._simulation.reset_vehicle(self._index(name), pose)
        self._mavlink.follow_reboots()

    def set_wind(self, velocity: Vector) -> None:
        """See ``SimulatorBackend``."""
        self._simulation.set_wind(velocity)

    def _index(self, name: str) -> int:
        index_of(name, self.names)
        return self._simulation.names.index(name)

    def add_vehicle(self, name: str, model: str, pose: StartPose | None) -> None:
        """See ``SimulatorBackend``."""
        if name not in self.names and name in self._models.present:
            raise ValueError(f"name: {name[:80]!r} is the name of a model in the world")
        simulation = self._simulation
        index = simulation.add_vehicle(name, model, pose)
        vehicle = simulation.vehicles[index]
        assert vehicle is not None
        try:
            self._mavlink.add_vehicle(index, vehicle, self._server.datagrams_expected)
        except OSError:
            simulation.remove_vehicle(index)
            raise
        self._datagrams.ports_changed()
        self._describe(name)
        self._follow_vehicles()

    def remove_vehicle(self, name: str) -> None:
        """See ``SimulatorBackend``."""
        index = self._index(name)
        self._simulation.remove_vehicle(index)
        self._mavlink.remove_vehicle(index)
        with contextlib.suppress(KeyError):
            rospy.delete_param(f"/{name}/robot_description")
        self._follow_vehicles()

    def _describe(self, name: str) -> None:
        model = self._simulation.models[self._simulation.names.index(name)]
        rospy.set_param(f"/{name}/robot_description", model.urdf.text)

    def _follow_vehicles(self) -> None:
        """Update names, topics and the fleet's parameter after a vehicle has joined or left."""
        simulation = self._simulation
        self.names = [vehicle.name for vehicle in simulation.fleet]
        self._model_states = ModelStatesMessage(simulation.names, simulation.world.model.models)
        self._models.update_vehicles()
        self._topics.update_vehicles()
        self._contacts.update_vehicles()
        self._imus.update_vehicles()
        rospy.set_param("/xtdrone/fleet", fleet_text(simulation.fleet))
        self._fleet_topic.publish(simulation.fleet)

    def close(self) -> None:
        """Close the ports, and release the autopilots and the physics engine."""
        close_all(self._mavlink.close, self._simulation.close)


def _make() -> tuple[FullSettings, FullSimulation]:
    settings = read_settings()
    return settings, FullSimulation(settings)


def main() -> int:
    """Run the node; return its exit status."""
    return run_node(_make, sys.argv)
