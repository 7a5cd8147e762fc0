"""The simulator's half of the lockstep: who takes part, who is due, and the barrier.

Free of ROS and of threads: everything happens inside `LockstepServer.poll`, `wait_for` and `tick`, which the simulator
calls from its own loop. Wall time is used for nothing but giving up on the dead.
"""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

from .protocol import (
    BASE_STEP_US,
    NEEDS_TIME,
    VERSION,
    FrameReader,
    Kind,
    ProtocolError,
    Schedule,
    pack_barrier,
    pack_object,
    process_namespace,
    same_machine,
    tune,
    unpack_barrier,
    unpack_object,
)

DigestSink = Callable[[str, int, Mapping[str, Sequence[int]]], None]
"""Takes a participant's name, the simulation time in us and its topics' digests, see `protocol.Digest`."""
Log = Callable[[int, str], None]
Idle = Callable[[float], None]
Pair = tuple[str, str, str]
"""Topic, publisher's name, subscriber's name."""

SLICE = 0.1
"""Longest single wait in seconds, so that limits and signals are looked at in time."""
GREETING_LIMIT = 10.0
"""Seconds that a connection may stay without a JOIN or RESERVE."""
SILENCE = 1.5
"""Wall seconds without a keep-alive after which the server looks whether the participant's process is there still."""


class HostLink(Protocol):
    """How the simulator's own publishers and subscribers tell and hear of connections and counts, see `client.Host`."""

    name: str

    def collect(self) -> tuple[dict[str, Any] | None, list[list[Any]], list[int], dict[int, int]]:
        """Returns what changed: declaration (as DECLARE) or None, peers made, ids lost, channel counts."""

    def counted(self, number: int, value: bool) -> None:
        """Says whether a connection's subscriber is a participant."""

    def deliver(self, news: Mapping[str, Any], counts: Mapping[int, int]) -> None:
        """Takes, after a barrier, what participants have sent to the simulator in all.

        Args:
            news: Connections to its subscribers, as a PEER frame has them: made, lost, void.
            counts: Channel to the number of messages sent over it, where that has changed.
        """


class Channel:
    """One topic connection between two participants.

    Attributes:
        id: The server's number.
        pair: Topic, publisher, subscriber.
        port: The subscriber's TCP port, which tells two connections of the same pair apart.
    """

    __slots__ = ("id", "pair", "port")

    def __init__(self, number: int, pair: Pair, port: int) -> None:
        """Keeps what identifies it."""
        self.id = number
        self.pair = pair
        self.port = port


class Process:
    """A process of this machine, told apart from a later one with the same number."""

    def __init__(self, pid: int) -> None:
        """Notes which it is.

        Args:
            pid: Of a process that runs.
        """
        self.pid = pid
        self._began = self._stat()[1]

    def state(self) -> str:
        """Returns the kernel's letter for its state (``t``: held by a debugger), empty if the process is gone."""
        state, began = self._stat()
        return "" if began != self._began or state in "ZX" else state

    def _stat(self) -> tuple[str, str]:
        try:
            with open(f"/proc/{self.pid}/stat", encoding="ascii", errors="replace") as file:
                # Fields 3 and 22 of proc(5); the second, the program's name, may hold anything.
                fields = file.read().rpartition(")")[2].split()
        except OSError:
            return "", ""
        return fields[0], fields[19]


