"""The simplified simulator as a ROS node: ``simplified_simulator TYPE NUM``, as ``simplified_simulator iris 9``.

One process stands for simulator, autopilots and MAVROS layer: /clock, the lockstep, /simulator/* and /gazebo/* as the
full simulator has them (``xtdrone_sim.runtime.simulator_node``), and the topics and services of ``topics.py``. With
communication nodes it takes their setpoints, without them XTDrone's commands themselves.

Parameters, besides those of every simulator (``simulator_node.NodeSettings``: ~speed, ~paused, ~until,
~participants, ~digest, ...):
    ~model: first-order, second-order, or a YAML file with the values of ``model.Model``; empty: the type's own.
    ~order: 1 or 2, in place of the model's.
    ~rows: vehicles side by side along x on the spawn grid, 3 m apart; 0: as many as make it the pattern ``origin``.
    ~places: [[x, y, z], ...], m ENU, a place for every vehicle in place of the grid.
    ~airborne (false): start armed, in OFFBOARD, ~altitude (10 m) above these places.
    ~view: a live window (``visualize.py``, in a process of its own that ends with this one); by default where there is
        a display.
    ~hover_speed (m/s, 0.001), ~cmd_timeout (s, 0): of XTDrone's commands, see multirotor_communication.py.
    ~setpoint_timeout (s, 1 as PX4's COM_OF_LOSS_T): a vehicle whose setpoints stop goes from OFFBOARD to POSCTL, which
        holds; 0: it keeps the last one for ever.

Nothing here is random. The node sets /xtdrone/fleet.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3

from xtdrone_control import lockstep
from xtdrone_control.communication.arguments import ArgumentError, check_multirotor, parse_count
from xtdrone_control.communication.core import HOVER_SPEED
from xtdrone_control.fleet import parse_fleet, spawn_grid
from xtdrone_control.geodesy.geo import GRAVITY
from xtdrone_control.lockstep.protocol import Schedule
from xtdrone_control.lockstep.server import LockstepServer
from xtdrone_coordination.patterns import origin_columns
from xtdrone_sim.runtime.backend import Idle
from xtdrone_sim.runtime.mailbox import Mailbox
from xtdrone_sim.runtime.simulator_node import NodeSettings, flag, integer, number, run_node
from xtdrone_swarm.simplified.model import Model, load_model
from xtdrone_swarm.simplified.simplified_vehicles import SimplifiedVehicles
from xtdrone_swarm.simplified.topics import SteeredVehicles, SwarmTopic, VehicleTopics
from xtdrone_swarm.swarm_vehicles import Array
from xtdrone_swarm.viewer import live_window, wanted

USAGE = "simplified_simulator TYPE NUM   (as iris 9)"
RATE = 30  # Hz: local position, and turns of XTDrone's commands

SETPOINT_TIMEOUT = 1.0  # s

_STATE_PERIOD_US = 1_000_000
_EXTENDED_PERIOD_US = 200_000


@dataclass(frozen=True)
class Settings(NodeSettings):
    """What arguments and parameters ask, besides what every simulator is asked; see the module.

    Attributes:
        kind: vehicle type.
        count: how many.
        model: what they are.
        places: shape (count, 3), m ENU.
        airborne: start flying.
        view: open a live window.
        hover_speed: of XTDrone's commands, m/s.
        cmd_timeout: likewise, s.
        setpoint_timeout: s without a setpoint after which OFFBOARD is left; 0: never.
    """

    kind: str
    count: int
    model: Model
    places: Array
    airborne: bool
    view: bool
    hover_speed: float
    cmd_timeout: float
    setpoint_timeout: float

    @classmethod
    def from_parameters(cls, kind: str, count: int) -> Settings:
        """Read the node's parameters.

        Raises:
            ValueError: one that is not allowed.
        """
        airborne = flag("~airborne", False)
        places = _places(kind, count)
        if airborne:
            places[:, 2] += number("~altitude", 10.0, 0.1, 1e4)
        return cls(
            **cls.common_parameters(),
            kind=kind,
            count=count,
            model=_model(kind),
            places=places,
            airborne=airborne,
            view=wanted(flag("~view", False) if rospy.has_param("~view") else None),
            hover_speed=number("~hover_speed", HOVER_SPEED, 0.0, 1e6),
            cmd_timeout=number("~cmd_timeout", 0.0, 0.0, 1e6),
            setpoint_timeout=number("~setpoint_timeout", SETPOINT_TIMEOUT, 0.0, 1e6),
        )


def _model(kind: str) -> Model:
    model = load_model(kind, str(rospy.get_param("~model", "")) or None)
    order = integer("~order", 0, 0, 2)
    return replace(model, order=order) if order else model


def _places(kind: str, count: int) -> Array:
    """Return where the vehicles start, shape (count, 3), m ENU."""
    given = rospy.get_param("~places", [])
    if not given:
        fleet = parse_fleet(f"{kind}:{count}")
        return np.array(spawn_grid(fleet, integer("~rows", 0, 0) or origin_columns(count)))
    try:
        places = np.array(given, dtype=float)
    except (TypeError, ValueError):
        places = np.empty(0)
    if places.shape != (count, 3) or not np.isfinite(places).all():
        raise ValueError(f"{rospy.resolve_name('~places')}: {given!r} is not allowed, {count} places [x, y, z], m ENU")
    return places


class SimplifiedScene:
    """Simplified vehicles behind topics; see ``xtdrone_sim.runtime.backend.Scene``.

    Attributes:
        names: the vehicles'.
        scenery, actors: none.
        step_us: base step, microseconds.
        gravity: m/s^2.
        need_time: services are answered at once.
        descriptors: nothing comes but by ROS.
        patience: nothing needs care meanwhile.
    """

    gravity = GRAVITY
    need_time = False
    descriptors: Sequence[int] = ()
    patience = math.inf

    def __init__(
        self, vehicles: SteeredVehicles, *, hover_speed: float, cmd_timeout: float, setpoint_timeout: float
    ) -> None:
        """Take the vehicles; the rest as for ``VehicleTopics``."""
        self.names: Sequence[str] = vehicles.names
        self.scenery: Sequence[str] = ()
        self.actors: Sequence[str] = ()
        self.step_us = vehicles.step_us
        self._vehicles = vehicles
        self._options = {
            "hover_speed": hover_speed,
            "cmd_timeout": cmd_timeout,
            "setpoint_timeout": setpoint_timeout,
        }
        self._schedule = Schedule(RATE, vehicles.step_us)
        self._began_us = 0
        self._begin()

    def _begin(self) -> None:
        # At once: participants have a turn in the first tick, whenever that is.
        self._next_turn_us = self._next_state_us = self._next_extended_us = 0

    @property
    def time_us(self) -> int:
        """Simulated time, microseconds; the vehicles' own begins anew when they are put back."""
        return self._began_us + self._vehicles.time_us

    def open(self, server: LockstepServer, mailbox: Mailbox, idle: Idle) -> None:
        """Offer topics and services."""
        self._server = server
        self._swarm = SwarmTopic(self._vehicles)
        self._topics = [
            VehicleTopics(self._vehicles, index, mailbox, lambda: self.time_us * 1e-6, **self._options)
            for index in range(len(self.names))
        ]

    def missing(self) -> str:
        """Nobody is waited for."""
        return ""

    def serve(self, ready: Collection[int]) -> None:
        """Nothing comes but by ROS."""

    def next_due_us(self, now_us: int) -> int | None:
        """Return the time of the next turn."""
        return self._schedule.after_us(now_us)

    def next_told_us(self, now_us: int) -> int | None:
        """Nothing is told but at ``next_due_us``."""
        return None

    def advance(self, until_us: int) -> None:
        """Move on."""
        self._vehicles.advance(until_us - self._began_us)

    def step(self) -> None:
        """Move on by a base step."""
        self._vehicles.advance(self._vehicles.time_us + self.step_us)

    def tick(self, idle: Idle) -> None:
        """Publish in a turn, run one barrier, dispatch what came, and carry out XTDrone's commands in a turn."""
        now_us = self.time_us
        turn = now_us >= self._next_turn_us
        if turn:
            self._next_turn_us = self._schedule.after_us(now_us)
            self._publish(now_us)
        self._server.tick(now_us, {}, idle)
        lockstep.host().receive()
        if turn:
            for topics in self._topics:
                topics.act()

    def _publish(self, now_us: int) -> None:
        now = rospy.Time(0, 0) + rospy.Duration(0, now_us * 1000)
        state_is_due = now_us >= self._next_state_us
        if state_is_due:
            self._next_state_us = now_us - now_us % _STATE_PERIOD_US + _STATE_PERIOD_US
        extended_is_due = now_us >= self._next_extended_us
        if extended_is_due:
            self._next_extended_us = now_us - now_us % _EXTENDED_PERIOD_US + _EXTENDED_PERIOD_US
        self._swarm.publish()
        for topics in self._topics:
            topics.publish_state(now, state_is_due)
            topics.publish_motion(now)
            if extended_is_due:
                topics.publish_extended(now)

    def truth(self) -> bytes:
        """Return positions, velocities and headings."""
        vehicles = self._vehicles
        return vehicles.true_position.tobytes() + vehicles.velocity.tobytes() + vehicles.yaw.tobytes()

    def model_states(self) -> ModelStates:
        """Return level vehicles at their places."""
        message = ModelStates(name=["ground_plane", *self.names])
        message.pose.append(Pose(Point(0.0, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0)))
        message.twist.append(Twist())
        vehicles = self._vehicles
        rows = zip(
            vehicles.true_position.tolist(), vehicles.velocity.tolist(), (0.5 * vehicles.yaw).tolist(), strict=True
        )
        for position, velocity, half in rows:
            turned = Quaternion(0.0, 0.0, math.sin(half), math.cos(half))
            message.pose.append(Pose(Point(*position), turned))
            message.twist.append(Twist(Vector3(*velocity), Vector3()))
        return message

    def collisions(self) -> set[tuple[int, int]]:
        """They fly through each other and everything."""
        return set()

    def restart(self, time_us: int) -> None:
        """Put all back to their start."""
        self._vehicles.restart()
        self._began_us = time_us
        self._begin()
        for topics in self._topics:
            topics.restart()

    def close(self) -> None:
        """Free what the vehicles hold."""
        self._vehicles.close()


