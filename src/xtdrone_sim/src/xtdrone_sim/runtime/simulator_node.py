"""ROS node that runs a simulator back end: /clock, ground truth, lockstep barrier, control and pacing."""

from __future__ import annotations

import contextlib
import gc
import logging
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import rosgraph
import rosgraph.names
import rosgraph.network
import rospy
from gazebo_msgs.msg import ModelStates
from rosgraph_msgs.msg import Clock

import xtdrone_lockstep as lockstep
from xtdrone_common import kernel_cache
from xtdrone_common.programs.plain_node import init_plain_node, survive_full_disk
from xtdrone_common.programs.under_roslaunch import announce, end_launch
from xtdrone_common.settings import Settings, setting
from xtdrone_lockstep.server import LockstepServer
from xtdrone_sim.mailbox import Mailbox
from xtdrone_sim.runtime.digest_file import DigestFile
from xtdrone_sim.runtime.other_simulator import obstacle, ready_words, stale_uri
from xtdrone_sim.runtime.requests.control_services import Services
from xtdrone_sim.runtime.requests.pacing import Pacer
from xtdrone_sim.runtime.requests.simulation_control import Control, Reset
from xtdrone_sim.runtime.requests.vehicle_services import VehicleServices
from xtdrone_sim.runtime.simulator_interface import SimulatorBackend
from xtdrone_sim.sensors.ground_truth import GroundTruth
from xtdrone_sim.topics.model_states import LiveStates

_CHUNK_US = 20_000  # longest simulated time between two polls of sockets and pace
_SLICE = 0.1  # s; longest single wait, so that a shutdown is noticed
_JOIN_REPORT = 5.0  # wall s between two log messages about missing participants
_HOLD_WARNING = 20.0  # wall s of waiting after which these become warnings, which appear on screen
_LEAST_HANG_LIMIT = 2.0  # s; participants send a keep-alive each second
UNLIMITED = "unlimited"
_CONNECT_LIMIT = 30.0  # wall s to hold the world for a topic connection; generous for a loaded machine


def _check_hang_limit(limit: float) -> None:
    if 0.0 < limit < _LEAST_HANG_LIMIT:
        raise ValueError


def _parse_participants(given: object) -> int | tuple[str, ...]:
    if isinstance(given, str) and not given.strip().isdecimal():
        given = [part.strip() for part in given.split(",")]
    if isinstance(given, list) and all(_is_node_name(part) for part in given):
        return tuple(rosgraph.names.make_global_ns(part).rstrip("/") for part in given)
    if isinstance(given, str):
        given = int(given)
    if isinstance(given, bool) or not isinstance(given, int) or given < 0:
        raise ValueError
    return given


def _is_node_name(text: object) -> bool:
    if not isinstance(text, str) or text.startswith("~"):
        return False
    return bool(text.strip("/")) and rosgraph.names.is_legal_name(text)


@dataclass(frozen=True, kw_only=True)
class NodeSettings(Settings):
    """Private parameters of both simulator nodes."""

    speed: float = setting(
        1.0,
        low=0.0,
        high=1e6,
        parse=lambda given: 0.0 if given == UNLIMITED else given,
        allowed=f"0 to 1000000, or '{UNLIMITED}' (0)",
        text=f"target real-time factor, 0 or {UNLIMITED}: as fast as possible",
    )
    paused: bool = setting(False, text="start paused")
    until: float = setting(0.0, low=0.0, high=1e9, unit="s", text="simulated time at which the node ends, 0 for never")
    lockstep: bool = setting(
        True, text="offer the lockstep; without it the simulator does not wait for nodes, which run on /clock"
    )
    participants: int | tuple[str, ...] = setting(
        0,
        parse=_parse_participants,
        allowed="a number from 0, or node names separated by commas, such as /mavros,/leader",
        text="lockstep participants that time waits for at the start",
    )
    start_limit: float = setting(120.0, low=0.0, high=1e6, unit="s", text="longest wall time to wait for participants")
    hang_limit: float = setting(
        60.0,
        low=0.0,
        high=1e6,
        unit="s",
        check=_check_hang_limit,
        allowed=f"0 (never), or {_LEAST_HANG_LIMIT:g} to 1000000 s; participants send a keep-alive every second",
        text="wall time without a message after which a participant is dropped",
    )
    busy_limit: float = setting(
        0.0, low=0.0, high=1e6, unit="s", text="longest wall time of one turn of a participant, 0 for unlimited"
    )
    host: str = setting(
        "127.0.0.1", text="address on which lockstep and MAVLink listen; 0.0.0.0 for every network interface"
    )
    lockstep_port: int = setting(0, low=0, high=65535, text="TCP port of the lockstep, 0 for a free one")
    states_rate: float = setting(
        50.0,
        low=0.1,
        high=250.0,
        unit="Hz",
        ros="model_states_rate",
        text="rate of /gazebo/model_states and ground_truth/odom in simulated time",
    )
    digest: str = setting("", text="file for digests of all published messages, empty for none")
    digest_topics: bool = setting(
        True,
        text="digest topics too, which are then published even without subscribers; otherwise only the ground truth",
    )


