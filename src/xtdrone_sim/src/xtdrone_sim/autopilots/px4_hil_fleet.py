"""Autopilot back end for external PX4s (``autopilot:=hil``): the simulator links of all vehicles, in lockstep.

Each step sends the samples to all PX4s, then waits for all answers in parallel. The controls that answer the samples of
one step drive the motors in the next. A vehicle without controls has its motors off; the others keep flying.

Time limits for an answer:

- A PX4 in lockstep: while armed, ``hang_limit``, because its motors depend on the answer; while disarmed,
  ``DISARMED_LIMIT``, because PX4 sends no controls while it has nothing to control, e.g. disarmed in OFFBOARD without
  setpoints. Closing the connection ends the wait.
- A PX4 that is booting, or whose last answer timed out: one step of real time. It is in lockstep again after its
  answers, late or not, cover ``RELOCK_STEPS`` consecutive steps.
- A PX4 that reports that it runs without lockstep: no wait.
"""

from __future__ import annotations

import logging
import math
import select
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from xtdrone_autopilot.autopilot import STEP_US, Autopilot
from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.state import MAX_ROTORS
from xtdrone_common.fleet import Vehicle
from xtdrone_common.geodesy.projection import Datum
from xtdrone_sim.autopilots.px4_hil_link import HilLink, Log
from xtdrone_sim.autopilots.px4_hil_messages import Frames
from xtdrone_sim.physics.world import World
from xtdrone_sim.vehicles.vehicle_model import VehicleModel
from xtdrone_worlds.worlds.sdf import SdfWorld

DISARMED_LIMIT = 1.0
"""Longest wait for the answer of a disarmed PX4, wall s; the same as in Gazebo's plugin."""

_SLICE = 0.1  # wall s between two calls of ``idle`` while waiting
_FIRST_WARNING = 5.0  # wall s of waiting after which a warning is logged
_WARNING_PERIOD = 30.0  # wall s between two such warnings
_HEARTBEAT_US = 1_000_000


def _log(level: int, text: str) -> None:
    logging.getLogger("xtdrone_sim.autopilots.px4_hil_fleet").log(level, text)


