"""Simulator link of one vehicle: the TCP server to which PX4's simulator_mavlink module connects.

Follows Gazebo Classic's mavlink_interface plugin; ``docs/px4-sitl.md`` lists the differences.
"""

from __future__ import annotations

import contextlib
import logging
import socket
from collections.abc import Callable

from xtdrone_autopilot.autopilot import STEP_US
from xtdrone_common.fleet import Vehicle
from xtdrone_sim.autopilots.px4_hil_messages import Controls, Stream, TruthInterval

Log = Callable[[int, str], None]

RELOCK_STEPS = 25
"""Consecutive steps that a silent PX4 must answer to be in lockstep again."""

STALE_US = 200_000
"""Simulated time, microseconds, after which controls expire and the motors stop, as in Gazebo's plugin."""

_READ = 65536  # bytes
_MOST_GARBAGE = 4096  # bytes without a MAVLink message after which the client is not considered a PX4
_MOST_PENDING = 1 << 20  # bytes that the client has not read


class HilError(OSError):
    """A simulator link cannot be opened."""


class HilLink:
    """Listens for PX4 and serves one connection at a time.

    Attributes:
        vehicle: vehicle of the link.
        listener: listening socket.
        connection: socket to PX4; None while disconnected.
        controls: latest controls of PX4; None before the first ones and after they have expired.
        truth_interval_us: interval of HIL_STATE_QUATERNION, microseconds, 0 for none; PX4 requests 5 ms.
        awaited: samples have been sent in this step and PX4 has not answered them yet.
        locked: PX4 is in lockstep, see ``hil``; otherwise the wait for an answer is one step of real time.
    """

    def __init__(self, vehicle: Vehicle, host: str, log: Log) -> None:
        """Listen on the simulator port of the vehicle.

        Args:
            vehicle: vehicle of the link.
            host: address to listen on; "0.0.0.0" for every network interface.
            log: logs a text at a level of ``logging``.

        Raises:
            HilError: the port is in use.
        """
        self.vehicle = vehicle
        self._log = log
        self._name = f"{vehicle.name}'s PX4"
        self.listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.listener.setblocking(False)
            self.listener.bind((host, vehicle.simulator_tcp_port))
            self.listener.listen(1)
        except OSError as error:
            self.listener.close()
            raise HilError(
                f"{vehicle.name}: TCP port {vehicle.simulator_tcp_port} of PX4's simulator link cannot be bound at "
                f"{host}: {error.strerror or error}; is another simulator using it?"
            ) from error
        self.connection: socket.socket | None = None
        self._forget()

    def _forget(self) -> None:
        """Reset the state of the connection."""
        self.controls: Controls | None = None
        self.truth_interval_us = 0.0
        self.awaited = False
        self.locked = False
        self._stream = Stream()
        self._pending = b""
        self._first_us: int | None = None  # time of the first samples, at which PX4's own clock starts
        self._sent_us = 0
        self._heard_us = 0
        self._has_answered = False
        self._answered_us = 0  # PX4's time of its latest answer
        self._streak = 0  # consecutive steps answered
        self._free = False  # PX4 reports that it runs without lockstep

    @property
    def armed(self) -> bool:
        """Whether PX4 has its motors armed."""
        return self.controls is not None and self.controls.armed

    @property
    def fresh(self) -> bool:
        """Whether no samples have been sent to PX4 yet."""
        return self._first_us is None

    def accept(self) -> bool:
        """Accept a pending connection; return whether it has become the connection of the link.

        A new connection replaces a PX4 that does not respond and is otherwise rejected.
        """
        try:
            connection, (host, port) = self.listener.accept()
        except OSError:  # the client has already closed it
            return False
        if self.connection is not None and self.locked:
            self._log(logging.WARNING, f"{self._name}: a second one, from {host}:{port}, is rejected")
            connection.close()
            return False
        if self.connection is not None:
            self.drop(f"is replaced by a new one from {host}:{port}")
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connection = connection
        self._log(logging.INFO, f"{self._name} has connected from {host}:{port}")
        return True

    def drop(self, reason: str) -> None:
        """Close the connection; the motors stop and another PX4 may connect."""
        if self.connection is None:
            return
        self.connection.close()
        self.connection = None
        level = logging.WARNING if self.armed else logging.INFO
        motors = ", armed: its motors stop" if self.armed else ""
        self._log(level, f"{self._name} {reason}{motors}; the link waits at TCP port {self.vehicle.simulator_tcp_port}")
        self._forget()

    def send(self, frames: bytes | memoryview, time_us: int) -> None:
        """Send the samples of one step, taken at the link's ``time_us``, and expect an answer."""
        if self.connection is None:
            return
        if self._first_us is None:
            self._first_us = time_us
        self._sent_us = time_us
        self.awaited = not self._free
        if self._pending:
            frames, self._pending = self._pending + frames, b""
        self._write(frames)

    def _write(self, data: bytes | memoryview) -> None:
        assert self.connection is not None
        try:
            sent = self.connection.send(data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self.drop(f"is gone ({error.strerror or error})")
            return
        if sent < len(data):
            self._pending = bytes(data[sent:])
            if len(self._pending) > _MOST_PENDING:
                self.drop("does not read its data and is disconnected")

    def read(self) -> None:
        """Read and process the data that PX4 has sent."""
        if self.connection is None:
            return
        try:
            data = self.connection.recv(_READ)
        except BlockingIOError:
            return
        except OSError as error:
            self.drop(f"is gone ({error.strerror or error})")
            return
        if not data:
            self.drop("has closed its link")
            return
        before = self._stream.garbage
        for said in self._stream.take(data):
            if isinstance(said, Controls):
                self._take(said)
            else:
                self._set_truth(said)
        if self._stream.garbage > before:
            self._note_garbage(before)

    def _note_garbage(self, before: int) -> None:
        if not before:
            self._log(
                logging.WARNING, f"{self._name}: the link has received bytes that are not MAVLink; they are ignored"
            )
        if not self._stream.messages and self._stream.garbage > _MOST_GARBAGE:
            self.drop("does not speak MAVLink and is disconnected")

    def _set_truth(self, wish: TruthInterval) -> None:
        wanted = wish.interval_us
        self.truth_interval_us = wanted if 0.0 < wanted < 1e12 else 0.0

    def _take(self, controls: Controls) -> None:
        self.controls = controls
        self._heard_us = self._sent_us
        if not controls.lockstep:
            if not self._free:
                self._log(logging.INFO, f"{self._name} runs without lockstep: the simulator does not wait for it")
            self._free, self.locked, self.awaited = True, False, False
            return
        self._free = False
        step = controls.time_us - self._answered_us
        if step:
            self._streak = self._streak + 1 if step == STEP_US else 1
        if not self.locked and (not self._has_answered or self._streak >= RELOCK_STEPS):
            self.locked = True
            self._log(logging.INFO, f"{self._name} answers: in lockstep")
        self._answered_us, self._has_answered = controls.time_us, True
        # PX4's clock starts at its first samples. An answer to an earlier step does not answer this one; 0: no time.
        if controls.time_us == 0 or controls.time_us >= self._sent_us - (self._first_us or 0):
            self.awaited = False

    def missed(self) -> None:
        """Leave lockstep: PX4 has not answered this step within its time limit."""
        self.awaited = False
        if not self.locked:
            return
        self.locked = False
        self._streak = 0
        if self.armed:
            self._log(
                logging.WARNING, f"{self._name} is armed and does not respond: the simulation continues without it"
            )
        else:
            self._log(
                logging.INFO, f"{self._name} is disarmed and silent: the simulation continues, no faster than real time"
            )

    def void_stale(self) -> None:
        """Stop the motors when no controls have been received for ``STALE_US``."""
        if self.controls is None or self._sent_us - self._heard_us <= STALE_US:
            return
        if self.armed:
            self._log(logging.WARNING, f"{self._name} has sent no controls for {STALE_US * 1e-6:g} s: its motors stop")
        self.controls = None

    def close(self) -> None:
        """Close the connection and the listening socket."""
        if self.connection is not None:
            with contextlib.suppress(OSError):
                self.connection.close()
            self.connection = None
        self.listener.close()