def _digest_file(settings: NodeSettings, host: lockstep.Host) -> DigestFile | None:
    """Open the digest file, or return None if the settings name none.

    Raises:
        OSError: the file cannot be opened for writing.
    """
    if not settings.digest:
        return None
    own = host.want_digests() if settings.digest_topics else {}
    return DigestFile(Path(settings.digest), host.name, own, lambda text: rospy.logerr("simulator: %s", text))


@dataclass(frozen=True)
class _Tick:
    """A time at which the state of the world is published.

    Attributes:
        is_regular: the time does not depend on subscribers.
        is_counted: participants have a turn, or there are none and the time is regular.
    """

    is_regular: bool
    is_counted: bool


class Stop:
    """Records requests to shut down. The node's ``init_node`` needs ``disable_signals=True``.

    rospy's own handler unregisters the node's topics within the signal, interrupting the main thread. If that was
    inside a log call, which reads a parameter from the master, it deadlocks on the lock of the master's proxy.
    """

    def __init__(self) -> None:
        """Install the handler of SIGINT and SIGTERM."""
        self._signalled = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def requested(self) -> bool:
        """Return whether a signal has arrived or ROS is shutting down."""
        return self._signalled or rospy.is_shutdown()

    def _note(self, *_: Any) -> None:
        self._signalled = True


