"""The script's ROS node: topics of its vehicles, turns at 30 Hz (in lockstep or in a thread), signals and shutdown."""

from __future__ import annotations

import atexit
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import rosgraph
import rosgraph.names
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from mavros_msgs.msg import State, StatusText, SysStatus
from sensor_msgs.msg import BatteryState

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import FleetError, parse_fleet
from xtdrone_control.communication.commands import CommandRequest, MultirotorCore
from xtdrone_control.communication.multirotor import RATE, MavrosLink
from xtdrone_lockstep import future_name

from .drones import Drone, DroneGroup
from .verbs import DroneError, GroupError, Steps, Verbs

NODE = "drone_script"
_SLICE = 0.1  # s of wall time between checks for Ctrl-C
_STALLED = 20.0  # s of wall time after which connecting gives up if ROS time does not advance
_CLOSE_LIMIT = 5.0  # s of ROS time for a vehicle to enter AUTO.LOITER at the end


class _Log:
    """Destination of the core's log messages; verbs raise errors instead, so all but warnings are at DEBUG."""

    def info(self, text: str) -> None:
        """Log at DEBUG."""
        rospy.logdebug(text)

    def warning(self, text: str) -> None:
        """Log at DEBUG."""
        rospy.logdebug(text)

    def stream_warning(self, text: str) -> None:
        """Log at WARN, an identical text once in 5 s."""
        rospy.logwarn_throttle_identical(5.0, text)


class ScriptLink(MavrosLink):
    """Connection to one vehicle's MAVROS, with the telemetry that the verbs need.

    Attributes:
        verbs: the vehicle's.
    """

    def __init__(self, vehicle: str, *, in_lockstep: bool) -> None:
        """Declare the topics of ``vehicle`` (such as ``iris_0``)."""
        core = MultirotorCore(vehicle, _Log(), hover_speed=0.0)
        self.verbs = Verbs(vehicle, core, self._submit, rospy.get_time)
        super().__init__(vehicle, core, in_lockstep=in_lockstep)
        base = f"/{vehicle}/mavros"
        lockstep.Subscriber(f"{base}/local_position/velocity_local", TwistStamped, self._on_velocity)
        lockstep.Subscriber(f"{base}/battery", BatteryState, self._on_battery)
        lockstep.Subscriber(f"{base}/sys_status", SysStatus, self._on_sys_status)
        lockstep.Subscriber(f"{base}/statustext/recv", StatusText, self._on_text)
        lockstep.add_reset_hook(self.verbs.on_reset)

    def step(self) -> None:
        """Publish the setpoint and process the results of finished service calls."""
        super().step()
        if self._output.get_num_connections():
            self.verbs.on_setpoint()

    def _submit(self, request: CommandRequest) -> None:
        self._services.submit(request)

    def _on_result(self, request: CommandRequest, accepted: bool, reason: str, now: float) -> None:
        super()._on_result(request, accepted, reason, now)
        self.verbs.on_result(request, accepted, reason)

    def _on_state(self, message: State) -> None:
        super()._on_state(message)
        self.verbs.telemetry.connected = message.connected

    def _on_velocity(self, message: TwistStamped) -> None:
        linear = message.twist.linear
        self.verbs.telemetry.velocity = (linear.x, linear.y, linear.z)

    def _on_battery(self, message: BatteryState) -> None:
        self.verbs.telemetry.battery = message.percentage

    def _on_sys_status(self, message: SysStatus) -> None:
        self.verbs.telemetry.sensors_present = message.sensors_present
        self.verbs.telemetry.sensors_health = message.sensors_health

    def _on_text(self, message: StatusText) -> None:
        self.verbs.on_text(message.severity, message.text)


