"""Sensors that a vehicle's YAML mounts on its body, in the lists ``imus:`` and ``uwb:``, and the reader of such lists.

UWB sensors measure ranges to those of other vehicles; the IMUs are additional to that of the autopilot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_common.settings import Settings, setting
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import MountError, check_sensor_name


@dataclass(frozen=True)
class BodySensor(Settings):
    """A sensor on a link of a vehicle, its body unless a kind has a setting for it; each kind has its own name."""

    name: str = setting("", check=check_sensor_name, text="the topic is ``/VEHICLE/NAME``")
    frame_id: str = setting("", text="its frame, x ahead, ``VEHICLE/`` is prefixed; empty: NAME_frame")
    position: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-10.0, high=10.0, unit="m", text="position in its link"
    )
    rpy: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad", text="roll, pitch, yaw in its link"
    )

    @property
    def frame(self) -> str:
        """Name of its frame without ``VEHICLE/``."""
        return self.frame_id or f"{self.name.replace('/', '_')}_frame"

    @property
    def pose(self) -> Pose:
        """Pose in its link."""
        return Pose(self.position, from_euler(*self.rpy))


Mount = TypeVar("Mount", bound=BodySensor)


def read_list(
    entries: Any, kind: str, mount: type[Mount], prepare: Callable[[Mapping[str, Any], str], Mapping[str, Any]] | None
) -> tuple[Mount, ...]:
    """Return the sensors of a list.

    Args:
        entries: content of the list; None for none.
        kind: name of the list.
        mount: class of its entries.
        prepare: returns the values of an entry; its second argument is the place for messages, such as ``imus, number
            2``. None: they are those of the entry.

    Raises:
        MountError: not a list of mappings, an invalid entry, or a name or frame given twice.
    """
    if not isinstance(entries or [], list):
        raise MountError(f"{kind}: {entries!r} is not allowed, a list")
    mounts = []
    for number, entry in enumerate(entries or [], start=1):
        where = f"{kind}, number {number}"
        if not isinstance(entry, Mapping):
            raise MountError(f"{where}: {entry!r} is not allowed, a mapping")
        try:
            mounts.append(mount.from_mapping(prepare(entry, where) if prepare else entry, where))
        except ValueError as error:
            text = str(error)
            raise MountError(text if text.startswith(where) else f"{where}: {text}") from error
    for what, values in (("name", [m.name for m in mounts]), ("frame_id", [m.frame for m in mounts])):
        for value in values:
            if values.count(value) > 1:
                raise MountError(f"{kind}: {what} {value!r} is given {values.count(value)} times")
    return tuple(mounts)


FASTEST_IMU = 250.0
"""Hz: one sample for each step of the simulation."""


@dataclass(frozen=True)
class ImuMount(BodySensor):
    """An IMU: an entry of the list ``imus:``. Noise densities are those of data sheets."""

    name: str = setting("imu_gazebo", check=check_sensor_name, text="the topic is ``/VEHICLE/NAME``, sensor_msgs/Imu")
    rate: float = setting(FASTEST_IMU, low=1.0, high=FASTEST_IMU, unit="Hz", text="samples per simulated second")
    gyro_noise: float = setting(0.0, low=0.0, high=1.0, unit="rad/s/√Hz", text="noise density of the gyroscope")
    gyro_walk: float = setting(0.0, low=0.0, high=1.0, unit="rad/s²/√Hz", text="random walk of its bias")
    gyro_bias: float = setting(0.0, low=0.0, high=1.0, unit="rad/s", text="standard deviation of its first bias")
    accel_noise: float = setting(0.0, low=0.0, high=10.0, unit="m/s²/√Hz", text="noise density of the accelerometer")
    accel_walk: float = setting(0.0, low=0.0, high=10.0, unit="m/s³/√Hz", text="random walk of its bias")
    accel_bias: float = setting(0.0, low=0.0, high=10.0, unit="m/s²", text="standard deviation of its first bias")
    seed: int = setting(0, low=0, high=2**31 - 1, text="seed of the noise, together with vehicle and name")


def read_imus(imus: Any) -> tuple[ImuMount, ...]:
    """Return the IMUs of the YAML list ``imus:``.

    Args:
        imus: content of the list; None for none.

    Raises:
        MountError: an unknown or invalid field, or a name or frame given twice.
    """
    return read_list(imus, "imus", ImuMount, None)


LEAST_RATE, MOST_RATE = 0.1, 50.0  # Hz, of lidars and UWB sensors
SIGHT_NEEDED, SIGHT_BIASED, SIGHT_IGNORED = "needed", "biased", "ignored"


@dataclass(frozen=True)
class UwbMount(BodySensor):
    """A UWB sensor: an entry of the list ``uwb:``."""

    name: str = setting("uwb", check=check_sensor_name, text="the topic is ``/VEHICLE/NAME``")
    rate: float = setting(10.0, low=LEAST_RATE, high=MOST_RATE, unit="Hz", text="measurements per simulated second")
    range_max: float = setting(50.0, low=0.01, high=10_000.0, unit="m", text="farther neighbours are not measured")
    noise: float = setting(0.1, low=0.0, high=10.0, unit="m", text="standard deviation of a range, white")
    bias: float = setting(0.0, low=-10.0, high=10.0, unit="m", text="added to every range")
    dropouts: float = setting(0.0, low=0.0, high=1.0, text="share of the ranges that are lost at random")
    outliers: float = setting(0.0, low=0.0, high=1.0, text="share of the ranges that are outliers, over a longer path")
    outlier_excess: float = setting(
        1.0, low=0.0, high=1000.0, unit="m", text="mean of an outlier's excess, which has an exponential distribution"
    )
    line_of_sight: str = setting(
        SIGHT_NEEDED,
        choices=(SIGHT_NEEDED, SIGHT_BIASED, SIGHT_IGNORED),
        text="a range is lost (needed) or longer (biased) if the world, a person or another vehicle blocks it; "
        "ignored: no check",
    )
    blocked_bias: float = setting(
        0.5, low=0.0, high=100.0, unit="m", text="added to a range without line of sight (biased)"
    )
    blocked_noise: float = setting(
        0.3, low=0.0, high=100.0, unit="m", text="further standard deviation of a range without line of sight (biased)"
    )
    bearing: bool = setting(False, text="true: also measure azimuth and elevation of the neighbour")
    bearing_noise: float = setting(
        0.05, low=0.0, high=math.pi, unit="rad", text="standard deviation of azimuth and of elevation, white"
    )
    seed: int = setting(0, low=0, high=2**31 - 1, text="seed of all random numbers, together with vehicle and name")


def read_uwb(sensors: Any) -> tuple[UwbMount, ...]:
    """Return the sensors of the YAML list ``uwb:``.

    Args:
        sensors: content of the list; None for none.

    Raises:
        MountError: an unknown or invalid field, or a name or frame given twice.
    """
    return read_list(sensors, "uwb", UwbMount, None)
