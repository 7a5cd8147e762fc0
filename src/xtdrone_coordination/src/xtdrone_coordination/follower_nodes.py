"""ROS nodes of followers and avoidance, and the main functions of their programs.

The leader is in ``ros_leader``: it needs scipy, which would double the memory of every follower's process.

==================================  ============================  =====================================================
topic                               type                          from, to
==================================  ============================  =====================================================
/xtdrone/leader/cmd                 std_msgs/String               user -> leader: a pattern's name, or for vehicle 0
/xtdrone/leader/cmd_vel_flu         geometry_msgs/Twist           user -> leader -> vehicle 0 (cmd_accel_flu likewise)
/xtdrone/leader/pose                geometry_msgs/PoseStamped     leader: pose of vehicle 0
/xtdrone/formation_pattern          std_msgs/Float32MultiArray    leader -> followers: 3 x (N-1), assigned offsets
/xtdrone/communication_topology     std_msgs/Int32MultiArray      leader -> followers: N x N, row i: neighbours of i
/xtdrone/T/avoid_vel (avoid_accel)  geometry_msgs/Vector3         avoidance of vehicle T, before its gain
/xtdrone/T/cmd_vel_enu (..accel..)  geometry_msgs/Twist           follower -> communication node
/T/mavros/local_position/pose       geometry_msgs/PoseStamped     every vehicle -> leader, followers, avoid
==================================  ============================  =====================================================

When simulated time is reset, leader, followers and avoidance restart. Pattern and topology are latched and survive
this: followers ignore messages received before their first step, and the leader replaces its latched messages by an
empty pattern and topology, which mean none.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import rospy
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped, Vector3
from numpy.typing import ArrayLike
from std_msgs.msg import Float32MultiArray, Float64MultiArray, Int32MultiArray

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import (
    ArgumentError,
    check_multirotor,
    fleet_of,
    parse_count,
    parse_ids,
    run_program,
)
from xtdrone_common.programs.user_classes import load_class, nothing_overridden
from xtdrone_common.settings import Settings, setting
from xtdrone_control.communication.commands import CommandSettings
from xtdrone_control.communication.multirotor import MultirotorCommunication
from xtdrone_coordination.compiled_follower import CompiledFollower, is_stock
from xtdrone_coordination.follower import RATE, Follower, FollowerOptions
from xtdrone_coordination.known_swarm_state import STATE_FIELDS, ArraySwarm, SwarmState, number_list
from xtdrone_coordination.laws import formation_avoidance
from xtdrone_coordination.laws.consensus import Vector
from xtdrone_coordination.laws.topology import without_neighbours
from xtdrone_coordination.patterns import PatternError

if TYPE_CHECKING:
    from xtdrone_coordination.batch import FollowerBatch

PATTERN_TOPIC = "/xtdrone/formation_pattern"
TOPOLOGY_TOPIC = "/xtdrone/communication_topology"

MANY = 30  # followers per process from which on computing them together is worth the start-up time of the kernels

_Base = TypeVar("_Base")
_Settings = TypeVar("_Settings", bound=Settings)


def subscribe_swarm(
    kind: str,
    swarm: SwarmState,
    *,
    velocities: bool = False,
    on_leader_pose: Callable[[PoseStamped], None] | None = None,
    estimates_of: int | None = None,
) -> str:
    """Subscribe to the positions of all vehicles of a type.

    The parameter ``/xtdrone/swarm_topic`` names a topic with all states in one message, as published by this
    workspace's MAVROS layer; if empty, the ``mavros/local_position`` topics of every vehicle are used, as in XTDrone.

    Args:
        kind: vehicle type, as ``iris``.
        swarm: receives them.
        velocities: whether to subscribe to velocities too.
        on_leader_pose: called with vehicle 0's whole pose.
        estimates_of: vehicle whose own estimates of the others are received instead, as of relative localisation.

    Returns:
        The topic with all states; empty if there is none.
    """

    def on_pose(index: int, message: PoseStamped) -> None:
        p = message.pose.position
        swarm.on_position(index, (p.x, p.y, p.z))
        if index == 0 and on_leader_pose is not None:
            on_leader_pose(message)

    def on_velocity(index: int, message: TwistStamped) -> None:
        v = message.twist.linear
        swarm.on_velocity(index, (v.x, v.y, v.z))

    def on_swarm(message: Float64MultiArray) -> None:
        if len(message.data) < STATE_FIELDS * swarm.count:
            rospy.logwarn_throttle(10.0, f"{topic}: {len(message.data)} numbers are too few for {swarm.count} vehicles")
            return
        swarm.hear_states(message.data)

    topic = str(rospy.get_param("/xtdrone/swarm_topic", ""))
    if estimates_of is not None:
        topic = f"/xtdrone/{kind}_{estimates_of}/swarm"
    if topic:
        lockstep.Subscriber(topic, Float64MultiArray, on_swarm)
        if on_leader_pose is not None:
            lockstep.Subscriber(f"/{kind}_0/mavros/local_position/pose", PoseStamped, on_leader_pose)
        return topic
    for i in range(swarm.count):
        base = f"/{kind}_{i}/mavros/local_position"
        lockstep.Subscriber(f"{base}/pose", PoseStamped, partial(on_pose, i))
        if velocities:
            lockstep.Subscriber(f"{base}/velocity_local", TwistStamped, partial(on_velocity, i))
    return ""


class OneByOne:
    """Followers computed one after the other; has the methods of FollowerBatch used by nodes."""

    def __init__(self, followers: Sequence[Follower]) -> None:
        self._followers = followers

    def on_pattern(self, offsets: ArrayLike) -> None:
        """See :meth:`Follower.on_pattern`."""
        for follower in self._followers:
            follower.on_pattern(offsets)

    def on_topology(self, adjacency: ArrayLike) -> None:
        """See :meth:`Follower.on_topology`."""
        for follower in self._followers:
            follower.on_topology(adjacency)

    def commands(self) -> list[Vector | None]:
        """Return the command of each follower; None for those without."""
        return [follower.update() for follower in self._followers]


def make_swarm(count: int, followers: int) -> SwarmState:
    """Return a state of ``count`` vehicles for a process with ``followers`` followers: in arrays if they are MANY."""
    return ArraySwarm(count) if followers >= MANY else SwarmState(count)


def together(followers: Sequence[Follower]) -> OneByOne | FollowerBatch:
    """Return a batch of the followers if their state is in arrays, else one that computes them one by one."""
    swarm = followers[0].swarm
    if not isinstance(swarm, ArraySwarm):
        return OneByOne(followers)
    from xtdrone_coordination.batch import FollowerBatch  # takes half a second, avoided for a few followers

    return FollowerBatch(followers, swarm)


class FollowerNode:
    """Subscriptions and publications of the followers of one process."""

    def __init__(self, kind: str, followers: Sequence[Follower], *, estimated: bool = False) -> None:
        """Declare the topics.

        Args:
            kind: vehicle type, as ``iris``.
            followers: Followers, at least one, all with the same options and ``swarm``; with ``estimated`` one.
            estimated: whether the positions are the follower's own estimates.
        """
        self.kind = kind
        self.followers = followers
        self._all = together(followers)
        self.swarm = followers[0].swarm
        options = followers[0].options
        self._count = followers[0].count
        self._pattern: tuple[float, ...] = ()
        self._topology: tuple[int, ...] = ()
        self._restarting = False
        self._twist = Twist()
        self._vector = Vector3()
        self._commands = {}
        self._avoidances = {}
        lockstep.Subscriber(PATTERN_TOPIC, Float32MultiArray, self._on_pattern)
        lockstep.Subscriber(TOPOLOGY_TOPIC, Int32MultiArray, self._on_topology)
        velocities = options.mode == "accel" or followers[0].uses_velocities
        own = followers[0].id if estimated else None
        self._swarm_topic = subscribe_swarm(kind, self.swarm, velocities=velocities, estimates_of=own)
        for follower in followers:
            base = f"/xtdrone/{kind}_{follower.id}"
            self._commands[follower.id] = lockstep.Publisher(f"{base}/cmd_{options.mode}_enu", Twist)
            topic = f"{base}/avoid_{options.mode}"
            if options.avoid == "own":
                self._avoidances[follower.id] = lockstep.Publisher(topic, Vector3)
            elif options.avoid == "topic":
                lockstep.Subscriber(topic, Vector3, partial(self._on_avoidance, follower))
        lockstep.add_reset_hook(self._restart)

    def _restart(self) -> None:
        """Restart; messages of this turn are latched ones from before the reset and are ignored."""
        self._reset()
        self._restarting = True

    def _reset(self) -> None:
        self._pattern = self._topology = ()
        for follower in self.followers:
            follower.restart()

    def step(self) -> None:
        """Publish the commands of all followers; call it at 30 Hz."""
        self._restarting = False
        for follower, command in zip(self.followers, self._all.commands(), strict=True):
            if command is None:
                continue
            linear = self._twist.linear
            linear.x, linear.y, linear.z = command
            self._commands[follower.id].publish(self._twist)
            publisher = self._avoidances.get(follower.id)
            if publisher is not None:
                self._vector.x, self._vector.y, self._vector.z = follower.avoidance_vector
                publisher.publish(self._vector)
        self.swarm.tick()

    def compiled(self, communication: MultirotorCommunication | None) -> CompiledFollower | None:
        """Return the compiled turn of a single stock follower that receives all states in one message, else None.

        Args:
            communication: the follower's vehicle's, if it is in this process too: its step comes first in the turn.
        """
        follower = self.followers[0]
        if len(self.followers) > 1 or not self._swarm_topic or not is_stock(follower):
            return None
        vehicle = f"{self.kind}_{follower.id}"
        mavros = f"/{vehicle}/mavros"
        received = [PATTERN_TOPIC, TOPOLOGY_TOPIC, self._swarm_topic, f"{mavros}/state"]
        received += [f"{mavros}/local_position/pose", f"/xtdrone/{vehicle}/cmd_vel_enu"]
        published = [] if communication is None else [communication.publisher]
        published += [self._commands[follower.id], *self._avoidances.values()]
        received = [rospy.resolve_name(name) for name in received]
        return CompiledFollower(follower, received, published, lambda: (self._pattern, self._topology), communication)

    def _on_pattern(self, message: Float32MultiArray) -> None:
        """Store the leader's pattern; most messages are repetitions."""
        if self._restarting or tuple(message.data) == self._pattern:
            return
        if not message.data:
            self._reset()
            return
        self._pattern = tuple(message.data)
        width = self._count - 1
        if len(message.data) != 3 * width:
            rospy.logwarn(f"{PATTERN_TOPIC}: {len(message.data)} values, {self._count} vehicles need 3 x {width}")
            return
        offsets = [message.data[k::width] for k in range(width)]
        try:
            self._all.on_pattern(offsets)
        except PatternError as error:
            rospy.logwarn(f"{PATTERN_TOPIC}: {error}")

    def _on_topology(self, message: Int32MultiArray) -> None:
        if self._restarting or not message.data or tuple(message.data) == self._topology:
            return
        self._topology = tuple(message.data)
        try:
            self._all.on_topology(message.data)
        except ValueError as error:
            rospy.logwarn(f"{TOPOLOGY_TOPIC}: {error}")
            return
        alone = sorted({follower.id for follower in self.followers} & set(without_neighbours(message.data)))
        if alone:
            rospy.logwarn(f"{TOPOLOGY_TOPIC}: no neighbours for vehicle {number_list(alone)}: vehicle 0 is added")

    def _on_avoidance(self, follower: Follower, message: Vector3) -> None:
        follower.on_avoidance((message.x, message.y, message.z))


