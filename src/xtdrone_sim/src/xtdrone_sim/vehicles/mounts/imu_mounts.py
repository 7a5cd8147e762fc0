"""Additional IMUs that a vehicle's YAML mounts on its body, besides that of the autopilot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from xtdrone_control.settings import setting
from xtdrone_sim.vehicles.mounts.body_sensors import BodySensor
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import check_sensor_name
from xtdrone_sim.vehicles.mounts.sensor_lists import read_list, reader

MOST_RATE = 250.0
"""Hz: one sample for each step of the simulation."""


@dataclass(frozen=True)
class ImuMount(BodySensor):
    """An IMU: an entry of the list ``imus:``. Noise densities are those of data sheets."""

    name: str = setting("imu_gazebo", check=check_sensor_name, text="the topic is ``/VEHICLE/NAME``, sensor_msgs/Imu")
    rate: float = setting(MOST_RATE, low=1.0, high=MOST_RATE, unit="Hz", text="samples per simulated second")
    gyro_noise: float = setting(0.0, low=0.0, high=1.0, unit="rad/s/√Hz", text="noise density of the gyroscope")
    gyro_walk: float = setting(0.0, low=0.0, high=1.0, unit="rad/s²/√Hz", text="random walk of its bias")
    gyro_bias: float = setting(0.0, low=0.0, high=1.0, unit="rad/s", text="standard deviation of its first bias")
    accel_noise: float = setting(0.0, low=0.0, high=10.0, unit="m/s²/√Hz", text="noise density of the accelerometer")
    accel_walk: float = setting(0.0, low=0.0, high=10.0, unit="m/s³/√Hz", text="random walk of its bias")
    accel_bias: float = setting(0.0, low=0.0, high=10.0, unit="m/s²", text="standard deviation of its first bias")
    seed: int = setting(0, low=0, high=2**31 - 1, text="of the noise, together with vehicle and name")


def read_imus(imus: Any) -> tuple[ImuMount, ...]:
    """Return the IMUs of the YAML list ``imus:``.

    Args:
        imus: content of the list; None for none.

    Raises:
        MountError: an unknown or invalid field, or a name or frame given twice.
    """
    return read_list(imus, "imus", reader(ImuMount))
