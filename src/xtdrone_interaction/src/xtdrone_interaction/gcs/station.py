"""A ground station: lines to many vehicles, what each of them tells, and exchanges with all of them at once.

Everything happens in one thread: that of ``poll`` and ``run``, or the station's own after ``start``, when ``run`` only
waits. Other threads may call ``submit``, ``states`` and ``close``, then ``run``, too. Time-outs are wall time: a ground
station lives by it, and simulated time may stand still meanwhile.
"""

from __future__ import annotations

import contextlib
import logging
import math
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future, wait
from copy import copy
from typing import Any, Generic, TypeVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.fleet import MAX_VEHICLES
from xtdrone_control.mavlink.wire.codec import FrameError, decoder, split
from xtdrone_control.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_control.plans.qgc_plan import Plan

from . import exchanges
from .exchanges import Beat, Exchange, Heard, Progress, RefusalError, Say
from .lines import Line, open_line
from .peers import ANY, LOOPBACK, GcsError, Peer, numbered, peers_of
from .state import TELEMETRY, VehicleState

__all__ = [
    "LOOPBACK",
    "GcsError",
    "GroundStation",
    "Peer",
    "find",
    "listen",
    "peers_of",
    "progress_of",
    "run",
    "upload_plans",
]

TIMEOUT = 0.3
"""s until what was not answered is sent again."""
PATIENCE = 10.0
"""s of a vehicle's silence after which it is given up."""
BEAT_PERIOD = 1.0
"""s between two heartbeats of ours."""

_LOG = logging.getLogger(__name__)
_FIND_LIMIT = 3.0  # s in which vehicles that are looked for have to answer
_AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
_NAMES = {MESSAGE_ID[name]: name for name in (*exchanges.ANSWERS, *TELEMETRY)}
_DECODERS = {number: decoder(name) for number, name in _NAMES.items()}

T = TypeVar("T")
Job = Exchange[T] | Callable[[Beat], Exchange[T]]
"""An exchange; or what makes one, given what the vehicle's heartbeat tells."""
Watcher = Callable[[str, str, int, int], None]
"""Told of a vehicle (its name) what is under way, how many of its parts are done, and how many there are."""
Closing = Callable[[int], list[Any]]
"""Returns what ends, with the autopilot of a system, an exchange that was broken off."""


def no_closing(_system: int) -> list[Any]:
    """Return nothing: an exchange that can be left off."""
    return []


class _Run(Generic[T]):
    """An exchange that is under way, or waits for those before it."""

    def __init__(self, job: Job[T], timeout: float, patience: float, closing: Closing) -> None:
        self.future: Future[T] = Future()
        self.timeout = timeout
        self.patience = patience
        self.closing = closing
        self.deadline = self.heard = math.inf  # until it begins
        self.exchange: Exchange[T] = _greeted(job) if callable(job) else job


def _greeted(job: Callable[[Beat], Exchange[T]]) -> Exchange[T]:
    beat = yield from exchanges.greet()
    return (yield from job(beat))


