"""The ``mavros`` node: one process that serves the topics of every vehicle of the fleet.

Private parameters, besides those of ``mavros/launch/px4_config.yaml``:

- ``~fleet`` (default ``/xtdrone/fleet``): the vehicles, e.g. ``iris:9``. Topics are ``/iris_0/mavros/...``; links are
  numbered as in upstream XTDrone.
- ``~fcu_host`` (127.0.0.1): host that runs the fleet's autopilots, a name or an IPv4 address.
- ``~bind_host`` (127.0.0.1 if the autopilots run on this machine, otherwise 0.0.0.0): local address for their MAVLink.
- ``~fleet_url``: both ends of the first vehicle's link in the form of MAVROS's ``fcu_url``; replaces the ports of
  ``/xtdrone/ports`` and the two parameters above. Each further vehicle's ports are one higher.
- ``/xtdrone/ports`` (xtdrone): px4 for the ports of PX4's own scripts, ``udp://:14540@127.0.0.1:14580``.
- ``~vehicle``: serve only this vehicle of the fleet, e.g. ``iris_0``; topics are in the node's own namespace. With one
  node per vehicle, named ``/iris_0/mavros`` and so on, this is how real MAVROS is started for a fleet.
- ``~wait_for_vehicle`` (false): wait until ``~vehicle`` has joined the simulation.
- ``~fcu_url``, with ``~target_system_id`` and ``~target_component_id`` (or ``~tgt_system`` and ``~tgt_component``, the
  names in MAVROS's launch files): serve a single vehicle as real MAVROS does; topics are in the node's own namespace.
- ``/xtdrone/setpoint_namespace``: namespace of local setpoints. With ``safety`` they are read below ``/iris_0/safety``
  instead of ``/iris_0/mavros``, where another node, the safety filter, publishes them.
- ``~lockstep`` (true): set to false to run on ROS time, like real MAVROS, even if the simulator runs in lockstep.
- ``~system_id``, ``~component_id``: MAVLink ids of the node itself (1, 240).
"""

from __future__ import annotations

import contextlib
import itertools
import resource
import sys
import threading
import xmlrpc.client
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from http.client import HTTPException
from typing import Any, NamedTuple

import rosgraph
import rospy
from xtdrone_msgs.srv import GetReadiness, GetReadinessResponse

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import XTDRONE, FleetError, Vehicle, check_instance, check_ports, parse_fleet
from xtdrone_common.fleet.fcu_url import AutopilotLinkError, FcuUrl, parse_fcu_url
from xtdrone_common.programs.node_command_line import check_no_arguments, run_program
from xtdrone_common.programs.plain_node import wait_for_fleet
from xtdrone_common.programs.under_roslaunch import announce
from xtdrone_mavros.feeds import Publisher
from xtdrone_mavros.lib.plugin_settings import Params, PluginLists
from xtdrone_mavros.link.autopilot_links import (
    AutopilotLink,
    AutopilotReceiver,
    bind_host_for,
)
from xtdrone_mavros.plugins import PLUGINS
from xtdrone_mavros.readiness import TelemetryDemand, TelemetryOf, readiness
from xtdrone_mavros.swarm_state_topic import Swarm
from xtdrone_mavros.uas import PluginKind, Uas
from xtdrone_mavros.unsubscribed_topics import GraphWatch, Registrations, plugin_reasons, topics_left_out

RATE = 50.0  # Hz of simulated time: PX4's fastest telemetry on the offboard link that MAVROS publishes
_FAILED = 1


class VehicleConnection(NamedTuple):
    """Name, namespace and link of one vehicle to serve."""

    name: str
    prefix: str
    url: FcuUrl
    target: tuple[int, int]


class _Connections(rospy.SubscribeListener):
    """Counts the subscriber connections opened and closed.

    Attributes:
        changes: their total number.
    """

    def __init__(self) -> None:
        super().__init__()
        self.changes = 0
        self._lock = threading.Lock()

    def peer_subscribe(self, topic_name: str, topic_publish: Any, peer_publish: Any) -> None:
        """Count a new connection; called in rospy's threads."""
        self.count()

    def peer_unsubscribe(self, topic_name: str, num_peers: int) -> None:
        """Count a closed connection; called in any thread."""
        self.count()

    def count(self) -> None:
        """Count a change; in any thread."""
        with self._lock:
            self.changes += 1


