"""ROS node for visual odometry of one vehicle ``T``; ``odometry_node`` lists the topics of every odometry.

=========================================  ==============================  ===========================================
topic (below /T/``~camera``/)              type                            meaning
=========================================  ==============================  ===========================================
color/image_raw, color/camera_info         sensor_msgs/Image, CameraInfo   in, ``~kind`` rgbd
depth/image_raw                            sensor_msgs/Image               in, rgbd: 32FC1 (m) or 16UC1 (mm), registered
left/, right/ image_raw, camera_info       sensor_msgs/Image, CameraInfo   in, ``~kind`` stereo: rectified
=========================================  ==============================  ===========================================

Two images form a pair if their stamps are equal.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import rospy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import depths_of
from xtdrone_common.pose_matrices import pose_of
from xtdrone_common.settings import setting
from xtdrone_perception.images import grey_of
from xtdrone_perception.slam.odometry_health import HealthLimits
from xtdrone_perception.slam.odometry_node import Job, OdometryNode, OdometryOptions, OdometrySource

from .camera_model import BodyCamera
from .corner_tracks import TrackSettings
from .pose_from_points import NoiseSettings
from .visual_odometry import KeyframeSettings, SeenPicture, VisualEstimate, VisualOdometry

_PARTS = {"rgbd": ("color", "depth"), "stereo": ("left", "right")}
_MOST_KEPT = 4  # images that wait for the other one of their pair
_LINK_TURN = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])  # optical frame to a camera's link (x ahead, z up)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class VisualOdometryOptions(OdometryOptions):
    """Private parameters of the node."""

    kind: str = setting("rgbd", choices=("rgbd", "stereo"), text="a depth camera with colours, or a stereo pair")
    camera: str = setting("realsense/depth_camera", text="name of the camera's topics below the vehicle's namespace")
    camera_position: tuple[float, float, float] = setting(
        (0.1, 0.0, 0.0), low=-10.0, high=10.0, unit="m",
        text="position in base_link of the camera, or of the centre of a stereo pair",
    )  # fmt: skip
    camera_rpy: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad",
        text="roll, pitch, yaw of the sensor in base_link",
    )  # fmt: skip
    pixel_centre: float = setting(
        0.5, low=0.0, high=0.5, unit="px",
        text="coordinate of the upper left pixel's centre in the camera's calibration: 0.5 for simulated cameras, 0 "
        "for cameras calibrated with OpenCV",
    )  # fmt: skip


@dataclass(frozen=True)
class VisualHealthLimits(HealthLimits):
    """Private parameters of the supervision of visual odometry."""

    least_information: float = setting(
        0.002, low=0.0, high=1.0, text="minimum information in the weakest direction, relative to the strongest"
    )
    most_residual: float = setting(5.0, above=0.0, high=100.0, text="maximum RMS of normalised residuals")


class VisualOdometryNode(OdometryNode):
    """Topics and state of one vehicle with a depth camera or a stereo pair."""

    def __init__(
        self,
        name: str,
        settings: VisualOdometryOptions,
        core: tuple[TrackSettings, NoiseSettings, KeyframeSettings],
        limits: HealthLimits,
    ) -> None:
        """Declare the topics.

        Args:
            name: Name of the vehicle.
            settings: Settings of the node.
            core: settings of corners, errors and keyframes.
            limits: Limits of the supervision.
        """
        super().__init__(name, OdometrySource("visual_odometry", "picture", core[2].least_points), settings, limits)
        self._settings, self._core_settings = settings, core
        base = f"/{name}/{settings.camera}"
        first, second = _PARTS[settings.kind]
        lockstep.Subscriber(f"{base}/{first}/camera_info", CameraInfo, partial(self._on_info, 0))
        if settings.kind == "stereo":
            lockstep.Subscriber(f"{base}/{second}/camera_info", CameraInfo, partial(self._on_info, 1))
        for index, part in enumerate((first, second)):
            lockstep.Subscriber(
                f"{base}/{part}/image_raw", Image, partial(self._on_image, index), queue_size=4, buff_size=2**24
            )

    def _clear(self) -> None:
        super()._clear()
        self._infos: list[CameraInfo | None] = [None, None]
        self._waiting: tuple[dict[int, Image], dict[int, Image]] = ({}, {})

    # messages

    def _on_info(self, index: int, message: CameraInfo) -> None:
        focal = np.array([message.P[0], message.P[5]])
        if np.isfinite(message.P).all() and (focal > 0.0).all():
            self._infos[index] = message
        else:
            rospy.logwarn_throttle(10.0, f"{self._name}: camera_info ignored: P: {list(message.P)} has no focal length")

    def _on_image(self, index: int, message: Image) -> None:
        stamp = message.header.stamp.to_nsec()
        mine, others = self._waiting[index], self._waiting[1 - index]
        mine[stamp] = message
        while len(mine) > _MOST_KEPT:
            del mine[min(mine)]
        if stamp in others:
            pair = (mine, others)[index][stamp], (others, mine)[index][stamp]
            self._on_pair(*pair)
            for kept in self._waiting:
                for old in [key for key in kept if key <= stamp]:
                    del kept[old]

    def _on_pair(self, first: Image, second: Image) -> None:
        is_stereo = self._settings.kind == "stereo"
        base = self._base()
        if self._infos[0] is None or (is_stereo and base is None):
            rospy.logwarn_throttle(10.0, f"{self._name}: no odometry: no usable camera_info of {self._settings.camera}")
            return
        end_ns = first.header.stamp.to_nsec()
        attitude = self._motion.attitude(end_ns)
        if attitude is None:
            self._warn_of_attitude()
            return
        try:
            grey = grey_of(first)
            depth, right = (None, grey_of(second)) if is_stereo else (depths_of(second, np.float32), None)
        except ValueError as error:
            rospy.logwarn_throttle(10.0, f"{self._name}: image ignored: {error}")
            return
        other = right if depth is None else depth
        if other is None or other.shape != grey.shape:
            rospy.logwarn_throttle(10.0, f"{self._name}: image ignored: the two images of a pair differ in size")
            return
        if not self._is_late():
            seen = SeenPicture(grey, attitude, end_ns * 1e-9, depth, right, base or 0.0)
            self._submit(seen, zlib.crc32(grey.tobytes()), end_ns)

    def _base(self) -> float | None:
        """Return focal length times baseline of the pair, px m; None if it is unknown."""
        info = self._infos[1]
        return None if info is None or not info.P[3] < 0.0 else -float(info.P[3])

    # odometry

    def _new_core(self, start: Array) -> VisualOdometry:
        info = self._infos[0]
        assert info is not None  # _on_pair has it
        base = self._base() if self._settings.kind == "stereo" else None
        focal = np.array([info.P[0], info.P[5]])
        centre = np.array([info.P[2], info.P[6]]) - self._settings.pixel_centre
        link = pose_of(self._settings.camera_position, Rotation.from_euler("xyz", self._settings.camera_rpy))
        left = pose_of((0.0, 0.5 * (base or 0.0) / focal[0], 0.0), _LINK_TURN)
        return VisualOdometry(BodyCamera(focal, centre, link @ left), self._core_settings, base or 0.0, start)

    def _register(self, core: VisualOdometry, job: Job, predicted: Array) -> VisualEstimate:
        return core.register(job.payload, predicted)


def read_settings() -> tuple[
    VisualOdometryOptions, tuple[TrackSettings, NoiseSettings, KeyframeSettings], VisualHealthLimits
]:
    """Read the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    get: Any = rospy.get_param
    core = TrackSettings.from_parameters(get), NoiseSettings.from_parameters(get), KeyframeSettings.from_parameters(get)
    return VisualOdometryOptions.from_parameters(get), core, VisualHealthLimits.from_parameters(get)
