"""Attitude and inertial, magnetic and pressure sensors, in ENU and FLU."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import common as mavlink
from sensor_msgs.msg import FluidPressure, Imu, MagneticField, Temperature

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas

_GAUSS_TO_TESLA = 1e-4
_CENTIDEGREE = 0.01  # degrees C

# Groups of HIGHRES_IMU.fields_updated
_ACCEL_GYRO = (
    mavlink.HIGHRES_IMU_UPDATED_XACC
    | mavlink.HIGHRES_IMU_UPDATED_YACC
    | mavlink.HIGHRES_IMU_UPDATED_ZACC
    | mavlink.HIGHRES_IMU_UPDATED_XGYRO
    | mavlink.HIGHRES_IMU_UPDATED_YGYRO
    | mavlink.HIGHRES_IMU_UPDATED_ZGYRO
)
_MAG = mavlink.HIGHRES_IMU_UPDATED_XMAG | mavlink.HIGHRES_IMU_UPDATED_YMAG | mavlink.HIGHRES_IMU_UPDATED_ZMAG


class ImuPlugin(Plugin):
    """MAVROS's imu: ``imu/data`` at the rate of ATTITUDE_QUATERNION, with the latest acceleration of HIGHRES_IMU.

    Pressures are in hPa, HIGHRES_IMU's unit, although sensor_msgs/FluidPressure is defined in Pa: MAVROS passes them
    on unscaled (imu.cpp, handle_highres_imu), and programs written for it expect that.
    """

    name = "imu"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topics."""
        super().__init__(uas)
        get = uas.params.get
        frame = get("imu/frame_id", "base_link")
        gyro = _covariance(get("imu/angular_velocity_stdev", 0.0003490659))
        self._accel = _covariance(get("imu/linear_acceleration_stdev", 0.0003))
        self._no_accel = [-1.0, *self._accel[1:]]  # sensor_msgs/Imu: the field is unknown

        self._data = uas.topic("imu/data", Imu())
        self._raw = uas.topic("imu/data_raw", Imu())
        self._mag = uas.topic("imu/mag", MagneticField())
        self._temperature = uas.topic("imu/temperature_imu", Temperature())
        self._temperature_baro = uas.topic("imu/temperature_baro", Temperature())
        self._static = uas.topic("imu/static_pressure", FluidPressure())
        self._differential = uas.topic("imu/diff_pressure", FluidPressure())
        highres = (self._raw, self._mag, self._temperature, self._static, self._differential)
        for topic in (self._data, self._temperature_baro, *highres):
            topic.message.header.frame_id = frame
        self._data.message.orientation_covariance = _covariance(get("imu/orientation_stdev", 1.0))
        self._raw.message.orientation_covariance = _covariance(0.0)
        self._raw.message.linear_acceleration_covariance = self._accel
        self._data.message.angular_velocity_covariance = self._raw.message.angular_velocity_covariance = gyro
        self._mag.message.magnetic_field_covariance = _covariance(get("imu/magnetic_stdev", 0.0))
        self.messages = {
            "ATTITUDE_QUATERNION": Feed(self._on_attitude, self._data),
            "HIGHRES_IMU": [Feed(self._on_highres, *highres), Feed(None, self._data)],
            "SCALED_PRESSURE": Feed(self._on_scaled_pressure, self._temperature_baro),
        }

    def _on_attitude(self, message: Any) -> None:
        attitude = self.uas.attitude()
        if attitude is None:
            return
        data = self._data.message
        orientation, rate = data.orientation, data.angular_velocity
        (orientation.w, orientation.x, orientation.y, orientation.z), (rate.x, rate.y, rate.z) = attitude
        self.uas.stamp(data.header, message.time_boot_ms)
        highres = self.uas.latest("HIGHRES_IMU")
        if highres is None:
            data.linear_acceleration_covariance = self._no_accel
        else:
            data.linear_acceleration_covariance = self._accel
            _set(data.linear_acceleration, highres.xacc, highres.yacc, highres.zacc)
        self._data.publish(data)

    def _on_highres(self, highres: Any) -> None:
        stamp, updated = self.uas.stamp_us, highres.fields_updated
        if self._raw.needed and updated & _ACCEL_GYRO:
            raw = self._raw.message
            stamp(raw.header, highres.time_usec)
            _set(raw.angular_velocity, highres.xgyro, highres.ygyro, highres.zgyro)
            _set(raw.linear_acceleration, highres.xacc, highres.yacc, highres.zacc)
            self._raw.publish(raw)
        if self._mag.needed and updated & _MAG:
            mag = self._mag.message
            stamp(mag.header, highres.time_usec)
            scale = _GAUSS_TO_TESLA
            _set(mag.magnetic_field, highres.xmag * scale, highres.ymag * scale, highres.zmag * scale)
            self._mag.publish(mag)
        if self._static.needed and updated & mavlink.HIGHRES_IMU_UPDATED_ABS_PRESSURE:
            self._publish_pressure(self._static, highres.time_usec, highres.abs_pressure)
        if self._differential.needed and updated & mavlink.HIGHRES_IMU_UPDATED_DIFF_PRESSURE:
            self._publish_pressure(self._differential, highres.time_usec, highres.diff_pressure)
        if self._temperature.needed and updated & mavlink.HIGHRES_IMU_UPDATED_TEMPERATURE:
            temperature = self._temperature.message
            stamp(temperature.header, highres.time_usec)
            temperature.temperature = highres.temperature
            self._temperature.publish(temperature)

    def _publish_pressure(self, topic: Any, time_us: int, hectopascal: float) -> None:
        message = topic.message
        self.uas.stamp_us(message.header, time_us)
        message.fluid_pressure = hectopascal
        topic.publish(message)

    def _on_scaled_pressure(self, pressure: Any) -> None:
        message = self._temperature_baro.message
        self.uas.stamp(message.header, pressure.time_boot_ms)
        message.temperature = pressure.temperature * _CENTIDEGREE
        self._temperature_baro.publish(message)


def _set(message: Any, x: float, y: float, z: float) -> None:
    message.x, message.y, message.z = frames.frd_to_flu(x, y, z)


def _covariance(stdev: float) -> list[float]:
    """Return a 3x3 covariance, row by row: the variance on the diagonal, or "unknown" (-1) for a deviation of 0."""
    variance = stdev * stdev
    if variance == 0.0:
        return [-1.0, *[0.0] * 8]
    return [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance]