class AvoidanceNode:
    """Avoidance of many vehicles in one process, as XTDrone's avoid.py; used by followers with ``avoid: topic``."""

    def __init__(self, kind: str, count: int, ids: Sequence[int], mode: str, radius: float) -> None:
        """Declare the topics.

        Args:
            kind: vehicle type, as ``iris``.
            count: number of vehicles N.
            ids: vehicles to compute the avoidance of.
            mode: ``vel`` or ``accel``: the topic's name.
            radius: b, m, above 0.
        """
        self.swarm = SwarmState(count)
        self._radius = radius
        self._publishers = {i: lockstep.Publisher(f"/xtdrone/{kind}_{i}/avoid_{mode}", Vector3) for i in ids}
        subscribe_swarm(kind, self.swarm)
        lockstep.add_reset_hook(self.swarm.restart)

    def step(self) -> None:
        """Publish the avoidance of each vehicle whose position is known; call it at 30 Hz."""
        for i, publisher in self._publishers.items():
            if self.swarm.positions[i] is not None:
                publisher.publish(Vector3(*formation_avoidance.avoid(i, self.swarm.positions, self._radius)))


@dataclass(frozen=True)
class HostedCommunication(CommandSettings):
    """A follower's process that also does the work of its vehicles' communication nodes."""

    communication: bool = setting(
        False,
        text="carry out XTDrone's commands for the followers' vehicles in this process instead of "
        "multirotor_communication.py; saves one process per vehicle",
    )

    def open(self, kind: str, ids: Sequence[int]) -> list[MultirotorCommunication]:
        """Declare the topics of the vehicles' communication, if any; call between init_node and start of lockstep."""
        if not self.communication:
            return []
        commands = {"hover_speed": self.hover_speed, "cmd_timeout": self.cmd_timeout}
        return [MultirotorCommunication(f"{kind}_{i}", in_lockstep=lockstep.is_active(), **commands) for i in ids]