class Session:
    """The node of this process, and the vehicles that it commands.

    A turn advances the running verbs, publishes every vehicle's setpoint, and receives messages. In lockstep the main
    thread runs turns only during a verb; otherwise a separate thread runs them all the time.

    Attributes:
        in_lockstep: whether the script is a lockstep participant.
        closed: whether the node has shut down, so that no more vehicles can be connected.
    """

    def __init__(self, node: str, in_lockstep: bool | None) -> None:
        """Start the node.

        Args:
            node: its name.
            in_lockstep: whether to take part in the simulator's lockstep, if there is one; None: yes, except at an
                interactive prompt.

        Raises:
            DroneError: there is no master, or rospy is already initialised.
        """
        if rospy.core.is_initialized():
            raise DroneError(node, "connect", "rospy is already initialised; call connect() instead of init_node()")
        join = not _interactive() if in_lockstep is None else in_lockstep
        with _joining(node, join):
            try:
                lockstep.init_node(node, rate=RATE, disable_signals=True)
            except rospy.ROSInitException as error:
                raise DroneError(node, "connect", str(error)) from error
        self.in_lockstep = lockstep.is_active()
        self.closed = False
        self._links: dict[str, ScriptLink] = {}
        self._rate: lockstep.Rate | None = None
        self._lock = threading.RLock()
        self._diagnostics: lockstep.Subscriber | None = None
        self._task: _Task | None = None
        self._failure: BaseException | None = None
        self._interrupt: BaseException | None = None
        self._running = False
        atexit.register(self.close)
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, self._on_signal)

    def add(self, names: Sequence[str], timeout: float) -> list[Drone]:
        """Connect vehicles, and wait for their state and pose.

        Raises:
            DroneError: a vehicle does not report within the timeout.
        """
        new = [name for name in names if name not in self._links]
        with self._lock:
            self._links.update({name: ScriptLink(name, in_lockstep=self.in_lockstep) for name in new})
        if self._rate is None:
            self._start()
        try:
            self.run("connect", {name: self._links[name].verbs.connect(timeout) for name in names}, stall=_STALLED)
        except DroneError as error:
            for name in new:
                self._links.pop(name).close()
            known = rospy.get_param("/xtdrone/fleet", None)
            hint = "is its MAVROS running?" if known is None else f"is its MAVROS running? /xtdrone/fleet is {known}"
            raise type(error)(error.vehicle, "connect", f"{error.reason}; {hint}") from error
        return [Drone(self, self._links[name].verbs) for name in names]

    def watch(self) -> None:
        """Pass statuses of /diagnostics to the vehicles from now on."""
        if self._diagnostics is None:
            self._diagnostics = lockstep.Subscriber("/diagnostics", DiagnosticArray, self._on_diagnostics)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for link in list(self._links.values()):
            for status in message.status:
                link.verbs.on_diagnostic(status.name, status.level, status.message)

    def _start(self) -> None:
        try:
            lockstep.start()
        except (rospy.ROSInitException, rospy.ROSInterruptException) as error:
            raise DroneError(", ".join(self._links), "connect", str(error)) from error
        self._rate = lockstep.Rate()
        if not self.in_lockstep:
            threading.Thread(target=self._stream, name="drone setpoints", daemon=True).start()

    def run(self, verb: str, steps: dict[str, Steps], stall: float | None = None) -> None:
        """Run a verb for several vehicles at once until it has ended for each.

        Args:
            verb: its name.
            steps: one generator for each vehicle, by name.
            stall: s of wall time after which to give up if ROS time does not advance; None: never.

        Raises:
            DroneError: the verb failed for a vehicle; the other vehicles have carried it out.
        """
        names = ", ".join(steps)
        if self.closed:
            raise DroneError(names, verb, "this process has left ROS; start a new one to connect again")
        if released := [name for name in steps if name not in self._links]:
            raise DroneError(", ".join(released), verb, "the connection is closed; call connect() again")
        links = [self._links[name] for name in steps]
        task = _Task(verb, steps, [link.verbs for link in links])
        watch = _Watch(stall)
        try:
            if self.in_lockstep:
                self._run_turns(task, watch)
            else:
                self._await(task, watch)
        except rospy.ROSInterruptException as error:
            raise DroneError(names, verb, f"the node was shut down ({error}); has the simulator ended?") from error
        except _StalledError:
            raise DroneError(names, verb, f"ROS time does not pass ({rospy.get_time():.1f} s); is it paused?") from None
        task.raise_errors()

    def _run_turns(self, task: _Task, watch: _Watch) -> None:
        self._running = True
        try:
            while not task.advance():
                self._turn()
                watch.check()
                if self._interrupt is not None:
                    interrupt, self._interrupt = self._interrupt, None
                    raise interrupt
        finally:
            self._running = False

    def _await(self, task: _Task, watch: _Watch) -> None:
        self._task = task
        try:
            while not task.done.wait(_SLICE):
                watch.check()
                if self._failure is not None:
                    raise self._failure
        finally:
            self._task = None

    def _stream(self) -> None:
        """Run turns until the node shuts down; the main function of a free-running script's thread."""
        try:
            while not rospy.is_shutdown():
                task = self._task
                if task is not None:
                    task.advance()
                self._turn()
        except BaseException as error:  # for the main thread to raise
            self._failure = error

    def _turn(self) -> None:
        with self._lock:
            for link in self._links.values():
                link.step()
        assert self._rate is not None
        self._rate.sleep()

    def _on_signal(self, number: int, _: Any) -> None:
        """End the running verb at the end of its turn; a second signal ends it at once."""
        error = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
        if not self._running or self._interrupt is not None:
            raise error
        self._interrupt = error

    def release(self, names: Sequence[str]) -> None:
        """Stop commanding vehicles; those in OFFBOARD hold position. Releasing the last one shuts the node down."""
        names = [name for name in names if name in self._links]
        if names and not rospy.is_shutdown():
            self._hold(names)
        with self._lock:
            for name in names:
                self._links.pop(name).close()
        if not self._links and self.in_lockstep:
            self.close()

    def _hold(self, names: Sequence[str]) -> None:
        verbs = {name: self._links[name].verbs for name in names}
        flying = {name: v for name, v in verbs.items() if v.core.armed and v.core.mode == "OFFBOARD"}
        if not flying:
            return
        try:
            self.run(
                "hold", {name: v.set_mode("AUTO.LOITER", "hold") for name, v in flying.items()}, stall=_CLOSE_LIMIT
            )
        except DroneError as error:
            rospy.logwarn(f"{error}; OFFBOARD ends when the setpoints do, and the autopilot's failsafe takes over")
            return
        for name, v in flying.items():
            where = "" if v.core.pose is None else " at ({:.1f}, {:.1f}, {:.1f}) m".format(*v.core.pose[0])
            rospy.logwarn(f"{name}: holds position in AUTO.LOITER{where}: the script no longer commands it")

    def close(self) -> None:
        """Release every vehicle and end the node."""
        if self.closed:
            return
        if self._links:
            self.release(list(self._links))
        self.closed = True
        rospy.signal_shutdown("the script has ended")


