"""A participant: joins the simulator, takes its turns, and leaves."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Mapping
from typing import Any

import rospy
import rospy.core

from ..protocol import (
    ALIVE_FRAME,
    DIGEST_PERIOD_US,
    NEEDS_TIME_FRAME,
    VERSION,
    Barrier,
    Kind,
    ProtocolError,
    pack_barrier,
    pack_object,
    printable,
    process_namespace,
    unpack_barrier,
    unpack_object,
)
from ..transport.outlets import Outlet
from ..transport.rospy_internals import set_time_us
from .compiled_turns import CompiledTurns, CompiledWork
from .messages_due import Deliveries
from .node_state import Node, Serve
from .server_link import ServerConnection, reason_of

DATAGRAM_LIMIT = 10.0
"""Wall seconds to wait for a counted datagram from this machine, where none is lost on the way."""
REMOTE_DATAGRAM_LIMIT = 0.25
"""Wall seconds to wait for a counted datagram from another machine, where some may be lost."""
ALIVE_PERIOD = 1.0
"""Wall seconds between keep-alives."""
SHUTDOWN_LOCK_LIMIT = 0.2
"""Wall seconds that a shutdown waits for another thread to finish sending."""


class Client:
    """The node's participation in a simulator's lockstep.

    Attributes:
        uri: Address of the simulator.
        tick: Number of the current tick, 0 before the first.
        time_us: Simulation time of the current tick in microseconds.
    """

    def __init__(self, uri: str, node: Node) -> None:
        """Store the address; ``reserve`` or ``join`` connects.

        Args:
            uri: Address of the simulator.
            node: The node that is to join.
        """
        self.uri = uri
        self.tick = 0
        self.time_us = 0
        self._node = node
        self._reader = node.reader
        self._connection = ServerConnection(uri)
        self._deliveries = Deliveries(node)
        self._joined = False
        self._ended = threading.Event()
        self._last_number = 0
        self._outlets: dict[int, Outlet] = {}
        self._waiters = 0  # threads that wait for an event that needs time to advance
        self._waiters_lock = threading.Lock()
        self._reported_datagrams: dict[int, int] = {}
        self._digest_period = -1
        self._was_reset = False
        self._compiled: CompiledTurns | None = None

    # ---- joining and leaving ----

    def reserve(self, name: str) -> None:
        """Connect and reserve a name for the node that is to join over this connection.

        Args:
            name: Resolved name.

        Raises:
            OSError: There is no connection.
            ProtocolError: The URI or the answer is not that of a lockstep server.
            RefusedError: The server refuses the name.
        """
        self._connection.ask(Kind.RESERVE, _introduction(name))

    def join(self) -> None:
        """Join, connecting first if necessary, and announce the existing topic connections.

        Raises:
            OSError: There is no connection.
            ProtocolError: The URI or the answer is not that of a lockstep server.
            RefusedError: The server refuses the node.
        """
        node = self._node
        content = {
            **_introduction(rospy.get_name()),
            "rate": node.rate,
            "udp_ports": node.udp_ports,
            **node.declaration(),
        }
        welcome = self._connection.ask(Kind.JOIN, content)
        if welcome.get("digest"):
            node.digests = {}
        self._connection.watch(self._reader, self._readable)
        node.counter = self
        # From now on rospy's threads announce new connections themselves; those made before are announced here.
        with self._connection.lock:
            self._joined = True
            self._announce(node.outlets())
        if {**content, **node.declaration()} != content:
            self.topics_changed()
        rospy.core.add_client_shutdown_hook(self._on_shutdown)
        thread = threading.Thread(target=self._keep_alive, name="lockstep keep-alive", daemon=True)
        # pydevd (the debugger of PyCharm and VS Code) stops all threads at a breakpoint except those marked like this.
        thread.__dict__.update(pydev_do_not_trace=True, is_pydev_daemon_thread=True)
        thread.start()

    def close(self) -> None:
        """Close the connection."""
        self._joined = False
        self._ended.set()
        self._connection.close()

    def _on_shutdown(self) -> None:
        # This may run in a signal handler that has interrupted the main thread while it holds the lock. The node then
        # ends without a LEAVE.
        lock = self._connection.lock
        if lock.acquire(timeout=SHUTDOWN_LOCK_LIMIT):
            try:
                if self._joined:
                    self._joined = False
                    self._leave()
            finally:
                lock.release()
        # rospy closes the topics next, perhaps in the same signal handler: nothing may wait for the lock from here on.
        self._joined = False
        self._ended.set()
        self._reader.wake()

    def _leave(self) -> None:
        last = self._compiled and self._compiled.stop()
        if last:
            self.tick, self.time_us = last
        crash = self._node.crash
        reason = f"it crashed: {printable(crash)}" if crash else "shut down"
        leave = pack_object(Kind.LEAVE, {"reason": reason, "failed": bool(crash)})
        frames = self._digest_frame() + self._done_frame() + leave
        with contextlib.suppress(OSError):
            self._connection.send(frames)

    # ---- keep-alive ----

    def wait_for_time(self, waiters: int) -> None:
        """Report to the server whether any thread is waiting for an event that needs time to advance.

        Args:
            waiters: 1 to add a waiting thread, -1 to remove one.
        """
        with self._waiters_lock:
            before, self._waiters = self._waiters, self._waiters + waiters
            if bool(before) != bool(self._waiters):
                with contextlib.suppress(OSError):
                    self._send(NEEDS_TIME_FRAME if self._waiters else ALIVE_FRAME)

    def _keep_alive(self) -> None:
        """Send keep-alives, also while the main thread is at a breakpoint."""
        while not self._ended.wait(ALIVE_PERIOD):
            try:
                self._send(NEEDS_TIME_FRAME if self._waiters else ALIVE_FRAME)
            except OSError:
                return

    # ---- topics and their connections ----

    def topics_changed(self) -> None:
        """Send the topics declared by now."""
        if self._joined:
            with contextlib.suppress(OSError):
                self._send(pack_object(Kind.DECLARE, self._node.declaration()))

    def outlet_made(self, outlet: Outlet) -> None:
        """Announce a new connection; called in rospy's threads."""
        if self._compiled is not None:
            self._compiled.stop()
        if not self._joined:
            return
        with self._connection.lock:
            if self._joined:
                self._announce([outlet])

    def outlet_lost(self, outlet: Outlet) -> None:
        """Report that a connection is closed; called in any thread."""
        if self._compiled is not None:
            self._compiled.stop()
        if not self._joined:
            return
        with self._connection.lock:
            self._outlets.pop(outlet.number, None)
            if self._joined and outlet.number:
                with contextlib.suppress(OSError):
                    self._connection.send(pack_object(Kind.PEER, {"made": [], "lost": [outlet.number]}))

    def _announce(self, outlets: list[Outlet]) -> None:
        made = []
        for outlet in outlets:
            if outlet.number or outlet.closed:
                continue
            self._last_number += 1
            outlet.number = self._last_number
            self._outlets[outlet.number] = outlet
            made.append([outlet.number, outlet.topic, outlet.peer, outlet.port, outlet.count])
        if made:
            with contextlib.suppress(OSError):  # the main thread notices when the simulator is gone
                self._connection.send(pack_object(Kind.PEER, {"made": made, "lost": []}))

    def _update_peers(self, content: Mapping[str, Any]) -> None:
        """Apply a PEER frame."""
        self._deliveries.update(content)
        for number in content["counted"]:
            self._set_participant(number, True)
        for number in content["uncounted"]:
            self._set_participant(number, False)
        self._was_reset |= bool(content.get("reset"))
        if "missing" in content:
            self._node.connect_again(content["missing"])

    def _set_participant(self, number: int, value: bool) -> None:
        outlet = self._outlets.get(number)
        if outlet is not None:
            outlet.participant = value

    # ---- turns ----

    def begin(self) -> None:
        """Wait for the first TICK.

        Raises:
            ROSInterruptException: The node is shut down, or the simulator is gone.
        """
        self._enter(self._await_tick())

    def turn(self) -> None:
        """Send DONE, then wait for the next TICK and for the messages due by then.

        Raises:
            ROSInterruptException: The node is shut down, or the simulator is gone.
        """
        failure = ""
        with self._connection.lock:
            if rospy.core.is_shutdown_requested():
                raise rospy.ROSInterruptException("ROS shutdown request")
            try:
                if self._node.digests is not None:
                    self._send_due_digest()
                counts, ports = self._take_counts()
                self._connection.send_done(self.tick, self.time_us, counts, ports)
            except OSError as error:
                failure = str(error)
        if failure:
            self._lose_simulator(failure)
        self._enter(self._carry() or self._await_tick())

    def compile(self, work: CompiledWork) -> None:
        """Run turns by a compiled program wherever possible, see ``compiled_turns``."""
        self._compiled = CompiledTurns(self._node, self._connection, self._deliveries, work)

    def _carry(self) -> Barrier | None:
        """Run compiled turns; return the TICK that ends them if it has already arrived."""
        if self._compiled is None or self._connection.pending:
            return None
        try:
            found, self.tick, self.time_us = self._compiled.carry(self.tick, self.time_us)
        except (OSError, ProtocolError) as error:
            self._lose_simulator(str(error))
        if rospy.core.is_shutdown_requested():
            raise rospy.ROSInterruptException("ROS shutdown request")
        return found

    def _done_frame(self) -> bytes:
        return pack_barrier(Kind.DONE, self.tick, self.time_us, *self._take_counts())

    def _take_counts(self) -> tuple[dict[int, int], dict[int, int]]:
        """Return the counts that changed since the last call, of messages by connection and of datagrams by port."""
        node = self._node
        ports = {}
        if node.datagrams:
            reported = self._reported_datagrams
            ports = {port: count for port, count in node.datagrams.items() if reported.get(port) != count}
            reported.update(ports)
        return node.take_counts() if node.dirty else {}, ports

    def _send_due_digest(self) -> None:
        """Send a DIGEST frame in the first turn of each digest period."""
        period = self.time_us // DIGEST_PERIOD_US
        if period != self._digest_period:
            self._digest_period = period
            self._connection.send(self._digest_frame())

    def _digest_frame(self) -> bytes:
        if self._node.digests is None:
            return b""
        # A copy, as other threads publish too.
        topics = {topic: digest.state() for topic, digest in list(self._node.digests.items())}
        return pack_object(Kind.DIGEST, {"time_us": self.time_us, "topics": topics})

    def _await_tick(self) -> Barrier:
        frames = self._connection.frames
        while True:
            while frames:
                kind, payload = frames.popleft()
                if kind == Kind.TICK:
                    return unpack_barrier(payload)
                if kind == Kind.PEER:
                    self._update_peers(unpack_object(payload))
                elif kind in (Kind.REFUSED, Kind.LEAVE):
                    self._end_by_frame(kind, payload)
            try:
                tick = self._connection.await_frames(self._reader, 1.0)
            except (OSError, ProtocolError) as error:
                self._lose_simulator(str(error))
            if rospy.core.is_shutdown_requested():
                raise rospy.ROSInterruptException("ROS shutdown request")
            if tick is not None:
                return tick

    def _enter(self, tick: Barrier) -> None:
        """Begin the turn of a TICK: set the time, run reset hooks, receive datagrams and messages."""
        was_reset, self._was_reset = self._was_reset or tick.time_us < self.time_us, False
        self.tick, self.time_us, self._node.time_us = tick.tick, tick.time_us, tick.time_us
        set_time_us(tick.time_us)
        if was_reset:
            self._node.run_reset_hooks()
        if self._node.serve is not None and tick.datagrams:
            self._receive_datagrams(self._node.serve, tick.datagrams)
        self._deliveries.fetch(tick.channels)

    def _receive_datagrams(self, serve: Serve, counts: Mapping[int, int]) -> None:
        missed = self._node.datagrams_missed
        expected = {port: count - missed.get(port, 0) for port, count in counts.items()}
        received = serve(expected, REMOTE_DATAGRAM_LIMIT if self._connection.remote else DATAGRAM_LIMIT)
        for port, count in expected.items():
            short = count - received.get(port, 0)
            if short < 0 < missed.get(port, 0):
                missed[port] = max(0, missed[port] + short)  # some that were given up as lost have arrived late
            elif short > 0 and not rospy.is_shutdown():
                missed[port] = missed.get(port, 0) + short
                rospy.logwarn(f"{short} datagrams from the simulator to UDP port {port} did not arrive")

    # ---- the simulator's messages and its end ----

    def _send(self, data: bytes) -> None:
        if not self._joined:
            return
        with self._connection.lock:
            if self._joined:
                self._connection.send(data)

    def _readable(self) -> None:
        try:
            self._connection.read()
        except (OSError, ProtocolError) as error:
            self._lose_simulator(str(error))

    def _lose_simulator(self, why: str) -> None:
        """End the node because the connection is broken; the reason is the simulator's last frame, if there is one."""
        self._connection.read_rest()
        for kind, payload in self._connection.frames:
            if kind in (Kind.REFUSED, Kind.LEAVE):
                self._end_by_frame(kind, payload)
        self._end(f"the simulator at {self.uri} is gone", why)

    def _end_by_frame(self, kind: int, payload: bytes) -> None:
        """End the node because of a REFUSED or LEAVE frame."""
        content = unpack_object(payload)
        fault = ""
        if kind == Kind.REFUSED:
            fault = f"the simulator at {self.uri} has dropped this node"
        elif content.get("failed"):
            fault = f"the simulator at {self.uri} has ended with an error"
        self._end(fault, reason_of(content))

    def _end(self, fault: str, why: str) -> None:
        """End the node; an empty ``fault`` means that the simulation has ended normally."""
        if fault:
            rospy.logerr(f"{fault}: {why}")
            self._node.exit_status = 1
        else:
            rospy.loginfo(why)
        self._joined = False
        self._ended.set()
        rospy.signal_shutdown(fault or why)
        raise rospy.ROSInterruptException(fault or why)


def _introduction(name: str) -> dict[str, Any]:
    return {"version": VERSION, "name": name, "pid": os.getpid(), "host": process_namespace()}
