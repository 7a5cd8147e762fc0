"""The barrier of a tick: which participants are due, TICK to each of them, and the wait for their DONE.

Wall time is used only to detect participants that are dead or hung.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping

from ..protocol import Barrier, Kind, pack_barrier, pack_object
from .channels import Channels
from .client_process import ClientConnection
from .client_sockets import ClientConnections, Log
from .datagram_counts import DatagramCounts
from .participant import Participant

Idle = Callable[[float], None]
"""Function called with a time in seconds in place of a plain wait."""

SLICE = 0.1
"""Longest single wait in wall seconds, so that limits and signals are checked in time."""
STOPPED = 2.0
"""Wall seconds by which a wait may overrun on a busy machine; beyond it the simulator itself has been stopped."""
SILENCE = 1.5
"""Wall seconds without a keep-alive after which the server checks that the participant's process is still alive."""


class TickBarrier:
    """Runs one tick after the other.

    Attributes:
        ticks: Number of ticks so far.
        time_us: Simulation time of the last tick in microseconds, -1 before the first.
        awaited: Number of participants whose DONE is outstanding.
        begins_counts: Whether this barrier's TICKs begin the count of datagrams to a port. The participant then treats
            all datagrams that have arrived as sent before that; no more may be sent until its DONE.
    """

    def __init__(
        self,
        participants: Mapping[str, Participant],
        connections: ClientConnections,
        channels: Channels,
        datagrams: DatagramCounts,
        *,
        poll: Callable[[float], None],
        hang_limit: float,
        busy_limit: float,
        log: Log,
    ) -> None:
        """Start before the first tick.

        Args:
            participants: Those that have joined, by name; kept up to date by the server.
            connections: Sends frames and drops connections.
            channels: Supplies the counts for TICK.
            datagrams: Supplies the datagram counts for TICK.
            poll: Handles what clients send, waiting for at most the given wall seconds.
            hang_limit: Wall seconds of silence after which a participant is dropped; 0 for no limit.
            busy_limit: Wall seconds that a participant may take for one tick; 0 for no limit.
            log: Receives log messages.
        """
        self.ticks = 0
        self.time_us = -1
        self.awaited = 0
        self.begins_counts = False
        self._participants = participants
        self._connections = connections
        self._channels = channels
        self._datagrams = datagrams
        self._poll = poll
        self._hang_limit = hang_limit
        self._busy_limit = busy_limit
        self._log = log
        self._under_way = False
        self._last_poll = 0.0
        self._next_check = 0.0

    # ---- due times ----

    def next_due_us(self, now_us: int) -> int | None:
        """Return the earliest time after ``now_us`` at which a participant is due in us; None without participants."""
        earliest = min([participant.due_us for participant in self._participants.values()], default=None)
        if earliest is None or earliest > now_us:
            return earliest
        return min(
            participant.due_us if participant.due_us > now_us else participant.schedule.after_us(now_us)
            for participant in self._participants.values()
            if participant.schedule is not None
        )

    def add_participant(self, participant: Participant) -> None:
        """Schedule the first turn of a participant that joins."""
        if participant.schedule is not None:
            participant.due_us = participant.schedule.after_us(self.time_us)

    def reset_time(self, now_us: int) -> None:
        """Set simulation time between two ticks; participants are next due at or after ``now_us``."""
        self.time_us = now_us - 1
        for participant in self._participants.values():
            # An explicit flag is needed, because its next tick may have the same time as its last.
            participant.news.reset = participant.tick > 0
            participant.news.mark_void()
            self.add_participant(participant)
        self._channels.reset()

    # ---- the barrier ----

    def begin(self, now_us: int, datagrams: Mapping[int, int] | None, idle: Idle | None) -> None:
        """Send the TICKs of one barrier, see ``LockstepServer.begin_tick``."""
        self._await_connections(idle)
        self.time_us = now_us
        self._datagrams.take(datagrams or {}, self._participants.values())
        due = [participant for participant in self._participants.values() if participant.due_us <= now_us]
        self._under_way = bool(due)
        self.begins_counts = False
        if due:
            self.ticks += 1
            self._last_poll = time.monotonic()
            self._send_ticks(due, self._last_poll)

    def end(self, idle: Idle | None, head_start: float = 0.0) -> None:
        """Await the DONEs of the barrier, see ``LockstepServer.end_tick``."""
        if not self._under_way:
            return
        self._under_way = False
        if head_start and self.awaited:
            self._wait(head_start, None)
        while self.awaited:
            self._wait(SLICE, idle)
            self._drop_hung()
        self._channels.deliver_to_host()

    def complete_turn(self, participant: Participant, done: Barrier) -> None:
        """Accept a participant's DONE, or ignore it if it belongs to an earlier tick."""
        if participant.waiting and done.tick == participant.tick:
            self.release(participant)

    def release(self, participant: Participant) -> None:
        """Stop waiting for a participant."""
        if participant.waiting:
            participant.waiting = False
            self.awaited -= 1
            if participant.connection is not None:
                self._connections.release(participant.connection)

    def _send_ticks(self, due: Iterable[Participant], wall: float) -> None:
        rows: list[tuple[ClientConnection, dict[int, int]]] = []
        next_due: dict[float, int] = {}  # by rate
        for participant in due:
            connection, schedule = participant.connection, participant.schedule
            if connection is None or schedule is None:
                continue
            due_us = next_due.get(participant.rate)
            if due_us is None:
                due_us = next_due[participant.rate] = schedule.after_us(self.time_us)
            participant.due_us = due_us
            participant.waiting = True
            participant.tick = self.ticks
            participant.asked = wall
            self.awaited += 1
            if participant.udp_ports or connection.unsent or participant.news.has_peers():
                self._send_tick(participant, connection)
            else:
                rows.append((connection, participant.news.counts))
        self._connections.send_ticks(self.ticks, self.time_us, rows)

    def _send_tick(self, participant: Participant, connection: ClientConnection) -> None:
        """Send TICK together with connections made and lost and with datagram counts."""
        counts = participant.news.counts
        peers = b"".join(pack_object(Kind.PEER, content) for content in participant.news.take_peers())
        known = len(participant.datagrams_reported)
        ports = self._datagrams.news_for(participant) if participant.udp_ports else {}
        self.begins_counts |= len(participant.datagrams_reported) > known
        frame = pack_barrier(Kind.TICK, self.ticks, self.time_us, counts, ports)
        counts.clear()
        self._connections.expect(connection, self.ticks)
        self._connections.send(connection, peers + frame if peers else frame)

    # ---- waiting ----

    def wait_until_complete(
        self,
        missing: Callable[[], str],
        timeout: float | None,
        idle: Idle | None,
        progress: Callable[[str], None] | None,
    ) -> bool:
        """Wait until nothing is missing, see ``LockstepServer.wait_for``.

        Args:
            missing: Returns a description of the missing participants and connections, empty if there are none.
            timeout: Longest wait in wall seconds; None for no limit.
            idle: Called instead of a plain wait.
            progress: Called with the description whenever it changes.

        Returns:
            Whether nothing is missing.
        """
        self._last_poll = time.monotonic()
        end = None if timeout is None else self._last_poll + timeout
        reported = ""
        while True:
            self._wait(0.0, idle)
            self._press_missing()
            text = missing()
            if progress is not None and text != reported:
                progress(text)
                reported = text
            if not text:
                return True
            if end is not None and time.monotonic() >= end:
                return False
            self._wait(SLICE if end is None else max(0.0, min(SLICE, end - time.monotonic())), idle)

    def _await_connections(self, idle: Idle | None) -> None:
        """Accept new participants, and hold the simulation until their connections are made."""
        self._last_poll = time.monotonic()
        self._poll(0.0)
        while self._channels.missing:
            self._wait(SLICE, idle)
            self._press_missing()

    def _press_missing(self) -> None:
        """Let participants ask the master again for missing connections; give up those whose time is over."""
        for participant, topics in self._channels.ask_again():
            if participant.connection is not None:
                peers = {"made": [], "lost": [], "counted": [], "uncounted": [], "missing": topics}
                self._connections.send(participant.connection, pack_object(Kind.PEER, peers))
        self._channels.give_up_missing()

    def _wait(self, timeout: float, idle: Idle | None) -> None:
        if idle is not None:
            idle(timeout)
            timeout = 0.0
        self._poll(timeout)
        now = time.monotonic()
        late, self._last_poll = now - self._last_poll - SLICE, now
        if late > STOPPED:
            self._excuse(late, now)

    def _excuse(self, late: float, now: float) -> None:
        """Extend all limits by ``late`` seconds in which the simulator or the whole machine did not run."""
        self._log(logging.WARNING, f"the simulator did not run for {late:.0f} s of wall time; it continues now")
        self._connections.excuse(late, now)
        for participant in self._participants.values():
            participant.asked = min(participant.asked + late, now)
        self._channels.missing.postpone(late)

    def _drop_hung(self) -> None:
        """Drop participants that are dead or hung; checks at most once per ``SLICE``."""
        now = time.monotonic()
        if now < self._next_check:
            return
        self._next_check = now + SLICE
        for participant in [participant for participant in self._participants.values() if participant.waiting]:
            why = self._hung(participant, now)
            if why and participant.connection is not None:
                self._connections.drop(participant.connection, why)

    def _hung(self, participant: Participant, now: float) -> str:
        """Return the reason for dropping a participant, empty to keep it."""
        connection = participant.connection
        if connection is None:
            return ""
        silent = now - max(connection.heard, participant.asked)
        if silent > min(SILENCE, self._hang_limit or SILENCE) and connection.process is not None:
            # A child process may hold the connection open after the participant has ended.
            state = connection.process.state()
            if not state:
                return f"is gone: its process {connection.process.pid} has ended"
            if state == "t":  # a debugger has stopped all threads, the keep-alive one included
                connection.heard = now
                return ""
        if self._hang_limit and silent > self._hang_limit:
            return f"was silent for {silent:.1f} s (hang limit {self._hang_limit:g} s)"
        if self._busy_limit and now - participant.asked > self._busy_limit:
            return f"took more than {self._busy_limit:g} s for one tick (busy limit)"
        return ""