class LockstepRos:
    """Topics and services for the plugins, on top of the lockstep client.

    Attributes:
        use_sim_time: whether ROS time is the simulator's time.
        demand: Demand of telemetry by callers of ``~get_readiness``.
    """

    def __init__(self, receiver: AutopilotReceiver) -> None:
        """Determine whether the time is simulated.

        Args:
            receiver: receives the autopilots' answers.
        """
        self._receiver = receiver
        self.use_sim_time = bool(lockstep.is_active() or rospy.get_param("/use_sim_time", False))
        self._connections = _Connections()
        self.demand = TelemetryDemand(self._connections.count)

    @property
    def connection_changes(self) -> int:
        """Number of subscribers' connections, and needs of telemetry, made and lost so far."""
        return self._connections.changes

    def now_ns(self) -> int:
        """Return the ROS time in nanoseconds."""
        return int(rospy.Time.now().to_nsec())

    def publisher(self, topic: str, kind: type, latch: bool) -> Publisher:
        """Advertise a topic."""
        return lockstep.Publisher(topic, kind, latch=latch, subscriber_listener=self._connections)

    def subscriber(self, topic: str, kind: type, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic."""
        lockstep.Subscriber(topic, kind, callback)

    def service(self, name: str, kind: type, handler: Callable[[Any], Any]) -> None:
        """Offer a service; its handler runs in a rospy thread."""
        rospy.Service(name, kind, handler)

    def set_param(self, name: str, value: Any) -> None:
        """Set a ROS parameter, or a tree of them."""
        rospy.set_param(name, value)

    def get_param(self, name: str, default: Any) -> Any:
        """Return a ROS parameter, or a tree of them."""
        return rospy.get_param(name, default)

    @contextlib.contextmanager
    def needs_time(self) -> Iterator[None]:
        """Return a context manager for waiting for a response from the autopilot."""
        with self._receiver.attention(), lockstep.needs_time():
            yield


def connections(
    settings: Mapping[str, Any], fleet: str, node_name: str, instance: object = 0, ports: object = XTDRONE
) -> list[VehicleConnection]:
    """Return the connections to serve.

    Args:
        settings: the node's private parameters.
        fleet: the value of ``/xtdrone/fleet``, or empty.
        node_name: the node's resolved name, e.g. ``/iris_0/mavros``.
        instance: the value of ``/xtdrone/instance``; shifts the fleet's default ports, not those of an explicit URL.
        ports: the value of ``/xtdrone/ports``; likewise.

    Raises:
        FleetError: no fleet is given, or it is invalid, or ``instance`` or ``ports`` is not allowed.
        AutopilotLinkError: a malformed ``fcu_url`` or ``fleet_url``, or an unreachable ``fcu_host``.
        ParamError: a setting has the wrong type.
    """
    params = Params(settings)
    url = params.get("fcu_url", "")
    if url:
        system = params.get("target_system_id", params.get("tgt_system", 1))
        target = system, params.get("target_component_id", params.get("tgt_component", 1))
        name = node_name.rpartition("/")[0].strip("/") or "fcu"
        return [VehicleConnection(name, node_name, parse_fcu_url(url), target)]
    text = params.get("fleet", fleet)
    if not text:
        raise FleetError("vehicles: none are named; set /xtdrone/fleet, e.g. to iris:9, or fcu_url for a single one")
    vehicles = parse_fleet(text, check_instance(instance), check_ports(ports))
    only = params.get("vehicle", "")
    if not only:
        return _fleet_connections(params, vehicles)
    chosen = [vehicle for vehicle in vehicles if vehicle.name == only]
    if not chosen:
        raise FleetError(f"vehicle: {only!r} is not in the fleet, {vehicles[0].name} to {vehicles[-1].name} are")
    return [connection._replace(prefix=node_name) for connection in _fleet_connections(params, chosen)]


def _fleet_connections(params: Params, vehicles: Iterable[Vehicle]) -> list[VehicleConnection]:
    fleet_url = params.get("fleet_url", "")
    if fleet_url:
        first = parse_fcu_url(fleet_url)
        return [_connection(vehicle, first.shifted(vehicle.id)) for vehicle in vehicles]
    fcu_host = params.get("fcu_host", "127.0.0.1")
    bind_host = bind_host_for(fcu_host, params.get("bind_host", ""))
    return [
        _connection(vehicle, FcuUrl(bind_host, vehicle.offboard_remote_port, fcu_host, vehicle.offboard_local_port))
        for vehicle in vehicles
    ]


def _connection(vehicle: Vehicle, url: FcuUrl) -> VehicleConnection:
    return VehicleConnection(vehicle.name, f"/{vehicle.name}/mavros", url, (vehicle.system_id, 1))


class MavrosNode:
    """The hubs of all vehicles and the receiver thread that serves them."""

    def __init__(self, vehicles: list[VehicleConnection], settings: Mapping[str, Any]) -> None:
        """Bind the ports and advertise topics and services.

        Args:
            vehicles: the connections to serve.
            settings: the node's private parameters.

        Raises:
            AutopilotLinkError: a port is already in use.
            ValueError: a setting is not allowed (includes ParamError).
        """
        shared = Params(settings)
        source = shared.get("system_id", 1), shared.get("component_id", 240)
        # Bind the ports before advertising anything, so that a node that cannot run leaves no trace.
        self._links = _open(vehicles, source)
        self._receiver = AutopilotReceiver(self._links)
        self._ros = LockstepRos(self._receiver)
        params = [_params(vehicle, settings) for vehicle in vehicles]
        for complaint in _complaints(params):
            rospy.logwarn(f"mavros: {complaint}")
        if shared.get("gcs_url", ""):
            rospy.logwarn("mavros: gcs_url is not supported; ground stations use a separate port of the autopilot")
        alone = bool(shared.get("fcu_url", "") or shared.get("vehicle", ""))
        setpoints = setpoint_namespace(rospy.get_param("/xtdrone/setpoint_namespace", ""))
        self._swarm = None if alone else Swarm(self._ros, len(vehicles))
        plugins: list[PluginKind] = [*PLUGINS, TelemetryOf(self._ros.demand)]
        self._uas = [
            Uas(vehicle.name, vehicle.prefix, link, own, self._ros, (*plugins, *self._swarm_member(index)), setpoints)
            for index, (vehicle, link, own) in enumerate(zip(vehicles, self._links, params, strict=True))
        ]
        self._starting = {uas.name for uas in self._uas}
        for uas in self._uas:
            uas.on_booted = self._on_booted
        prefixes = [vehicle.prefix for vehicle in vehicles]
        rospy.Service("~get_readiness", GetReadiness, self._get_readiness)
        names = [vehicle.name for vehicle in vehicles]
        self._watch = GraphWatch(rospy.get_name(), prefixes, topics_left_out(), system_state, names)
        lockstep.declare_udp([link.port for link in self._links], self._serve)
        lockstep.add_reset_hook(self._on_time_reset)
        self._receiver.start()

    def step(self) -> None:
        """Publish the swarm topic, run the timers and report the sent datagrams to the simulator."""
        if lockstep.is_active():
            self._receive_uncounted()
        if self._swarm is not None:
            self._swarm.publish()
        self._ros.demand.tend()
        now_ns = self._ros.now_ns()
        for uas in self._uas:
            uas.step(now_ns)
        report = lockstep.datagrams_sent
        for link in self._links:
            report(link.remote[1], link.sent)

    def watch(self) -> None:
        """Start watching for publishers on topics without a subscriber here."""
        self._watch.start()

    def close(self) -> None:
        """Stop the receiver thread and close the ports."""
        self._watch.stop()
        self._receiver.stop()

    def _swarm_member(self, index: int) -> list[PluginKind]:
        return [] if self._swarm is None else [self._swarm.member(index)]

    def _get_readiness(self, request: Any) -> GetReadinessResponse:
        """Answer in a rospy thread, from what has arrived: also while time stands still."""
        if request.telemetry:
            self._ros.demand.ask()
        return GetReadinessResponse([readiness(uas, telemetry=request.telemetry) for uas in self._uas])

    def _on_booted(self, name: str) -> None:
        """Announce once that all vehicles can be armed."""
        if name not in self._starting:  # a reboot
            return
        self._starting.discard(name)
        if not self._starting:
            count = len(self._uas)
            whose = f"the estimator of {name} is" if count == 1 else f"the estimators of all {count} vehicles are"
            when = f" at {self._ros.now_ns() * 1e-9:.1f} s" if self._ros.use_sim_time else ""
            announce(f"mavros: {whose} ready{when}")

    def _on_time_reset(self) -> None:
        for uas in self._uas:
            uas.on_time_reset(self._ros.now_ns())

    def _serve(self, expected: Mapping[int, int] | None, timeout: float) -> Mapping[int, int]:
        """Receive and publish: in lockstep the datagrams counted by the simulator, otherwise all that have arrived."""
        if expected is None:
            self._receiver.wait_any(timeout)
            now_ns = self._ros.now_ns()
            for uas in self._uas:
                self._receive(uas, now_ns)
        else:
            targets = self._receiver.wait_counted(expected, timeout)
            now_ns = self._ros.now_ns()
            for uas in self._uas:
                count = targets.get(uas.link.port)
                if count is not None:
                    self._receive(uas, now_ns, count)
        return self._receiver.counted()

    def _receive_uncounted(self) -> None:
        """Receive from autopilots outside the simulator, whose datagrams are not counted."""
        now_ns = self._ros.now_ns()
        for uas in self._uas:
            if not self._receiver.is_counted(uas.link.port):
                self._receive(uas, now_ns)

    def _receive(self, uas: Uas, now_ns: int, datagrams: int | None = None) -> None:
        try:
            uas.receive(now_ns, datagrams)
        except Exception:  # a bad message from one vehicle must not stop the topics of all others
            if not rospy.is_shutdown():  # while shutting down, topics are closed under the plugins
                uas.failed("receiving MAVLink failed")


def main() -> int:
    """Run the node; return its exit status."""
    return run_program(_run, sys.argv, "mavros_node.py   (see its parameters in docs/mavros.md)")


def _run(arguments: Sequence[str]) -> int:
    check_no_arguments(arguments)
    _allow_many_files()
    lockstep.init_node("mavros", rate=RATE)
    try:
        settings = rospy.get_param("~", {})
        fleet = _fleet(settings)
        instance, ports = rospy.get_param("/xtdrone/instance", 0), rospy.get_param("/xtdrone/ports", XTDRONE)
        vehicles = connections(settings, fleet, rospy.get_name(), instance, ports)
        with lockstep.registering_together():
            node = MavrosNode(vehicles, settings)
    except (FleetError, AutopilotLinkError, ValueError) as error:
        rospy.logfatal(f"mavros: {error}")
        rospy.signal_shutdown(str(error))
        return _FAILED
    rospy.loginfo(f"mavros: serving {', '.join(vehicle.name for vehicle in vehicles)}")
    try:
        lockstep.start()
        node.watch()
        lockstep.spin(node.step)
    finally:
        node.close()
    return 0


def _allow_many_files() -> None:
    """Raise the limit of open files to the maximum: rospy opens a socket for each connection."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def _fleet(settings: Mapping[str, Any]) -> str:
    """Return the value of ``/xtdrone/fleet``, empty if it is not set.

    In lockstep, if ``settings`` do not name vehicles either, wait for the parameter: the launch file that sets it may
    run on another machine and start later. With ``~wait_for_vehicle``, wait until it lists the vehicle.

    Raises:
        ROSInterruptException: the node was shut down while waiting.
    """
    fleet = str(rospy.get_param("/xtdrone/fleet", ""))
    wanted = str(settings.get("vehicle", "")) if settings.get("wait_for_vehicle") else ""
    if not wanted and (fleet or not lockstep.is_active() or settings.get("fleet") or settings.get("fcu_url")):
        return fleet
    rospy.loginfo("mavros: waiting for %s", wanted or "/xtdrone/fleet, which the simulator's launch file sets")
    return wait_for_fleet(wanted)


def _open(vehicles: list[VehicleConnection], source: tuple[int, int]) -> list[AutopilotLink]:
    links: list[AutopilotLink] = []
    try:
        for vehicle in vehicles:
            links.append(AutopilotLink(vehicle.name, vehicle.url, vehicle.target, source))
    except AutopilotLinkError:
        for link in links:
            link.close()
        raise
    return links


def _complaints(params: Iterable[Params]) -> list[str]:
    """Return the problems found in the vehicles' plugin lists, without duplicates."""
    names = [plugin.name for plugin in PLUGINS if plugin.listed]
    absent = plugin_reasons()
    sentences = (PluginLists(own).complaints(names, absent) for own in params)
    return list(dict.fromkeys(itertools.chain.from_iterable(sentences)))


def system_state() -> tuple[Registrations, Registrations]:
    """Return the publishers and subscribers by topic, from the ROS master.

    Raises:
        OSError: the master does not answer.
    """
    try:
        publishers, subscribers, _ = rosgraph.Master(rospy.get_name()).getSystemState()
    except (rosgraph.MasterException, xmlrpc.client.Error, HTTPException) as error:
        raise OSError(str(error)) from error
    return dict(publishers), dict(subscribers)


def setpoint_namespace(value: object) -> str:
    """Return the parameter ``/xtdrone/setpoint_namespace`` after a check.

    Raises:
        ValueError: it is neither empty nor a valid name.
    """
    if isinstance(value, str) and (not value or rosgraph.names.is_legal_base_name(value)):
        return value
    raise ValueError(f"/xtdrone/setpoint_namespace: {value!r} is not allowed, a name such as safety, or empty")


def _params(vehicle: VehicleConnection, settings: Mapping[str, Any]) -> Params:
    own = rospy.get_param(vehicle.prefix, {})
    return Params(own, settings) if isinstance(own, dict) else Params(settings)