class SimulatorNode:
    """Runs a back end on the ROS graph until the simulation ends."""

    def __init__(self, settings: NodeSettings, backend: SimulatorBackend, stop: Stop) -> None:
        """Create server, publishers and services; simulated time stays at 0.

        Args:
            settings: parameters of the node.
            backend: the back end to run; ``run`` closes it.
            stop: reports requests to shut down.

        Raises:
            ValueError: a setting is invalid.
            OSError: a port is in use.
        """
        self._settings = settings
        self._backend = backend
        self._stop = stop
        self._patience = _SLICE  # longest wait given by the back end, wall s
        pacer = Pacer(settings.speed)
        host = lockstep.host()
        self._digests = _digest_file(settings, host)
        self._server = LockstepServer(
            settings.host,
            settings.hang_limit,
            port=settings.lockstep_port,
            busy_limit=settings.busy_limit,
            connect_limit=_CONNECT_LIMIT,
            log=log,
            on_digest=self._digests.write if self._digests and settings.digest_topics else None,
        )
        # rosout subscribes like every node in C++, but reads the time only for messages of its own.
        self._clock = lockstep.UncountedPublisher("/clock", Clock, queue_size=10, rare=["/rosout", "/web_station"])
        self._clock_message = Clock()
        self._server.attach_host(host)
        self._states = lockstep.Publisher("/gazebo/model_states", ModelStates)
        self._live = LiveStates(backend.model_states)
        self._truth = GroundTruth([*backend.names, *backend.actors])
        self._states_period_us = round(1e6 / settings.states_rate)
        self._next_states_us = 0
        self._time_us = backend.time_us  # /clock; the world may be one tick ahead of it
        self._next: _Tick | None = None  # the tick for which the world is ready
        self._looked_us = backend.time_us  # last tick whose time does not depend on subscribers
        self._collisions: set[tuple[str, str]] = set()
        self._control = Control(
            pacer,
            self._server,
            lambda: self._time_us,
            paused=settings.paused,
            hang_limit=settings.hang_limit,
            info=lambda text: rospy.loginfo("simulator: %s", text),
            warn=lambda text: rospy.logwarn("simulator: %s", text),
        )
        self._mailbox = Mailbox()
        self._services = Services(
            self._control,
            self._mailbox,
            step_s=backend.step_us * 1e-6,
            gravity=backend.gravity,
            model_names=lambda: list(backend.model_states().name),
        )
        self._vehicle_services = VehicleServices(self._control, self._mailbox, backend, self._follow_vehicles)
        backend.open(self._server, self._mailbox, self._serve)
        self._poll = select.epoll()
        for descriptor in (self._mailbox.fileno(), self._server.fileno(), *backend.descriptors):
            self._poll.register(descriptor, select.EPOLLIN)
        self._uri = reachable_uri(self._server.uri, settings.host)
        own = rosgraph.network.get_local_address()
        if not _is_loopback(settings.host) and _is_loopback(own):
            rospy.logwarn(
                "simulator: host is %s, but ROS tells other machines that this one is %s: they cannot reach it; "
                "export ROS_IP with its address in the network",
                settings.host,
                own,
            )
        if settings.lockstep:
            rospy.set_param("/lockstep/uri", self._uri)
        else:
            rospy.logwarn("simulator: no lockstep (~lockstep is false): nodes run on /clock, no flight is repeatable")
            # Remove the address of a terminated simulator: nodes that read it would try to join.
            with contextlib.suppress(KeyError):
                rospy.delete_param("/lockstep/uri")

    def run(self) -> None:
        """Run until the node shuts down; report a failure to the participants.

        Raises:
            Exception: the failure.
        """
        failure = ""
        try:
            self._run()
        except Exception as error:
            failure = f"{type(error).__name__}: {error}"
            raise
        finally:
            self._close(failure)

    def _run(self) -> None:
        try:
            self._publish_clock()
            self._wait_for_backend()
            self._wait_for_participants()
            announce(f"simulator: {ready_words(self._backend.names, self._settings.speed)}; Ctrl-C ends it")
            self._control.start()
            while not self._over():
                self._hold()
                self._run_tick(self._next or self._advance())
                self._wait_for_pace()
            end_launch()
        except rospy.ROSException:
            # ROSInterruptException of ``_serve``, or rospy's error on a closed topic
            if not self._stop.requested():
                raise

    def _close(self, failure: str) -> None:
        digests = [] if self._digests is None else [partial(self._digests.close, self._time_us)]
        close_all(
            partial(_forget_uri, self._uri),
            self._mailbox.close,
            self._control.close,
            partial(self._server.close, failure),
            *digests,
            self._backend.close,
        )

    def _wait_for_backend(self) -> None:
        begun = word = time.monotonic()
        while missing := self._backend.missing():
            now = time.monotonic()
            if now - begun >= self._settings.start_limit:
                rospy.logwarn("simulator: time starts after %.0f s: %s", self._settings.start_limit, missing)
                return
            if now >= word:
                word += _JOIN_REPORT
                _hold_log(now - begun)("simulator: holding time at 0: %s", missing)
            self._serve(_SLICE)
            self._server.poll(0.0)

    def _wait_for_participants(self) -> None:
        expected = self._control.held = self._settings.participants if self._settings.lockstep else 0
        begun = time.monotonic()
        while expected and time.monotonic() - begun < self._settings.start_limit:
            if self._server.wait_for(expected, _JOIN_REPORT, self._serve):
                rospy.loginfo("simulator: %d participants have joined, time starts", len(self._server.participants))
                return
            write = _hold_log(time.monotonic() - begun)
            write("simulator: holding time at 0: %s", self._server.missing(expected))
        if expected:
            rospy.logwarn(
                "simulator: time starts without all participants after %.0f s: %s",
                self._settings.start_limit,
                self._server.missing(expected),
            )

    def _over(self) -> bool:
        """Return whether simulated time has reached ``~until``."""
        until = self._settings.until
        return until > 0.0 and self._time_us >= round(until * 1e6)

    def _hold(self) -> None:
        """Execute the requests queued for the end of a tick; block while the simulation is paused."""
        while not self._control.between_ticks(self._reset):
            self._live.stands()
            self._serve(_SLICE)
            self._server.poll(0.0)

    def _reset(self, kind: Reset) -> None:
        """Restore the initial state and reboot all autopilots; Reset.SIMULATION also sets simulated time to 0."""
        backend = self._backend
        backend.restart(0 if kind is Reset.SIMULATION else backend.time_us)
        self._collisions.clear()
        if kind is Reset.SIMULATION:
            self._next = None
            self._next_states_us = 0
            self._time_us = 0
            self._server.reset_time(0)
        if self._next is None:
            self._looked_us = backend.time_us
        if backend.time_us > 0:  # 0 means "no time yet" in ROS and ends rosbag record: wait for the next tick
            self._publish_clock()

    def _advance(self) -> _Tick:
        """Step to the next tick, or by ``_CHUNK_US`` if no participant is due before."""
        backend = self._backend
        now = backend.time_us
        due = self._server.next_due_us(now)
        times = (due, backend.next_due_us(now), self._looked_us + _CHUNK_US)
        regular = min(time_us for time_us in times if time_us is not None)
        until = min([regular, *self._publication_times_us(now)])
        is_regular = until == regular
        backend.advance(until)
        if is_regular:
            self._looked_us = backend.time_us
        return _Tick(is_regular, is_regular and due in (None, until))

    def _run_tick(self, tick: _Tick) -> None:
        """Publish the state of the world, and run one barrier, during which the world may advance to the next tick."""
        backend = self._backend
        self._next = None
        now = backend.time_us
        self._publish_clock()
        lockstep.host().time_passed(now)
        if now >= self._next_states_us:
            self._publish_states(now)
        self._live.ticked()
        self._serve(0.0)
        if tick.is_regular and self._digests is not None:
            self._digests.tick(now, backend.truth())
        backend.begin_tick(self._serve_in_tick)
        if backend.overlap and not self._over():
            if self._server.begins_counts:
                self._server.end_tick(self._wait_for_participant)
            # Until the barrier ends, no input is read, so that messages of participants always take effect at the next
            # tick.
            self._next = self._advance()
        backend.end_tick(self._serve_in_tick)
        self._report_collisions()
        if tick.is_counted:
            self._control.ticked()

    def _publication_times_us(self, now: int) -> list[int]:
        """Return the next times at which a subscriber needs a message; they do not count as ticks."""
        publication = self._backend.next_publication_us(now)
        times = [] if publication is None else [publication]
        if self._next_states_us > now and (self._states.get_num_connections() or self._truth.wanted):
            times.append(self._next_states_us)
        return times

    def _report_collisions(self) -> None:
        found = self._backend.collisions()
        new = found - self._collisions
        for a, b in sorted(new):
            rospy.logwarn("simulator: collision of %s and %s", a, b)
        if found != self._collisions:  # a vehicle that was reset may collide again
            self._collisions = set(found)

    def _serve(self, timeout: float) -> None:
        """Wait up to ``timeout`` wall s for data on any socket, and process it.

        Raises:
            ROSInterruptException: the node is shutting down; a wait for a participant must end.
        """
        if self._stop.requested():
            raise rospy.ROSInterruptException("shutdown")
        ready = {descriptor for descriptor, _ in self._poll.poll(min(timeout, self._patience))}
        self._backend.serve(ready)
        if timeout > 0.0 and self._server.fileno() not in ready:
            # The response of a participant does not change it, and ends most waits.
            self._patience = self._backend.patience
        if self._mailbox.fileno() in ready:
            self._mailbox.serve()
        self._services.tend()

    def _wait_for_participant(self, timeout: float) -> None:
        """Wait up to ``timeout`` wall s for the lockstep server alone.

        Raises:
            ROSInterruptException: the node shuts down.
        """
        if self._stop.requested():
            raise rospy.ROSInterruptException("shutdown")
        select.select([self._server.fileno()], [], [], min(timeout, _SLICE))

    def _serve_in_tick(self, timeout: float) -> None:
        """Serve as ``_serve`` does, while the barrier waits for participants.

        A participant may wait for an autopilot that answers only while simulated time advances. Time then advances
        within the turn, which would deadlock otherwise; the turn takes time, as on a real vehicle.
        """
        if not (self._backend.need_time and self._server.needs_time and not self._control.paused):
            self._serve(timeout)
            return
        self._backend.step()
        self._publish_clock()
        self._serve(min(max(0.0, self._control.pacer.delay(self._backend.time_us, time.monotonic())), timeout))

    def _wait_for_pace(self) -> None:
        while self._control.flowing:
            delay = self._control.pacer.delay(self._backend.time_us, time.monotonic())
            if delay <= 0.0:
                return
            self._serve(min(delay, _SLICE))
            self._server.poll(0.0)

    def _publish_clock(self) -> None:
        self._time_us = self._backend.time_us
        clock = self._clock_message.clock
        clock.secs, micros = divmod(self._time_us, 1_000_000)
        clock.nsecs = micros * 1000
        self._clock.publish(self._clock_message)

    def _follow_vehicles(self) -> None:
        """Publish the ground truth of vehicles that have joined, and no longer that of vehicles that have left."""
        self._truth.update([*self._backend.names, *self._backend.actors])

    def _publish_states(self, now: int) -> None:
        self._next_states_us = now - now % self._states_period_us + self._states_period_us
        listened = self._states.get_num_connections()
        if not (listened or self._truth.wanted):
            return
        states = self._backend.model_states()
        if listened:
            self._states.publish(states)
        self._truth.publish(states, now)


