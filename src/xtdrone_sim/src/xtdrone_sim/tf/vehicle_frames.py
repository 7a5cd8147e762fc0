"""TF frames of a vehicle: ``VEHICLE/LINK`` for every link of its URDF, and the frames of its sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from xtdrone_common.poses import OPTICAL_FRAME, Pose, compose, from_axis_angle
from xtdrone_sim.vehicles.mounts.body_sensors import ImuMount, UwbMount
from xtdrone_sim.vehicles.vehicle_model import VehicleModel
from xtdrone_worlds.worlds.urdf import FIXED


class Frame(NamedTuple):
    """A frame and its pose in its parent frame.

    Attributes:
        parent, child: frame names.
        pose: pose of the child in the parent.
    """

    parent: str
    child: str
    pose: Pose


class RobotFrames:
    """The frames of one vehicle.

    Attributes:
        body: frame of the root link.
        fixed: frames fixed in their parents, including those of joints without a published angle, at 0.
    """

    def __init__(self, name: str, model: VehicleModel) -> None:
        """Derive the frames from the vehicle's description.

        Args:
            name: name of the vehicle, e.g. ``typhoon_h480_0``.
            model: model of its type.
        """
        urdf = model.urdf
        gimbal = model.gimbal.joints if model.gimbal else ()
        told = {joint.name for joint in (*gimbal, *model.landing_gear)}
        self.body = f"{name}/{urdf.root}"
        self._name = name
        self._turning = {joint.name: joint for joint in urdf.joints if joint.kind != FIXED and joint.name in told}
        still = [joint for joint in urdf.joints if joint.name not in self._turning]
        self.fixed = [Frame(f"{name}/{joint.parent}", f"{name}/{joint.child}", joint.pose) for joint in still]
        links = {link.name for link in urdf.links}
        for camera in model.cameras:
            for frame, pose in camera.eyes:
                if frame not in links:
                    optical = compose(pose, OPTICAL_FRAME)
                    self.fixed.append(Frame(f"{name}/{camera.link}", f"{name}/{frame}", optical))
        body_sensors: tuple[ImuMount | UwbMount, ...] = (*model.imus, *model.uwb)
        for sensor in body_sensors:
            if sensor.frame not in links:
                self.fixed.append(Frame(self.body, f"{name}/{sensor.frame}", sensor.pose))
        for lidar in model.lidars:
            if lidar.frame not in links:
                self.fixed.append(Frame(f"{name}/{lidar.link}", f"{name}/{lidar.frame}", lidar.pose))

    def at_rest(self) -> list[Frame]:
        """Return the frames of moving joints, with all joints at 0."""
        return self.at_angles(dict.fromkeys(self._turning, 0.0))

    def at_angles(self, angles: Mapping[str, float]) -> list[Frame]:
        """Return the frames of moving joints.

        Args:
            angles: joint angles by name, rad; frames of other joints are omitted.
        """
        frames = []
        for name, angle in angles.items():
            joint = self._turning.get(name)
            if joint is not None:
                pose = compose(joint.pose, Pose(orientation=from_axis_angle(joint.axis, angle)))
                frames.append(Frame(f"{self._name}/{joint.parent}", f"{self._name}/{joint.child}", pose))
        return frames
