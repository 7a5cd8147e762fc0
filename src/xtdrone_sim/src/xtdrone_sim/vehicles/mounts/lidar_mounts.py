"""Lidars that a vehicle's YAML mounts on the links of its URDF."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_common.settings import SettingError, setting
from xtdrone_sim.vehicles.mounts.body_sensors import LEAST_RATE, MOST_RATE, BodySensor, read_list
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import MountError, check_sensor_name
from xtdrone_worlds.worlds.urdf import Description

KINDS = ("scan", "spinning", "pattern")
ROSETTE = "rosette"
MOST_RAYS = 1_000_000
"""Largest number of rays of one scan."""


@dataclass(frozen=True)
class LidarMount(BodySensor):
    """A lidar on a link of a vehicle: an entry of the list ``lidars:``."""

    name: str = setting("scan", check=check_sensor_name, text="the topic is ``/VEHICLE/NAME``")
    link: str = setting("base_link", text="link of the URDF that carries it")
    kind: str = setting(
        "scan",
        choices=KINDS,
        text="scan: one plane, LaserScan; spinning: several planes, PointCloud2; pattern: PointCloud2 of directions "
        "that do not repeat",
    )
    rate: float = setting(10.0, low=LEAST_RATE, high=MOST_RATE, unit="Hz", text="scans per simulated second")
    samples: int = setting(512, low=1, high=MOST_RAYS, text="rays of a plane; of a pattern, rays of a scan")
    angle_min: float = setting(-math.pi, low=-math.pi, high=math.pi, unit="rad", text="first ray, angle about z from x")
    angle_max: float = setting(
        math.pi,
        low=-math.pi,
        high=math.pi,
        unit="rad",
        text="last ray of a scan; end of a spinning lidar's turn, where the next one begins",
    )
    channels: int = setting(16, low=1, high=256, text="planes of a spinning lidar")
    vertical_min: float = setting(
        math.radians(-15.0), low=-0.5 * math.pi, high=0.5 * math.pi, unit="rad", text="lowest plane, ring 0"
    )
    vertical_max: float = setting(
        math.radians(15.0), low=-0.5 * math.pi, high=0.5 * math.pi, unit="rad", text="highest plane"
    )
    pattern: str = setting(
        ROSETTE, text="``rosette``, or a CSV file beside the YAML with time (s), azimuth and zenith angle (deg) per ray"
    )
    half_angle: float = setting(
        math.radians(35.2), low=0.01, high=1.5, unit="rad", text="half the field of view of a rosette"
    )
    range_min: float = setting(0.2, low=0.0, high=1000.0, unit="m", text="nearer returns are lost")
    range_max: float = setting(30.0, low=0.01, high=1000.0, unit="m", text="farther returns are lost")
    noise: float = setting(0.0, low=0.0, high=10.0, unit="m", text="standard deviation of a range, white")
    resolution: float = setting(0.0, low=0.0, high=10.0, unit="m", text="ranges are multiples of it; 0: any")
    dropouts: float = setting(0.0, low=0.0, high=1.0, text="share of the returns that are lost at random")
    seed: int = setting(0, low=0, high=2**31 - 1, text="seed of noise and dropouts, together with vehicle and name")
    skew: bool = setting(
        True, text="cast each ray from the lidar's pose at the ray's time; false: all at the beginning of the scan"
    )

    def __post_init__(self) -> None:
        """Check combinations of settings as well.

        Raises:
            SettingError: a value is not allowed.
        """
        super().__post_init__()
        for low, high in (("angle_min", "angle_max"), ("vertical_min", "vertical_max"), ("range_min", "range_max")):
            if not getattr(self, low) <= getattr(self, high) or (
                low == "range_min" and self.range_min >= self.range_max
            ):
                raise SettingError(high, getattr(self, high), f"more than {low}, which is {getattr(self, low):g}")
        if self.kind == "spinning" and self.samples * self.channels > MOST_RAYS:
            raise SettingError(
                "samples", self.samples, f"at most {MOST_RAYS // self.channels} with {self.channels} channels"
            )

    @property
    def pattern_file(self) -> Path:
        """The file of its pattern."""
        return Path(self.pattern)

    @property
    def duration(self) -> float:
        """Time from the first ray of a scan to the first one of the next, s; 0 without skew."""
        return 1.0 / self.rate if self.skew else 0.0


def read_lidars(lidars: Any, urdf: Description, folder: Path) -> tuple[LidarMount, ...]:
    """Return the lidars of the YAML list ``lidars:``.

    Args:
        lidars: content of the list; None for no lidars.
        urdf: the vehicle's links.
        folder: folder of the YAML; pattern files are relative to it.

    Raises:
        MountError: missing, unknown or invalid field, unknown link, missing file, or duplicate name or frame.
    """

    def prepare(entry: Mapping[str, Any], where: str) -> Mapping[str, Any]:
        if "name" not in entry:
            raise MountError(f"{where}: field 'name' is missing")
        urdf.link(entry.get("link", LidarMount.link))
        pattern = entry.get("pattern", ROSETTE)
        if not isinstance(pattern, str) or pattern == ROSETTE:
            return entry
        file = folder / Path(pattern).expanduser()
        if not file.is_file():
            raise MountError(f"{where}: pattern: {file} is not a file; {ROSETTE}, or a CSV file, is allowed")
        return {**entry, "pattern": str(file)}

    return read_list(lidars, "lidars", LidarMount, prepare)