class Participant:
    """What the server knows of one participant.

    Attributes:
        name: Resolved ROS name, as /follower_1; empty until it joined.
        remote: True if it runs on another machine.
        reserved: The name that it has reserved, empty if none.
        address: Host and port of its connection.
        rate: In Hz; 0 for the simulator itself.
        due_us: When its next turn is.
        waiting: True from TICK to DONE.
        needs_time: True while it waits for what comes only when time goes on.
        tick: Number of its last TICK.
        heard: Monotonic wall time at which something was last received from it, s.
        asked: Monotonic wall time of its last TICK, s.
        process: Its process, if that runs on this machine.
        publications: Topic to type.
        subscriptions: Topic to type.
        udp_ports: Local ports on which it receives the simulator's datagrams.
    """

    def __init__(self, sock: socket.socket | None, address: str, now: float) -> None:
        """Makes one that has not joined."""
        self.sock = sock
        self.address = address
        self.name = ""
        self.remote = False
        self.reserved = ""
        self.rate = 0.0
        self.schedule: Schedule | None = None
        self.due_us = 0
        self.waiting = False
        self.needs_time = False
        self.tick = 0
        self.heard = now
        self.asked = now
        self.accepted = now
        self.process: Process | None = None
        self.publications: dict[str, str] = {}
        self.subscriptions: dict[str, str] = {}
        self.udp_ports: list[int] = []
        self.reader = FrameReader()
        self.unsent = bytearray()
        # Its own connections as publisher: id -> channel, and id -> (news of the subscriber, id there) for new counts;
        # those that are no more, whose last counts come with its next DONE.
        self.channels: dict[int, Channel] = {}
        self.routes: dict[int, tuple[dict[int, int], int]] = {}
        self.closing: list[int] = []
        self.counted: list[int] = []
        self.uncounted: list[int] = []
        # News for it as subscriber, sent with its next TICK.
        self.counts: dict[int, int] = {}
        self.made: list[list[Any]] = []
        self.lost: list[int] = []
        self.reset = False
        self.void: list[list[int]] = []
        # UDP: told and base count the simulator's datagrams to it, sent counts its own per remote port.
        self.datagrams_base: dict[int, int] = {}
        self.datagrams_told: dict[int, int] = {}
        self.datagrams_sent: dict[int, int] = {}

    def connected(self) -> bool:
        """Says whether its connection is open."""
        return self.sock is not None


