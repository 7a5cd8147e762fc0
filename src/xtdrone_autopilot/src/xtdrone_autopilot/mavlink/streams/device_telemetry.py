"""Telemetry of devices: motors, further sensors, gimbal, pilot input, as PX4 v1.14's streams have it."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.manual_control import CHANNELS
from xtdrone_autopilot.mavlink.streams.vehicle_state import Values, VehicleState, round_within
from xtdrone_autopilot.navigator import gimbal_manager
from xtdrone_common import rotation

_ESC_BATCH = 4  # ESCs in one message
_ESC_BUS = 2  # ESC_CONNECTION_TYPE_ONESHOT
_ESC_COLD, _ESC_WARMING = 20.0, 40.0  # deg C
_UINT16 = 65535
_FULL_SIGNAL = 100  # % of RC_CHANNELS.rssi
_NAN = math.nan
GIMBAL_DEVICE = 1  # id of a gimbal driven by the autopilot, not a MAVLink device
GIMBAL_CAPABILITIES = (
    mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_NEUTRAL
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_ROLL_LOCK
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_PITCH_AXIS
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_PITCH_LOCK
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_YAW_AXIS
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_YAW_FOLLOW
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_HAS_YAW_LOCK
    | mavlink.GIMBAL_MANAGER_CAP_FLAGS_CAN_POINT_LOCATION_GLOBAL
)
GIMBAL_RANGE = (0.0, 0.0, -0.5 * math.pi, 0.5 * math.pi, -math.pi, math.pi)  # rad, limits of roll, pitch, yaw
_LASER, _DOWNWARD = 0, 25  # MAV_DISTANCE_SENSOR, MAV_SENSOR_ORIENTATION
_FLOW_SPAN_US = 20_000
_SENSOR_TIMEOUT_US = 500_000


class DeviceTelemetry:
    """Messages on the devices of one vehicle; the name of a method is that of its message in lower case."""

    def __init__(self, vehicle: VehicleState) -> None:
        """Build the messages from ``vehicle``."""
        self._vehicle = vehicle

    def _batches(self, values: list[float]) -> list[list[float]]:
        """Return one value for each motor in batches of four, padded with zeros."""
        count = self._vehicle.rotor_count
        kept = [*values[:count], *[0.0] * (len(values) - count)]
        return [kept[start : start + _ESC_BATCH] for start in range(0, max(count, 1), _ESC_BATCH)]

    def esc_info(self) -> list[Values]:
        """Return ESC_INFO: healthy ESCs, with the temperatures that PX4's SITL derives from the motor commands."""
        time_us, count = self._vehicle.time_us, self._vehicle.rotor_count
        head = time_us, *[0] * 4, time_us // 4000 & _UINT16, *[0] * 4
        commands = [max(0.0, command) for command in self._vehicle.control["actuators"].tolist()]  # NaN becomes 0
        online = (1 << count) - 1 & 0xFF
        found: list[Values] = []
        for number, batch in enumerate(self._batches(commands)):
            temperatures = [round(100.0 * (_ESC_COLD + _ESC_WARMING * command)) for command in batch]
            found.append((*head, *temperatures, _ESC_BATCH * number, count, _ESC_BUS, online))
        return found

    def esc_status(self) -> list[Values]:
        """Return ESC_STATUS: speed (rev/min), voltage (V) and current (A) of each motor."""
        voltage = self._vehicle.commander.battery.voltage
        speeds = self._batches(self._vehicle.sensors["esc_rpm"].tolist())
        currents = self._batches(self._vehicle.sensors["esc_current"].tolist())
        return [
            (self._vehicle.time_us, *map(round, speeds[i]), *[voltage] * _ESC_BATCH, *currents[i], _ESC_BATCH * i)
            for i in range(len(speeds))
        ]

    def actuator_control_target(self) -> Values:
        """Return ACTUATOR_CONTROL_TARGET: torque (normalised, FRD) and collective thrust demanded of the allocator."""
        c = self._vehicle.control
        return self._vehicle.time_us, *c["sp_torque"].tolist(), float(c["sp_thrust"]), 0.0, 0.0, 0.0, 0.0, 0

    def actuator_output_status(self) -> Values:
        """Return ACTUATOR_OUTPUT_STATUS: motor commands, 0..1."""
        motors = self._vehicle.control["actuators"].tolist()
        return self._vehicle.time_us, self._vehicle.rotor_count, *motors, *[0.0] * (32 - len(motors))

    def vibration(self) -> Values:
        """Return VIBRATION: PX4's vibration metrics; the simulated accelerometers never clip."""
        return self._vehicle.time_us, *self._vehicle.estimator["vibration"]["metrics"].tolist(), 0, 0, 0

    def distance_sensor(self) -> Values | None:
        """Return DISTANCE_SENSOR: the downward range finder, cm, while its samples are recent."""
        s, quality = self._vehicle.sensors, int(self._vehicle.sensors["range_quality"])
        if not self._is_recent("time_range_us"):
            return None
        fields = ("range_least", "range_largest", "range_distance")
        distances = [round_within(100.0 * float(s[field]), 0, _UINT16) for field in fields]
        signal = 0 if quality < 0 else max(quality, 1)  # 0 means unknown, 1 invalid
        return self._vehicle.time_ms, *distances, _LASER, 0, _DOWNWARD, 0, *[0.0] * 6, signal

    def optical_flow_rad(self) -> Values | None:
        """Return OPTICAL_FLOW_RAD while samples are recent: angles over ``_FLOW_SPAN_US`` at the last rates."""
        if not self._is_recent("time_flow_us"):
            return None
        s, span = self._vehicle.sensors, _FLOW_SPAN_US * 1e-6
        flow, gyro = ([rate * span for rate in s[field].tolist()] for field in ("flow_rate", "flow_gyro"))
        distance = float(s["range_distance"]) if self._is_recent("time_range_us") else -1.0
        quality = round_within(int(s["flow_quality"]), 0, 255)
        return self._vehicle.time_us, _FLOW_SPAN_US, *flow, *gyro, _NAN, 0, distance, 0, 0, quality

    def _is_recent(self, field: str) -> bool:
        """Return whether a sensor's last sample, its time in the estimator's ``field``, is less than 0.5 s old."""
        last = int(self._vehicle.estimator[field])
        return last > 0 and self._vehicle.time_us - last < _SENSOR_TIMEOUT_US

    def mount_orientation(self) -> Values | None:
        """Return MOUNT_ORIENTATION: gimbal attitude, degrees, yaw relative to the heading and to north."""
        attitude = self._vehicle.commander.navigator.payload.gimbal_attitude
        if attitude is None:
            return None
        roll, pitch, yaw = (math.degrees(angle) for angle in attitude)
        return self._vehicle.time_ms, roll, pitch, yaw, (yaw + math.degrees(self._vehicle.commander.view.yaw)) % 360.0

    def gimbal_device_attitude_status(self) -> Values | None:
        """Return GIMBAL_DEVICE_ATTITUDE_STATUS: q (w, x, y, z), yaw relative to the heading, or to north if locked."""
        payload = self._vehicle.commander.navigator.payload
        attitude = payload.gimbal_attitude
        if attitude is None:
            return None
        flags, heading = payload.gimbal_manager.flags, self._vehicle.commander.view.yaw
        locked = bool(flags & gimbal_manager.YAW_LOCK)
        roll, pitch, yaw = attitude
        q = rotation.from_euler(roll, pitch, yaw + heading if locked else yaw)
        flags |= gimbal_manager.YAW_IN_EARTH_FRAME if locked else gimbal_manager.YAW_IN_VEHICLE_FRAME
        return self._vehicle.time_ms, *q, _NAN, _NAN, _NAN, 0, flags, 0, 0, heading, _NAN, GIMBAL_DEVICE

    def gimbal_manager_status(self) -> Values | None:
        """Return GIMBAL_MANAGER_STATUS: the systems with primary and secondary control."""
        payload = self._vehicle.commander.navigator.payload
        if payload.gimbal_attitude is None:
            return None
        manager = payload.gimbal_manager
        return self._vehicle.time_ms, manager.flags, GIMBAL_DEVICE, *manager.primary, *manager.secondary

    def gimbal_manager_information(self) -> Values | None:
        """Return GIMBAL_MANAGER_INFORMATION: capabilities, as of PX4's driver for a gimbal without MAVLink."""
        if self._vehicle.commander.navigator.payload.gimbal_attitude is None:
            return None
        return self._vehicle.time_ms, GIMBAL_CAPABILITIES, *GIMBAL_RANGE, GIMBAL_DEVICE

    def rc_channels(self) -> Values | None:
        """Return RC_CHANNELS: pulse widths, us, while a radio is in use."""
        manual = self._vehicle.commander.manual
        channels = manual.channels
        if not channels or not manual.by_radio:
            return None
        pulses = [*channels, *[_UINT16] * (CHANNELS - len(channels))]
        return self._vehicle.time_ms, *pulses, len(channels), _FULL_SIGNAL

    def manual_control(self) -> Values | None:
        """Return MANUAL_CONTROL: stick positions, -1000..1000, throttle 0..1000."""
        sticks = self._vehicle.commander.manual.sticks
        if sticks is None:
            return None
        x, y, yaw = (round(1000.0 * value) for value in (sticks.x, sticks.y, sticks.yaw))
        system = self._vehicle.commander.vehicle.system_id
        return x, y, round(500.0 * (sticks.z + 1.0)), yaw, 0, system, *[0] * 10