class _Task:
    """A verb in progress for one or more vehicles.

    Attributes:
        done: set when the verb has ended for all vehicles.
    """

    def __init__(self, verb: str, steps: dict[str, Steps], vehicles: Sequence[Verbs]) -> None:
        self.done = threading.Event()
        self._verb = verb
        self._steps = dict(steps)
        self._vehicles = {vehicle.name: (vehicle, vehicle.resets) for vehicle in vehicles}
        self._errors: list[DroneError] = []
        self._crash: BaseException | None = None

    def advance(self) -> bool:
        """Advance by one turn; return whether the verb has ended for all vehicles."""
        for name, steps in list(self._steps.items()):
            try:
                self._check_reset(name)
                next(steps)
                continue
            except StopIteration:
                pass
            except DroneError as error:
                self._errors.append(error)
            except Exception as error:  # a bug in a verb must not end the thread that streams setpoints
                self._crash = error
            del self._steps[name]
        if not self._steps:
            self.done.set()
        return not self._steps

    def _check_reset(self, name: str) -> None:
        vehicle, resets = self._vehicles[name]
        if vehicle.resets != resets:
            raise DroneError(name, self._verb, "the simulation was reset")

    def raise_errors(self) -> None:
        """Raise the error of the verb, if there is one."""
        if self._crash is not None:
            raise self._crash
        if len(self._errors) == 1:
            raise self._errors[0]
        if self._errors:
            raise GroupError(self._errors)


