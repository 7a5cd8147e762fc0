"""The simulator's half of the lockstep: who takes part, who is due, and the barrier.

Free of ROS and of threads: everything happens inside `LockstepServer.poll`, `wait_for` and `tick`, which the simulator
calls from its own loop. Wall time is used for nothing but giving up on the dead.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import socket
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import islice
from typing import Any, Protocol

from . import frames
from .frames import Declaration, Made, Peers, RefusalError, Reservation
from .participant import Channel, Pair, Participant, Process
from .protocol import (
    BASE_STEP_US,
    VERSION,
    Kind,
    ProtocolError,
    pack_barrier,
    pack_object,
    printable,
    process_namespace,
    tune,
)
from .wanted import Missing, Topics

DigestSink = Callable[[str, int, Mapping[str, Sequence[int]]], None]
"""Takes a participant's name, the simulation time in us and its topics' digests, see `protocol.Digest`."""
Log = Callable[[int, str], None]
Idle = Callable[[float], None]
SLICE = 0.1
"""Longest single wait in seconds, so that limits and signals are looked at in time."""
GREETING_LIMIT = 10.0
"""Seconds that a connection may stay without a JOIN or RESERVE."""
STOPPED = 2.0
"""Seconds by which a wait may last too long on a busy machine; beyond, the simulator has been stopped itself."""
RESERVATION_LIMIT = 60.0
"""Seconds that a name may stay reserved without a JOIN, unless it is a living process of this machine that has it."""
LOOK_PERIOD = 0.5
"""Seconds between two looks for connections that have had their time."""
SILENCE = 1.5
"""Wall seconds without a keep-alive after which the server looks whether the participant's process is there still."""
GREETING_BUDGET = 0.05
"""Wall seconds of one `poll` after which no more is taken from connections that have not joined."""
FRAMES_A_POLL = 256
"""Frames of one participant that one `poll` takes; a node that starts announces each connection by one of its own."""
MOST_NEWCOMERS = 256
"""Connections without a name; one more, and the oldest of the address that has most of them is closed."""
MOST_UNFINISHED = 1 << 27
"""Bytes of frames that have not come whole, of all connections; above it that with most of them is closed."""
LONG_FRAME = 1 << 16
"""Bytes above which a frame that has not come whole counts there."""
MOST_CONNECTIONS = 4096
MOST_OF_AN_ADDRESS = 2048
"""Connections from one address."""
MOST_UNSENT = 1 << 27
"""Bytes that wait for a participant that does not read."""
MOST_REASON = 2000
"""Characters of what a connection is told when it is closed."""
COMPLAINT_PERIOD = 5.0
"""Seconds between two warnings about connections without a name, of which there may be any number."""


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
        self._listener = socket.create_server((host, port), backlog=1024)
        self._listener.setblocking(False)
        named = socket.gethostname() if host in {"", "0.0.0.0"} else host
        self.uri = f"tcp://{named}:{self._listener.getsockname()[1]}"
        self._epoll = select.epoll()
        self._listening = True
        self._epoll.register(self._listener.fileno(), select.EPOLLIN)
        # Readable while there is a backlog: frames that have been received and are not handled.
        self._more = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll.register(self._more, select.EPOLLIN)
        self._backlog: dict[Participant, None] = {}
        self._connections: dict[int, Participant] = {}
        self._addresses: dict[str, int] = {}  # to the number of connections from there
        self._newcomers: dict[Participant, None] = {}  # without a name; the oldest first
        self._reserved: dict[str, Participant] = {}
        self._next_look = 0.0
        self._refused = ""
        self._next_complaint = 0.0
        self._untold = 0
        self.participants: dict[str, Participant] = {}
        self.datagrams_expected: dict[int, int] = {}
        self._datagrams: dict[int, int] = {}
        self._datagram_ports: frozenset[int] = frozenset()
        self._remote_ports: set[int] = set()
        self._tick = 0
        self._ticked_us = -1
        self._awaited = 0
        self._next_channel = 1
        self._topics = Topics()
        # Numbers of the open connections by pair; by subscriber, the publisher and its own number of each.
        self._live: dict[Pair, set[int]] = {}
        self._looked = 0.0
        self._towards: dict[str, dict[int, tuple[Participant, int]]] = {}
        self._missing = Missing()
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
        self._host_state = Participant(None, ("the simulator", 0), time.monotonic())
        self._host_state.name = link.name

    def open_datagram_ports(self, ports: Collection[int]) -> None:
        """Names the UDP ports on which the simulator receives what participants count in DONE.

        Counts of other ports are ignored; without such ports no participant's `udp_ports` are taken either.
        """
        self._datagram_ports = frozenset(ports)

    def poll(self, timeout: float = 0.0) -> None:
        """Accepts connections, reads what has come and drops the dead.

        What participants have sent comes first. Newcomers get `GREETING_BUDGET` seconds, and of one participant
        `FRAMES_A_POLL` frames are taken; the rest waits for the next call, see `fileno`.

        Args:
            timeout: Longest wait for something to come, in wall seconds.
        """
        if self._host is not None:
            self._collect_host()
        backlog = list(self._backlog)
        newcomers: list[Participant] = []
        knocks = False
        for descriptor, event in self._epoll.poll(timeout):
            participant = self._connections.get(descriptor)
            if participant is None:  # the listener, or one that is gone meanwhile
                knocks = knocks or descriptor == self._listener.fileno()
                continue
            if not participant.name:
                newcomers.append(participant)
                continue
            if event & select.EPOLLOUT:
                self._flush(participant)
            if event & (select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR):
                self._receive(participant)
        for participant in backlog:
            self._take_frames(participant)
        if newcomers or knocks:
            self._greet(newcomers)
        if self._newcomers or self._reserved or not self._listening:
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
        started = self._looked = time.monotonic()
        for participant in due:
            self._send_tick(participant, now_us, started)
        while self._awaited:
            self._wait(SLICE, idle)
            self._drop_hung()
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
        self._looked = time.monotonic()
        end = None if timeout is None else self._looked + timeout
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
                text = _listing(absent, len(absent))
                parts.append(f"{len(absent)} of {len(names)} participants have not joined: {text}")
        if self._missing:
            pairs = (f"{topic} from {publisher} to {subscriber}" for topic, publisher, subscriber in self._missing)
            text = _listing(pairs, len(self._missing))
            parts.append(f"{len(self._missing)} connections are not made: {text}")
        return "; ".join(parts)

    def close(self, failure: str = "") -> None:
        """Closes every connection; participants take this as the simulator's end.

        Args:
            failure: Why the simulator fails; empty for an orderly end. Participants then end with an error.
        """
        if self._closed:
            return
        self._closed = True
        reason = f"the simulation has failed: {printable(failure)}" if failure else "the simulation has ended"
        farewell = pack_object(Kind.LEAVE, {"reason": reason, "failed": bool(failure)})
        for participant in self._connections.values():
            if participant.sock is not None:
                with contextlib.suppress(OSError):
                    participant.sock.send(bytes(participant.unsent) + farewell)
                participant.sock.close()
        for table in (self._connections, self._newcomers, self._reserved, self._backlog, self.participants):
            table.clear()
        self._epoll.close()
        os.close(self._more)
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
        if idle is not None:
            idle(timeout)
            timeout = 0.0
        self.poll(timeout)
        now = time.monotonic()
        late, self._looked = now - self._looked - SLICE, now
        if late > STOPPED:
            self._excuse(late, now)

    def _excuse(self, late: float, now: float) -> None:
        """Holds `late` seconds in which the simulator itself did not run against no participant.

        It was stopped, or the whole machine was asleep: nothing could be heard.
        """
        self._log(logging.WARNING, f"the simulator did not run for {late:.0f} s of wall time, and goes on")
        for participant in self._connections.values():
            participant.heard = min(participant.heard + late, now)
            participant.asked = min(participant.asked + late, now)
        self._missing.postpone(late)

    def _settle(self, idle: Idle | None) -> None:
        """Takes in who has come, and holds the world until their connections are made."""
        self._looked = time.monotonic()
        self.poll(0.0)
        while self._missing:
            self._wait(SLICE, idle)
            self._give_up_connections()

    def _give_up_connections(self) -> None:
        if not self._missing:
            return
        for topic, publisher, subscriber in self._missing.expire(time.monotonic()):
            self._log(
                logging.WARNING,
                f"no connection of {topic} from {publisher} to {subscriber} within {self._connect_limit:g} s: "
                "going on without",
            )

    def _send_tick(self, participant: Participant, now_us: int, wall: float) -> None:
        participant.waiting = True
        participant.tick = self._tick
        participant.asked = wall
        if participant.schedule is not None:
            participant.due_us = participant.schedule.after_us(now_us)
        self._awaited += 1
        news = b"".join(pack_object(Kind.PEER, content) for content in participant.take_news())
        ports = self._datagram_news(participant) if participant.udp_ports else {}
        frame = pack_barrier(Kind.TICK, self._tick, now_us, participant.counts, ports)
        participant.counts.clear()
        self._send(participant, news + frame if news else frame)

    def _deliver_to_host(self) -> None:
        """Tells the simulator's own subscribers what has been sent to them by the end of this tick."""
        state = self._host_state
        if self._host is None or state is None or not (state.made or state.lost or state.counts):
            return
        news = {"made": state.made, "lost": state.lost, "void": state.void}
        counts = dict(state.counts)
        state.counts.clear()
        state.made, state.lost, state.void = [], [], []
        state.new.clear()
        self._host.deliver(news, counts)

    def _datagram_news(self, participant: Participant) -> dict[int, int]:
        news = {}
        for port in participant.udp_ports:
            told = participant.datagrams_told.get(port, 0)
            # The simulator may have forgotten a port that it has long sent nothing to.
            count = max(told, self._datagrams.get(port, 0) - participant.datagrams_base.get(port, 0))
            if count != told:
                participant.datagrams_told[port] = count
                news[port] = count
        return news

    def _drop_hung(self) -> None:
        now = time.monotonic()
        for participant in [participant for participant in self.participants.values() if participant.waiting]:
            silent = now - max(participant.heard, participant.asked)
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

    def _greet(self, newcomers: Iterable[Participant]) -> None:
        """Serves newcomers, and accepts more of them, for `GREETING_BUDGET` seconds.

        What they have sent, and connections that are not taken, wait in the kernel.
        """
        end = time.monotonic() + GREETING_BUDGET
        for participant in newcomers:
            if time.monotonic() >= end:
                return
            self._flush(participant)
            self._receive(participant)
        while self._listening and time.monotonic() < end and self._accept():
            continue

    def _accept(self) -> bool:
        """Takes a connection, if one is there, and says whether."""
        try:
            sock, address = self._listener.accept()
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno in {errno.EMFILE, errno.ENFILE}:
                self._listen(False)
            self._complain(f"a connection to {self.uri} was not taken: {error}")
            return False
        sock.setblocking(False)
        tune(sock)
        participant = Participant(sock, address, time.monotonic())
        self._connections[sock.fileno()] = participant
        self._addresses[participant.host] = self._addresses.get(participant.host, 0) + 1
        self._newcomers[participant] = None
        self._epoll.register(sock.fileno(), select.EPOLLIN)
        of_address = self._addresses[participant.host]
        if len(self._connections) > MOST_CONNECTIONS or of_address > MOST_OF_AN_ADDRESS:
            limits = f"at most {MOST_OF_AN_ADDRESS} of one address and {MOST_CONNECTIONS} in all"
            self._refuse(participant, "full", f"there are {of_address} connections from {participant.host}, {limits}")
            return True
        if len(self._newcomers) > MOST_NEWCOMERS:
            self._close_oldest_newcomer()
        # Its JOIN is mostly there already: then it takes part in the very next tick.
        self._receive(participant)
        return True

    def _listen(self, value: bool) -> None:
        """Has new connections wait in the kernel, or be taken again."""
        if value != self._listening:
            self._listening = value
            self._epoll.modify(self._listener.fileno(), select.EPOLLIN if value else 0)

    def _close_oldest_newcomer(self) -> None:
        count: dict[str, int] = {}
        for newcomer in self._newcomers:
            count[newcomer.host] = count.get(newcomer.host, 0) + 1
        crowd = max(count, key=lambda host: count[host])
        oldest = next(newcomer for newcomer in self._newcomers if newcomer.host == crowd)
        self._drop(oldest, f"is one of more than {MOST_NEWCOMERS} that have not joined")

    def _receive(self, participant: Participant) -> None:
        if participant.sock is None or participant in self._backlog:
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
        self._take_frames(participant)

    def _take_frames(self, participant: Participant) -> None:
        """Acts on what a connection has sent; what is wrong with it ends this connection and no other."""
        if participant.sock is None:
            return
        try:
            for kind, payload in islice(participant.reader.frames(), FRAMES_A_POLL):
                self._handle(participant, kind, payload)
                if not participant.connected():
                    return
        except RefusalError as error:
            self._refuse(participant, error.code, str(error))
        except ProtocolError as error:
            self._drop(participant, f"sent what is no lockstep frame: {error}")
        if participant.reader or self._backlog:  # seldom: mostly a frame comes whole and alone
            self._set_backlog(participant, participant.connected() and participant.reader.has_frame())
            if len(participant.reader) > LONG_FRAME:
                self._limit_unfinished()

    def _set_backlog(self, participant: Participant, value: bool) -> None:
        """Notes whether a connection has frames that are not handled; `fileno` is readable while one has."""
        if value == (participant in self._backlog):
            return
        if not value:
            del self._backlog[participant]
            if not self._backlog:
                os.eventfd_read(self._more)
            return
        if not self._backlog:
            os.eventfd_write(self._more, 1)
        self._backlog[participant] = None

    def _limit_unfinished(self) -> None:
        """Bounds what is kept of frames that have not come whole."""
        unfinished = sum(len(participant.reader) for participant in self._connections.values())
        if unfinished > MOST_UNFINISHED:
            longest = max(self._connections.values(), key=lambda participant: len(participant.reader))
            limit = f"of all {unfinished}, at most {MOST_UNFINISHED} are kept"
            self._drop(longest, f"has sent {len(longest.reader)} bytes of a frame that is not whole, {limit}")

    def _send(self, participant: Participant, data: bytes) -> None:
        if participant.sock is None:
            return
        if participant.unsent:
            participant.unsent += data
            if len(participant.unsent) > MOST_UNSENT:
                self._drop(participant, f"does not read what it is sent: {len(participant.unsent)} bytes wait")
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
        if data and participant.sock is not None:
            self._epoll.modify(participant.sock.fileno(), select.EPOLLIN)
            self._send(participant, data)

    def _close(self, participant: Participant) -> None:
        if participant.sock is None:
            return
        descriptor = participant.sock.fileno()
        self._epoll.unregister(descriptor)
        del self._connections[descriptor]
        self._newcomers.pop(participant, None)
        self._set_backlog(participant, False)
        left = self._addresses[participant.host] - 1
        if left:
            self._addresses[participant.host] = left
        else:
            del self._addresses[participant.host]
        participant.sock.close()
        participant.sock = None
        self._listen(True)

    def _drop_strangers(self) -> None:
        """Ends connections that have neither joined nor reserved a name in time, and releases names kept too long."""
        now = time.monotonic()
        if now < self._next_look:
            return
        self._next_look = now + LOOK_PERIOD
        self._listen(True)
        for participant in [one for one in self._newcomers if now - one.accepted > GREETING_LIMIT]:
            self._drop(participant, f"did not join within {GREETING_LIMIT:g} s")
        for participant in list(self._reserved.values()):
            process = participant.process
            if process is not None and not process.state():
                self._drop(participant, f"is gone: its process {process.pid} has ended")
            elif process is None and now - participant.accepted > RESERVATION_LIMIT:
                self._drop(participant, f"did not join within {RESERVATION_LIMIT:g} s of reserving its name")

    def _complain(self, text: str) -> None:
        """Warns of a connection without a name, once in `COMPLAINT_PERIOD` seconds."""
        now = time.monotonic()
        if now < self._next_complaint:
            self._untold += 1
            self._log(logging.DEBUG, text)
            return
        more = f" (and {self._untold} more like this before)" if self._untold else ""
        self._next_complaint, self._untold = now + COMPLAINT_PERIOD, 0
        self._log(logging.WARNING, text + more)

    def _drop(self, participant: Participant, why: str) -> None:
        """Ends a participant that is dead, hung or talks nonsense."""
        if participant.sock is None:
            return
        who = f"participant {participant.name}" if participant.name else f"the connection from {participant.address}"
        if participant.name:
            self._log(logging.WARNING, f"{who} {why}; dropped, the simulation goes on")
        elif participant.reserved:
            self._log(logging.INFO, f"{participant.reserved}, which has not joined, {why}")
        elif participant.heard == participant.accepted:
            self._log(logging.DEBUG, f"{who} {why}")
        else:
            self._complain(f"{who} {why}")
        self._part(participant, "dropped", f"it {why}")

    def _part(self, participant: Participant, code: str, reason: str) -> None:
        """Says REFUSED and closes. One attempt: it may be dead, or read nothing."""
        refusal = pack_object(Kind.REFUSED, {"code": code, "reason": reason[:MOST_REASON]})
        try:
            if participant.sock is not None:
                participant.sock.send(refusal)
        except OSError:
            self._log(logging.DEBUG, f"{participant.name or participant.address} could not be told: {reason}")
        self._remove(participant)

    def _remove(self, participant: Participant) -> None:
        self._close(participant)
        if self._reserved.get(participant.reserved) is participant:
            del self._reserved[participant.reserved]
        if participant.waiting:
            participant.waiting = False
            self._awaited -= 1
        name = participant.name
        if self.participants.get(name) is not participant:
            return
        del self.participants[name]
        for number in list(participant.channels):
            self._lose_channel(participant, number)
        self._topics.withdraw(name)
        for number, (publisher, own) in self._towards.get(name, {}).items():
            # A later participant of this name has connections of its own.
            publisher.routes[own] = (self._ignored_counts, 0)
            self._tell_counted(publisher, own, False)
            self._forget_live(publisher.channels[own].pair, number)
        for pair in self._missing.of(name):
            self._missing.discard(pair)

    # ---- frames ----

    def _handle(self, participant: Participant, kind: int, payload: bytes) -> None:
        """Acts on one frame, of a type that the connection's reader lets through.

        Raises:
            ProtocolError: It is malformed, or must not come now.
        """
        if kind == Kind.DONE:
            self._done(participant, payload)
        elif kind == Kind.ALIVE:
            participant.needs_time = frames.needs_time(payload)
        elif kind == Kind.JOIN:
            self._join(participant, frames.join(payload, self._base_step_us))
        elif kind == Kind.RESERVE:
            self._reserve(participant, frames.reservation(payload))
        elif kind == Kind.PEER:
            self._peer(participant, frames.peers(payload))
        elif kind == Kind.DECLARE:
            self._declare(participant, frames.declaration(payload))
        elif kind == Kind.DIGEST:
            report = frames.digest(payload)
            if self._on_digest is not None:
                self._on_digest(participant.name, report.time_us, report.topics)
        elif kind == Kind.LEAVE:
            leave = frames.leave(payload)
            level = logging.WARNING if leave.failed else logging.INFO
            self._log(level, f"participant {participant.name} leaves: {leave.reason}")
            self._remove(participant)

    def _done(self, participant: Participant, payload: bytes) -> None:
        done = frames.done(payload)
        routes = participant.routes
        for number, count in done.channels.items():
            news, channel = routes.get(number, (self._ignored_counts, 0))  # it may be gone by now
            news[channel] = count
        _forget_routes(participant)
        for port, count in done.datagrams.items():
            if port in self._datagram_ports:
                self._count_datagrams(participant, port, count)
        if participant.waiting and done.tick == participant.tick:
            participant.waiting = False
            self._awaited -= 1

    def _count_datagrams(self, participant: Participant, port: int, count: int) -> None:
        before = participant.datagrams_sent.get(port, 0)
        if count < before:
            raise ProtocolError(f"DONE: {count} datagrams to port {port}, after {before} before")
        participant.datagrams_sent[port] = count
        (self._remote_ports.add if participant.remote else self._remote_ports.discard)(port)
        self.datagrams_expected[port] = self.datagrams_expected.get(port, 0) + count - before

    def _reserve(self, participant: Participant, node: Reservation) -> None:
        """Keeps a name for a node that is starting, so that a second one hears of it before it registers with ROS."""
        if participant.reserved:
            raise ProtocolError("RESERVE on a connection that has a name")
        self._require_free(participant, node.name)
        participant.reserved = node.name
        participant.accepted = time.monotonic()
        participant.process = self._process(participant, node)
        self._reserved[node.name] = participant
        self._newcomers.pop(participant, None)
        self._welcome(participant)

    def _require_free(self, participant: Participant, name: str) -> None:
        """Checks that another connection neither has a name nor has reserved it.

        Raises:
            RefusalError: One has.
        """
        taken = self.participants.get(name) or (self._host_state if self._is_host(name) else None)
        if taken is None and self._reserved.get(name) is not participant:
            taken = self._reserved.get(name)
        if taken is None:
            return
        pid = "" if taken.process is None else f" (process {taken.process.pid})"
        raise RefusalError("taken", f"the name {name} is taken by a participant connected from {taken.address}{pid}")

    def _process(self, participant: Participant, node: Reservation) -> Process | None:
        """Returns the process that a RESERVE or JOIN names, None if it cannot be seen from here."""
        if not self._namespace or node.host != self._namespace or participant.remote or node.pid < 1:
            return None
        return Process(node.pid)

    def _welcome(self, participant: Participant) -> None:
        content = {"version": VERSION, "base_step_us": self._base_step_us, "digest": self._on_digest is not None}
        self._send(participant, pack_object(Kind.WELCOME, content))

    def _join(self, participant: Participant, join: frames.Join) -> None:
        name = join.node.name
        self._require_free(participant, name)
        participant.join(name, join.rate, join.schedule)
        participant.due_us = join.schedule.after_us(self._ticked_us)
        participant.udp_ports = join.udp_ports if self._datagram_ports else ()
        # What the simulator sent before this participant existed it cannot have received.
        participant.datagrams_base = {port: self._datagrams.get(port, 0) for port in participant.udp_ports}
        self.participants[name] = participant
        self._newcomers.pop(participant, None)
        self._reserved.pop(participant.reserved, None)
        participant.process = self._process(participant, join.node)
        self._welcome(participant)
        late = f", in flight at {self._ticked_us * 1e-6:g} s" if self._tick else ""
        rate, address = participant.rate, participant.address
        self._log(logging.INFO, f"participant {name} joins at {rate:g} Hz from {address}{late}")
        if participant.connected():
            self._adopt_channels(participant)
            self._declare(participant, join.topics)

    def _refuse(self, participant: Participant, code: str, reason: str) -> None:
        again, self._refused = reason == self._refused, reason
        if again:  # one that waits for a name asks many times a second
            self._log(logging.DEBUG, f"refused: {reason}")
        else:
            self._complain(f"refused: {reason}")
        self._part(participant, code, reason)

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
            topics = (dict(declaration.get(key, ())) for key in ("publications", "subscriptions"))
            self._declare(self._host_state, Declaration(*topics))
        if made or lost:
            self._peer(self._host_state, Peers([Made(*row) for row in made], lost))
        for number, count in counts.items():
            route = self._host_state.routes.get(number)
            if route is not None:
                route[0][route[1]] = count
        _forget_routes(self._host_state)

    def _declare(self, participant: Participant, declaration: Declaration) -> None:
        """Notes a participant's topics and finds the connections that they need.

        Raises:
            ProtocolError: They need more than `frames.MOST_CHANNELS`.
        """
        self._topics.declare(participant.name, declaration)
        wanted = self._wanted_pairs(participant)
        for pair in self._missing.of(participant.name):
            if pair not in wanted:
                self._missing.discard(pair)
        limit = time.monotonic() + self._connect_limit
        for pair in sorted(wanted):
            if pair not in self._live:
                self._missing.add(pair, limit)

    def _wanted_pairs(self, participant: Participant) -> set[Pair]:
        pairs = set()
        for pair, sent, read in self._topics.pairs(participant.name):
            topic, publisher, subscriber = pair
            if publisher == subscriber and self._is_host(publisher):
                continue
            if sent == read or "*" in {sent, read}:
                pairs.add(pair)
                if len(pairs) > frames.MOST_CHANNELS:
                    raise ProtocolError(f"its topics need more than {frames.MOST_CHANNELS} connections")
            elif self._topics.is_new_clash(pair):
                text = f"{topic}: {publisher} publishes {sent}, {subscriber} subscribes to {read}"
                self._log(logging.WARNING, text)
        return pairs

    def _peer(self, publisher: Participant, news: Peers) -> None:
        """A publisher's connections were made or lost.

        Raises:
            ProtocolError: A connection is made twice, or there are too many.
        """
        for number in news.lost:
            self._lose_channel(publisher, number)
        for made in news.made:
            self._make_channel(publisher, made)

    def _make_channel(self, publisher: Participant, made: Made) -> None:
        if made.number in publisher.routes:
            raise ProtocolError(f"PEER: connection {made.number} is made twice")
        if len(publisher.routes) >= frames.MOST_CHANNELS and not self._is_host(publisher.name):
            raise ProtocolError(f"PEER: more than {frames.MOST_CHANNELS} connections")
        channel = Channel(self._next_channel, (made.topic, publisher.name, made.subscriber), made.port)
        self._next_channel += 1
        publisher.channels[made.number] = channel
        self._towards.setdefault(made.subscriber, {})[channel.id] = publisher, made.number
        reader = self._reader(channel)
        if reader is None:
            # A free rider, or a node that has yet to join: remember the count.
            publisher.routes[made.number] = ({channel.id: made.sent}, channel.id)
        else:
            self._open_channel(publisher, made.number, reader, made.sent)

    def _reader(self, channel: Channel) -> Participant | None:
        """Returns who counts what comes over a connection: a participant, or the simulator for what it declares."""
        topic, publisher, subscriber = channel.pair
        if not self._is_host(subscriber):
            return self.participants.get(subscriber)
        host = self._host_state
        return host if self._topics.subscribes(subscriber, topic) and publisher != subscriber else None

    def _open_channel(self, publisher: Participant, number: int, reader: Participant, count: int) -> None:
        channel = publisher.channels[number]
        publisher.routes[number] = (reader.counts, channel.id)
        self._tell_counted(publisher, number, True)
        if count:
            reader.counts[channel.id] = count
        reader.made.append([channel.id, channel.pair[0], publisher.name, channel.port])
        self._live.setdefault(channel.pair, set()).add(channel.id)
        self._missing.discard(channel.pair)
        new = reader.new[publisher.name] = reader.new.get(publisher.name, 0) + 1
        if new > frames.MOST_CHANNELS and not self._is_host(publisher.name):
            raise ProtocolError(f"PEER: more than {frames.MOST_CHANNELS} connections to {reader.name} within its turn")

    def _tell_counted(self, publisher: Participant, number: int, value: bool) -> None:
        if self._host is not None and publisher is self._host_state:
            self._host.counted(number, value)
        else:
            (publisher.counted if value else publisher.uncounted).append(number)

    def _adopt_channels(self, reader: Participant) -> None:
        """Takes the connections that were made to a participant before it joined."""
        towards = self._towards.get(reader.name)
        if not towards:
            return
        order = {publisher: index for index, publisher in enumerate(self._publishers())}
        for publisher, number in sorted(towards.values(), key=lambda entry: order[entry[0]]):
            news, channel = publisher.routes[number]
            if news is not self._ignored_counts:
                self._open_channel(publisher, number, reader, news.get(channel, 0))

    def _lose_channel(self, publisher: Participant, number: int) -> None:
        channel = publisher.channels.pop(number, None)
        if channel is None:
            return
        # A count that is under way finds its route still; nobody reads it.
        publisher.routes[number] = (self._ignored_counts, 0)
        publisher.closing.append(number)
        topic, name, subscriber = channel.pair
        del self._towards[subscriber][channel.id]
        if not self._towards[subscriber]:
            del self._towards[subscriber]
        if not self._forget_live(channel.pair, channel.id):
            return
        reader = self._reader(channel)
        if reader is None:
            return
        reader.lost.append(channel.id)
        still_wanted = self._topics.publishes(name, topic) and name in self.participants
        wanted = (still_wanted or self._is_host(name)) and self._topics.subscribes(reader.name, topic)
        if wanted and channel.pair not in self._live:
            self._missing.add(channel.pair, time.monotonic() + self._connect_limit)

    def _forget_live(self, pair: Pair, number: int) -> bool:
        """Notes that a counted connection is no more; says whether it was one."""
        live = self._live.get(pair, set())
        if number not in live:
            return False
        live.discard(number)
        if not live:
            del self._live[pair]
        return True


def _forget_routes(publisher: Participant) -> None:
    for number in publisher.closing:
        publisher.routes.pop(number, None)
    publisher.closing.clear()


def _listing(items: Iterable[str], count: int, most: int = 6) -> str:
    rest = count - most
    return ", ".join(islice(items, most)) + (f" and {rest} more" if rest > 0 else "")