class _Contact:
    """One vehicle: its line, its state, what is to be done with it."""

    def __init__(self, peer: Peer, line: Line, mav: Any) -> None:
        self.peer = peer
        self.line = line
        self.system = peer.system
        self.state = VehicleState(peer.name, peer.system)
        self.runs: deque[_Run[Any]] = deque()
        self._mav = mav

    @property
    def deadline(self) -> float:
        return self.runs[0].deadline if self.runs else math.inf

    def add(self, run: _Run[Any]) -> None:
        self.runs.append(run)
        if len(self.runs) == 1:
            self._begin()

    def _begin(self) -> None:
        """Begin the exchange that is the next, of those that nobody has cancelled."""
        while self.runs and not self.runs[0].future.set_running_or_notify_cancel():
            self.runs.popleft()
        if not self.runs:
            return
        run = self.runs[0]
        run.deadline = run.heard = time.monotonic()
        self._advance(run, lambda: next(run.exchange))

    def _advance(self, run: _Run[Any], step: Callable[[], list[Any]]) -> None:
        """Let the exchange go on, and send what it says."""
        try:
            outgoing = step()
            while isinstance(outgoing, Say):
                self.send(outgoing)
                outgoing = run.exchange.send(None)
            self.send(outgoing)
        except StopIteration as end:
            result = end.value
            self._end(run, lambda: run.future.set_result(result))
        except (RefusalError, GcsError) as error:
            self.fail(run, GcsError(f"{self.peer.name}: {error}"))
        except Exception as error:  # a flaw of this exchange; the others go on
            self.fail(run, error)
        else:
            if outgoing:
                run.deadline = time.monotonic() + run.timeout

    def _end(self, run: _Run[Any], tell: Callable[[], None]) -> None:
        self.runs.popleft()
        tell()
        if self.runs:
            self._begin()

    def fail(self, run: _Run[Any], error: Exception) -> None:
        """End an exchange by an error."""
        self.break_off(run)
        self._end(run, lambda: run.future.set_exception(error))

    def break_off(self, run: _Run[Any]) -> None:
        """End an exchange with the vehicle; nothing is left half done there."""
        run.exchange.close()
        with contextlib.suppress(GcsError):
            self.send(run.closing(self.system))

    def send(self, messages: Sequence[Any]) -> None:
        for message in messages:
            self.line.send(message.pack(self._mav), self.system)

    def take(self, number: int, system: int, frame: bytes, now: float) -> bool:
        """Take a frame of this vehicle; return whether it changes the state.

        Raises:
            FrameError: it is damaged.
        """
        if self.system == ANY:
            self.system = self.state.system = system
        name = _NAMES.get(number)
        if name is None:
            return False
        message = _DECODERS[number](frame)
        if name in TELEMETRY:
            self.state.take(name, message, now)
        if name in exchanges.ANSWERS and self.runs:
            if name == "HEARTBEAT":
                message = Beat(system, message.autopilot, message.type, message.base_mode, message.custom_mode)
            elif name == "TIMESYNC":
                message = Heard(system)
            if getattr(message, "target_system", exchanges.SYSTEM) in (0, exchanges.SYSTEM):
                run = self.runs[0]
                if name not in TELEMETRY and name != "TIMESYNC":  # those come without being asked for
                    run.heard = now
                self._advance(run, lambda: run.exchange.send(message))
        return name in TELEMETRY

    def check_time(self, now: float) -> None:
        """Tell the exchange that nothing came in time, or give the vehicle up."""
        if now < self.deadline:
            return
        run = self.runs[0]
        run.deadline = now + run.timeout
        if now - run.heard > run.patience:
            self.fail(run, GcsError(self._silence(run.patience)))
        else:
            self._advance(run, lambda: run.exchange.send(None))

    def _silence(self, patience: float) -> str:
        where = f"{self.peer.name}: {self.line.where}"
        if self.line.unreachable:
            return f"{where}: nobody listens there; does the simulation run, with this vehicle?"
        who = "any autopilot" if self.system == ANY else f"system {self.system}"
        return f"{where}: no answer of {who} within {patience:g} s"


