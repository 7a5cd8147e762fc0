"""The simplified simulator as a ROS node: ``simplified_simulator TYPE NUM``, e.g. ``simplified_simulator iris 9``.

One process replaces simulator, autopilots and MAVROS layer. It offers /clock, the lockstep, /simulator/* and /gazebo/*
like the full simulator (``xtdrone_sim.runtime.simulator_node``), and the topics and services of ``simplified_topics``.
It receives setpoints from communication nodes or, without them, executes XTDrone's commands directly.

Parameters: those of :class:`SimplifiedSettings`, and
    ~model: first-order, second-order, or a YAML file with the values of ``vehicle_parameters.Model``; empty for the
        vehicle type's.
    ~order: 1 or 2, replaces the model's.
    ~rows: vehicles side by side along x on the spawn grid, 3 m apart; 0 for the grid of the pattern ``origin``.
    ~poses: start poses of all vehicles instead of the grid, a YAML list of [x, y, z, roll, pitch, yaw], m and rad ENU;
        roll and pitch are 0.
    ~places: likewise, only positions: [[x, y, z], ...], m ENU.
    ~altitude (10 m): height above these positions with ~airborne.
    ~view: open a live window (``visualize.py``, in a process that ends with this one); default: with a display.

The simulation is deterministic. The node sets /xtdrone/fleet.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import signal
import subprocess
import sys
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import StartPose, Vehicle, fleet_text, parse_fleet, start_poses, with_poses
from xtdrone_common.geodesy.projection import GRAVITY
from xtdrone_common.programs.node_command_line import ArgumentError, check_multirotor, parse_count
from xtdrone_common.rotation import Vector
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_control.communication.commands import CommandSettings
from xtdrone_coordination.patterns import origin_columns
from xtdrone_lockstep.protocol import Schedule
from xtdrone_lockstep.server import LockstepServer
from xtdrone_sim.mailbox import Mailbox
from xtdrone_sim.runtime.simulator_interface import HEAD_START, Idle, index_of
from xtdrone_sim.runtime.simulator_node import NodeSettings, run_node
from xtdrone_swarm.simplified.simplified_topics import SteeredVehicles, SwarmTopic, VehicleTopics
from xtdrone_swarm.simplified.simplified_vehicles import SimplifiedVehicles
from xtdrone_swarm.simplified.vehicle_parameters import Model, load_model
from xtdrone_swarm.swarm_vehicles import Array

_PR_SET_PDEATHSIG = 1
_PATIENCE = 3.0  # s of wall time for the window to close
_libc = ctypes.CDLL(None)


def wants_window(view: bool | None) -> bool:
    """Return whether to open a live window.

    Args:
        view: the user's choice; None: open a window if a display is available.

    Raises:
        ValueError: a window is requested without a display.
    """
    has_display = bool(os.environ.get("DISPLAY"))
    if view and not has_display:
        raise ValueError("~view: there is no display (DISPLAY is not set); a film needs none, see visualize.py")
    return has_display if view is None else view


@contextlib.contextmanager
def live_window(kind: str, count: int, remappings: Sequence[str]) -> Iterator[None]:
    """Show ``visualize.py``'s window while the block runs; closing it earlier ends nothing else.

    Args:
        kind: vehicle type.
        count: number of vehicles.
        remappings: ROS arguments of the node; all but its name and parameters are passed on.
    """
    passed = [text for text in remappings if ":=" in text and (text.startswith("__ns") or not text.startswith("_"))]
    command = [sys.executable, "-m", "xtdrone_swarm.view", kind, str(count), *passed]
    parent = os.getpid()

    def end_with_us() -> None:
        """Make the operating system end the window when this process ends for any reason."""
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if os.getppid() != parent:  # the parent ended before prctl took effect
            os._exit(1)

    window = subprocess.Popen(command, stdin=subprocess.DEVNULL, preexec_fn=end_with_us)
    try:
        yield
    finally:
        window.terminate()
        try:
            window.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            window.kill()
            window.wait()


USAGE = "simplified_simulator TYPE NUM   (as iris 9)"
RATE = 30  # Hz, of the local position and of the turns of XTDrone's commands

SETPOINT_TIMEOUT = 1.0  # s

_STATE_PERIOD_US = 1_000_000
_EXTENDED_PERIOD_US = 200_000


@dataclass(frozen=True, kw_only=True)
class SimplifiedSettings(CommandSettings, NodeSettings):
    """Arguments and parameters of the simplified simulator.

    Attributes:
        kind: vehicle type.
        count: number of vehicles.
        model: model of every vehicle.
        fleet: the vehicles, with their start poses.
        places: initial positions, shape (count, 3), m ENU.
        headings: initial yaw, shape (count,), rad.
        view: whether to open a live window.
    """

    kind: str
    count: int
    model: Model
    fleet: tuple[Vehicle, ...]
    places: Array
    headings: Array
    view: bool
    airborne: bool = setting(False, text="start armed, in OFFBOARD, at ~altitude above the initial positions")
    setpoint_timeout: float = setting(
        SETPOINT_TIMEOUT,
        low=0.0,
        high=1e6,
        unit="s",
        text="time without a setpoint after which a vehicle leaves OFFBOARD for POSCTL, as COM_OF_LOSS_T; 0 for never",
    )


@dataclass(frozen=True)
class _Start(Settings):
    """Parameters of the vehicles' initial state."""

    model: str = setting("", text="first-order, second-order or a YAML file; empty for the vehicle type's")
    order: int = setting(0, low=0, high=2, text="order of the model, 0 for the model's own")
    rows: int = setting(0, low=0, text="vehicles side by side on the spawn grid, 0 for the grid of pattern origin")
    altitude: float = setting(10.0, low=0.1, high=1e4, unit="m", text="height of airborne vehicles at the start")