class LockstepServer:
    """Keeps the participants' connections and runs the barrier.

    Attributes:
        uri: Where participants connect, tcp://host:port.
        participants: Name to state, of those who have joined, in the order of joining.
        datagrams_expected: UDP port to the number of datagrams that participants say they have sent to it, cumulative.
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
        """Opens the listening socket.

        Args:
            host: Address to listen on; "0.0.0.0" for every network.
            hang_limit: Wall seconds of complete silence (no keep-alive either) after which a participant that the
                simulator waits for is dropped; 0 for never.
            port: TCP port, 0 for any free one.
            busy_limit: Wall seconds that a living participant may take for one tick; 0 for any time.
            connect_limit: Wall seconds that the world is held for a topic connection between participants.
            base_step_us: The simulator's step in microseconds.
            log: Called with a level of `logging` and a text; a logger of this module's name if None.
            on_digest: Called with what participants have published, condensed; None: they are not asked for it.

        Raises:
            OSError: The address or port cannot be used.
        """
        self._hang_limit = hang_limit
        self._busy_limit = busy_limit
        self._connect_limit = connect_limit
        self._base_step_us = base_step_us
        self._log = log or logging.getLogger(__name__).log
        self._on_digest = on_digest
        self._namespace = process_namespace()
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        named = socket.gethostname() if host in {"", "0.0.0.0"} else host
        self.uri = f"tcp://{named}:{self._listener.getsockname()[1]}"
        self._epoll = select.epoll()
        self._epoll.register(self._listener.fileno(), select.EPOLLIN)
        self._connections: dict[int, Participant] = {}
        self._reserved: dict[str, Participant] = {}
        self._refused = ""
        self.participants: dict[str, Participant] = {}
        self.datagrams_expected: dict[int, int] = {}
        self._datagrams: dict[int, int] = {}
        self._remote_ports: set[int] = set()
        self._tick = 0
        self._ticked_us = -1
        self._awaited = 0
        self._next_channel = 1
        self._live: dict[Pair, set[int]] = {}
        # Connections that should exist and do not -> monotonic time at which the world no longer waits for them.
        self._missing: dict[Pair, float] = {}
        self._ignored_counts: dict[int, int] = {}
        self._host: HostLink | None = None
        self._host_state: Participant | None = None
        self._closed = False

    # ---- what the simulator calls ----

    def fileno(self) -> int:
        """Returns a descriptor that is readable when `poll` has something to do."""
        return self._epoll.fileno()

    def attach_host(self, link: HostLink) -> None:
        """Counts the messages between the simulator itself and participants like those between participants.

        Args:
            link: Tells of the simulator's own publishers, and hears for its subscribers.

        Raises:
            ValueError: There is one already.
        """
        if self._host is not None:
            raise ValueError("the simulator's own publishers are attached already")
        self._host = link
        self._host_state = Participant(None, "the simulator", time.monotonic())
        self._host_state.name = link.name

    def poll(self, timeout: float = 0.0) -> None:
        """Accepts connections, reads what has come and drops the dead.

        Args:
            timeout: Longest wait for something to come, in wall seconds.
        """
        if self._host is not None:
            self._collect_host()
        for descriptor, event in self._epoll.poll(timeout):
            if descriptor == self._listener.fileno():
                self._accept()
                continue
            participant = self._connections.get(descriptor)
            if participant is None:
                continue
            if event & select.EPOLLOUT:
                self._flush(participant)
            if event & (select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR):
                self._receive(participant)
        if len(self._connections) > len(self.participants):
            self._drop_strangers()

    def next_due_us(self, now_us: int) -> int | None:
        """Returns the earliest time after `now_us` at which a participant is due, us, or None without participants."""
        times = [
            participant.due_us if participant.due_us > now_us else participant.schedule.after_us(now_us)
            for participant in self.participants.values()
            if participant.schedule is not None
        ]
        return min(times, default=None)

    def reset_time(self, now_us: int) -> None:
        """Sets simulation time back (or forth) between two ticks; the tick number goes on.

        Args:
            now_us: The new time in microseconds; participants are due from then on as they are at a start.
        """
        self._ticked_us = now_us - 1
        if self._host is not None:
            self._collect_host()
        for participant in self.participants.values():
            participant.reset = participant.tick > 0  # its next tick may have the very time of its last
            # What is on its way to it is of before, and must not be taken for news of the new time.
            participant.void = [[channel, count] for channel, count in participant.counts.items()]
            if participant.schedule is not None:
                participant.due_us = participant.schedule.after_us(self._ticked_us)
        if self._host_state is not None:
            self._host_state.void = [[channel, count] for channel, count in self._host_state.counts.items()]

    def tick(self, now_us: int, datagrams: Mapping[int, int] | None = None, idle: Idle | None = None) -> None:
        """Runs one barrier: holds for new connections, sends TICK to all who are due, waits until all are done.

        Args:
            now_us: Simulation time in microseconds.
            datagrams: UDP port to the number of datagrams that the simulator has sent to it, cumulative.
            idle: Called with a time in seconds instead of a plain wait; it should return when that time has passed or
                when `fileno` becomes readable, and may serve other sockets meanwhile.
        """
        self._settle(idle)
        self._ticked_us = now_us
        self._datagrams = dict(datagrams or {})
        due = [participant for participant in self.participants.values() if participant.due_us <= now_us]
        if not due:
            return
        self._tick += 1
        started = time.monotonic()
        for participant in due:
            self._send_tick(participant, now_us, started)
        while self._awaited:
            self._wait(SLICE, idle)
            self._drop_hung(started)
        self._deliver_to_host()

    def wait_for(
        self,
        expected: int | Iterable[str],
        timeout: float | None = None,
        idle: Idle | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> bool:
        """Waits until the expected participants have joined and all connections between their topics are made.

        A connection that is not made within `connect_limit` is warned of and no longer waited for.

        Args:
            expected: How many participants, or their names.
            timeout: Longest wait in wall seconds; None for any time.
            idle: As for `tick`.
            progress: Called with a text that says who or what is missing, whenever this changes.

        Returns:
            True if all are there, False if the time is over.
        """
        wanted = expected if isinstance(expected, int) else list(expected)
        end = None if timeout is None else time.monotonic() + timeout
        told = ""
        while True:
            self._wait(0.0, idle)
            self._give_up_connections()
            text = self.missing(wanted)
            if progress is not None and text != told:
                progress(text)
                told = text
            if not text:
                return True
            if end is not None and time.monotonic() >= end:
                return False
            self._wait(SLICE if end is None else max(0.0, min(SLICE, end - time.monotonic())), idle)

    def missing(self, expected: int | Iterable[str] = 0) -> str:
        """Says in one line which participants and connections are missing; empty if none.

        Args:
            expected: How many participants, or their names (with or without the leading slash).
        """
        parts = []
        if isinstance(expected, int):
            if len(self.participants) < expected:
                parts.append(f"{len(self.participants)} of {expected} participants have joined")
        else:
            names = [name if name.startswith("/") else "/" + name for name in expected]
            absent = [name for name in names if name not in self.participants]
            if absent:
                parts.append(f"{len(absent)} of {len(names)} participants have not joined: {_listing(absent)}")
        if self._missing:
            pairs = [f"{topic} from {publisher} to {subscriber}" for topic, publisher, subscriber in self._missing]
            parts.append(f"{len(pairs)} connections are not made: {_listing(pairs)}")
        return "; ".join(parts)

    def close(self) -> None:
        """Closes every connection; participants take this as the simulator's end."""
        if self._closed:
            return
        self._closed = True
        farewell = pack_object(Kind.LEAVE, {"reason": "the simulation has ended"})
        for participant in self._connections.values():
            if participant.sock is not None:
                with contextlib.suppress(OSError):
                    participant.sock.send(farewell)
                participant.sock.close()
        self._connections.clear()
        self.participants.clear()
        self._epoll.close()
        self._listener.close()

    @property
    def needs_time(self) -> bool:
        """Whether some participant waits for what comes only when time goes on."""
        return any(participant.needs_time for participant in self.participants.values())

    def remote_sender(self, port: int) -> bool:
        """Says whether whoever sends to one of the simulator's UDP ports is, or was, on another machine."""
        return port in self._remote_ports

    # ---- barrier ----

    def _wait(self, timeout: float, idle: Idle | None) -> None:
        if idle is None:
            self.poll(timeout)
            return
        idle(timeout)
        self.poll(0.0)

    def _settle(self, idle: Idle | None) -> None:
        """Takes in who has come, and holds the world until their connections are made."""
        self.poll(0.0)
        while self._missing:
            self._wait(SLICE, idle)
            self._give_up_connections()

    def _give_up_connections(self) -> None:
        if not self._missing:
            return
        now = time.monotonic()
        for pair in [pair for pair, limit in self._missing.items() if now >= limit]:
            topic, publisher, subscriber = pair
            self._log(
                logging.WARNING,
                f"no connection of {topic} from {publisher} to {subscriber} within {self._connect_limit:g} s: "
                "going on without",
            )
            del self._missing[pair]

    def _send_tick(self, participant: Participant, now_us: int, wall: float) -> None:
        participant.waiting = True
        participant.tick = self._tick
        participant.asked = wall
        if participant.schedule is not None:
            participant.due_us = participant.schedule.after_us(now_us)
        self._awaited += 1
        news = self._peer_news(participant)
        ports = self._datagram_news(participant) if participant.udp_ports else {}
        frame = pack_barrier(Kind.TICK, self._tick, now_us, participant.counts, ports)
        participant.counts.clear()
        self._send(participant, news + frame if news else frame)

    @staticmethod
    def _peer_news(participant: Participant) -> bytes:
        content: dict[str, Any] = {
            name: getattr(participant, name) for name in ("made", "lost", "counted", "uncounted")
        }
        if participant.reset:
            content |= {"reset": True, "void": participant.void}
        if not any(content.values()):
            return b""
        participant.reset = False
        for name in ("made", "lost", "counted", "uncounted", "void"):
            setattr(participant, name, [])
        return pack_object(Kind.PEER, content)

    def _deliver_to_host(self) -> None:
        """Tells the simulator's own subscribers what has been sent to them by the end of this tick."""
        state = self._host_state
        if self._host is None or state is None or not (state.made or state.lost or state.counts):
            return
        news = {"made": state.made, "lost": state.lost, "void": state.void}
        counts = dict(state.counts)
        state.counts.clear()
        state.made, state.lost, state.void = [], [], []
        self._host.deliver(news, counts)

    def _datagram_news(self, participant: Participant) -> dict[int, int]:
        news = {}
        for port in participant.udp_ports:
            count = self._datagrams.get(port, 0) - participant.datagrams_base.get(port, 0)
            if count != participant.datagrams_told.get(port, 0):
                participant.datagrams_told[port] = count
                news[port] = count
        return news

    def _drop_hung(self, started: float) -> None:
        now = time.monotonic()
        for participant in [participant for participant in self.participants.values() if participant.waiting]:
            silent = now - max(participant.heard, started)
            if silent > min(SILENCE, self._hang_limit or SILENCE) and participant.process is not None:
                # A child of it may hold the connection open; and a debugger that stops every thread is no hang.
                state = participant.process.state()
                if not state:
                    self._drop(participant, f"is gone: its process {participant.process.pid} has ended")
                    continue
                if state == "t":
                    participant.heard = now
                    continue
            if self._hang_limit and silent > self._hang_limit:
                self._drop(participant, f"was silent for {silent:.1f} s (hang limit {self._hang_limit:g} s)")
            elif self._busy_limit and now - participant.asked > self._busy_limit:
                self._drop(participant, f"took more than {self._busy_limit:g} s for one tick (busy limit)")

    # ---- sockets ----

    def _accept(self) -> None:
        while True:
            try:
                sock, address = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as error:
                self._log(logging.WARNING, f"a connection to {self.uri} was not taken: {error}")
                return
            sock.setblocking(False)
            tune(sock)
            participant = Participant(sock, f"{address[0]}:{address[1]}", time.monotonic())
            participant.remote = not same_machine(address[0], sock.getsockname()[0])
            self._connections[sock.fileno()] = participant
            self._epoll.register(sock.fileno(), select.EPOLLIN)
            # Its JOIN is mostly there already: then it takes part in the very next tick.
            self._receive(participant)

    def _receive(self, participant: Participant) -> None:
        if participant.sock is None:
            return
        try:
            data = participant.sock.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(participant, f"is gone: {error}")
            return
        if not data:
            self._drop(participant, "is gone: it closed its connection without taking leave")
            return
        participant.heard = time.monotonic()
        participant.reader.feed(data)
        try:
            for kind, payload in participant.reader.frames():
                self._handle(participant, kind, payload)
                if not participant.connected():
                    return
        except (ProtocolError, KeyError, TypeError, ValueError) as error:
            self._drop(participant, f"sent what is no lockstep frame: {type(error).__name__}: {error}")

    def _send(self, participant: Participant, data: bytes) -> None:
        if participant.sock is None:
            return
        if participant.unsent:
            participant.unsent += data
            return
        try:
            sent = participant.sock.send(data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self._drop(participant, f"is gone: {error}")
            return
        if sent < len(data):
            participant.unsent += data[sent:]
            self._epoll.modify(participant.sock.fileno(), select.EPOLLIN | select.EPOLLOUT)

    def _flush(self, participant: Participant) -> None:
        data, participant.unsent = bytes(participant.unsent), bytearray()
        if participant.sock is not None:
            self._epoll.modify(participant.sock.fileno(), select.EPOLLIN)
            self._send(participant, data)

    def _close(self, participant: Participant) -> None:
        if participant.sock is None:
            return
        descriptor = participant.sock.fileno()
        self._epoll.unregister(descriptor)
        del self._connections[descriptor]
        participant.sock.close()
        participant.sock = None

    def _drop_strangers(self) -> None:
        now = time.monotonic()
        for participant in list(self._connections.values()):
            if not participant.name and not participant.reserved and now - participant.accepted > GREETING_LIMIT:
                self._drop(participant, f"did not join within {GREETING_LIMIT:g} s")

    def _drop(self, participant: Participant, why: str) -> None:
        """Ends a participant that is dead, hung or talks nonsense."""
        if participant.sock is None:
            return
        who = f"participant {participant.name}" if participant.name else f"the connection from {participant.address}"
        if participant.name:
            self._log(logging.WARNING, f"{who} {why}; dropped, the simulation goes on")
        elif participant.reserved:
            self._log(logging.INFO, f"{participant.reserved} has ended before it joined")
        else:
            self._log(logging.DEBUG if participant.heard == participant.accepted else logging.WARNING, f"{who} {why}")
        # It may be alive and only slow: say why. One attempt, it may be dead as well.
        try:
            participant.sock.send(pack_object(Kind.REFUSED, {"code": "dropped", "reason": f"it {why}"}))
        except OSError:
            self._log(logging.DEBUG, f"{who} could not be told")
        self._remove(participant)

    def _remove(self, participant: Participant) -> None:
        self._close(participant)
        if self._reserved.get(participant.reserved) is participant:
            del self._reserved[participant.reserved]
        if participant.waiting:
            participant.waiting = False
            self._awaited -= 1
        if self.participants.get(participant.name) is not participant:
            return
        del self.participants[participant.name]
        for number in list(participant.channels):
            self._lose_channel(participant, number)
        for other in self._publishers():
            for number, channel in other.channels.items():
                if channel.pair[2] == participant.name:
                    # Whoever takes this name next has connections of its own.
                    other.routes[number] = (self._ignored_counts, 0)
                    self._tell_counted(other, number, False)
                    self._live.pop(channel.pair, None)
        for pair in [pair for pair in self._missing if participant.name in pair[1:]]:
            del self._missing[pair]

    # ---- frames ----

    def _handle(self, participant: Participant, kind: int, payload: bytes) -> None:
        if kind == Kind.DONE:
            self._done(participant, payload)
        elif kind == Kind.ALIVE:
            participant.needs_time = payload == NEEDS_TIME
        elif kind == Kind.JOIN:
            self._join(participant, unpack_object(payload))
        elif kind == Kind.RESERVE:
            self._reserve(participant, unpack_object(payload))
        elif not participant.name:
            raise ProtocolError(f"frame of type {kind} before JOIN")
        elif kind == Kind.PEER:
            self._peer(participant, unpack_object(payload))
        elif kind == Kind.DECLARE:
            self._declare(participant, unpack_object(payload))
        elif kind == Kind.DIGEST:
            content = unpack_object(payload)
            if self._on_digest is not None:
                self._on_digest(participant.name, int(content["time_us"]), content["topics"])
        elif kind == Kind.LEAVE:
            content = unpack_object(payload)
            level = logging.WARNING if content.get("failed") else logging.INFO
            self._log(level, f"participant {participant.name} leaves: {content.get('reason', '')}")
            self._remove(participant)
        else:
            raise ProtocolError(f"unknown frame type {kind}")

    def _done(self, participant: Participant, payload: bytes) -> None:
        done = unpack_barrier(payload)
        routes = participant.routes
        for number, count in done.channels.items():
            news, channel = routes.get(number, (self._ignored_counts, 0))  # it may be gone by now
            news[channel] = count
        _forget_routes(participant)
        for port, count in done.datagrams.items():
            more = count - participant.datagrams_sent.get(port, 0)
            participant.datagrams_sent[port] = count
            (self._remote_ports.add if participant.remote else self._remote_ports.discard)(port)
            self.datagrams_expected[port] = self.datagrams_expected.get(port, 0) + more
        if participant.waiting and done.tick == participant.tick:
            participant.waiting = False
            self._awaited -= 1

    def _reserve(self, participant: Participant, content: dict[str, Any]) -> None:
        """Keeps a name for a node that is starting, so that a second one hears of it before it registers with ROS."""
        if participant.name or participant.reserved:
            raise ProtocolError("RESERVE on a connection that has a name")
        name = self._checked_name(participant, content)
        if not name:
            return
        participant.reserved = name
        participant.process = self._process(content)
        self._reserved[name] = participant
        self._welcome(participant)

    def _checked_name(self, participant: Participant, content: dict[str, Any]) -> str:
        """Returns the name that a RESERVE or JOIN asks for, empty after having refused it."""
        name = str(content.get("name", ""))
        version = content.get("version")
        if version != VERSION:
            self._refuse(participant, "version", f"{name} speaks lockstep version {version!r}, this is {VERSION}")
            return ""
        if not name.startswith("/"):
            self._refuse(participant, "name", f"name {name!r}: must be a resolved ROS name, as /follower_1")
            return ""
        taken = self.participants.get(name) or (self._host_state if self._is_host(name) else None)
        if taken is None and self._reserved.get(name) is not participant:
            taken = self._reserved.get(name)
        if taken is None:
            return name
        pid = "" if taken.process is None else f" (process {taken.process.pid})"
        self._refuse(
            participant, "taken", f"the name {name} is taken by a participant connected from {taken.address}{pid}"
        )
        return ""

    def _process(self, content: dict[str, Any]) -> Process | None:
        """Returns the process that a RESERVE or JOIN names, None if it cannot be seen from here."""
        pid = content.get("pid")
        if not self._namespace or content.get("host") != self._namespace or not isinstance(pid, int) or pid < 1:
            return None
        return Process(pid)

    def _welcome(self, participant: Participant) -> None:
        content = {"version": VERSION, "base_step_us": self._base_step_us, "digest": self._on_digest is not None}
        self._send(participant, pack_object(Kind.WELCOME, content))

    def _join(self, participant: Participant, content: dict[str, Any]) -> None:
        if participant.name:
            raise ProtocolError("JOIN a second time")
        name = self._checked_name(participant, content)
        if not name:
            return
        try:
            schedule = Schedule(content.get("rate", 0), self._base_step_us)
        except ValueError as error:
            self._refuse(participant, "rate", f"{name}: {error}")
            return
        participant.name = name
        participant.rate = float(content["rate"])
        participant.schedule = schedule
        participant.due_us = schedule.after_us(self._ticked_us)
        participant.udp_ports = [int(port) for port in content.get("udp_ports", [])]
        # What the simulator sent before this participant existed it cannot have received.
        participant.datagrams_base = {port: self._datagrams.get(port, 0) for port in participant.udp_ports}
        self.participants[name] = participant
        self._reserved.pop(participant.reserved, None)
        participant.process = self._process(content)
        self._welcome(participant)
        late = f", in flight at {self._ticked_us * 1e-6:g} s" if self._tick else ""
        rate, address = participant.rate, participant.address
        self._log(logging.INFO, f"participant {name} joins at {rate:g} Hz from {address}{late}")
        self._adopt_channels(participant)
        self._declare(participant, content)

    def _refuse(self, participant: Participant, code: str, reason: str) -> None:
        again, self._refused = reason == self._refused, reason
        # One that waits for a name asks many times a second.
        self._log(logging.DEBUG if again else logging.WARNING, f"refused: {reason}")
        self._send(participant, pack_object(Kind.REFUSED, {"code": code, "reason": reason}))
        self._remove(participant)

    # ---- topics and channels ----

    def _is_host(self, name: str) -> bool:
        return self._host_state is not None and self._host_state.name == name

    def _publishers(self) -> list[Participant]:
        host = [] if self._host_state is None else [self._host_state]
        return [*host, *self.participants.values()]

    def _collect_host(self) -> None:
        if self._host is None or self._host_state is None:
            return
        declaration, made, lost, counts = self._host.collect()
        if declaration is not None:
            self._declare(self._host_state, declaration)
        if made or lost:
            self._peer(self._host_state, {"made": made, "lost": lost})
        for number, count in counts.items():
            route = self._host_state.routes.get(number)
            if route is not None:
                route[0][route[1]] = count
        _forget_routes(self._host_state)

    def _declare(self, participant: Participant, content: dict[str, Any]) -> None:
        """Takes a participant's topics and finds the connections that there must be."""
        participant.publications = {str(topic): str(kind) for topic, kind in content.get("publications", [])}
        participant.subscriptions = {str(topic): str(kind) for topic, kind in content.get("subscriptions", [])}
        wanted: set[Pair] = set()
        for other in self._publishers():
            wanted |= self._wanted_pairs(participant, other)
            wanted |= self._wanted_pairs(other, participant)
        for pair in [pair for pair in self._missing if participant.name in pair[1:] and pair not in wanted]:
            del self._missing[pair]
        limit = time.monotonic() + self._connect_limit
        for pair in sorted(wanted):
            if not self._live.get(pair):
                self._missing.setdefault(pair, limit)

    def _wanted_pairs(self, publisher: Participant, subscriber: Participant) -> set[Pair]:
        if publisher is subscriber and self._is_host(subscriber.name):
            return set()
        pairs = set()
        for topic in publisher.publications.keys() & subscriber.subscriptions.keys():
            sent, read = publisher.publications[topic], subscriber.subscriptions[topic]
            if sent == read or "*" in {sent, read}:
                pairs.add((topic, publisher.name, subscriber.name))
            else:
                self._log(
                    logging.WARNING,
                    f"{topic}: {publisher.name} publishes {sent}, {subscriber.name} subscribes to {read}",
                )
        return pairs

    def _peer(self, publisher: Participant, content: dict[str, Any]) -> None:
        """A publisher's connections were made or lost."""
        for number in content.get("lost", []):
            self._lose_channel(publisher, number)
        for number, topic, subscriber, port, count in content.get("made", []):
            channel = Channel(self._next_channel, (topic, publisher.name, subscriber), port)
            self._next_channel += 1
            publisher.channels[number] = channel
            reader = self._reader(channel)
            if reader is None:
                # A free rider, or somebody who has yet to join: remember the count.
                publisher.routes[number] = ({channel.id: count}, channel.id)
            else:
                self._open_channel(publisher, number, reader, count)

    def _reader(self, channel: Channel) -> Participant | None:
        """Returns who counts what comes over a connection: a participant, or the simulator for what it declares."""
        topic, publisher, subscriber = channel.pair
        if not self._is_host(subscriber):
            return self.participants.get(subscriber)
        host = self._host_state
        return host if host is not None and topic in host.subscriptions and publisher != subscriber else None

    def _open_channel(self, publisher: Participant, number: int, reader: Participant, count: int) -> None:
        channel = publisher.channels[number]
        publisher.routes[number] = (reader.counts, channel.id)
        self._tell_counted(publisher, number, True)
        if count:
            reader.counts[channel.id] = count
        reader.made.append([channel.id, channel.pair[0], publisher.name, channel.port])
        self._live.setdefault(channel.pair, set()).add(channel.id)
        self._missing.pop(channel.pair, None)

    def _tell_counted(self, publisher: Participant, number: int, value: bool) -> None:
        if self._host is not None and publisher is self._host_state:
            self._host.counted(number, value)
        else:
            (publisher.counted if value else publisher.uncounted).append(number)

    def _adopt_channels(self, reader: Participant) -> None:
        """Takes the connections that were made to a participant before it joined."""
        for publisher in self._publishers():
            for number, channel in publisher.channels.items():
                news, _ = publisher.routes[number]
                if channel.pair[2] == reader.name and news is not self._ignored_counts:
                    self._open_channel(publisher, number, reader, news.get(channel.id, 0))

    def _lose_channel(self, publisher: Participant, number: int) -> None:
        channel = publisher.channels.pop(number, None)
        if channel is None:
            return
        # A count that is under way finds its route still; nobody reads it.
        publisher.routes[number] = (self._ignored_counts, 0)
        publisher.closing.append(number)
        live = self._live.get(channel.pair, set())
        if channel.id not in live:
            return
        live.discard(channel.id)
        reader = self._reader(channel)
        if reader is None:
            return
        reader.lost.append(channel.id)
        topic, name, _ = channel.pair
        still_wanted = topic in reader.subscriptions and topic in publisher.publications and name in self.participants
        if not live and (still_wanted or (self._is_host(name) and topic in reader.subscriptions)):
            self._missing.setdefault(channel.pair, time.monotonic() + self._connect_limit)


def _forget_routes(publisher: Participant) -> None:
    for number in publisher.closing:
        publisher.routes.pop(number, None)
    publisher.closing.clear()


def _listing(items: list[str], most: int = 6) -> str:
    rest = len(items) - most
    return ", ".join(items[:most]) + (f" and {rest} more" if rest > 0 else "")