@dataclass(frozen=True)
class NeighbourSettings(Settings):
    """Source of the positions of a follower node."""

    neighbours: Literal["truth", "estimated"] = setting(
        "truth",
        choices=("truth", "estimated"),
        text="positions of the other vehicles: as they report them in the shared frame, or as this vehicle estimates "
        "them on /xtdrone/T/swarm, for example by relative_localisation.py",
    )


@dataclass(frozen=True)
class TurnSettings(Settings):
    """How a follower's process takes its turns."""

    compiled: bool = setting(
        True,
        text="run the turns of a single follower that overrides no method in compiled code, with bit-identical "
        "results; false: run all in Python, for a debugger",
    )


def follower_nodes(kind: str, followers: Sequence[Follower], *, estimated: bool) -> list[FollowerNode]:
    """Return the nodes of the followers: one for all, or with estimates, of which each has its own, one each."""
    if not estimated:
        return [FollowerNode(kind, followers)]
    return [FollowerNode(kind, [follower], estimated=True) for follower in followers]


def run_follower(cls: type[Follower] = Follower, *, mode_argument: bool = False) -> int:
    """Run a follower program with ``sys.argv``; return the exit status.

    Args:
        cls: the follower's class; the parameter ``~class`` (``file.py``, ``file.py:Class`` or ``module:Class``)
            replaces it.
        mode_argument: whether the fourth argument, ``vel`` or ``accel``, is required; else ``~mode`` is used if it is
            missing.
    """

    def main(arguments: Sequence[str]) -> None:
        check_number_of(arguments, 4 if mode_argument or len(arguments) > 3 else 3)
        kind, text, number, *mode = arguments
        count = count_of(kind, number)
        ids = parse_ids(text, 1, count - 1)
        name = f"follower_{ids[0]}" if len(ids) == 1 else f"followers_{ids[0]}_{ids[-1]}"
        lockstep.init_node(name, rate=RATE)
        given = {"mode": mode[0]} if mode else {}
        settings = options(FollowerOptions, given)
        communication = options(HostedCommunication, {})
        compiled = options(TurnSettings, {}).compiled
        chosen = class_parameter(cls, Follower)
        estimated = options(NeighbourSettings, {}).neighbours == "estimated"
        swarm = None if estimated else make_swarm(count, len(ids))
        followers = [chosen(i, count, swarm=swarm, options=settings, warn=rospy.logwarn) for i in ids]
        for follower in followers:
            follower.info = rospy.loginfo
        with lockstep.registering_together():
            nodes = follower_nodes(kind, followers, estimated=estimated)
            hosted = communication.open(kind, ids)

        def step() -> None:
            for vehicle in hosted:
                vehicle.step()
            for node in nodes:
                node.step()

        single = compiled and len(nodes) == 1 and len(hosted) <= 1
        try:
            lockstep.start()
            lockstep.spin(step, nodes[0].compiled(hosted[0] if hosted else None) if single else None)
        finally:
            for vehicle in hosted:
                vehicle.close()

    usage = "TYPE ID NUM" + (" vel|accel" if mode_argument else " [vel|accel]") + "   (ID: 1, 1-8, 1,3 or all)"
    return run_program(main, sys.argv, f"{Path(sys.argv[0]).name} {usage}")