def read_settings(kind: str, count: int) -> SimplifiedSettings:
    """Read the node's parameters.

    Args:
        kind: vehicle type.
        count: number of vehicles.

    Raises:
        ValueError: a parameter is not allowed.
    """
    start = _Start.from_parameters(rospy.get_param)
    fleet = with_poses(parse_fleet(f"{kind}:{count}"), str(rospy.get_param("~poses", "")))
    settings = SimplifiedSettings.from_parameters(
        rospy.get_param,
        kind=kind,
        count=count,
        model=_model(kind, start),
        fleet=fleet,
        places=_places(fleet, start.rows),
        headings=np.array([0.0 if vehicle.pose is None else vehicle.pose.yaw for vehicle in fleet]),
        view=wants_window(_view()),
    )
    if settings.airborne:
        settings.places[:, 2] += start.altitude
    return settings


def _view() -> bool | None:
    name = "~view"
    if not rospy.has_param(name):
        return None
    view = rospy.get_param(name)
    if not isinstance(view, bool):
        raise SettingError(rospy.resolve_name(name), view, "true or false")
    return view


def _model(kind: str, start: _Start) -> Model:
    model = load_model(kind, start.model or None)
    return replace(model, order=start.order) if start.order else model


def _places(fleet: Sequence[Vehicle], rows: int) -> Array:
    """Return the initial positions, shape (count, 3), m ENU."""
    given = rospy.get_param("~places", [])
    count = len(fleet)
    if not given:
        poses = start_poses(fleet, rows or origin_columns(count))
        for vehicle, pose in zip(fleet, poses, strict=True):
            _check_level(vehicle.name, pose)
        return np.array([pose[:3] for pose in poses])
    try:
        places = np.array(given, dtype=float)
    except (TypeError, ValueError):
        places = np.empty(0)
    if places.shape != (count, 3) or not np.isfinite(places).all():
        raise ValueError(f"{rospy.resolve_name('~places')}: {given!r} is not allowed, {count} places [x, y, z], m ENU")
    return places


def _check_level(name: str, pose: StartPose) -> None:
    """Check that a start pose is one of a simplified vehicle.

    Raises:
        ValueError: the vehicle would be tilted or below the ground.
    """
    if pose.roll or pose.pitch:
        raise ValueError(
            f"poses: {name}: roll {pose.roll:g}, pitch {pose.pitch:g} rad: simplified vehicles are level, 0"
        )
    if pose.z < 0.0:
        raise ValueError(f"poses: {name}: the start is {-pose.z:.2f} m below the ground, 0 or more is allowed")