class GroundStation:
    """Lines to vehicles; see the module's text.

    Attributes:
        peers: the vehicles that can be spoken to.
        errors: why others cannot be, by name.
    """

    def __init__(
        self,
        peers: Iterable[Peer],
        *,
        heartbeat: bool = False,
        on_change: Callable[[VehicleState], None] | None = None,
    ) -> None:
        """Open the lines.

        Args:
            peers: the vehicles.
            heartbeat: tell them each second that a ground station is there. An autopilot may be set to act when that
                ends (PX4's NAV_DLL_ACT), so only who stays should do it; without it they are greeted all the same.
            on_change: called with a copy of a vehicle's state after each message that changes it, in the thread that
                polls. What it raises comes out of ``poll``, or is logged where the station has a thread of its own.
        """
        self.errors: dict[str, GcsError] = {}
        self._heartbeat = heartbeat
        self._on_change = on_change
        self._mav = mavlink.MAVLink(None, srcSystem=exchanges.SYSTEM, srcComponent=exchanges.COMPONENT)
        self._selector = selectors.DefaultSelector()
        self._lines: dict[tuple[str, str, int], Line] = {}
        self._contacts: dict[Peer, _Contact] = {}
        self._by_line: dict[Line, list[_Contact]] = {}
        self._beat = -math.inf
        self._lock = threading.RLock()
        self._arrived: deque[tuple[Peer, _Run[Any]]] = deque()
        self._closed = False
        self._thread: threading.Thread | None = None
        self._waker, self._wakened = socket.socketpair()
        self._wakened.setblocking(False)
        self._selector.register(self._wakened, selectors.EVENT_READ, None)
        for peer in peers:
            self._add(peer)

    def __enter__(self) -> GroundStation:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def peers(self) -> list[Peer]:
        """The vehicles that can be spoken to."""
        return list(self._contacts)

    def _add(self, peer: Peer) -> None:
        line = self._lines.get(peer.line)
        if line is None:
            try:
                line = self._lines[peer.line] = open_line(*peer.line)
            except GcsError as error:
                self.errors[peer.name] = GcsError(f"{peer.name}: {error}")
                return
            self._selector.register(line, selectors.EVENT_READ, line)
            self._by_line[line] = []
        contact = self._contacts[peer] = _Contact(peer, line, self._mav)
        self._by_line[line].append(contact)

    # for all threads

    def submit(
        self,
        peer: Peer,
        job: Job[T],
        *,
        timeout: float = TIMEOUT,
        patience: float = PATIENCE,
        closing: Closing = no_closing,
    ) -> Future[T]:
        """Begin an exchange with a vehicle, after those that are under way with it.

        Args:
            peer: one of ``peers``.
            job: the exchange, or what makes it.
            timeout: s until what was not answered is sent again.
            patience: s of silence after which the vehicle is given up.
            closing: returns what ends it there when it is broken off.

        Returns:
            What will have the result, or a GcsError. It can be cancelled until the exchange begins.

        Raises:
            GcsError: the vehicle cannot be spoken to, or the station is closed.
        """
        if peer not in self._contacts:
            raise self.errors.get(peer.name) or GcsError(f"{peer.name}: no vehicle of this station")
        found: _Run[T] = _Run(job, timeout, patience, closing)
        with self._lock:
            if self._closed:
                raise GcsError(f"{peer.name}: the station is closed")
            self._arrived.append((peer, found))
        self._wake()
        return found.future

    def states(self) -> list[VehicleState]:
        """Return what is known of the vehicles, in the order in which they were given."""
        with self._lock:
            return [copy(contact.state) for contact in self._contacts.values()]

    def start(self) -> None:
        """Poll in a thread of its own until ``close``."""
        self._thread = threading.Thread(target=self._serve, name="ground station", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Break off what is under way, and close the lines."""
        with self._lock:
            ended, self._closed = self._closed, True
        if ended:
            return
        if self._thread is not None:
            self._wake()
            self._thread.join()
        for contact in self._contacts.values():
            for run in contact.runs:
                if run.future.running():
                    contact.break_off(run)
                    run.future.set_exception(GcsError(f"{contact.peer.name}: the station is closed"))
                else:
                    run.future.cancel()
        for _, run in self._arrived:
            run.future.cancel()
        for line in self._lines.values():
            line.close()
        self._selector.close()
        self._waker.close()
        self._wakened.close()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            self._waker.send(b"\0")

    def _serve(self) -> None:
        while not self._closed:
            self.poll(BEAT_PERIOD)

    # for the thread that polls

    def poll(self, limit: float) -> None:
        """Do what is to be done, waiting up to ``limit`` s for it."""
        self._take_arrived()
        now = time.monotonic()
        self._say_hello(now)
        due = min((contact.deadline for contact in self._contacts.values()), default=math.inf)
        due = min(due, self._beat + BEAT_PERIOD if self._heartbeat else math.inf, now + limit)
        for key, _ in self._selector.select(max(due - now, 0.0)):
            if key.data is None:
                with contextlib.suppress(BlockingIOError):
                    self._wakened.recv(4096)
            else:
                self._receive(key.data)
        now = time.monotonic()
        for contact in self._contacts.values():
            contact.check_time(now)

    def _take_arrived(self) -> None:
        while self._arrived:
            peer, found = self._arrived.popleft()
            if peer in self._contacts:
                self._contacts[peer].add(found)
            else:  # its line has ended in the meantime
                found.future.set_exception(self.errors[peer.name])

    def _say_hello(self, now: float) -> None:
        if not self._heartbeat or now < self._beat + BEAT_PERIOD:
            return
        self._beat = now
        kind, none, active = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, mavlink.MAV_STATE_ACTIVE
        beat = mavlink.MAVLink_heartbeat_message(kind, none, 0, 0, active, 3).pack(self._mav)
        for line in self._by_line:
            with contextlib.suppress(GcsError):  # the vehicle's silence shows it
                line.send(beat, ANY)

    def _receive(self, line: Line) -> None:
        try:
            arrived = line.receive()
        except GcsError as error:
            self._lose(line, error)
            return
        now = time.monotonic()
        for datagram in arrived:
            try:
                for number, system, component, frame in split(datagram):
                    if component == _AUTOPILOT:
                        self._give(line, number, system, frame, now)
            except FrameError:  # noise; what is missing is asked for again
                continue

    def _give(self, line: Line, number: int, system: int, frame: bytes, now: float) -> None:
        for contact in self._by_line[line]:
            if contact.system not in (ANY, system):
                continue
            with self._lock:
                changed = contact.take(number, system, frame, now)
            if changed:
                self._tell_change(contact)

    def _tell_change(self, contact: _Contact) -> None:
        if self._on_change is None:
            return
        try:
            self._on_change(copy(contact.state))
        except Exception:
            if self._thread is None:
                raise
            _LOG.exception("%s: on_change of the ground station has failed; the station goes on", contact.peer.name)

    def _lose(self, line: Line, error: GcsError) -> None:
        """Take note that a line has ended."""
        self._selector.unregister(line)
        for contact in self._by_line.pop(line):
            while contact.runs:
                contact.fail(contact.runs[0], GcsError(f"{contact.peer.name}: {error}"))
            with self._lock:
                self.errors[contact.peer.name] = GcsError(f"{contact.peer.name}: {error}")
                del self._contacts[contact.peer]

    def run(self, jobs: Mapping[Peer, Job[T]], **limits: Any) -> dict[str, T | GcsError]:
        """Run exchanges with vehicles, all at once; see ``submit`` for ``limits``.

        Returns:
            By vehicle's name what the exchange has returned, or the error with which it ended.
        """
        futures: dict[str, Future[T]] = {}
        results: dict[str, T | GcsError] = {}
        for peer, job in jobs.items():
            try:
                futures[peer.name] = self.submit(peer, job, **limits)
            except GcsError as error:
                results[peer.name] = error
        if self._thread is not None:
            wait(futures.values())
        while not all(future.done() for future in futures.values()):
            self.poll(BEAT_PERIOD)
        for name, future in futures.items():
            try:
                results[name] = future.result()
            except GcsError as error:
                results[name] = error
        return results


def run(
    jobs: Mapping[Peer, Job[T]],
    *,
    timeout: float = TIMEOUT,
    patience: float = PATIENCE,
    closing: Closing = exchanges.cancel,
) -> dict[str, T | GcsError]:
    """Run exchanges with vehicles, all at once.

    Args:
        jobs: the exchange with each, or what makes it.
        timeout: s until what was not answered is sent again.
        patience: s of a vehicle's silence after which it is given up.
        closing: returns what ends an exchange that was broken off.

    Returns:
        By vehicle's name what the exchange has returned, or the error with which it ended.
    """
    with GroundStation(jobs) as station:
        return station.run(jobs, timeout=timeout, patience=patience, closing=closing)


def find(host: str = LOOPBACK, limit: float = _FIND_LIMIT, instance: int = 0) -> list[Peer]:
    """Return the vehicles that answer at the ports of a simulation, in their order, with their system ids.

    Args:
        host: the machine on which they fly.
        limit: s in which they have to answer; a port that nobody has says so at once where the machine tells it.
        instance: of the simulations on it.

    Raises:
        GcsError: there is no such machine.
    """
    try:
        address = socket.gethostbyname(host)  # once for all
    except (OSError, UnicodeError) as error:
        raise GcsError(f"{host}: no such machine: {getattr(error, 'strerror', None) or error}") from error
    peers = [numbered(number, host=address, instance=instance) for number in range(MAX_VEHICLES)]
    with GroundStation(peers) as station:
        futures = {peer: station.submit(peer, exchanges.greet(), patience=limit) for peer in station.peers}
        end = time.monotonic() + limit
        while time.monotonic() < end:
            station.poll(TIMEOUT)
            if all(futures[peer].done() or contact.line.unreachable for peer, contact in station._contacts.items()):
                break
        done = [peer for peer, future in futures.items() if future.done() and future.exception() is None]
        return [Peer(peer.name, futures[peer].result().system, host, peer.port) for peer in done]


def listen(address: tuple[str, str, int], limit: float = _FIND_LIMIT, wanted: Collection[int] = ()) -> list[Peer]:
    """Return the vehicles of which heartbeats come over a line, by their system ids.

    Args:
        address: scheme, host and port.
        limit: s in which they have to come.
        wanted: system ids; when all of these are there no more are waited for. Empty: all that come in time.

    Raises:
        GcsError: the line cannot be opened, or ends.
    """
    line = open_line(*address)
    beat = MESSAGE_ID["HEARTBEAT"]
    mav = mavlink.MAVLink(None, srcSystem=exchanges.SYSTEM, srcComponent=exchanges.COMPONENT)
    found: set[int] = set()
    try:
        with selectors.DefaultSelector() as selector:
            selector.register(line, selectors.EVENT_READ)
            end = time.monotonic() + limit
            while (now := time.monotonic()) < end and not (wanted and found.issuperset(wanted)):
                for message in exchanges.hello():
                    line.send(message.pack(mav), ANY)
                if not selector.select(min(TIMEOUT, end - now)):
                    continue
                for datagram in line.receive():
                    with contextlib.suppress(FrameError):
                        found |= {s for number, s, part, _ in split(datagram) if (number, part) == (beat, _AUTOPILOT)}
    finally:
        line.close()
    return [Peer(f"system_{system}", system, *address[1:], address[0]) for system in sorted(found)]


def upload_plans(
    plans: Mapping[str, Plan],
    *,
    fleet: str = "",
    host: str = LOOPBACK,
    watch: Watcher | None = None,
    timeout: float = TIMEOUT,
    patience: float = PATIENCE,
    instance: int = 0,
) -> None:
    """Give vehicles their plans, all at once, and see that they have come whole.

    Args:
        plans: by vehicle's name.
        fleet: the fleet that flies; see ``peers_of``.
        host: the machine on which it flies.
        watch: told of the progress.
        timeout, patience: see ``run``.
        instance: of the simulations on that machine.

    Raises:
        GcsError: some vehicle has not taken its plan; one line each.
        FleetError: the fleet is none.
    """
    jobs = {}
    for peer in peers_of(plans, fleet, host, instance):
        too_long = exchanges.check_kinds(plans[peer.name])
        if too_long:
            raise GcsError(f"{peer.name}: {too_long}")
        jobs[peer] = exchanges.store_plan(peer.system, plans[peer.name], progress_of(peer.name, watch))
    failures = [str(result) for result in run(jobs, timeout=timeout, patience=patience).values() if _failed(result)]
    if failures:
        raise GcsError("\n".join(failures))


def _failed(result: object) -> bool:
    return isinstance(result, GcsError)


def progress_of(name: str, watch: Watcher | None) -> Progress:
    """Return what tells ``watch`` of the vehicle ``name``."""
    if watch is None:
        return exchanges.nobody
    return lambda what, done, total: watch(name, what, done, total)