def _arguments(arguments: Sequence[str]) -> tuple[str, int]:
    """Return type and number of the vehicles.

    Raises:
        ArgumentError: they cannot be flown.
    """
    if len(arguments) != 2:
        raise ArgumentError(f"2 arguments are needed, {len(arguments)} were given")
    kind, count = arguments
    check_multirotor(kind, None)
    return kind, parse_count(count)


def main() -> int:
    """Run the node; return its exit status."""
    try:
        kind, count = _arguments(rospy.myargv(sys.argv)[1:])
    except ArgumentError as error:
        print(f"{error}\nusage: {USAGE}", file=sys.stderr)
        return 2

    windows = contextlib.ExitStack()

    def make() -> tuple[Settings, SimplifiedScene]:
        settings = Settings.from_parameters(kind, count)
        # The dead zone is that of XTDrone's commands: whoever sends setpoints has his own.
        vehicles = SimplifiedVehicles(
            count,
            kind=kind,
            model=settings.model,
            places=settings.places,
            airborne=settings.airborne,
            hover_speed=None,
        )
        rospy.set_param("/xtdrone/fleet", f"{kind}:{count}")
        if settings.view:
            windows.enter_context(live_window(kind, count, sys.argv))
        scene = SimplifiedScene(
            vehicles,
            hover_speed=settings.hover_speed,
            cmd_timeout=settings.cmd_timeout,
            setpoint_timeout=settings.setpoint_timeout,
        )
        return settings, scene

    with windows:
        return run_node(make, sys.argv)
