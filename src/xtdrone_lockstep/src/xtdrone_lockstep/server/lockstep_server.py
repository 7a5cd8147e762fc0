"""The lockstep server, which runs in the simulator: joining and leaving participants, and the barrier of each tick.

Free of ROS and of threads: everything happens inside ``LockstepServer.poll``, ``wait_for`` and ``tick``, which the
simulator calls from its own loop.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import islice

from ..protocol import BASE_STEP_US, VERSION, Barrier, Kind, ProtocolError, pack_object, printable, process_namespace
from . import frame_checks
from .barrier import Idle, TickBarrier
from .channels import Channels, HostLink
from .client_process import ClientConnection, Process
from .client_sockets import ClientConnections, Log
from .datagram_counts import DatagramCounts
from .participant import Participant

DigestSink = Callable[[str, int, Mapping[str, Sequence[int]]], None]
"""Called with a participant's name, the simulation time in us and the digests of its topics (``protocol.Digest``)."""


class LockstepServer:
    """Accepts participants and runs the barrier.

    Attributes:
        participants: Those that have joined, by name, in the order of joining.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        hang_limit: float = 60.0,
        *,
        port: int = 0,
        busy_limit: float = 0.0,
        connect_limit: float = 5.0,
        base_step_us: int = BASE_STEP_US,
        log: Log | None = None,
        on_digest: DigestSink | None = None,
    ) -> None:
        """Open the listening socket.

        Args:
            host: Address to listen on; "0.0.0.0" for all interfaces.
            hang_limit: Wall seconds of complete silence (no keep-alive either) after which a participant that the
                simulator is waiting for is dropped; 0 for no limit.
            port: TCP port, 0 for any free one.
            busy_limit: Wall seconds that a living participant may take for one tick; 0 for no limit.
            connect_limit: Wall seconds that the simulation waits for a topic connection between participants.
            base_step_us: The simulator's step in microseconds.
            log: Called with a level of ``logging`` and a text; by default this module's logger.
            on_digest: Called with the digests of participants; without it they send none.

        Raises:
            OSError: The address or port cannot be used.
        """
        self.participants: dict[str, Participant] = {}
        self._base_step_us = base_step_us
        self._log = log or logging.getLogger(__name__).log
        self._on_digest = on_digest
        self._namespace = process_namespace()
        self._closed = False
        self._connections = ClientConnections(
            host, port, self._log, self._handle_frame, self._complete_turn, self._remove_participant
        )
        self._channels = Channels(self.participants, connect_limit, self._log)
        self._datagrams = DatagramCounts()
        self._barrier = TickBarrier(
            self.participants,
            self._connections,
            self._channels,
            self._datagrams,
            poll=self.poll,
            hang_limit=hang_limit,
            busy_limit=busy_limit,
            log=self._log,
        )

    # ---- set-up and state ----

    @property
    def uri(self) -> str:
        """Address to which participants connect, tcp://host:port."""
        return self._connections.uri

    @property
    def datagrams_expected(self) -> dict[int, int]:
        """Cumulative number of datagrams that participants report having sent, by the simulator's UDP port."""
        return self._datagrams.expected

    @property
    def needs_time(self) -> bool:
        """Whether a participant is waiting for an event that needs simulation time to advance."""
        return any(participant.needs_time for participant in self.participants.values())

    def fileno(self) -> int:
        """Return a file descriptor that is readable when ``poll`` has work to do."""
        return self._connections.fileno()

    def attach_host(self, link: HostLink) -> None:
        """Count the messages between the simulator itself and participants like those between participants.

        Args:
            link: The simulator's own publishers and subscribers.

        Raises:
            ValueError: The simulator's own topics are already attached.
        """
        self._channels.attach_host(link)

    def open_datagram_ports(
        self, ports: Collection[int], sent_so_far: Callable[[], Mapping[int, int]] | None = None
    ) -> None:
        """Set the UDP ports on which the simulator receives the datagrams that participants count in DONE.

        Counts of other ports are ignored; without such ports, ``udp_ports`` of participants are ignored as well.
        """
        self._datagrams.open_ports(ports, sent_so_far)

    def remote_sender(self, port: int) -> bool:
        """Return whether the last participant to send to one of the simulator's UDP ports is on another machine."""
        return self._datagrams.is_sender_remote(port)

    # ---- time ----

    def poll(self, timeout: float = 0.0) -> None:
        """Accept connections, handle received frames and drop dead or faulty clients.

        Args:
            timeout: Longest wait for data in wall seconds.
        """
        self._channels.collect_host()
        self._connections.poll(timeout)

    def next_due_us(self, now_us: int) -> int | None:
        """Return the earliest time after ``now_us`` at which a participant is due in us; None without participants."""
        return self._barrier.next_due_us(now_us)

    def reset_time(self, now_us: int) -> None:
        """Set simulation time between two ticks; the tick number continues; messages in transit become void.

        Args:
            now_us: New simulation time in microseconds; participants are next due at or after it.
        """
        self._channels.collect_host()
        self._barrier.reset_time(now_us)

    def tick(
        self,
        now_us: int,
        datagrams: Mapping[int, int] | None = None,
        idle: Idle | None = None,
        head_start: float = 0.0,
    ) -> None:
        """Run one barrier: ``begin_tick`` and ``end_tick``, whose arguments these are."""
        self.begin_tick(now_us, datagrams, idle)
        self.end_tick(idle, head_start)

    def begin_tick(self, now_us: int, datagrams: Mapping[int, int] | None = None, idle: Idle | None = None) -> None:
        """Wait for new connections, and send TICK to all due participants.

        Args:
            now_us: Simulation time in microseconds.
            datagrams: Cumulative number of datagrams that the simulator has sent, by the participants' UDP port.
            idle: Called with a time in seconds instead of a plain wait; it should return when that time has passed or
                when ``fileno`` becomes readable, and may serve other sockets meanwhile.
        """
        self._barrier.begin(now_us, datagrams, idle)

    @property
    def begins_counts(self) -> bool:
        """Whether no datagrams may be sent until this barrier has ended, see ``TickBarrier``."""
        return self._barrier.begins_counts

    def end_tick(self, idle: Idle | None = None, head_start: float = 0.0) -> None:
        """Wait for DONE of each participant that has received TICK.

        Args:
            idle: As for ``begin_tick``.
            head_start: Wall seconds in which participants may be done before ``idle`` is called for the first time,
                unless one waits for an event that needs time to advance. This saves a call for each DONE.
        """
        self._barrier.end(idle, 0.0 if self.needs_time else head_start)

    def wait_for(
        self,
        expected: int | Iterable[str],
        timeout: float | None = None,
        idle: Idle | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> bool:
        """Wait until the expected participants have joined and all connections between their topics are made.

        A connection that is not made within ``connect_limit`` causes a warning and is no longer waited for.

        Args:
            expected: Number of participants, or their names.
            timeout: Longest wait in wall seconds; None for no limit.
            idle: As for ``tick``.
            progress: Called with a description of what is missing whenever it changes.

        Returns:
            Whether everything is complete; False after a timeout.
        """
        wanted = expected if isinstance(expected, int) else list(expected)
        return self._barrier.wait_until_complete(lambda: self.missing(wanted), timeout, idle, progress)

    def missing(self, expected: int | Iterable[str] = 0) -> str:
        """Return one line that names the missing participants and connections; empty if there are none.

        Args:
            expected: Number of participants, or their names (with or without the leading slash).
        """
        parts = []
        if isinstance(expected, int):
            if len(self.participants) < expected:
                parts.append(f"{len(self.participants)} of {expected} participants have joined")
        else:
            names = [name if name.startswith("/") else "/" + name for name in expected]
            absent = [name for name in names if name not in self.participants]
            if absent:
                text = _listing(absent, len(absent))
                parts.append(f"{len(absent)} of {len(names)} participants have not joined: {text}")
        missing = self._channels.missing
        if missing:
            pairs = (f"{topic} from {publisher} to {subscriber}" for topic, publisher, subscriber in missing)
            text = _listing(pairs, len(missing))
            parts.append(f"{len(missing)} connections are not made: {text}")
        return "; ".join(parts)

    def close(self, failure: str = "") -> None:
        """Close every connection, which ends the participants.

        Args:
            failure: Why the simulator failed, in which case participants end with an error; empty for a normal end.
        """
        if self._closed:
            return
        self._closed = True
        reason = f"the simulation has failed: {printable(failure)}" if failure else "the simulation has ended"
        self._connections.close(pack_object(Kind.LEAVE, {"reason": reason, "failed": bool(failure)}))
        self.participants.clear()

    # ---- frames ----

    def _handle_frame(self, connection: ClientConnection, kind: int, payload: bytes) -> None:
        """Handle one frame; the connection's reader accepts only RESERVE and JOIN before joining, all others after it.

        Raises:
            ProtocolError: It is malformed, or not allowed in the current state.
        """
        if kind == Kind.DONE:  # first, as it is by far the most frequent
            self._end_turn(self.participants[connection.name], frame_checks.done(payload))
        elif kind == Kind.JOIN:
            self._join(connection, frame_checks.join(payload, self._base_step_us))
        elif kind == Kind.RESERVE:
            self._reserve(connection, frame_checks.reservation(payload))
        else:
            self._handle_participant_frame(self.participants[connection.name], kind, payload)

    def _handle_participant_frame(self, participant: Participant, kind: int, payload: bytes) -> None:
        if kind == Kind.ALIVE:
            participant.needs_time = frame_checks.needs_time(payload)
        elif kind == Kind.PEER:
            self._channels.update(participant, frame_checks.peers(payload))
        elif kind == Kind.DECLARE:
            self._channels.declare(participant, frame_checks.declaration(payload))
        elif kind == Kind.DIGEST:
            report = frame_checks.digest(payload)
            if self._on_digest is not None:
                self._on_digest(participant.name, report.time_us, report.topics)
        elif kind == Kind.LEAVE and participant.connection is not None:
            leave = frame_checks.leave(payload)
            level = logging.WARNING if leave.failed else logging.INFO
            self._log(level, f"participant {participant.name} leaves: {leave.reason}")
            self._connections.remove(participant.connection)

    def _end_turn(self, participant: Participant, done: Barrier) -> None:
        self._channels.count(participant, done.channels)
        if done.datagrams:
            self._datagrams.count(participant, done.datagrams)
        self._barrier.complete_turn(participant, done)

    def _complete_turn(self, connection: ClientConnection, datagrams: Mapping[int, int]) -> None:
        """Accept the DONE that the barrier awaits, see ``client_sockets.EndTurn``."""
        participant = self.participants[connection.name]
        if datagrams:
            self._datagrams.count(participant, datagrams)
        self._barrier.release(participant)

    # ---- joining and leaving ----

    def _reserve(self, connection: ClientConnection, node: frame_checks.Reservation) -> None:
        """Reserve a name for a starting node, so that a second one is refused before it registers with ROS."""
        if connection.reserved:
            raise ProtocolError("RESERVE on a connection that has a name")
        self._require_free(connection, node.name)
        connection.process = self._process(connection, node)
        self._connections.reserve(connection, node.name)
        self._welcome(connection)

    def _join(self, connection: ClientConnection, join: frame_checks.Join) -> None:
        name = join.node.name
        self._require_free(connection, name)
        connection.reader.longest = frame_checks.AFTER_JOIN
        connection.process = self._process(connection, join.node)
        participant = Participant(name, connection, join.rate, join.schedule)
        self._connections.join(connection, name, participant.outgoing.routes, participant.outgoing.closing)
        self._barrier.add_participant(participant)
        self._datagrams.add_participant(participant, join.udp_ports)
        self.participants[name] = participant
        self._welcome(connection)
        late = f", at {self._barrier.time_us * 1e-6:g} s of simulation time" if self._barrier.ticks else ""
        self._log(logging.INFO, f"participant {name} joins at {join.rate:g} Hz from {connection.address}{late}")
        if connection.is_open:
            self._channels.add_participant(participant)
            self._channels.declare(participant, join.topics)

    def _require_free(self, connection: ClientConnection, name: str) -> None:
        """Check that no other connection has or has reserved a name.

        Raises:
            RefusalError: The name is taken.
        """
        participant = self.participants.get(name) or self._channels.host_named(name)
        owner = participant.connection if participant is not None else self._connections.reserved.get(name)
        if participant is None and owner in (None, connection):
            return
        address = "the simulator" if owner is None else owner.address
        pid = "" if owner is None or owner.process is None else f" (process {owner.process.pid})"
        raise frame_checks.RefusalError(
            "taken", f"the name {name} is taken by a participant connected from {address}{pid}"
        )

    def _process(self, connection: ClientConnection, node: frame_checks.Reservation) -> Process | None:
        """Return the process named by a RESERVE or JOIN, None if it is not visible from here."""
        if not self._namespace or node.host != self._namespace or connection.remote or node.pid < 1:
            return None
        return Process(node.pid)

    def _welcome(self, connection: ClientConnection) -> None:
        content = {"version": VERSION, "base_step_us": self._base_step_us, "digest": self._on_digest is not None}
        self._connections.send(connection, pack_object(Kind.WELCOME, content))

    def _remove_participant(self, connection: ClientConnection) -> None:
        """Remove the participant of a closed connection, if it had joined."""
        participant = self.participants.get(connection.name)
        if participant is None or participant.connection is not connection:
            return
        self._barrier.release(participant)
        del self.participants[connection.name]
        self._channels.remove_participant(participant)


def _listing(items: Iterable[str], count: int, most: int = 6) -> str:
    """Return the first ``most`` of ``count`` items, separated by commas, and the number of the others."""
    rest = count - most
    return ", ".join(islice(items, most)) + (f" and {rest} more" if rest > 0 else "")
