"""Exchanges with many vehicles at once, over one UDP socket each, in one thread.

Time-outs are wall time: a ground station lives by it, and simulated time may stand still meanwhile.
"""

from __future__ import annotations

import re
import selectors
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.fleet import Vehicle, parse_fleet
from xtdrone_control.mavlink.codec import FrameError, decoder, split
from xtdrone_control.mavlink.dialect import MESSAGE_ID
from xtdrone_control.qgc_plan import Plan

from . import exchanges
from .exchanges import Exchange, Progress, RefusalError, Say

LOOPBACK = "127.0.0.1"
TIMEOUT = 0.3
"""s until what was not answered is sent again."""
PATIENCE = 10.0
"""s of a vehicle's silence after which it is given up."""

_RECEIVE_BUFFER = 1 << 20  # whoever speaks to a vehicle hears its telemetry, too
_LARGEST_DATAGRAM = 65535
_NAME = re.compile(r"([a-z][a-z0-9_]*)_(\d+)")
_DECODERS = {MESSAGE_ID[name]: decoder(name) for name in exchanges.ANSWERS}

T = TypeVar("T")
Watcher = Callable[[str, str, int, int], None]
"""Told of a vehicle (its name) what is under way, how many of its parts are done, and how many there are."""


class GcsError(Exception):
    """What was asked for could not be done; the message says of which vehicle and why."""


@dataclass(frozen=True)
class Peer:
    """Where a vehicle is met.

    Attributes:
        name: as ``typhoon_h480_0``.
        system: MAVLink system id.
        host, port: of its ground-station link.
    """

    name: str
    system: int
    host: str
    port: int

    @staticmethod
    def of(vehicle: Vehicle, host: str = LOOPBACK) -> Peer:
        """Return where ``vehicle`` is met on the machine ``host``."""
        return Peer(vehicle.name, vehicle.system_id, host, vehicle.gcs_local_port)


def peers_of(names: Iterable[str], fleet: str = "", host: str = LOOPBACK) -> list[Peer]:
    """Return where vehicles are met.

    Args:
        names: the vehicles'.
        fleet: the fleet that flies, as ``iris:3,typhoon_h480:2``; empty: all are of one type, and so is the fleet.
        host: the machine on which they fly.

    Raises:
        GcsError: a name that is none, or is not in the fleet; names of several types without a fleet.
        FleetError: the fleet is none.
    """
    names = list(names)
    known = parse_fleet(fleet) if fleet else ()
    by_name = {vehicle.name: vehicle for vehicle in known}
    parts = [_NAME.fullmatch(name) for name in names]
    types = {part[1] for part in parts if part}
    found = []
    for name, part in zip(names, parts, strict=True):
        if part is None:
            raise GcsError(f"vehicle: {name!r} is not allowed, a type and a number, as typhoon_h480_0")
        if not known and len(types) > 1:
            raise GcsError(f"vehicles of several types ({', '.join(sorted(types))}): say which fleet flies, as "
                           f"--fleet {','.join(f'{kind}:1' for kind in sorted(types))}")  # fmt: skip
        if known and name not in by_name:
            raise GcsError(f"vehicle: {name!r} is not allowed, one of the fleet {fleet}")
        number = int(part[2])
        vehicle = by_name.get(name) or parse_fleet(f"{part[1]}:{number + 1}")[number]
        found.append(Peer.of(vehicle, host))
    return found


