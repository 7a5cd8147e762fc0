"""A stand-in for PX4 on its simulator link, written from PX4's side: simulator_mavlink of v1.14.

It connects to the simulator, sends a heartbeat and requests HIL_STATE_QUATERNION, takes its time from HIL_SENSOR (it
starts at 0 with the first one), receives nothing of the world but HIL_SENSOR and HIL_GPS, and answers every HIL_SENSOR
with HIL_ACTUATOR_CONTROLS. pymavlink's own parser and packer are used. The firmware is our autopilot's.

As a program, ``px4_stand_in.py TYPE INSTANCE``, it is PX4 as ``px4 -i INSTANCE`` starts it: with MAVLink on PX4's stock
ports, until the simulator ends.
"""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.autopilot import Autopilot
from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_common import modes
from xtdrone_common.fleet import Vehicle
from xtdrone_sim.vehicles.vehicle_model import load_vehicle

WALL_LIMIT = 120.0  # s; only a broken run takes so long
ACCEL, GYRO, MAG, BARO = 0b111, 0b111000, 0b111000000, 0b1101000000000


class Firmware:
    """Our autopilot on one vehicle, fed by HIL messages."""

    def __init__(self, vehicle: Vehicle) -> None:
        model = load_vehicle(vehicle.type)
        own = {"EKF2_MAG_DECL": 3.0, "CBRK_SUPPLY_CHK": 894281, "MPC_TKO_RAMP_T": 1.0}
        parameters = Parameters({**model.parameters, **own})
        self.autopilot = Autopilot([model.rotor_layout], None)
        parameters.write_to(self.autopilot.params[0])
        self.commander = Commander(vehicle, self.autopilot, parameters, 0)
        self.autopilot.start_control()
        self._sensors = self.autopilot.sensors[0]

    def gps(self, message: Any) -> None:
        s = self._sensors
        s["gps_fresh"], s["gps_fix"], s["gps_satellites"] = 1, message.fix_type, message.satellites_visible
        s["gps_lat"], s["gps_lon"], s["gps_alt"] = message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3
        s["gps_vel"] = message.vn * 1e-2, message.ve * 1e-2, message.vd * 1e-2
        s["gps_eph"], s["gps_epv"], s["gps_speed_accuracy"] = message.eph * 1e-2, message.epv * 1e-2, 0.1

    def step(self, message: Any, time_us: int) -> tuple[list[float], bool]:
        """Run on one HIL_SENSOR at PX4's time; return outputs and whether armed."""
        s, fields = self._sensors, message.fields_updated
        s["time_us"] = time_us
        s["accel"] = message.xacc, message.yacc, message.zacc
        s["gyro"] = message.xgyro, message.ygyro, message.zgyro
        s["mag_fresh"] = fields & MAG == MAG
        s["mag"] = message.xmag, message.ymag, message.zmag
        s["baro_fresh"] = fields & BARO == BARO
        s["baro_pressure"], s["baro_alt"] = message.abs_pressure * 100.0, message.pressure_alt
        s["baro_temperature"] = message.temperature
        self.autopilot.step()
        s["gps_fresh"] = 0
        if self.autopilot.time_us % 100_000 == 0:
            self.commander.update()
        outputs = [float(value) for value in self.autopilot.control[0]["actuators"]]
        return outputs, bool(self.autopilot.setpoint[0]["armed"])


class StockVehicle(Vehicle):
    """A vehicle with the ports of PX4's own start scripts (px4-rc.mavlink)."""

    @property
    def offboard_local_port(self) -> int:
        return 14580 + self.id

    @property
    def offboard_remote_port(self) -> int:
        return 14540 + self.id


class StandIn:
    """PX4 in its own thread.

    Attributes:
        received: every message with its fields, in order, for the first ``keep`` steps.
        sent: (time of HIL_SENSOR, outputs) of every answer.
        error: the exception that ended the thread, if any.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        script: dict[int, Callable[[StandIn], None]] | None = None,
        *,
        keep: int = 1000,
        lockstep: bool = True,
        mavlink_ports: bool = False,
    ) -> None:
        """Connect and run.

        Args:
            vehicle: the vehicle that this PX4 flies.
            script: actions by PX4's time, microseconds.
            keep: number of steps whose messages are kept.
            lockstep: whether PX4 is built with the lockstep scheduler.
            mavlink_ports: serve MAVLink at the vehicle's ports.
        """
        self.firmware = Firmware(vehicle)
        firmware = self.firmware
        self._door = MavlinkServer([vehicle], firmware.autopilot, [firmware.commander]) if mavlink_ports else None
        self.silent = False
        self.received: list[Any] = []
        self.sent: list[tuple[int, tuple[float, ...]]] = []
        self.error: Exception | None = None
        self._script = dict(script or {})
        self._keep = keep
        self._flags = 1 if lockstep else 0
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = False
        self._packer = mavlink.MAVLink(None, srcSystem=vehicle.system_id, srcComponent=1)
        self._first_us: int | None = None
        self._socket = socket.create_connection(("127.0.0.1", vehicle.simulator_tcp_port), timeout=WALL_LIMIT)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.port = self._socket.getsockname()[1]
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def commander(self) -> Commander:
        return self.firmware.commander

    def take_off(self) -> None:
        """Arm and take off, as on a ground station's command."""
        assert self.commander.request(modes.AUTO_TAKEOFF) == 0
        assert self.commander.arm_disarm(True) == 0

    def kill(self) -> None:
        """End at once, as after kill -9."""
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(WALL_LIMIT)
        self._socket.close()

    def check(self) -> None:
        """Raise the exception that ended the thread."""
        if self.error is not None:
            raise self.error

    def _send(self, message: Any) -> None:
        self._socket.sendall(message.pack(self._packer))

    def _run(self) -> None:
        try:
            self._send(mavlink.MAVLink_heartbeat_message(0, 12, 0, 0, 0, 3))
            self._send(
                mavlink.MAVLink_command_long_message(0, 0, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, 115, 5e3, *[0] * 5)
            )
            while data := self._socket.recv(4096):
                for message in self._parser.parse_buffer(data) or []:
                    self._take(message)
        except OSError:
            pass  # killed, or the simulator has ended
        except Exception as error:
            self.error = error
            self._socket.close()

    def _take(self, message: Any) -> None:
        if len(self.sent) < self._keep:
            self.received.append(message)
        kind = message.get_type()
        if kind == "HIL_GPS":
            self.firmware.gps(message)
        elif kind == "HIL_SENSOR":
            self._answer(message)

    def _answer(self, message: Any) -> None:
        if self._first_us is None:
            self._first_us = message.time_usec
        now = message.time_usec - self._first_us
        if now in self._script:
            self._script.pop(now)(self)
        outputs, armed = self.firmware.step(message, now)
        if self._door is not None:
            self._door.receive(0.0)
            self._door.send_streams(now)
        if self._keep:
            self.sent.append((message.time_usec, tuple(outputs)))
        if self.silent:
            return
        mode = 1 | (128 if armed else 0)
        controls = [value if armed else 0.0 for value in outputs] + [0.0] * (16 - len(outputs))
        self._send(mavlink.MAVLink_hil_actuator_controls_message(now, controls, mode, self._flags))

    def wait(self) -> None:
        """Wait until the simulator ends."""
        self._thread.join()
        self.check()


if __name__ == "__main__":
    StandIn(StockVehicle(sys.argv[1], int(sys.argv[2]), int(sys.argv[2])), keep=0, mavlink_ports=True).wait()
