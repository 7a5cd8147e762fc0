"""AprilTag node: publishes poses of tags and the landing target from the images of one or several vehicles.

For each vehicle ``T`` (as ``iris_downward_camera_0``):

=====================================  =====================================  ==========================================
topic                                  type                                   meaning
=====================================  =====================================  ==========================================
/T/camera/image_raw, camera_info       sensor_msgs/Image, CameraInfo          in: rgb8, bgr8 or mono8
/T/mavros/local_position/pose          geometry_msgs/PoseStamped              in: the vehicle's pose at the exposure
/T/tag_detections                      apriltag_ros/AprilTagDetectionArray    out: one per image, in the optical frame
/tf                                    tf2_msgs/TFMessage                     out: optical frame -> tag or bundle
/T/mavros/landing_target/pose          geometry_msgs/PoseStamped              out: the board ``~target`` in map, with
                                                                              the exposure's stamp
=====================================  =====================================  ==========================================

The results of an image are published ``~latency`` of simulated time after its arrival. Of the images that arrive
meanwhile, the newest waits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rospy
from apriltag_ros.msg import AprilTagDetection, AprilTagDetectionArray
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Transform, TransformStamped, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

import xtdrone_lockstep as lockstep
from xtdrone_common.cameras.camera_pose import CameraPose
from xtdrone_common.files import ContentError
from xtdrone_common.frames import to_xyzw
from xtdrone_common.pose_history import PoseHistory
from xtdrone_common.programs.node_command_line import ArgumentError
from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_common.tag_boards import TagBoard, boards_of
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_perception.images import Picture, PictureNode, PictureVehicle, grey_of
from xtdrone_perception.tags.tag_detector import SeenTag, TagDetector, TagDetectorSettings
from xtdrone_perception.tags.tag_poses import BoardPose, Optics, board_pose, in_map, optical_frame, quaternion, up_in

RATE = 50.0  # Hz
_WARNING_PERIOD = 10.0  # s


@dataclass(frozen=True)
class AprilTagOptions(Settings):
    """Private parameters of the node, for all its vehicles."""

    tags: str = setting("landing", text="boards to look for: landing, or a YAML file in the format of apriltag_ros")
    target: str = setting("landing", text="name of the board that is the landing target; empty: none")
    camera: str = setting("camera", text="name of the camera's topics below the vehicle's namespace")
    camera_offset: tuple[float, float, float] = setting(
        (0.0, 0.0, -0.05), low=-10.0, high=10.0, unit="m", text="camera position relative to base_link, FLU"
    )
    camera_rpy: tuple[float, float, float] = setting(
        (0.0, 0.5 * math.pi, 0.0), low=-7.0, high=7.0, unit="rad",
        text="camera orientation in base_link; pitch pi/2 looks down",
    )  # fmt: skip
    pixel_centre: float = setting(
        0.5, low=0.0, high=0.5, unit="px",
        text="coordinate of the upper left pixel's centre in the camera's calibration: 0.5 for simulated cameras, 0 "
        "for cameras calibrated with OpenCV",
    )  # fmt: skip
    level: bool = setting(True, text="boards are horizontal; resolves ambiguous poses")
    max_error: float = setting(
        2.0, above=0.0, high=100.0, unit="px", text="maximum reprojection error of a published pose"
    )
    latency: float = setting(0.04, low=0.0, high=10.0, unit="s", text="simulated time from an image to its results")


def read_boards(options: AprilTagOptions) -> tuple[TagBoard, ...]:
    """Return the boards that the node looks for.

    Raises:
        ArgumentError: the file is unusable, or has no board ``target``.
    """
    try:
        boards = boards_of(options.tags)
    except (OSError, ContentError, SettingError) as error:
        raise ArgumentError(f"parameter ~tags: {error}") from error
    names = [board.name for board in boards]
    if options.target and options.target not in names:
        raise ArgumentError(f"parameter ~target: {options.target!r} is not allowed, empty or one of {', '.join(names)}")
    return boards


class VehicleTags(PictureVehicle):
    """Topics of one vehicle."""

    def __init__(self, name: str, options: AprilTagOptions, boards: Sequence[TagBoard], tf: lockstep.Publisher) -> None:
        """Declare the topics.

        Args:
            name: Name of the vehicle.
            options: Options of the node.
            boards: Boards to look for.
            tf: publisher of /tf.
        """
        self.name = name
        self._options, self._boards, self._tf = options, boards, tf
        self._poses = PoseHistory(scalar_last=True)
        self._restart()
        self._detections = lockstep.Publisher(f"/{name}/tag_detections", AprilTagDetectionArray)
        self._target = lockstep.Publisher(f"/{name}/mavros/landing_target/pose", PoseStamped)
        VehicleTopics(name, "pose", poses=self._poses)
        lockstep.Subscriber(f"/{name}/{options.camera}/camera_info", CameraInfo, self._on_info)
        lockstep.Subscriber(f"/{name}/{options.camera}/image_raw", Image, self._on_image, queue_size=2, buff_size=2**24)
        lockstep.add_reset_hook(self._restart)

    def _restart(self) -> None:
        self._optics: Optics | None = None
        self.forget_pictures()

    # messages

    def _on_info(self, message: CameraInfo) -> None:
        try:
            self._optics = Optics(np.array(message.K, float).reshape(3, 3), np.array(message.D, float))
        except ValueError as error:
            rospy.logwarn_throttle(_WARNING_PERIOD, f"{self.name}: ignored: {error}")

    def _on_image(self, message: Image) -> None:
        try:
            self.put(Picture(message.header, grey_of(message)))
        except ValueError as error:
            rospy.logwarn_throttle(_WARNING_PERIOD, f"{self.name}: image ignored: {error}")

    # steps

    def finish(self, picture: Picture, found: Sequence[SeenTag]) -> None:
        """Publish the results of an image."""
        super().finish(picture, found)
        header = picture.header
        camera = self._camera_at(header.stamp.to_nsec())
        boards = [] if self._optics is None else self._locate(found, self._optics, camera)
        self._detections.publish(AprilTagDetectionArray(header, [_detection(header, *entry) for entry in boards]))
        if boards:
            self._tf.publish(TFMessage([_transform(header, *entry) for entry in boards]))
        for board, pose in boards:
            if board.name == self._options.target and camera is not None:
                turn, place = in_map(camera, pose.rotation, pose.position)
                message = PoseStamped(Header(stamp=header.stamp, frame_id="map"), _pose(turn, place))
                self._target.publish(message)

    def _locate(
        self, seen: Sequence[SeenTag], optics: Optics, camera: CameraPose | None
    ) -> list[tuple[TagBoard, BoardPose]]:
        shift = self._options.pixel_centre - 0.5
        moved = [SeenTag(tag.id, tag.corners + shift) for tag in seen]
        normal = up_in(camera) if camera is not None and self._options.level else None
        poses = [(board, board_pose(board, moved, optics, normal)) for board in self._boards]
        return [(board, pose) for board, pose in poses if pose is not None and pose.error <= self._options.max_error]

    def _camera_at(self, time_ns: int) -> CameraPose | None:
        """Return the pose of the optical frame at a time, None if unknown."""
        entry = self._poses.at(time_ns)
        if entry is None:
            rospy.logwarn_throttle(_WARNING_PERIOD, f"{self.name}: no pose at the exposure: no landing target")
            return None
        position, attitude = entry[:3].tolist(), entry[3:].tolist()
        return optical_frame(position, attitude, self._options.camera_offset, self._options.camera_rpy)


class AprilTagNode(PictureNode):
    """Tag detection for one or several vehicles in one process."""

    def __init__(self, kind: str, ids: Sequence[int], options: AprilTagOptions, settings: TagDetectorSettings) -> None:
        """Declare the topics.

        Args:
            kind: vehicle type, as ``iris_downward_camera``.
            ids: numbers of the vehicles.
            options: shared by the vehicles.
            settings: Settings of the detector.

        Raises:
            ArgumentError: the boards are unusable.
        """
        boards = read_boards(options)
        tf = lockstep.Publisher("/tf", TFMessage)
        vehicles = [VehicleTags(f"{kind}_{index}", options, boards, tf) for index in ids]
        super().__init__(vehicles, TagDetector(settings).detect, options.latency)


def _pose(turn: NDArray[np.float64], place: NDArray[np.float64]) -> Pose:
    return Pose(Point(*place.tolist()), Quaternion(*to_xyzw(quaternion(turn))))


def _detection(header: Header, board: TagBoard, pose: BoardPose) -> AprilTagDetection:
    message = AprilTagDetection(id=[tag.id for tag in board.tags], size=[tag.size for tag in board.tags])
    message.pose.header = header
    message.pose.pose.pose = _pose(pose.rotation, pose.position)
    message.pose.pose.covariance = pose.covariance.ravel().tolist()
    return message


def _transform(header: Header, board: TagBoard, pose: BoardPose) -> TransformStamped:
    turn = Quaternion(*to_xyzw(quaternion(pose.rotation)))
    return TransformStamped(header, board.name, Transform(Vector3(*pose.position.tolist()), turn))