class _Session(Generic[T]):
    """An exchange with one vehicle."""

    def __init__(self, peer: Peer, exchange: Exchange[T], timeout: float, patience: float) -> None:
        self.peer = peer
        self.result: T | GcsError | None = None
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.deadline = self._heard = time.monotonic()
        self._exchange = exchange
        self._timeout = timeout
        self._patience = patience
        self._mav = mavlink.MAVLink(None, srcSystem=exchanges.SYSTEM, srcComponent=exchanges.COMPONENT)
        self._unreachable = False
        try:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self.socket.setblocking(False)
            self.socket.connect((peer.host, peer.port))
        except OSError as error:
            self.socket.close()
            raise GcsError(f"{peer.name}: {peer.host}:{peer.port} cannot be reached: {error.strerror}") from error

    @property
    def over(self) -> bool:
        return self.result is not None

    def start(self) -> None:
        self._advance(lambda: next(self._exchange))

    def _advance(self, step: Callable[[], list[Any]]) -> None:
        """Let the exchange go on, and send what it says."""
        try:
            outgoing = step()
            while isinstance(outgoing, Say):
                self.send(outgoing)
                outgoing = self._exchange.send(None)
        except StopIteration as end:
            self.result = end.value if end.value is not None else _DONE
        except RefusalError as error:
            self.result = GcsError(f"{self.peer.name}: {error}")
        else:
            self.send(outgoing)
            if outgoing:
                self.deadline = time.monotonic() + self._timeout

    def send(self, messages: Sequence[Any]) -> None:
        for message in messages:
            try:
                self.socket.send(message.pack(self._mav))
            except ConnectionRefusedError:  # an earlier datagram found nobody
                self._unreachable = True
            except OSError as error:
                text = f"{self.peer.name}: {self.peer.host}:{self.peer.port} cannot be reached: {error.strerror}"
                self.result = GcsError(text)

    def receive(self) -> None:
        """Give the exchange what has come."""
        while True:
            try:
                datagram = self.socket.recv(_LARGEST_DATAGRAM)
            except ConnectionRefusedError:
                self._unreachable = True
                continue
            except OSError:
                return
            self._unreachable = False
            for message in self._messages(datagram):
                self._heard = time.monotonic()
                self._give(message)

    def _give(self, message: Any) -> None:
        """Let the exchange go on with a message, or with None."""
        if not self.over:
            self._advance(lambda: self._exchange.send(message))

    def _messages(self, datagram: bytes) -> Iterable[Any]:
        try:
            for number, system, component, frame in split(datagram):
                if number in _DECODERS and (system, component) == (self.peer.system, mavlink.MAV_COMP_ID_AUTOPILOT1):
                    message = _DECODERS[number](frame)
                    if getattr(message, "target_system", exchanges.SYSTEM) in (0, exchanges.SYSTEM):
                        yield message
        except FrameError:  # noise; what is missing is asked for again
            return

    def check_time(self, now: float) -> None:
        """Tell the exchange that nothing came in time, or give the vehicle up."""
        if now < self.deadline:
            return
        self.deadline = now + self._timeout
        if now - self._heard > self._patience:
            self.result = GcsError(self._silence())
        else:
            self._give(None)

    def _silence(self) -> str:
        peer = self.peer
        where = f"{peer.name}: UDP {peer.host}:{peer.port}"
        if self._unreachable:
            return f"{where}: nobody listens there; does the simulation run, with this vehicle?"
        return f"{where}: no answer of system {peer.system} within {self._patience:g} s"

    def close(self) -> None:
        self._exchange.close()
        self.socket.close()


_DONE: Any = object()  # the result of an exchange that returns nothing


def run(
    jobs: Mapping[Peer, Exchange[T]], *, timeout: float = TIMEOUT, patience: float = PATIENCE
) -> dict[str, T | GcsError]:
    """Run exchanges with vehicles, all at once.

    Args:
        jobs: the exchange with each.
        timeout: s until what was not answered is sent again.
        patience: s of a vehicle's silence after which it is given up.

    Returns:
        By vehicle's name what the exchange has returned, or the error with which it ended.
    """
    results: dict[str, T | GcsError] = {}
    sessions: list[_Session[T]] = []
    with selectors.DefaultSelector() as selector:
        try:
            for peer, exchange in jobs.items():
                try:
                    session = _Session(peer, exchange, timeout, patience)
                except GcsError as error:
                    results[peer.name] = error
                    continue
                sessions.append(session)
                selector.register(session.socket, selectors.EVENT_READ, session)
                session.start()
            while waiting := [session for session in sessions if not session.over]:
                delay = max(min(session.deadline for session in waiting) - time.monotonic(), 0.0)
                for key, _ in selector.select(delay):
                    key.data.receive()
                now = time.monotonic()
                for session in waiting:
                    if not session.over:
                        session.check_time(now)
                for session in waiting:
                    if session.over:
                        selector.unregister(session.socket)
        finally:
            for session in sessions:
                if not session.over or isinstance(session.result, GcsError):
                    session.send(exchanges.cancel(session.peer.system))  # nothing is left half done
                if session.result is not None:
                    results[session.peer.name] = session.result
                session.close()
    return results


def upload_plans(
    plans: Mapping[str, Plan],
    *,
    fleet: str = "",
    host: str = LOOPBACK,
    watch: Watcher | None = None,
    timeout: float = TIMEOUT,
    patience: float = PATIENCE,
) -> None:
    """Give vehicles their plans, all at once, and see that they have come whole.

    Args:
        plans: by vehicle's name.
        fleet: the fleet that flies; see ``peers_of``.
        host: the machine on which it flies.
        watch: told of the progress.
        timeout, patience: see ``run``.

    Raises:
        GcsError: some vehicle has not taken its plan; one line each.
        FleetError: the fleet is none.
    """
    jobs = {}
    for peer in peers_of(plans, fleet, host):
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