class Hil:
    """PX4s behind their simulator links. See ``AutopilotBackend``."""

    commanders: list[Commander]
    served: tuple[Vehicle, ...] = ()  # PX4 serves its MAVLink itself
    need_time = True  # PX4's clock is the simulator's

    def __init__(
        self,
        fleet: tuple[Vehicle, ...],
        models: Sequence[VehicleModel],
        world: SdfWorld,
        datum: Datum | None,
        reserve: int = 0,
        *,
        host: str = "127.0.0.1",
        hang_limit: float = 60.0,
        idle: Callable[[float], None] = lambda timeout: None,
        log: Log = _log,
    ) -> None:
        """Listen on the simulator ports of all vehicles.

        Args:
            fleet: the vehicles, in order of their global index.
            models: one per vehicle.
            world: the world in which they fly.
            datum: unused: PX4 receives the origin of its local frame by MAVLink, which the simulator does not serve.
            reserve: must be 0.
            host: address to listen on; "0.0.0.0" for every network interface.
            hang_limit: longest wait for the answer of an armed PX4, wall s; 0 for unlimited.
            idle: called periodically with 0 while waiting; may raise.
            log: logs a text at a level of ``logging``.

        Raises:
            HilError: a port is in use; all ports are closed.
            ValueError: places are reserved.
        """
        if reserve:
            raise ValueError(f"reserve: {reserve} is not allowed with autopilot hil, 0; PX4 instances cannot join")
        place = world.datum.latitude, world.datum.longitude, world.datum.altitude
        self._layouts = [model.rotor_layout for model in models]
        self._hang_limit = hang_limit if hang_limit > 0.0 else math.inf
        self._idle = idle
        self._log = log
        self._frames = Frames(fleet, place)
        self._next_truth_us = np.zeros(len(fleet))
        self._next_heartbeat_us = 0
        self._time_us = 0  # time of the links; never set back, because PX4's clock is monotonic
        self._poll = select.epoll()
        self._readers: dict[int, Callable[[], None]] = {}
        self.links: list[HilLink] = []
        self.descriptors: tuple[int, ...] = (self._poll.fileno(),)
        self.commanders = []
        self.autopilot = Autopilot(self._layouts, None)
        try:
            for vehicle in fleet:
                link = HilLink(vehicle, host, log)
                self.links.append(link)
                self._register(link.listener.fileno(), partial(self._accept, link))
        except OSError:
            self.close()
            raise

    def _register(self, descriptor: int, reader: Callable[[], None]) -> None:
        self._readers[descriptor] = reader
        self._poll.register(descriptor, select.EPOLLIN)

    def _accept(self, link: HilLink) -> None:
        if link.accept():
            assert link.connection is not None
            self._register(link.connection.fileno(), link.read)

    def begin(self, world: World, time_us: int) -> None:
        """Continue in a new world. PX4s are not restarted and their time continues: they see a jump."""
        self._world = world
        self.autopilot = Autopilot(self._layouts, None)
        self.autopilot.time_us = time_us
        for link in self.links:
            link.controls = None

    def kernel_steps(self) -> int:
        """Return 0: every step exchanges messages with the autopilots."""
        return 0

    def count_steps(self, steps: int) -> None:
        """Do nothing; see ``kernel_steps``."""

    def check_reboot(self) -> None:
        """See ``AutopilotBackend``.

        Raises:
            ValueError: always; only PX4 itself can reboot.
        """
        raise ValueError("autopilot: single PX4 instances (hil) cannot be rebooted by the simulator, only builtin ones")

    def reboot(self, index: int) -> None:
        """See ``check_reboot``."""
        self.check_reboot()

    def check_join(self) -> None:
        """See ``AutopilotBackend``.

        Raises:
            ValueError: always; the set of PX4 instances is fixed at the start.
        """
        raise ValueError("autopilot: with PX4 instances (hil) no vehicle can join or leave, only with builtin ones")

    def join(self, index: int, vehicle: Vehicle, model: VehicleModel) -> None:
        """See ``check_join``."""
        self.check_join()

    def leave(self, index: int) -> None:
        """See ``check_join``."""
        self.check_join()

    def missing(self) -> str:
        """Return a text on the vehicles that have no PX4 yet; "" when all have."""
        waiting = [
            f"{link.vehicle.name} (TCP port {link.vehicle.simulator_tcp_port})"
            for link in self.links
            if link.connection is None
        ]
        return f"no PX4 has connected for {', '.join(waiting)}" if waiting else ""

    def step(self) -> None:
        """Send all samples, wait for all answers, and apply the received controls to the motors."""
        self.autopilot.time_us += STEP_US
        self._time_us += STEP_US
        self._send()
        self._collect()
        self._apply()

    def _send(self) -> None:
        """Send the samples of this step, after the data that PX4 has not read yet."""
        now, frames = self._time_us, self._frames
        for i, link in enumerate(self.links):
            interval = link.truth_interval_us
            due = frames.truth_due[i] = interval > 0.0 and now >= self._next_truth_us[i]
            if due:
                # on a fixed grid, so that the mean rate is the one that PX4 requests
                self._next_truth_us[i] = max(self._next_truth_us[i] + interval, now - interval + 1)
        frames.fill(self.autopilot.sensors, self._world, now)
        heartbeat = now >= self._next_heartbeat_us
        if heartbeat:
            self._next_heartbeat_us = now + _HEARTBEAT_US
        for i, link in enumerate(self.links):
            if link.connection is None:
                continue
            samples = frames.of(i, samples_only=link.fresh)  # PX4 has no time before its first HIL_SENSOR
            link.send(b"".join((samples, frames.heartbeat(i))) if heartbeat else samples, now)

    def _collect(self) -> None:
        """Wait for the answers of all PX4s, each within its time limit."""
        self.serve()
        began = end = looked = time.monotonic()
        next_warning = _FIRST_WARNING
        waiting = self.links
        while waiting := [link for link in waiting if link.awaited]:
            now = time.monotonic()
            if now >= end:
                end = self._give_up(waiting, began, now)
                continue
            self._read(min(end - now, _SLICE))
            if now - looked >= _SLICE:
                looked = now
                self._idle(0.0)
            if now - began >= next_warning:
                next_warning += _WARNING_PERIOD
                names = ", ".join(link.vehicle.name for link in waiting)
                self._log(logging.WARNING, f"the world has waited {now - began:.0f} s for PX4's controls of {names}")

    def _give_up(self, waiting: list[HilLink], began: float, now: float) -> float:
        """Time out the links whose limit has passed; return the monotonic wall time of the next timeout, s."""
        end = math.inf
        for link in waiting:
            until = began + self._limit(link)
            if now >= until:
                link.missed()
            else:
                end = min(end, until)
        return end

    def _limit(self, link: HilLink) -> float:
        """Return the time limit for the answer to this step, wall s."""
        if not link.locked:
            return STEP_US * 1e-6
        return self._hang_limit if link.armed else min(DISARMED_LIMIT, self._hang_limit)

    def _apply(self) -> None:
        actuators, armed = self.autopilot.control["actuators"], self.autopilot.setpoint["armed"]
        for i, link in enumerate(self.links):
            link.void_stale()
            controls = link.controls
            if controls is None or not controls.armed:
                actuators[i] = 0.0
                armed[i] = 0
            else:
                actuators[i] = controls.outputs[:MAX_ROTORS]
                armed[i] = 1
        np.nan_to_num(actuators, copy=False, nan=0.0)
        np.clip(actuators, 0.0, 1.0, out=actuators)

    def serve(self) -> None:
        """Accept connections and read the data that PX4s have sent, without blocking."""
        self._read(0.0)

    def _read(self, timeout: float) -> None:
        for descriptor, _ in self._poll.poll(timeout):
            reader = self._readers.get(descriptor)
            if reader is not None:
                reader()

    def close(self) -> None:
        """Close all links."""
        for link in self.links:
            link.close()
        self._poll.close()
