"""The simulator as a ROS node: /clock, /gazebo/model_states, MAVLink over UDP, the lockstep's barrier, pacing."""

from __future__ import annotations

import logging
import select
import sys
import time
from dataclasses import dataclass

import rosgraph
import rospy
from gazebo_msgs.msg import ModelStates
from rosgraph_msgs.msg import Clock

from xtdrone_control import lockstep
from xtdrone_control.fleet import Vehicle, parse_fleet
from xtdrone_control.lockstep.server import LockstepServer
from xtdrone_control.mavlink.server import MavlinkServer

from .gazebo_names import model_states
from .pacing import Pacer
from .simulation import Simulation

_CHUNK_US = 20_000  # longest simulated time between two looks at sockets and pace
_DATAGRAM_LIMIT = 10.0  # s of wall time to wait for datagrams that a participant says it has sent
_JOIN_REPORT = 5.0  # s between two words on who has not joined
_CONNECT_LIMIT = 30.0  # s of wall time that the world is held for a topic connection; a loaded machine takes some


@dataclass(frozen=True)
class Settings:
    """What the node's parameters ask.

    Attributes:
        fleet: vehicles (``/xtdrone/fleet`` or ``~fleet``).
        rows: spawn grid (``~rows``).
        world: name or file (``~world``).
        seed: of the sensor noise (``~seed``).
        speed: target real-time factor, 0 for unlimited (``~speed``).
        participants: lockstep participants to wait for before time starts (``~participants``).
        start_limit: wall seconds to wait for them (``~start_limit``).
        hang_limit: wall seconds of silence after which a participant is dropped (``~hang_limit``).
        host: address on which lockstep and MAVLink listen (``~host``).
        shared_datum: one local frame for all (``~shared_datum``).
        states_rate: /gazebo/model_states, Hz of simulated time (``~model_states_rate``).
    """

    fleet: tuple[Vehicle, ...]
    rows: int
    world: str
    seed: int
    speed: float
    participants: int
    start_limit: float
    hang_limit: float
    host: str
    shared_datum: bool
    states_rate: float

    @classmethod
    def from_parameters(cls) -> Settings:
        """Read the node's parameters.

        Raises:
            ValueError: one that is not allowed.
        """
        return cls(
            fleet=parse_fleet(str(rospy.get_param("~fleet", rospy.get_param("/xtdrone/fleet", "iris:1")))),
            rows=_integer("~rows", 3, 1),
            world=str(rospy.get_param("~world", "empty")),
            seed=_integer("~seed", 0, 0),
            speed=_number("~speed", 1.0, 0.0, 1e6),
            participants=_integer("~participants", 0, 0),
            start_limit=_number("~start_limit", 120.0, 0.0, 1e6),
            hang_limit=_number("~hang_limit", 60.0, 0.0, 1e6),
            host=str(rospy.get_param("~host", "127.0.0.1")),
            shared_datum=bool(rospy.get_param("~shared_datum", True)),
            states_rate=_number("~model_states_rate", 50.0, 0.1, 250.0),
        )


def _number(name: str, default: float, low: float, high: float) -> float:
    value = rospy.get_param(name, default)
    if not isinstance(value, (int, float)) or not low <= value <= high:
        raise ValueError(f"{rospy.resolve_name(name)}: {value!r} is not allowed, {low} to {high}")
    return float(value)


def _integer(name: str, default: int, low: int) -> int:
    value = rospy.get_param(name, default)
    if not isinstance(value, int) or value < low:
        raise ValueError(f"{rospy.resolve_name(name)}: {value!r} is not allowed, a whole number from {low}")
    return value


