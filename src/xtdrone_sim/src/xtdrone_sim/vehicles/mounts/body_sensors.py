"""Base class of the sensors that a vehicle's YAML mounts on its body: name, frame and pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

from xtdrone_control.rotation import from_euler
from xtdrone_control.settings import Settings, setting
from xtdrone_sim.shapes.visual import Pose
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import check_sensor_name


@dataclass(frozen=True)
class BodySensor(Settings):
    """A sensor on the body of a vehicle; each kind has a ``name`` of its own."""

    name: str = setting("", check=check_sensor_name, text="the topic is ``/VEHICLE/NAME``")
    frame_id: str = setting("", text="its frame, x ahead, ``VEHICLE/`` is prefixed; empty: NAME_frame")
    position: tuple[float, float, float] = setting((0.0, 0.0, 0.0), low=-10.0, high=10.0, unit="m", text="in the body")
    rpy: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad", text="roll, pitch, yaw in the body"
    )

    @property
    def frame(self) -> str:
        """Name of its frame without ``VEHICLE/``."""
        return self.frame_id or f"{self.name.replace('/', '_')}_frame"

    @property
    def pose(self) -> Pose:
        """Pose in the body."""
        return Pose(self.position, from_euler(*self.rpy))
