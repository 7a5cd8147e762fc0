"""UWB sensors that a vehicle's YAML mounts on its body: they measure ranges to those of other vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from xtdrone_control.settings import setting
from xtdrone_sim.vehicles.mounts.body_sensors import BodySensor
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import check_sensor_name
from xtdrone_sim.vehicles.mounts.sensor_lists import read_list, reader

LEAST_RATE, MOST_RATE = 0.1, 50.0  # Hz
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
    seed: int = setting(0, low=0, high=2**31 - 1, text="of all random numbers, together with vehicle and name")


def read_uwb(sensors: Any) -> tuple[UwbMount, ...]:
    """Return the sensors of the YAML list ``uwb:``.

    Args:
        sensors: content of the list; None for none.

    Raises:
        MountError: an unknown or invalid field, or a name or frame given twice.
    """
    return read_list(sensors, "uwb", reader(UwbMount))
