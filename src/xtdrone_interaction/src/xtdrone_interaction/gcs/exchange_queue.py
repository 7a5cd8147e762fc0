"""One vehicle of a ground station: its connection, its state, and the queue of exchanges with it."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, Generic, TypeVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.codec import decoder
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID

from .exchanges import exchange
from .exchanges.exchange import Exchange, Heartbeat, Presence, RefusalError, Unanswered
from .udp_tcp_serial import Connection
from .vehicle_addresses import ANY, GcsError, Peer
from .vehicle_state import TELEMETRY, VehicleState, name_constant

_NAMES = {MESSAGE_ID[name]: name for name in (*exchange.ANSWERS, *TELEMETRY)}
_DECODERS = {number: decoder(name) for number, name in _NAMES.items()}

T = TypeVar("T")
Job = Exchange[T] | Callable[[Heartbeat], Exchange[T]]
"""An exchange, or a function that creates one from the heartbeat of a PX4; other autopilots are refused."""
AbortMessages = Callable[[int], list[Any]]
"""Returns, for a MAVLink system id, the messages that end an aborted exchange on the vehicle's side."""


class QueuedExchange(Generic[T]):
    """An exchange that is running, or waits for earlier ones with the same vehicle."""

    def __init__(self, job: Job[T], timeout: float, patience: float, on_abort: AbortMessages) -> None:
        self.future: Future[T] = Future()
        self.timeout = timeout
        self.patience = patience
        self.on_abort = on_abort
        self.deadline = self.answered = math.inf  # until it starts
        self.exchange: Exchange[T] = _after_heartbeat(job) if callable(job) else job


def _after_heartbeat(job: Callable[[Heartbeat], Exchange[T]]) -> Exchange[T]:
    heartbeat = yield from exchange.await_heartbeat()
    if heartbeat.autopilot != mavlink.MAV_AUTOPILOT_PX4:
        other = name_constant("MAV_AUTOPILOT", heartbeat.autopilot)
        raise RefusalError(f"autopilot: {other} is not supported, only PX4", True)
    return (yield from job(heartbeat))


class Contact:
    """A vehicle: its connection, its state, and its exchanges, of which the first one runs."""

    def __init__(self, peer: Peer, connection: Connection, mav: Any) -> None:
        self.peer = peer
        self.connection = connection
        self.system = peer.system
        self.state = VehicleState(peer.name, peer.system)
        self.queue: deque[QueuedExchange[Any]] = deque()
        self._mav = mav

    @property
    def deadline(self) -> float:
        """Time of the next timeout, s of the monotonic clock."""
        return self.queue[0].deadline if self.queue else math.inf

    def add(self, item: QueuedExchange[Any]) -> None:
        """Queue an exchange, and start it if it is the only one."""
        self.queue.append(item)
        if len(self.queue) == 1:
            self._start_next()

    def _start_next(self) -> None:
        """Start the first exchange that has not been cancelled."""
        while self.queue and not self.queue[0].future.set_running_or_notify_cancel():
            self.queue.popleft()
        if not self.queue:
            return
        item = self.queue[0]
        item.deadline = item.answered = time.monotonic()
        self._advance(item, lambda: next(item.exchange))

    def _advance(self, item: QueuedExchange[Any], step: Callable[[], list[Any]]) -> None:
        """Resume an exchange and send the messages that it yields."""
        try:
            outgoing = step()
            while isinstance(outgoing, Unanswered):
                self.send(outgoing)
                outgoing = item.exchange.send(None)
            self.send(outgoing)
        except StopIteration as end:
            result = end.value
            self._finish(item, lambda: item.future.set_result(result))
        except (RefusalError, GcsError) as error:
            self.fail(item, GcsError(f"{self.peer.name}: {error}"))
        except Exception as error:  # a defect of this exchange; the others continue
            self.fail(item, error)
        else:
            if outgoing:
                item.deadline = time.monotonic() + item.timeout

    def _finish(self, item: QueuedExchange[Any], resolve: Callable[[], None]) -> None:
        self.queue.popleft()
        resolve()
        if self.queue:
            self._start_next()

    def fail(self, item: QueuedExchange[Any], error: Exception) -> None:
        """Abort the running exchange with an error."""
        self.abort(item)
        self._finish(item, lambda: item.future.set_exception(error))

    def abort(self, item: QueuedExchange[Any]) -> None:
        """Abort an exchange here and on the vehicle."""
        item.exchange.close()
        with contextlib.suppress(GcsError):
            self.send(item.on_abort(self.system))

    def send(self, messages: Sequence[Any]) -> None:
        """Send messages to the vehicle."""
        for message in messages:
            self.connection.send(message.pack(self._mav), self.system)

    def receive(self, number: int, system: int, frame: bytes, now: float) -> bool:
        """Process a frame of this vehicle and return whether it has changed the state.

        Raises:
            FrameError: the frame is damaged.
        """
        if self.system == ANY:
            self.system = self.state.system = system
        name = _NAMES.get(number)
        if name is None:
            return False
        message = _DECODERS[number](frame)
        if name in TELEMETRY:
            self.state.update(name, message, now)
        if name in exchange.ANSWERS and self.queue:
            self._answer(name, system, message, now)
        return name in TELEMETRY

    def _answer(self, name: str, system: int, message: Any, now: float) -> None:
        """Pass a message to the running exchange, unless it is addressed to another ground station."""
        if name == "HEARTBEAT":
            message = Heartbeat(system, message.autopilot, message.type, message.base_mode, message.custom_mode)
        elif name == "TIMESYNC":
            message = Presence(system)
        if getattr(message, "target_system", exchange.SYSTEM) not in (0, exchange.SYSTEM):
            return
        item = self.queue[0]
        if name not in TELEMETRY and name != "TIMESYNC":  # those are sent without a request
            item.answered = now
        self._advance(item, lambda: item.exchange.send(message))

    def check_timeout(self, now: float) -> None:
        """Report a timeout to the running exchange, or give the vehicle up."""
        if now < self.deadline:
            return
        item = self.queue[0]
        item.deadline = now + item.timeout
        if now - item.answered > item.patience:
            self.fail(item, GcsError(self._silence(item.patience)))
        else:
            self._advance(item, lambda: item.exchange.send(None))

    def _silence(self, patience: float) -> str:
        where = f"{self.peer.name}: {self.connection.where}"
        if self.connection.unreachable:
            return f"{where}: no program listens there; is the simulation running, with this vehicle?"
        who = "any autopilot" if self.system == ANY else f"system {self.system}"
        return f"{where}: no answer from {who} within {patience:g} s"
