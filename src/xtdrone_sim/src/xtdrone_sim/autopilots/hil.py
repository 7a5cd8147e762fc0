"""PX4s in our autopilot's place (``autopilot:=hil``): each vehicle's simulator link, in lockstep.

In every step all PX4s get their samples, then all their answers are waited for at once. The controls that answer the
samples of one step move the vehicle in the next. Whom nobody controls has its motors off; the others fly on.

How long an answer is waited for:

- A PX4 that has answered is waited for: armed, up to ``hang_limit``, for its motors depend on it; disarmed, up to
  ``DISARMED_LIMIT``, for PX4 sends no controls while it has nothing to control, as disarmed in OFFBOARD without
  setpoints. One whose connection closes is not waited for.
- One that has not answered yet, because it boots, or has not in time, is given one step of real time. It is waited for
  again once its answers, late or not, are to ``RELOCK_STEPS`` steps one after another.
- One that says that it runs without lockstep is never waited for.
"""

from __future__ import annotations

import logging
import math
import select
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from xtdrone_control.autopilot.autopilot import STEP_US, Autopilot
from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.autopilot.state import MAX_ROTORS
from xtdrone_control.fleet import Vehicle
from xtdrone_control.geodesy.datum import Datum
from xtdrone_sim.autopilots.hil_link import HilLink, Log
from xtdrone_sim.autopilots.hil_messages import Frames
from xtdrone_sim.physics.world import World, WorldModel
from xtdrone_sim.vehicles.vehicle_model import VehicleModel

DISARMED_LIMIT = 1.0
"""Wall seconds that a disarmed PX4's answer is waited for; Gazebo's plugin waits as long."""

_SLICE = 0.1  # wall s between two looks at other things while waiting
_FIRST_WORD = 5.0  # wall s of waiting until the log says so
_NEXT_WORD = 30.0  # wall s between two such words
_HEARTBEAT_US = 1_000_000


def _log(level: int, text: str) -> None:
    logging.getLogger("xtdrone_sim.autopilots.hil").log(level, text)


class Hil:
    """PX4s behind their simulator links. See ``autopilots.Autopilots``."""

    commanders: list[Commander]
    served: tuple[Vehicle, ...] = ()  # PX4 serves its MAVLink itself
    need_time = True  # PX4's clock is the simulator's

    def __init__(
        self,
        fleet: tuple[Vehicle, ...],
        models: Sequence[VehicleModel],
        world: WorldModel,
        datum: Datum | None,
        *,
        host: str = "127.0.0.1",
        hang_limit: float = 60.0,
        idle: Callable[[float], None] = lambda timeout: None,
        log: Log = _log,
    ) -> None:
        """Listen for all PX4s.

        Args:
            fleet: the vehicles, in order of their global index.
            models: one a vehicle.
            world: where they fly.
            datum: of no use here: PX4 takes its local frame's origin by MAVLink, which the simulator does not serve.
            host: address to listen on; "0.0.0.0" for every network.
            hang_limit: wall seconds that an armed PX4's answer is waited for, 0 for ever.
            idle: called now and then with 0 while waiting; may raise.
            log: takes level and text for the user.

        Raises:
            HilError: a port is taken; none stays bound then.
        """
        place = world.datum.latitude, world.datum.longitude, world.datum.altitude
        self._layouts = [model.rotor_layout for model in models]
        self._hang_limit = hang_limit if hang_limit > 0.0 else math.inf
        self._idle = idle
        self._log = log
        self._frames = Frames(fleet, place)
        self._next_truth_us = np.zeros(len(fleet))
        self._next_heartbeat_us = 0
        self._time_us = 0  # of the links: it never goes back, for PX4's cannot
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
        """Go on in a new world. PX4s are not restarted, and their time goes on: they see a jump."""
        self._world = world
        self.autopilot = Autopilot(self._layouts, None)
        self.autopilot.time_us = time_us
        for link in self.links:
            link.controls = None

    def missing(self) -> str:
        """Say which vehicles have no PX4 yet."""
        waiting = [
            f"{link.vehicle.name} (TCP port {link.vehicle.simulator_tcp_port})"
            for link in self.links
            if link.connection is None
        ]
        return f"no PX4 has connected for {', '.join(waiting)}" if waiting else ""

    def step(self) -> None:
        """Send all samples, wait for all answers, and hand the motors what they say."""
        self.autopilot.time_us += STEP_US
        self._time_us += STEP_US
        self._send()
        self._collect()
        self._apply()

    def _send(self) -> None:
        """Send this step's samples, behind what PX4 has not taken yet."""
        now, frames = self._time_us, self._frames
        for i, link in enumerate(self.links):
            interval = link.truth_interval_us
            due = frames.truth_due[i] = interval > 0.0 and now >= self._next_truth_us[i]
            if due:
                # on a grid of its own, so that the mean rate is what PX4 asks for
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
        """Wait for everybody's answer, each within its limit."""
        self.serve()
        began = end = looked = time.monotonic()
        word = _FIRST_WORD
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
            if now - began >= word:
                word += _NEXT_WORD
                names = ", ".join(link.vehicle.name for link in waiting)
                self._log(logging.WARNING, f"the world waits for PX4's controls of {names} since {now - began:.0f} s")

    def _give_up(self, waiting: list[HilLink], began: float, now: float) -> float:
        """Wait no longer for those whose time is over; return when somebody's next is."""
        end = math.inf
        for link in waiting:
            until = began + self._limit(link)
            if now >= until:
                link.missed()
            else:
                end = min(end, until)
        return end

    def _limit(self, link: HilLink) -> float:
        """Return for how long this step's answer is waited for, wall s."""
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
        """Take connections and what PX4s have sent."""
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