@dataclass(frozen=True)
class AvoidanceSettings(Settings):
    """Settings of the avoidance node."""

    avoid_radius: float = setting(formation_avoidance.RADIUS, above=0.0, unit="m", text="radius b of the avoidance")


def run_avoidance() -> int:
    """Run the avoidance program with ``sys.argv``; return the exit status."""

    def main(arguments: Sequence[str]) -> None:
        check_number_of(arguments, 3)
        kind, number, mode = arguments
        count = count_of(kind, number)
        if mode not in ("vel", "accel"):
            raise ArgumentError(f"mode: {mode!r} is not allowed, one of vel, accel")
        lockstep.init_node("avoid", rate=RATE)
        ids = parse_ids(str(rospy.get_param("~ids", "all")), 0, count - 1, "~ids")
        node = AvoidanceNode(kind, count, ids, mode, options(AvoidanceSettings, {}).avoid_radius)
        lockstep.start()
        lockstep.spin(node.step)

    return run_program(main, sys.argv, f"{Path(sys.argv[0]).name} TYPE NUM vel|accel")


def class_parameter(default: type[_Base], base: type[_Base]) -> type[_Base]:
    """Return the class named by the parameter ``~class``, ``default`` if it is empty or not set.

    Raises:
        ArgumentError: see :func:`load_class`.
    """
    text = rospy.get_param("~class", "")
    chosen = load_class(text, base) if text else default
    warning = nothing_overridden(chosen, base)
    if warning:
        rospy.logwarn(f"~class: {warning}")
    return chosen


def options(cls: type[_Settings], given: dict[str, Any]) -> _Settings:
    """Return settings read from the private parameters named after their fields, except those in ``given``.

    Raises:
        ArgumentError: a value is not allowed.
    """
    try:
        return cls.from_parameters(rospy.get_param, **given)
    except ValueError as error:
        raise ArgumentError(str(error)) from error


def check_number_of(arguments: Sequence[str], needed: int) -> None:
    """Raise ArgumentError unless there are ``needed`` arguments."""
    if len(arguments) != needed:
        raise ArgumentError(f"{needed} arguments are needed, {len(arguments)} were given")


def count_of(kind: str, number: str) -> int:
    """Return the number of vehicles of a formation.

    Raises:
        ArgumentError: less than 2, more than allowed or than the fleet has, or an unknown type.
    """
    count = parse_count(number)
    if count < 2:
        raise ArgumentError(f"number of vehicles: {count} is not allowed, a formation has at least 2")
    there = check_multirotor(kind, fleet_of(rospy.get_param("/xtdrone/fleet", None)))
    if there is not None and count > there:
        raise ArgumentError(f"number of vehicles: {count}, but the fleet (/xtdrone/fleet) has {there} of type {kind}")
    return count
