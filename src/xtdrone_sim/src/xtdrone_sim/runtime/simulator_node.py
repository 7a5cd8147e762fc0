"""The simulator as a ROS node around a scene: /clock, the ground truth, the lockstep's barrier, control, pacing."""

from __future__ import annotations

import contextlib
import logging
import select
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import rosgraph
import rosgraph.names
import rosgraph.network
import rospy
from gazebo_msgs.msg import ModelStates
from rosgraph_msgs.msg import Clock

from xtdrone_control import kernel, lockstep
from xtdrone_control.lockstep.server import LockstepServer
from xtdrone_control.log_output import survive_full_disk
from xtdrone_control.settings import Settings, setting
from xtdrone_sim.runtime.backend import Scene
from xtdrone_sim.runtime.control import Control, Reset
from xtdrone_sim.runtime.digests import DigestFile
from xtdrone_sim.runtime.mailbox import Mailbox
from xtdrone_sim.runtime.pacing import Pacer
from xtdrone_sim.runtime.services import Services
from xtdrone_sim.runtime.startup import obstacle, stale_uri
from xtdrone_sim.runtime.stopping import Stop
from xtdrone_sim.sensors.ground_truth import GroundTruth

_CHUNK_US = 20_000  # longest simulated time between two looks at sockets and pace
_SLICE = 0.1  # s; longest single wait, so that a shutdown is noticed
_JOIN_REPORT = 5.0  # s between two words on who has not joined
_HOLD_WARNING = 20.0  # s of waiting after which such words are warnings, which are on screen
_LEAST_HANG_LIMIT = 2.0  # s; participants send a keep-alive each second
_CONNECT_LIMIT = 30.0  # s of wall time that the world is held for a topic connection; a loaded machine takes some


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

    speed: float = setting(1.0, low=0.0, high=1e6, text="target real-time factor, 0 for unlimited")
    paused: bool = setting(False, text="start paused")
    until: float = setting(0.0, low=0.0, high=1e9, unit="s", text="simulated time at which the node ends, 0 for never")
    lockstep: bool = setting(
        True, text="offer the lockstep; without it the simulator waits for no node and nodes run on /clock"
    )
    participants: int | tuple[str, ...] = setting(
        0,
        parse=_parse_participants,
        allowed="a number from 0, or node names separated by commas, as /mavros,/leader",
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
    digest: str = setting("", text="file for digests of everything published, empty for none")
    digest_topics: bool = setting(
        True, text="digest topics too, which are then published without subscribers; otherwise only the ground truth"
    )


def _digest_file(settings: NodeSettings, host: lockstep.Host) -> DigestFile | None:
    """Open the digest file, if one is asked for.

    Raises:
        OSError: it cannot be written.
    """
    if not settings.digest:
        return None
    own = host.want_digests() if settings.digest_topics else {}
    return DigestFile(Path(settings.digest), host.name, own, lambda text: rospy.logerr("simulator: %s", text))


class SimulatorNode:
    """Runs a scene against the ROS graph until it is to end."""

    def __init__(self, settings: NodeSettings, scene: Scene, stop: Stop) -> None:
        """Set everything up; time stands at 0.

        Args:
            settings: the node's parameters.
            scene: what is run; it is closed at the end.
            stop: says when to end.

        Raises:
            ValueError: bad settings.
            OSError: a port that is taken.
        """
        self._settings = settings
        self._scene = scene
        self._stop = stop
        self._names = [*scene.names, *scene.scenery]
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
        self._clock = lockstep.UncountedPublisher("/clock", Clock, queue_size=10)
        self._server.attach_host(host)
        self._states = lockstep.Publisher("/gazebo/model_states", ModelStates)
        self._truth = GroundTruth([*scene.names, *scene.actors])
        self._states_period_us = round(1e6 / settings.states_rate)
        self._next_states_us = 0
        self._looked_us = scene.time_us  # the last time that does not depend on who listens to what
        self._collisions: set[tuple[int, int]] = set()
        self._control = Control(
            pacer,
            self._server,
            lambda: scene.time_us,
            paused=settings.paused,
            hang_limit=settings.hang_limit,
            info=lambda text: rospy.loginfo("simulator: %s", text),
            warn=lambda text: rospy.logwarn("simulator: %s", text),
        )
        self._mailbox = Mailbox()
        self._services = Services(
            self._control,
            self._mailbox,
            step_s=scene.step_us * 1e-6,
            gravity=scene.gravity,
            model_names=["ground_plane", *self._names],
        )
        scene.open(self._server, self._mailbox, self._serve)
        self._poll = select.epoll()
        for descriptor in (self._mailbox.fileno(), self._server.fileno(), *scene.descriptors):
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
            rospy.logwarn("simulator: no lockstep (~lockstep is false): nodes run on /clock, nothing is repeatable")
            # That of a simulator which is no more: nodes that saw it would try to take part.
            with contextlib.suppress(KeyError):
                rospy.delete_param("/lockstep/uri")

    def run(self) -> None:
        """Step until the node is to end; participants are told whether it ends by a failure.

        Raises:
            Exception: what the failure is.
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
            self._wait_for_scene()
            self._wait_for_participants()
            names = self._scene.names
            first_last = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
            rospy.loginfo("simulator: %s stand ready, time runs; Ctrl-C ends it", first_last)
            self._control.start()
            while not self._over():
                self._hold()
                self._advance()
                self._wait_for_pace()
        except rospy.ROSException:
            # ROSInterruptException of our own, or rospy's word that its topics are closed
            if not self._stop.requested():
                raise

    def _close(self, failure: str) -> None:
        digests = [] if self._digests is None else [partial(self._digests.close, self._scene.time_us)]
        close_all(
            partial(_forget_uri, self._uri),
            self._mailbox.close,
            self._control.close,
            partial(self._server.close, failure),
            *digests,
            self._scene.close,
        )

    def _wait_for_scene(self) -> None:
        begun = word = time.monotonic()
        while missing := self._scene.missing():
            now = time.monotonic()
            if now - begun >= self._settings.start_limit:
                rospy.logwarn("simulator: time starts after %.0f s: %s", self._settings.start_limit, missing)
                return
            if now >= word:
                word += _JOIN_REPORT
                _hold_word(now - begun)("simulator: holding time at 0: %s", missing)
            self._serve(_SLICE)
            self._server.poll(0.0)

    def _wait_for_participants(self) -> None:
        expected = self._control.held = self._settings.participants if self._settings.lockstep else 0
        begun = time.monotonic()
        while expected and time.monotonic() - begun < self._settings.start_limit:
            if self._server.wait_for(expected, _JOIN_REPORT, self._serve):
                rospy.loginfo("simulator: %d participants have joined, time starts", len(self._server.participants))
                return
            write = _hold_word(time.monotonic() - begun)
            write("simulator: holding time at 0: %s", self._server.missing(expected))
        if expected:
            rospy.logwarn(
                "simulator: time starts without all participants after %.0f s: %s",
                self._settings.start_limit,
                self._server.missing(expected),
            )

    def _over(self) -> bool:
        """Say whether the simulated time is reached at which the node is to end."""
        until = self._settings.until
        return until > 0.0 and self._scene.time_us >= round(until * 1e6)

    def _hold(self) -> None:
        """Carry out what waits for the end of a tick; stay here while the simulation is paused."""
        while not self._control.between_ticks(self._reset):
            self._serve(_SLICE)
            self._server.poll(0.0)

    def _reset(self, kind: Reset) -> None:
        """Put everything back to its start, with simulated time or without: a reboot of all autopilots."""
        scene = self._scene
        scene.restart(0 if kind is Reset.SIMULATION else scene.time_us)
        self._collisions.clear()
        self._looked_us = scene.time_us
        if kind is Reset.SIMULATION:
            self._next_states_us = 0
            self._server.reset_time(0)
        if scene.time_us > 0:  # 0 means "no time yet" in ROS, and ends rosbag record: the next tick's is the first
            self._publish_clock()

    def _advance(self) -> None:
        """Step to the next tick, or a little way when nobody is due soon; then one barrier."""
        scene = self._scene
        now = scene.time_us
        due = self._server.next_due_us(now)
        times = (due, scene.next_due_us(now), self._looked_us + _CHUNK_US)
        regular = min(time_us for time_us in times if time_us is not None)
        until = min([regular, *self._telling_us(now)])
        is_regular = until == regular
        scene.advance(until)
        now = scene.time_us
        self._publish_clock()
        lockstep.host().time_passed(now)
        if now >= self._next_states_us:
            self._publish_states(now)
        self._serve(0.0)
        if is_regular and self._digests is not None:
            self._digests.tick(now, scene.truth())
        scene.tick(self._serve_in_tick)
        self._report_collisions()
        if is_regular:
            self._looked_us = scene.time_us
            if due is None or due == until:
                self._control.ticked()

    def _telling_us(self, now: int) -> list[int]:
        """Return the next times at which something is told to those who listen: what nobody else takes for a tick."""
        told = self._scene.next_told_us(now)
        times = [] if told is None else [told]
        if self._next_states_us > now and (self._states.get_num_connections() or self._truth.wanted):
            times.append(self._next_states_us)
        return times

    def _report_collisions(self) -> None:
        new = self._scene.collisions() - self._collisions
        for a, b in sorted(new):
            rospy.logwarn("simulator: collision of %s and %s", self._names[a], self._names[b])
        self._collisions |= new

    def _serve(self, timeout: float) -> None:
        """Wait up to ``timeout`` s for something on any socket, and serve what came.

        Raises:
            ROSInterruptException: ROS shuts down; whoever waits for a participant must not wait on.
        """
        if self._stop.requested():
            raise rospy.ROSInterruptException("shutdown")
        if timeout > 0.0:
            timeout = min(timeout, self._scene.patience)
        ready = {descriptor for descriptor, _ in self._poll.poll(timeout)}
        self._scene.serve(ready)
        if self._mailbox.fileno() in ready:
            self._mailbox.serve()
        self._services.tend()

    def _serve_in_tick(self, timeout: float) -> None:
        """As ``_serve``, while participants are waited for.

        When one of them waits for an autopilot that needs simulated time to answer, time flows meanwhile, for else it
        would stand still. The turn then lasts, as it does on a real vehicle.
        """
        if not (self._scene.need_time and self._server.needs_time and not self._control.paused):
            self._serve(timeout)
            return
        self._scene.step()
        self._publish_clock()
        self._serve(min(max(0.0, self._control.pacer.delay(self._scene.time_us, time.monotonic())), timeout))

    def _wait_for_pace(self) -> None:
        while self._control.flowing:
            delay = self._control.pacer.delay(self._scene.time_us, time.monotonic())
            if delay <= 0.0:
                return
            self._serve(min(delay, _SLICE))
            self._server.poll(0.0)

    def _publish_clock(self) -> None:
        self._clock.publish(Clock(clock=rospy.Time.from_sec(0) + rospy.Duration(0, self._scene.time_us * 1000)))

    def _publish_states(self, now: int) -> None:
        self._next_states_us = now - now % self._states_period_us + self._states_period_us
        listened = self._states.get_num_connections()
        if not (listened or self._truth.wanted):
            return
        states = self._scene.model_states()
        if listened:
            self._states.publish(states)
        self._truth.publish(states, now)


def _hold_word(waited: float) -> Callable[..., None]:
    """Return what logs that time is held at 0, after ``waited`` wall seconds."""
    write: Callable[..., None] = rospy.loginfo if waited < _HOLD_WARNING else rospy.logwarn
    return write


def _is_loopback(address: str) -> bool:
    return address == "localhost" or address.startswith("127.")


def reachable_uri(uri: str, host: str) -> str:
    """Return an address under which participants on other machines find the lockstep's server.

    Args:
        uri: the server's, tcp://host:port.
        host: the address on which it listens; for "0.0.0.0" the one that this machine tells other ROS nodes is named.
    """
    if host not in {"", "0.0.0.0"}:
        return uri
    return f"tcp://{rosgraph.network.get_local_address()}:{uri.rpartition(':')[2]}"


def close_all(*closings: Callable[[], object]) -> None:
    """Call all ``closings`` in this order, also those after one that raises.

    Raises:
        Exception: what a closing raised; if several did, the last one's, with the others as its context.
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
        rospy.logdebug("simulator: /lockstep/uri was gone already")


def log(level: int, text: str) -> None:
    """Pass the lockstep's words on to ROS."""
    write = {logging.WARNING: rospy.logwarn, logging.ERROR: rospy.logerr}.get(level, rospy.loginfo)
    write("simulator: %s", text)


class _Kernels:
    """Says that kernels are compiled: the world stands still meanwhile, and nothing else tells why."""

    def __init__(self) -> None:
        self._told = False

    def announce(self) -> None:
        """Say so from now on."""
        kernel.Announcer(self._begins, self._ends).register()

    def _begins(self, name: str) -> None:
        write, where = (rospy.loginfo, "") if self._told else (rospy.logwarn, f"; {kernel.cache_words()}")
        self._told = True
        write("simulator: compiling kernels: %s%s", name, where)

    def _ends(self, name: str, seconds: float) -> None:
        rospy.loginfo("simulator: kernel compiled: %s, in %.1f s", name, seconds)


def run_node(make: Callable[[], tuple[NodeSettings, Scene]], arguments: Sequence[str]) -> int:
    """Run a simulator's node until it is to end.

    Args:
        make: reads the node's parameters and makes the scene; it may raise ValueError or OSError.
        arguments: the command line, for its remappings.

    Returns:
        The exit status.
    """
    if not rosgraph.is_master_online():
        advice = "start one (roscore, roslaunch) or set ROS_MASTER_URI"
        print(f"simulator: no ROS master answers at {rosgraph.get_master_uri()}; {advice}", file=sys.stderr)
        return 1
    name = lockstep.future_name("simulator", list(arguments))
    # Before the name is registered: the master would shut down the node that has it now.
    reason = obstacle(name)
    if reason:
        print(f"simulator: {reason}", file=sys.stderr)
        return 1
    stale = stale_uri(name)
    rospy.init_node("simulator", disable_rostime=True, disable_signals=True)
    survive_full_disk()
    stop = Stop()
    _Kernels().announce()
    if stale:
        rospy.logwarn("simulator: /lockstep/uri was %s, where nobody answers: it is forgotten", stale)
    try:
        settings, scene = make()
        node = SimulatorNode(settings, scene, stop)
    except (ValueError, OSError) as error:
        rospy.logfatal("simulator: %s", error)
        return 1
    node.run()
    rospy.signal_shutdown("the simulation has ended")
    return 0
