"""Fly one of our vehicles over MAVLink in the same way as the recorded PX4, and record the flight.

Simulator, autopilot and client run in one process in lockstep: a step of 4 ms, then the messages of both sides. The
datagrams are sent over loopback and counted, so that the result does not depend on wall time.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from validation.compare_px4.reference import Event, Flight, Track
from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.modes import Mode
from xtdrone_sim.simulation import Simulation

_NAN = math.nan
_SYSTEM, _COMPONENT = 255, 190  # the ground station's
_SAMPLE_US = 20_000
_SETPOINT_US = 50_000
_BEAT_US = 1_000_000
_ANSWER_LIMIT = 5.0  # s of wall time; only a broken server needs it
_EVERY_STEP = (
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
)  # asked for at 50 Hz
Setpoint = tuple[tuple[float, float, float], tuple[float, float, float], float]


class PilotError(RuntimeError):
    """The vehicle does not respond or does not reach a required state."""


class Pilot:
    """One vehicle and its client.

    Commanded and recorded positions and headings are in a frame whose x axis is the vehicle's initial heading, like
    that of the recorded vehicle (to a degree).

    Attributes:
        time: simulated time, s.
    """

    def __init__(self, vehicle: str, seed: int = 0) -> None:
        """Spawn a ``vehicle`` on the ground and open its links.

        Raises:
            ModelError: there is no such vehicle type.
            OSError: a port of the vehicle is taken.
        """
        self._simulation = Simulation(parse_fleet(vehicle), places=[(0.0, 0.0, 0.0)], seed=seed)
        try:
            self._server = MavlinkServer(
                self._simulation.fleet, self._simulation.autopilot, self._simulation.commanders
            )
        except OSError:
            self._simulation.close()
            raise
        self._port = self._simulation.fleet[0].gcs_local_port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(_ANSWER_LIMIT)
        self._own_port = self._socket.getsockname()[1]
        self._mav = mavlink.MAVLink(None, srcSystem=_SYSTEM, srcComponent=_COMPONENT)
        self._mav.robust_parsing = True
        self._sent = 0
        self._arrived = 0
        self._latest: dict[str, Any] = {}
        self._mode = ""
        self._landed = ""
        self._phase = ""
        self._heading = 0.0
        self._rows: list[list[float]] = []
        self._events: list[Event] = []
        self._reached = -1
        self._mission: list[Any] = []
        self._setpoint: Setpoint | None = None
        self._say(self._beat())
        for number in _EVERY_STEP:
            self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, _SAMPLE_US)

    def close(self) -> None:
        """Close the ports and the simulation."""
        self._socket.close()
        self._server.close()
        self._simulation.close()

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self._simulation.time_us * 1e-6

    @property
    def setpoint(self) -> Setpoint | None:
        """Sent at 20 Hz while it is not None: position, velocity (m, m/s; NaN not controlled), heading (rad)."""
        return self._setpoint

    @setpoint.setter
    def setpoint(self, setpoint: Setpoint | None) -> None:
        self._setpoint = setpoint
        if setpoint is not None:
            self._say(self._target(setpoint))

    @property
    def flight(self) -> Flight:
        """The recording so far."""
        return Flight(Track(np.array(self._rows)), list(self._events))

    # flying

    def begin(self, phase: str) -> None:
        """Record the beginning of ``phase``."""
        self._phase = phase
        self._note("phase", phase)

    def look_ahead(self) -> None:
        """Use the current heading as the direction of x."""
        self._heading = self._latest["ATTITUDE"].yaw

    def run(self, seconds: float) -> None:
        """Advance by ``seconds``."""
        self.run_until(lambda: False, seconds)

    def run_until(self, done: Callable[[], bool], limit: float) -> bool:
        """Advance until ``done()`` or for ``limit`` seconds; return whether it is done."""
        end = self._simulation.time_us + round(limit * 1e6)
        while self._simulation.time_us < end:
            if done():
                return True
            self._step()
        return done()

    def command(self, number: int, *params: float) -> None:
        """Send COMMAND_LONG; missing parameters are 0."""
        values = [*params, *[0.0] * (7 - len(params))]
        self._say(mavlink.MAVLink_command_long_message(1, 1, number, 0, *values))

    def set_mode(self, mode: Mode) -> None:
        """Request a PX4 mode."""
        self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, mode.main, mode.sub)

    def set_parameter(self, name: str, value: float) -> None:
        """Set a float parameter."""
        self._say(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32))

    def reposition(self, forward: float, right: float, altitude: float) -> None:
        """Request a flight to a local position, ``altitude`` m above the origin (MAV_CMD_DO_REPOSITION)."""
        latitude, longitude, amsl = self._global(forward, right, altitude)
        self._say(
            mavlink.MAVLink_command_int_message(
                1, 1, mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_REPOSITION, 0, 0,
                -1.0, 1.0, 0.0, _NAN, round(latitude * 1e7), round(longitude * 1e7), amsl,
            )
        )  # fmt: skip

    def upload_mission(self, items: list[tuple[int, float, float, float]]) -> None:
        """Upload a mission of (MAV_CMD, forward, right, height over home in m) and wait for its ACK.

        Raises:
            PilotError: no ACK within 5 s.
        """
        self._mission = []
        self._reached = -1
        for seq, (command, forward, right, height) in enumerate(items):
            latitude, longitude, _ = self._global(forward, right, 0.0)
            self._mission.append(
                mavlink.MAVLink_mission_item_int_message(
                    1, 1, seq, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, command, int(seq == 0), 1,
                    0.0, 0.0, 0.0, _NAN, round(latitude * 1e7), round(longitude * 1e7), height,
                )
            )  # fmt: skip
        self._latest.pop("MISSION_ACK", None)
        self._say(mavlink.MAVLink_mission_count_message(1, 1, len(items)))
        if not self.run_until(lambda: "MISSION_ACK" in self._latest, 5.0):
            raise PilotError("mission: no MISSION_ACK within 5 s")

    @property
    def position(self) -> tuple[float, float, float]:
        """Estimated position, m: forward, right, down."""
        m = self._latest["LOCAL_POSITION_NED"]
        forward, right = self._to_own(m.x, m.y)
        return forward, right, m.z

    @property
    def yaw(self) -> float:
        """Estimated heading relative to the initial one, rad."""
        return _wrap(self._latest["ATTITUDE"].yaw - self._heading)

    @property
    def armed(self) -> bool:
        """Whether the motors are running."""
        return self._simulation.commanders[0].armed

    @property
    def texts(self) -> list[str]:
        """Status texts of the current phase."""
        return [event.value for event in self._events if event.kind == "text" and event.phase == self._phase]

    # frames

    def _to_own(self, north: float, east: float) -> tuple[float, float]:
        cos, sin = math.cos(self._heading), math.sin(self._heading)
        return cos * north + sin * east, cos * east - sin * north

    def _to_local(self, forward: float, right: float) -> tuple[float, float]:
        cos, sin = math.cos(self._heading), math.sin(self._heading)
        return cos * forward - sin * right, sin * forward + cos * right

    def _global(self, forward: float, right: float, altitude: float) -> tuple[float, float, float]:
        north, east = self._to_local(forward, right)
        return self._simulation.commanders[0].view.to_global((north, east, -altitude))

    # the exchange

    def _step(self) -> None:
        self._simulation.step()
        now = self._simulation.time_us
        self._server.send_streams(now)
        self._listen()
        self._watch_mode()
        if now % _SAMPLE_US == 0 and self._phase:
            self._sample()
        if now % _BEAT_US == 0:
            self._say(self._beat())
        if self._setpoint is not None and now % _SETPOINT_US < self._simulation.step_us:
            self._say(self._target(self._setpoint))

    @staticmethod
    def _beat() -> Any:
        return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)

    def _target(self, setpoint: Setpoint) -> Any:
        position, velocity, yaw = setpoint
        x, y = self._to_local(position[0], position[1])
        vx, vy = self._to_local(velocity[0], velocity[1])
        values = (x, y, position[2], vx, vy, velocity[2])
        mask = sum(1 << bit for bit, value in enumerate(values) if math.isnan(value))
        mask |= 0b111 << 6 | 1 << 11  # no acceleration, no yaw rate
        sent = [0.0 if math.isnan(value) else value for value in values]
        return mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, mask, *sent, 0.0, 0.0, 0.0, _wrap(yaw + self._heading), 0.0
        )

    def _say(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._mav), ("127.0.0.1", self._port))
        self._sent += 1
        limit = time.monotonic() + _ANSWER_LIMIT
        while self._server.received[self._port] < self._sent:
            self._server.receive(0.1)
            if time.monotonic() > limit:
                raise PilotError(f"UDP port {self._port}: the vehicle's link has not read a datagram for 5 s")
        self._listen()

    def _listen(self) -> None:
        """Process all datagrams received from the vehicle."""
        while self._arrived < self._server.sent.get(self._own_port, 0):
            try:
                datagram = self._socket.recv(65535)
            except TimeoutError as error:
                raise PilotError(f"UDP port {self._own_port}: no datagram of the vehicle received for 5 s") from error
            self._arrived += 1
            for message in self._mav.parse_buffer(datagram) or ():
                self._take(message)

    def _take(self, message: Any) -> None:
        kind = message.get_type()
        self._latest[kind] = message
        if kind == "COMMAND_ACK" and message.command != mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._note("ack", f"{message.command} {message.result}")
        elif kind == "STATUSTEXT":
            self._take_text(message)
        elif kind == "EXTENDED_SYS_STATE":
            state = str(message.landed_state)
            if state != self._landed:
                self._note("landed_state", state)
            self._landed = state
        elif kind == "MISSION_ITEM_REACHED":
            if message.seq != self._reached:  # it is sent several times
                self._note("reached", str(message.seq))
            self._reached = message.seq
        elif kind in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
            self._say(self._mission[message.seq])

    def _take_text(self, message: Any) -> None:
        """Record a status text; append the further chunks of a long one to its first."""
        if message.id == 0 or message.chunk_seq == 0:
            self._note("text", f"{message.severity} {message.text.strip()}")
        elif self._events and self._events[-1].kind == "text":
            first = self._events[-1]
            self._events[-1] = replace(first, value=first.value + message.text.strip())

    def _watch_mode(self) -> None:
        """Record a change of mode before the next heartbeat; heartbeats have a rate of 1 Hz."""
        commander = self._simulation.commanders[0]
        mode = f"{commander.base_mode} {commander.custom_mode} {commander.system_status}"
        if mode != self._mode:
            self._note("mode", mode)
        self._mode = mode

    def note_setpoints_stopped(self) -> None:
        """Record the end of the setpoints, and stop sending them."""
        self.setpoint = None
        self._note("setpoints", "stopped")

    def _note(self, kind: str, value: str) -> None:
        if self._phase:
            self._events.append(Event(self.time, self._phase, kind, value))

    def _sample(self) -> None:
        place, attitude = self._latest["LOCAL_POSITION_NED"], self._latest["ATTITUDE"]
        target, aim = self._latest["POSITION_TARGET_LOCAL_NED"], self._latest["ATTITUDE_TARGET"]
        self._rows.append(
            [
                self.time,
                *self._to_own(place.x, place.y), place.z,
                *self._to_own(place.vx, place.vy), place.vz,
                attitude.roll, attitude.pitch, self.yaw,
                attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed,
                aim.thrust,
                *self._to_own(target.x, target.y), target.z,
                *self._to_own(target.vx, target.vy), target.vz,
                _wrap(target.yaw - self._heading),
            ]
        )  # fmt: skip


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)
