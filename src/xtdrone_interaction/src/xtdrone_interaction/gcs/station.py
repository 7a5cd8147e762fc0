"""A ground station for many vehicles: their connections, their states, and exchanges with all of them at once.

All work is done in one thread: the one that calls ``poll`` or ``run``, or after ``start`` the station's own, in which
case ``run`` only waits. Other threads may call ``submit``, ``states`` and ``close``, and after ``start`` also ``run``.
Time-outs are in wall time, because simulated time may stand still.
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
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, wait
from copy import copy
from typing import Any, TypeVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.codec import FrameError, split
from xtdrone_autopilot.plans.qgc_plan import Plan
from xtdrone_interaction.gcs.exchange_queue import AbortMessages, Contact, Job, QueuedExchange

from .exchanges import exchange
from .exchanges.exchange import Progress
from .exchanges.plans import cancel_transfers, check_capacity, upload_plan
from .udp_tcp_serial import Connection, open_connection
from .vehicle_addresses import ANY, LOOPBACK, GcsError, Peer, peers_of
from .vehicle_state import VehicleState

TIMEOUT = 0.3
"""s without an answer before a message is repeated."""
PATIENCE = 10.0
"""s of silence before a vehicle is given up."""
HEARTBEAT_PERIOD = 1.0
"""s between our heartbeats."""

_LOG = logging.getLogger(__name__)

T = TypeVar("T")
Watcher = Callable[[str, str, int, int], None]
"""Callback for progress: name of the vehicle, description, number of finished parts, total number of parts."""


def no_abort_messages(_system: int) -> list[Any]:
    """Return no messages, for exchanges that need no end."""
    return []


class GroundStation:
    """Connections to vehicles; see the module's docstring.

    Attributes:
        errors: connection errors by name of the vehicle.
    """

    def __init__(
        self,
        peers: Iterable[Peer],
        *,
        heartbeat: bool = False,
        on_change: Callable[[VehicleState], None] | None = None,
    ) -> None:
        """Open the connections.

        Args:
            peers: the vehicles.
            heartbeat: send a ground station's heartbeat each second. An autopilot may react to its loss (PX4's
                NAV_DLL_ACT), so only a permanent station should send it; exchanges do not need it.
            on_change: callback with a copy of a vehicle's state after each message that changes it, in the polling
                thread. Its exceptions propagate from ``poll``; the station's own thread logs them.
        """
        self.errors: dict[str, GcsError] = {}
        self._sends_heartbeat = heartbeat
        self._on_change = on_change
        self._mav = mavlink.MAVLink(None, srcSystem=exchange.SYSTEM, srcComponent=exchange.COMPONENT)
        self._selector = selectors.DefaultSelector()
        self._connections: dict[tuple[str, str, int], Connection] = {}
        self._contacts: dict[Peer, Contact] = {}
        self._by_connection: dict[Connection, list[Contact]] = {}
        self._last_heartbeat = -math.inf
        self._lock = threading.RLock()
        self._submitted: deque[tuple[Peer, QueuedExchange[Any]]] = deque()
        self._closed = False
        self._thread: threading.Thread | None = None
        self._waker, self._wakened = socket.socketpair()
        self._wakened.setblocking(False)
        self._waker.setblocking(False)  # when it is full, the polling thread is woken anyway
        self._selector.register(self._wakened, selectors.EVENT_READ, None)
        for peer in peers:
            self._add(peer)

    def __enter__(self) -> GroundStation:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def peers(self) -> list[Peer]:
        """The vehicles that are connected."""
        return list(self._contacts)

    def is_unreachable(self, peer: Peer) -> bool:
        """Return whether the vehicle's machine has reported that no program has its port."""
        return self._contacts[peer].connection.unreachable

    def _add(self, peer: Peer) -> None:
        connection = self._connections.get(peer.address)
        if connection is None:
            try:
                connection = self._connections[peer.address] = open_connection(*peer.address)
            except GcsError as error:
                self.errors[peer.name] = GcsError(f"{peer.name}: {error}")
                return
            self._selector.register(connection, selectors.EVENT_READ, connection)
            self._by_connection[connection] = []
        contact = self._contacts[peer] = Contact(peer, connection, self._mav)
        self._by_connection[connection].append(contact)

    # for all threads

    def submit(
        self,
        peer: Peer,
        job: Job[T],
        *,
        timeout: float = TIMEOUT,
        patience: float = PATIENCE,
        on_abort: AbortMessages = no_abort_messages,
    ) -> Future[T]:
        """Queue an exchange with a vehicle.

        Args:
            peer: one of ``peers``.
            job: the exchange, or a function that creates it from the vehicle's heartbeat.
            timeout: s without an answer before a message is repeated.
            patience: s of silence before the vehicle is given up.
            on_abort: returns the messages that end the exchange if it is aborted.

        Returns:
            Future of the result, or of a GcsError. It can be cancelled until the exchange starts.

        Raises:
            GcsError: the vehicle is not connected, or the station is closed.
        """
        if peer not in self._contacts:
            raise self.errors.get(peer.name) or GcsError(f"{peer.name}: no vehicle of this station")
        item: QueuedExchange[T] = QueuedExchange(job, timeout, patience, on_abort)
        with self._lock:
            if self._closed:
                raise GcsError(f"{peer.name}: the station is closed")
            self._submitted.append((peer, item))
        self._wake()
        return item.future

    def states(self) -> list[VehicleState]:
        """Return the states of the connected vehicles, in the order of the constructor."""
        with self._lock:
            return [copy(contact.state) for contact in self._contacts.values()]

    def start(self) -> None:
        """Poll in a thread of the station's own until ``close``."""
        self._thread = threading.Thread(target=self._serve, name="ground station", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Abort all exchanges and close the connections."""
        with self._lock:
            was_closed, self._closed = self._closed, True
        if was_closed:
            return
        if self._thread is not None:
            self._wake()
            self._thread.join()
        for contact in self._contacts.values():
            for item in contact.queue:
                if item.future.running():
                    contact.abort(item)
                    item.future.set_exception(GcsError(f"{contact.peer.name}: the station is closed"))
                else:
                    item.future.cancel()
        for _, item in self._submitted:
            item.future.cancel()
        for connection in self._connections.values():
            connection.close()
        self._selector.close()
        self._waker.close()
        self._wakened.close()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            self._waker.send(b"\0")

    def _serve(self) -> None:
        while not self._closed:
            self.poll(HEARTBEAT_PERIOD)

    # for the polling thread

    def poll(self, limit: float) -> None:
        """Process messages, new exchanges and timeouts, waiting for the first of them up to ``limit`` s."""
        self._start_submitted()
        now = time.monotonic()
        self._send_heartbeat(now)
        due = min((contact.deadline for contact in self._contacts.values()), default=math.inf)
        due = min(due, self._last_heartbeat + HEARTBEAT_PERIOD if self._sends_heartbeat else math.inf, now + limit)
        for key, _ in self._selector.select(max(due - now, 0.0)):
            if key.data is None:
                with contextlib.suppress(BlockingIOError):
                    self._wakened.recv(4096)
            else:
                self._receive(key.data)
        now = time.monotonic()
        for contact in self._contacts.values():
            contact.check_timeout(now)

    def _start_submitted(self) -> None:
        while self._submitted:
            peer, item = self._submitted.popleft()
            if peer in self._contacts:
                self._contacts[peer].add(item)
            else:  # its connection has ended in the meantime
                item.future.set_exception(self.errors[peer.name])

    def _send_heartbeat(self, now: float) -> None:
        if not self._sends_heartbeat or now < self._last_heartbeat + HEARTBEAT_PERIOD:
            return
        self._last_heartbeat = now
        kind, none, active = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, mavlink.MAV_STATE_ACTIVE
        heartbeat = mavlink.MAVLink_heartbeat_message(kind, none, 0, 0, active, 3).pack(self._mav)
        for connection in self._by_connection:
            with contextlib.suppress(GcsError):  # the silence of its vehicles is reported
                connection.send(heartbeat, ANY)

    def _receive(self, connection: Connection) -> None:
        try:
            chunks = connection.receive()
        except GcsError as error:
            self._remove(connection, error)
            return
        now = time.monotonic()
        for chunk in chunks:
            try:
                for number, system, component, frame in split(chunk):
                    if component == exchange.AUTOPILOT:
                        self._dispatch(connection, number, system, frame, now)
            except FrameError:  # noise; exchanges repeat their requests
                continue

    def _dispatch(self, connection: Connection, number: int, system: int, frame: bytes, now: float) -> None:
        for contact in self._by_connection[connection]:
            if contact.system not in (ANY, system):
                continue
            with self._lock:
                changed = contact.receive(number, system, frame, now)
            if changed:
                self._report_change(contact)

    def _report_change(self, contact: Contact) -> None:
        if self._on_change is None:
            return
        try:
            self._on_change(copy(contact.state))
        except Exception:
            if self._thread is None:
                raise
            _LOG.exception("%s: on_change of the ground station has failed; the station continues", contact.peer.name)

    def _remove(self, connection: Connection, error: GcsError) -> None:
        """Remove a connection that has ended, and its vehicles."""
        self._selector.unregister(connection)
        for contact in self._by_connection.pop(connection):
            while contact.queue:
                contact.fail(contact.queue[0], GcsError(f"{contact.peer.name}: {error}"))
            with self._lock:
                self.errors[contact.peer.name] = GcsError(f"{contact.peer.name}: {error}")
                del self._contacts[contact.peer]

    def run(self, jobs: Mapping[Peer, Job[T]], **limits: Any) -> dict[str, T | GcsError]:
        """Run exchanges with vehicles, all at once; see ``submit`` for ``limits``.

        Returns:
            Result or error by name of the vehicle.
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
            self.poll(HEARTBEAT_PERIOD)
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
    on_abort: AbortMessages = cancel_transfers,
) -> dict[str, T | GcsError]:
    """Run exchanges with vehicles, all at once, over connections of their own.

    Args:
        jobs: exchanges, or functions that create them.
        timeout, patience, on_abort: see ``GroundStation.submit``.

    Returns:
        Result or error by name of the vehicle.
    """
    with GroundStation(jobs) as station:
        return station.run(jobs, timeout=timeout, patience=patience, on_abort=on_abort)


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
    """Upload plans to vehicles, all at once, and compare what the vehicles have stored.

    Args:
        plans: by name of the vehicle.
        fleet: the fleet; see ``peers_of``.
        host: machine of the simulation.
        watch: callback for progress.
        timeout, patience: see ``GroundStation.submit``.
        instance: number of the simulation on that machine.

    Raises:
        GcsError: some vehicles have not stored their plan; one line each.
        FleetError: invalid fleet.
    """
    jobs = {}
    for peer in peers_of(plans, fleet, host, instance):
        too_long = check_capacity(plans[peer.name])
        if too_long:
            raise GcsError(f"{peer.name}: {too_long}")
        jobs[peer] = upload_plan(peer.system, plans[peer.name], progress_of(peer.name, watch))
    results = run(jobs, timeout=timeout, patience=patience).values()
    failures = [str(result) for result in results if isinstance(result, GcsError)]
    if failures:
        raise GcsError("\n".join(failures))


def progress_of(name: str, watch: Watcher | None) -> Progress:
    """Return the callback for the progress of the vehicle ``name``."""
    if watch is None:
        return exchange.ignore_progress
    return lambda what, done, total: watch(name, what, done, total)
