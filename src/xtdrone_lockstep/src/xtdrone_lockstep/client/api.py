"""The names that a node in lockstep uses in place of rospy's: ``init_node``, ``Publisher``, ``start``, ``Rate``, ...

A node in lockstep (a *participant*) takes its time from the simulator's TICK, runs its callbacks in its own thread in a
fixed order (in ``start`` and ``Rate.sleep``), and reports with DONE how many messages it has sent. Without a simulator
the same calls behave like rospy.Rate with plain topics, and callbacks run in the same place.

Never call ``rospy.sleep`` or ``rospy.Rate`` in a participant's main thread: time stands still until the node has sent
DONE. Use ``Rate``, ``sleep`` or ``spin`` instead.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import rosgraph
import rospy
import rospy.core
import rospy.impl.simtime
import rospy.rostime

from xtdrone_common.programs.node_command_line import exit_statuses
from xtdrone_common.programs.plain_node import lengthen_connection_queue, survive_full_disk

from ..protocol import Schedule
from ..transport import local_topics
from ..transport.rospy_internals import handle_signal, set_time_us
from ..transport.rospy_internals import registering_together as registering_together
from . import joining
from .compiled_turns import CompiledWork
from .host import Host
from .joining import future_name
from .node_state import Serve, this_node
from .participant_turns import Client
from .server_link import URI_PARAM
from .topics import Publisher as Publisher
from .topics import Subscriber as Subscriber
from .topics import UncountedPublisher as UncountedPublisher

WAIT_PARAM = "/lockstep/wait"
"""ROS parameter that makes nodes wait for a simulator that a launch file starts along with them."""
SLICE = 0.1
"""Longest single wait for datagrams in wall seconds, so that a shutdown is noticed."""


@dataclass
class _Session:
    """This process's state in relation to a simulator.

    Attributes:
        reservation: Client that has reserved the node's name and will join.
        client: Client that has joined.
        host: The simulator's own topics, if this process is the simulator.
        started: Whether ``start`` has been called.
    """

    reservation: Client | None = None
    client: Client | None = None
    host: Host | None = None
    started: bool = False


_session = _Session()


# ---- starting and ending ----


def init_node(name: str, rate: float = 30.0, **options: Any) -> None:
    """Initialise the ROS node and determine whether it takes part in a simulator's lockstep.

    It does if ``/lockstep/uri`` is set or ``/lockstep/wait`` is true (set by launch files that start a simulator along
    with the node), unless ``~lockstep`` is false.

    Args:
        name: Node name.
        rate: Turns per second of simulation time in Hz, above 0 and at most 250.
        options: Passed to ``rospy.init_node``.

    Raises:
        ValueError: The rate is out of range.
        ROSInitException: The master does not answer, the time cannot be initialised, or another participant has this
            name.
    """
    Schedule(rate)  # checks the rate
    if not rosgraph.is_master_online():  # rospy would wait for it indefinitely
        advice = "start one (roscore, roslaunch) or set ROS_MASTER_URI"
        raise rospy.ROSInitException(f"no ROS master answers at {rosgraph.get_master_uri()}; {advice}")
    if not options.get("anonymous"):
        _session.reservation = joining.reserve(future_name(name, options.get("argv")), this_node)
    rospy.init_node(name, disable_rostime=True, **options)
    lengthen_connection_queue()
    survive_full_disk()
    if not options.get("disable_signals"):
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, _on_signal)
    _record_crash()
    this_node.rate = rate
    if rospy.get_param(joining.PRIVATE_PARAM, True):
        this_node.taking_part = bool(rospy.get_param(URI_PARAM, "") or rospy.get_param(WAIT_PARAM, False))
    if this_node.taking_part:
        # TICK carries the time; rospy's subscription to /clock would deliver it later and in another thread.
        set_time_us(0)
        this_node.reader.activate()
        local_topics.serve()
    elif not rospy.impl.simtime.init_simtime():
        raise rospy.ROSInitException("cannot initialise the time; is the master running?")


def _on_signal(number: int, _: Any) -> None:
    # rospy's handler unregisters the topics while the main thread is interrupted. If that was in a log call, which asks
    # the master for a parameter, the handler would wait forever for the lock of the master's proxy; a thread does not.
    threading.Thread(target=handle_signal, args=(number,), name="lockstep shutdown").start()


def _record_crash() -> None:
    """Record an exception that ends the program, to be reported to the simulator."""
    previous = sys.excepthook

    def record(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        this_node.crash = f"{kind.__name__}: {error}" if str(error) else kind.__name__
        previous(kind, error, trace)

    sys.excepthook = record


def start() -> None:
    """Join the simulator, if there is one, and wait for the first tick; all topics should be declared before.

    Callbacks of messages that arrived before that tick (latched ones, say) run before this returns.

    Raises:
        ROSInitException: The simulator does not answer or refuses the node; the text gives the reason.
        ROSInterruptException: The node is shut down meanwhile.
    """
    if _session.started:
        raise rospy.ROSInitException("lockstep.start() was called a second time")
    if not rospy.core.is_initialized():
        raise rospy.ROSInitException("call lockstep.init_node() before lockstep.start()")
    _session.started = True
    if not this_node.taking_part:
        return
    reservation, _session.reservation = _session.reservation, None
    client = _session.client = joining.join(this_node, reservation)
    rospy.loginfo(f"in lockstep with the simulator at {client.uri}, {this_node.rate:g} Hz")
    client.begin()
    this_node.dispatch()


def is_active() -> bool:
    """Return whether this node takes part in a simulator's lockstep."""
    return this_node.taking_part


def exit_status() -> int:
    """Return the exit status for the program: 1 if the simulator has failed or has dropped the node, else 0."""
    return this_node.exit_status