class _StalledError(Exception):
    """ROS time does not pass."""


class _Watch:
    """Detects that ROS time does not advance."""

    def __init__(self, limit: float | None) -> None:
        self._limit = limit
        self._seen = (rospy.get_time(), time.monotonic())

    def check(self) -> None:
        """Raise if ROS time has stood still for longer than the limit."""
        now, wall = rospy.get_time(), time.monotonic()
        if now != self._seen[0]:
            self._seen = (now, wall)
        elif self._limit is not None and wall - self._seen[1] > self._limit:
            raise _StalledError


_session: Session | None = None


def connect(name: str = "iris_0", *, node: str = NODE, lockstep: bool | None = None, timeout: float = 30.0) -> Drone:
    """Connect one vehicle.

    Args:
        name: such as ``iris_0``: its MAVROS is in the namespace ``/iris_0/mavros``.
        node: name of this process's ROS node, at the first call.
        lockstep: True or False to take part in the simulator's lockstep or not, at the first call; None: take part
            unless at an interactive prompt, where time would stand still between two lines.
        timeout: s of ROS time for the vehicle to report state and position.

    Raises:
        DroneError: no ROS master, no such vehicle, or no report within the timeout.
    """
    return _connect([name], node, lockstep, timeout)[0]


def connect_all(
    names: Sequence[str] | None = None, *, node: str = NODE, lockstep: bool | None = None, timeout: float = 30.0
) -> DroneGroup:
    """Connect several vehicles; see ``connect``.

    Args:
        names: None for every vehicle of the parameter ``/xtdrone/fleet``, in its order.
        node, lockstep, timeout: see ``connect``.

    Raises:
        DroneError: as for ``connect``, or there is no such parameter.
    """
    wanted = _fleet_names() if names is None else list(names)
    if not wanted or len(set(wanted)) != len(wanted):
        raise ValueError(f"names: {wanted} is not allowed, at least one vehicle, and each of them once")
    return DroneGroup(_connect(wanted, node, lockstep, timeout))


def _connect(names: Sequence[str], node: str, lockstep: bool | None, timeout: float) -> list[Drone]:
    global _session  # a process has one node
    if _session is None:
        _check_master(names)
        known = _fleet(rosgraph.Master("/" + node))
        unknown = [name for name in names if known and name not in known]
        if unknown:
            raise DroneError(", ".join(unknown), "connect", f"not in the fleet: /xtdrone/fleet has {', '.join(known)}")
        _session = Session(node, lockstep)
    if _session.closed:
        raise DroneError(", ".join(names), "connect", "this process has left ROS; start a new one to connect again")
    return _session.add(names, timeout)


def _check_master(names: Sequence[str]) -> None:
    if not rosgraph.is_master_online():
        raise DroneError(", ".join(names), "connect", f"no ROS master answers at {rosgraph.get_master_uri()}")


def _fleet(master: Any) -> list[str]:
    """Return the names of the vehicles in ``/xtdrone/fleet``; empty if the parameter is not set."""
    if not master.hasParam("/xtdrone/fleet"):
        return []
    try:
        return [vehicle.name for vehicle in parse_fleet(str(master.getParam("/xtdrone/fleet")))]
    except FleetError as error:
        raise DroneError("all", "connect", f"/xtdrone/fleet: {error}") from error


def _fleet_names() -> list[str]:
    _check_master(["all"])
    names = _fleet(rosgraph.Master("/" + NODE))
    if not names:
        raise DroneError("all", "connect", "/xtdrone/fleet is not set: name the vehicles, connect_all([...])")
    return names


def _interactive() -> bool:
    return hasattr(sys, "ps1") or bool(sys.flags.interactive)


@contextlib.contextmanager
def _joining(node: str, join: bool) -> Iterator[None]:
    """Keep a node that is initialised in this context out of the lockstep unless ``join``."""
    if join or not rosgraph.is_master_online():
        yield
        return
    name = future_name(node, None)
    master, parameter = rosgraph.Master(name), rosgraph.names.ns_join(name, "lockstep")
    master.setParam(parameter, False)
    try:
        yield
    finally:
        master.deleteParam(parameter)