def _hold_log(waited: float) -> Callable[..., None]:
    """Return the log function for the message that time is held at 0, after ``waited`` wall s."""
    write: Callable[..., None] = rospy.loginfo if waited < _HOLD_WARNING else rospy.logwarn
    return write


def _is_loopback(address: str) -> bool:
    return address == "localhost" or address.startswith("127.")


def reachable_uri(uri: str, host: str) -> str:
    """Return the address at which participants on other machines reach the lockstep server.

    Args:
        uri: address of the server, tcp://host:port.
        host: address on which it listens; "0.0.0.0" is replaced by this machine's ROS address.
    """
    if host not in {"", "0.0.0.0"}:
        return uri
    return f"tcp://{rosgraph.network.get_local_address()}:{uri.rpartition(':')[2]}"


def close_all(*closings: Callable[[], object]) -> None:
    """Call all ``closings`` in order, including those after one that raises.

    Raises:
        Exception: the last exception that a closing has raised, with earlier ones as its context.
    """
    with contextlib.ExitStack() as stack:
        for closing in reversed(closings):
            stack.callback(closing)


def _forget_uri(uri: str) -> None:
    try:
        master = rosgraph.Master(rospy.get_name())
        if master.getParam("/lockstep/uri") == uri:  # not that of another simulator
            master.deleteParam("/lockstep/uri")
    except (rosgraph.MasterException, OSError):
        rospy.logdebug("simulator: /lockstep/uri was already gone")