exit_statuses.append(exit_status)  # of nodes started by ``run_program``


# ---- turns ----


class Rate:
    """Ends the node's turns; callbacks run in ``sleep``."""

    def __init__(self, hz: float | None = None) -> None:
        """Use the rate of the node.

        Args:
            hz: The rate given to ``init_node``, or None; a node has one rate.

        Raises:
            ValueError: It is another rate.
        """
        if hz is not None and hz != this_node.rate:
            raise ValueError(f"lockstep.Rate({hz!r}): the node was initialised with rate={this_node.rate!r}")
        # With reset=True rospy does not raise when /clock jumps back.
        self._rate = None if this_node.taking_part else rospy.Rate(this_node.rate, reset=True)

    def sleep(self) -> None:
        """End this turn, wait for the next and run the callbacks of received messages.

        Raises:
            ROSInterruptException: The node is shut down, or the simulator is gone.
        """
        if self._rate is None:
            if _session.client is None:
                raise rospy.ROSInitException("call lockstep.start() before lockstep.Rate.sleep()")
            _session.client.turn()
        else:
            self._sleep_free(self._rate)
        this_node.dispatch()

    @staticmethod
    def _sleep_free(rate: rospy.Rate) -> None:
        """Sleep without lockstep, serving datagrams meanwhile."""
        serve, began = this_node.serve, rospy.Time.now()
        if serve is None:
            rate.sleep()
        elif rospy.rostime.is_wallclock():
            while (remaining := rate.remaining().to_sec()) > 0.0 and not rospy.is_shutdown():
                serve(None, min(remaining, SLICE))
            rate.sleep()
        else:
            # The turn is timed by /clock, which cannot end a wait for datagrams.
            rate.sleep()
            serve(None, 0.0)
        # A corrected wall clock, as on a real vehicle, is not a reset.
        if rospy.Time.now() < began and not rospy.rostime.is_wallclock():
            this_node.run_reset_hooks()


def sleep(seconds: float) -> None:
    """Sleep in ROS time, turn by turn; callbacks run meanwhile.

    Args:
        seconds: Minimum duration in seconds of ROS time; a reset of the time ends the sleep early.

    Raises:
        ROSInterruptException: The node is shut down, or the simulator is gone.
    """
    rate, now = Rate(), rospy.Time.now()
    end = now + rospy.Duration.from_sec(seconds)
    while now < end:
        rate.sleep()
        before, now = now, rospy.Time.now()
        if now < before:
            return


def spin(step: Callable[[], None] | None = None, compiled: CompiledWork | None = None) -> None:
    """Call ``step`` once per turn until the node is shut down.

    Args:
        step: Work of one turn; None for a node that works in callbacks only.
        compiled: The same work, callbacks included, as a compiled program, which in lockstep takes the turns in which
            nothing unusual happens.
    """
    rate = Rate()
    if compiled is not None and _session.client is not None:
        _session.client.compile(compiled)
    with contextlib.suppress(rospy.ROSInterruptException):
        while not rospy.is_shutdown():
            if step is not None:
                step()
            rate.sleep()


def add_reset_hook(hook: Callable[[], None]) -> None:
    """Register a function to be called after simulation time was reset, as by /gazebo/reset_simulation.

    Args:
        hook: Called in the node's own thread in ``Rate.sleep`` with the new time set, before all callbacks of the turn.
    """
    this_node.reset_hooks.append(hook)


@contextlib.contextmanager
def needs_time() -> Iterator[None]:
    """Context in which the simulator knows that the node is waiting for an event that needs time to advance.

    An external autopilot, for example, responds only as time advances. The simulator then lets time advance although a
    participant whose turn depends on this node is not done. May be used in any thread; no effect without lockstep.
    """
    client = _session.client
    if client is None:
        yield
        return
    client.wait_for_time(1)
    try:
        yield
    finally:
        client.wait_for_time(-1)


# ---- datagrams ----


def declare_udp(ports: Iterable[int], serve: Serve) -> None:
    """Declare, before ``start``, that the node exchanges datagrams with the simulator.

    Args:
        ports: Local ports on which the node receives.
        serve: Called in ``Rate.sleep`` before any topic callback as serve(expected, timeout). It must receive until
            each port in ``expected`` has received that many datagrams in total, and no more, or until ``timeout`` wall
            seconds have passed; with ``expected`` None (no lockstep) it must receive for that time. It returns the
            total number of datagrams received by port. The sockets' receive buffers must hold the datagrams of a turn.
    """
    this_node.udp_ports = list(ports)
    this_node.serve = serve


def datagrams_sent(port: int, count: int) -> None:
    """Set the number of datagrams that the node has sent to a port of the simulator.

    Args:
        port: The simulator's UDP port.
        count: Cumulative number.
    """
    this_node.datagrams[port] = count


# ---- the simulator's own topics ----


def host() -> Host:
    """Make this process the simulator: messages of its publishers, and to its subscribers, are counted.

    Call it after ``rospy.init_node`` in the simulator's thread, and pass the result to ``LockstepServer.attach_host``.
    Declare subscribers afterwards in the same thread. The process itself is not a participant.

    Raises:
        ROSInitException: The node takes part in another simulator's lockstep.
    """
    if this_node.taking_part:
        raise rospy.ROSInitException("a participant cannot be the simulator as well")
    if _session.host is None:
        lengthen_connection_queue()
        this_node.reader.activate()
        local_topics.serve()
        _session.host = Host(rospy.get_name(), this_node)
        this_node.counter = _session.host
        for outlet in this_node.outlets():
            _session.host.outlet_made(outlet)
    return _session.host