class SimulatorNode:
    """Runs a simulation against the ROS graph until ROS shuts down."""

    def __init__(self, settings: Settings) -> None:
        """Set everything up; time stands at 0.

        Raises:
            ValueError: bad settings, unknown vehicle or world.
            OSError: a port that is taken.
        """
        self._settings = settings
        self._names = [vehicle.name for vehicle in settings.fleet]
        self._pacer = Pacer(settings.speed)
        self._simulation = Simulation(
            settings.fleet,
            rows=settings.rows,
            world=settings.world,
            seed=settings.seed,
            shared_datum=settings.shared_datum,
        )
        self._mavlink = MavlinkServer(settings.fleet, self._simulation.autopilot, self._simulation.commanders)
        self._server = LockstepServer(settings.host, settings.hang_limit, connect_limit=_CONNECT_LIMIT, log=_log)
        self._clock = rospy.Publisher("/clock", Clock, queue_size=10)
        self._server.attach_host(lockstep.host())
        self._states = lockstep.Publisher("/gazebo/model_states", ModelStates)
        self._states_period_us = round(1e6 / settings.states_rate)
        self._next_states_us = 0
        self._collisions: set[tuple[int, int]] = set()
        self._lost: dict[int, int] = {}  # datagrams given up, by local port
        self._poll = select.epoll()
        self._poll.register(self._server.fileno(), select.EPOLLIN)
        self._poll.register(self._mavlink.fileno(), select.EPOLLIN)
        rospy.set_param("/lockstep/uri", self._server.uri)
        rospy.on_shutdown(_forget_uri)

    def run(self) -> None:
        """Step until shutdown."""
        try:
            self._publish_clock()
            self._wait_for_participants()
            while True:
                self._advance()
                self._wait_for_pace()
        except rospy.ROSException:
            # ROSInterruptException of our own, or rospy's word that its topics are closed
            if not rospy.is_shutdown():
                raise
        finally:
            self._server.close()
            self._mavlink.close()
            self._simulation.close()

    def _wait_for_participants(self) -> None:
        expected = self._settings.participants
        end = time.monotonic() + self._settings.start_limit
        while expected and time.monotonic() < end:
            if self._server.wait_for(expected, _JOIN_REPORT, self._serve):
                rospy.loginfo("simulator: %d participants have joined, time starts", expected)
                return
            rospy.loginfo("simulator: holding time at 0: %s", self._server.missing(expected))
        if expected:
            rospy.logwarn(
                "simulator: time starts without all participants after %.0f s: %s",
                self._settings.start_limit,
                self._server.missing(expected),
            )

    def _advance(self) -> None:
        """Step to the next tick, or a little way when nobody is due soon; then one barrier."""
        simulation, mavlink = self._simulation, self._mavlink
        now = simulation.time_us
        due = self._server.next_due_us(now)
        until = now + _CHUNK_US if due is None else min(due, now + _CHUNK_US)
        next_stream = mavlink.next_due_us
        while simulation.time_us < until:
            simulation.step()
            if simulation.time_us >= next_stream:
                mavlink.send_streams(simulation.time_us)
                next_stream = mavlink.next_due_us
        now = simulation.time_us
        mavlink.send_streams(now)
        self._publish_clock()
        if now >= self._next_states_us:
            self._publish_states(now)
        self._serve(0.0)
        self._server.tick(now, mavlink.sent, self._serve)
        self._await_datagrams()
        self._report_collisions()

    def _report_collisions(self) -> None:
        new = self._simulation.world.collisions - self._collisions
        for a, b in sorted(new):
            rospy.logwarn("simulator: collision of %s and %s", self._names[a], self._names[b])
        self._collisions |= new

    def _serve(self, timeout: float) -> None:
        """Wait up to ``timeout`` s for something on any socket, and serve what came by MAVLink.

        Raises:
            ROSInterruptException: ROS shuts down; whoever waits for a participant must not wait on.
        """
        if rospy.is_shutdown():
            raise rospy.ROSInterruptException("shutdown")
        events = self._poll.poll(timeout)
        server = self._server.fileno()
        if any(descriptor != server for descriptor, _ in events):
            self._mavlink.receive(0.0)

    def _await_datagrams(self) -> None:
        """Take in the MAVLink that participants say they have sent in this tick."""
        missing = self._missing_datagrams()
        end = time.monotonic() + _DATAGRAM_LIMIT
        while missing and time.monotonic() < end:
            self._mavlink.receive(0.01)
            missing = self._missing_datagrams()
        for port, count in missing.items():
            rospy.logwarn("simulator: %d datagrams to UDP port %d did not come", count, port)
            self._lost[port] = self._lost.get(port, 0) + count

    def _missing_datagrams(self) -> dict[int, int]:
        """Return how many datagrams are on their way to each local port, where there are any."""
        received, lost = self._mavlink.received, self._lost
        missing = {}
        for port, count in self._server.datagrams_expected.items():
            away = count - received.get(port, count) - lost.get(port, 0)
            if away > 0:
                missing[port] = away
        return missing

    def _wait_for_pace(self) -> None:
        while True:
            delay = self._pacer.delay(self._simulation.time_us, time.monotonic())
            if delay <= 0.0:
                return
            self._serve(min(delay, 0.1))
            self._server.poll(0.0)

    def _publish_clock(self) -> None:
        self._clock.publish(Clock(clock=rospy.Time.from_sec(0) + rospy.Duration(0, self._simulation.time_us * 1000)))

    def _publish_states(self, now: int) -> None:
        self._next_states_us += self._states_period_us
        if self._next_states_us <= now:
            self._next_states_us = now + self._states_period_us
        if self._states.get_num_connections():
            self._states.publish(model_states(self._names, self._simulation.world.plant))


def _forget_uri() -> None:
    try:
        rospy.delete_param("/lockstep/uri")
    except (KeyError, rospy.ROSException, OSError):
        rospy.logdebug("simulator: /lockstep/uri was gone already")


def _log(level: int, text: str) -> None:
    """Pass the lockstep's words on to ROS."""
    write = {logging.WARNING: rospy.logwarn, logging.ERROR: rospy.logerr}.get(level, rospy.loginfo)
    write("simulator: %s", text)


def main() -> int:
    """Run the node; return its exit status."""
    if not rosgraph.is_master_online():
        advice = "start one (roscore, roslaunch) or set ROS_MASTER_URI"
        print(f"simulator: no ROS master answers at {rosgraph.get_master_uri()}; {advice}", file=sys.stderr)
        return 1
    rospy.init_node("simulator", disable_rostime=True)
    try:
        node = SimulatorNode(Settings.from_parameters())
    except (ValueError, OSError) as error:
        rospy.logfatal("simulator: %s", error)
        return 1
    node.run()
    return 0