class SimplifiedScene:
    """Simplified vehicles behind topics; see ``xtdrone_sim.runtime.simulator_interface.SimulatorBackend``.

    Attributes:
        names: names of the vehicles.
        actors: empty.
        step_us: base step, microseconds.
        gravity: gravitational acceleration, m/s^2.
        need_time: false, because services are answered immediately.
        overlap: false, because a step costs next to nothing.
        descriptors: empty, because all input arrives through ROS.
        patience: unlimited, because no other input needs service.
    """

    gravity = GRAVITY
    need_time = False
    overlap = False
    descriptors: Sequence[int] = ()
    patience = math.inf

    def __init__(
        self, vehicles: SteeredVehicles, *, hover_speed: float, cmd_timeout: float, setpoint_timeout: float
    ) -> None:
        """Create the scene of ``vehicles``; the other arguments are those of ``VehicleTopics``."""
        self.names: Sequence[str] = vehicles.names
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
        self._turn = False
        self._begin()

    def _begin(self) -> None:
        # Due immediately: participants have a turn in the first tick, whatever its time.
        self._next_turn_us = self._next_state_us = self._next_extended_us = 0

    @property
    def time_us(self) -> int:
        """Simulated time, microseconds; the vehicles' internal time restarts at 0 on a reset."""
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
        """Return "": the scene waits for no client."""
        return ""

    def serve(self, ready: Collection[int]) -> None:
        """Do nothing: all input arrives through ROS."""

    def next_due_us(self, now_us: int) -> int | None:
        """Return the time of the next turn."""
        return self._schedule.after_us(now_us)

    def next_publication_us(self, now_us: int) -> int | None:
        """Return None: all publications happen at ``next_due_us``."""
        return None

    def advance(self, until_us: int) -> None:
        """Advance the vehicles to ``until_us``."""
        self._vehicles.advance(until_us - self._began_us)

    def step(self) -> None:
        """Advance the vehicles by one base step."""
        self._vehicles.advance(self._vehicles.time_us + self.step_us)

    def begin_tick(self, idle: Idle) -> None:
        """Publish if a turn is due, and begin a barrier."""
        now_us = self.time_us
        self._turn = now_us >= self._next_turn_us
        if self._turn:
            self._next_turn_us = self._schedule.after_us(now_us)
            self._publish(now_us)
        self._server.begin_tick(now_us, {}, idle)

    def end_tick(self, idle: Idle) -> None:
        """Wait for the end of the barrier, dispatch its messages, and execute XTDrone's commands if due."""
        self._server.end_tick(idle, HEAD_START)
        lockstep.host().receive()
        if self._turn:
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
        """Return positions, velocities and headings as bytes."""
        vehicles = self._vehicles
        return vehicles.true_position.tobytes() + vehicles.velocity.tobytes() + vehicles.yaw.tobytes()

    def model_states(self) -> ModelStates:
        """Return the vehicles' poses and velocities, with level attitude."""
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

    def collisions(self) -> set[tuple[str, str]]:
        """Return an empty set: simplified vehicles do not collide."""
        return set()

    def restart(self, time_us: int) -> None:
        """Reset all vehicles to their initial state."""
        self._vehicles.restart()
        self._began_us = time_us
        self._begin()
        for topics in self._topics:
            topics.restart()

    def reset_vehicle(self, name: str, pose: StartPose | None) -> None:
        """See ``SimulatorBackend``; the pose is level."""
        index = index_of(name, self.names)
        if pose is not None:
            _check_level(name, pose)
        self._vehicles.reset(index, None if pose is None else pose[:3], None if pose is None else pose.yaw)
        self._topics[index].restart()

    def set_wind(self, velocity: Vector) -> None:
        """Reject: the simplified simulator has no wind.

        Raises:
            ValueError: always.
        """
        raise ValueError("wind: the simplified simulator has no wind; use launch formation")

    def add_vehicle(self, name: str, model: str, pose: StartPose | None) -> None:
        """Reject: the fleet of the simplified simulator is fixed at the start.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            f"name: {name[:80]!r} cannot join: the fleet of the simplified simulator is fixed at the start"
        )

    def remove_vehicle(self, name: str) -> None:
        """Reject; see ``add_vehicle``."""
        raise ValueError(
            f"name: {name[:80]!r} cannot leave: the fleet of the simplified simulator is fixed at the start"
        )

    def close(self) -> None:
        """Release the vehicles' resources."""
        self._vehicles.close()


def _arguments(arguments: Sequence[str]) -> tuple[str, int]:
    """Parse the arguments and return vehicle type and number of vehicles.

    Raises:
        ArgumentError: the arguments are not allowed.
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

    def make() -> tuple[SimplifiedSettings, SimplifiedScene]:
        settings = read_settings(kind, count)
        # The dead zone applies to XTDrone's commands only: a communication node applies its own to setpoints.
        vehicles = SimplifiedVehicles(
            count,
            kind=kind,
            model=settings.model,
            places=settings.places,
            headings=settings.headings,
            airborne=settings.airborne,
            hover_speed=None,
        )
        rospy.set_param("/xtdrone/fleet", fleet_text(settings.fleet))
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