def log(level: int, text: str) -> None:
    """Log a text at a level of ``logging`` with rospy."""
    write = {logging.WARNING: rospy.logwarn, logging.ERROR: rospy.logerr}.get(level, rospy.loginfo)
    write("simulator: %s", text)


class _Kernels:
    """Logs the compilation of kernels, which explains why the world stands still."""

    def __init__(self) -> None:
        self._told = False

    def announce(self) -> None:
        """Register the log output."""
        kernel_cache.Announcer(self._begins, self._ends).register()

    def _begins(self, name: str) -> None:
        write, where = (rospy.loginfo, "") if self._told else (rospy.logwarn, f"; {kernel_cache.cache_words()}")
        self._told = True
        write("simulator: compiling kernels: %s%s", name, where)

    def _ends(self, name: str, seconds: float) -> None:
        rospy.loginfo("simulator: kernel compiled: %s, in %.1f s", name, seconds)


def _exempt_set_up_from_garbage_collection() -> None:
    """Exempt all objects made so far, which live as long as the node, from garbage collection.

    Python collects the oldest garbage only once new objects are a quarter of those that the last such collection found
    alive. Counting the set-up's, megabytes of garbage would wait for it, and it would stop the node for a moment.
    """
    gc.freeze()
    gc.collect()  # resets that number to what is alive without the set-up


def run_node(make: Callable[[], tuple[NodeSettings, SimulatorBackend]], arguments: Sequence[str]) -> int:
    """Run a simulator node until it shuts down.

    Args:
        make: reads the parameters and creates the back end; may raise ValueError or OSError.
        arguments: command line with its remappings.

    Returns:
        The exit status.
    """
    if not rosgraph.is_master_online():
        advice = "start one (roscore, roslaunch) or set ROS_MASTER_URI"
        print(f"simulator: no ROS master answers at {rosgraph.get_master_uri()}; {advice}", file=sys.stderr)
        return 1
    name = lockstep.future_name("simulator", list(arguments))
    # Check before registering the name: the master would shut down the node that holds it.
    reason = obstacle(name)
    if reason:
        print(f"simulator: {reason}", file=sys.stderr)
        return 1
    stale = stale_uri(name)
    init_plain_node("simulator", disable_rostime=True, disable_signals=True)
    survive_full_disk()
    stop = Stop()
    _Kernels().announce()
    if stale:
        rospy.logwarn("simulator: /lockstep/uri was %s, where no server answers; removed", stale)
    try:
        settings, backend = make()
        node = SimulatorNode(settings, backend, stop)
    except (ValueError, OSError) as error:
        rospy.logfatal("simulator: %s", error)
        return 1
    _exempt_set_up_from_garbage_collection()
    node.run()
    rospy.signal_shutdown("the simulation has ended")
    return 0
