"""Detection node: publishes boxes and ground positions from the images of one or several vehicles.

For each vehicle ``T`` (as ``typhoon_h480_0``) with the number ``i``:

=======================================  ==============================  =============================================
topic                                    type                            meaning
=======================================  ==============================  =============================================
/T/cgo3_camera/image_raw, camera_info    sensor_msgs/Image, CameraInfo   in: rgb8 or bgr8
/T/mavros/local_position/pose            geometry_msgs/PoseStamped       in: position at the exposure
/T/mavros/mount_control/orientation      geometry_msgs/Quaternion        in: gimbal attitude
/T/mavros/state                          mavros_msgs/State               in: no camera fault while disarmed
/uav_<i>/darknet_ros/bounding_boxes      darknet_ros_msgs/BoundingBoxes  out: one per image, as darknet_ros
/uav_<i>/darknet_ros/found_object        darknet_ros_msgs/ObjectCount    out: number of boxes
/uav_<i>/darknet_ros/detection_image     sensor_msgs/Image               out: with boxes; only while subscribed
/xtdrone/T/objects                       xtdrone_msgs/ObjectsOnGround    out: tracked people on the ground, in map
/xtdrone/T/camera_ok                     std_msgs/Bool                   out, latched: whether the camera works
=======================================  ==============================  =============================================

The results of an image are published a fixed simulated time (``~latency``) after processing began, however long it
takes; the flight continues meanwhile. One image per vehicle is processed at a time; of those that arrive meanwhile, the
newest waits, and the others are dropped and counted.
"""

from __future__ import annotations

import math
import queue
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
import rospy
from darknet_ros_msgs.msg import BoundingBox, BoundingBoxes, ObjectCount
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Bool
from xtdrone_msgs.msg import ObjectOnGround, ObjectsOnGround

import xtdrone_lockstep as lockstep
from xtdrone_common.cameras.camera_pose import CameraPose, camera_link_pose, optical_pose
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.frames import to_xyzw
from xtdrone_common.pose_history import PoseHistory
from xtdrone_common.pose_messages import is_pose
from xtdrone_common.programs.node_command_line import ArgumentError
from xtdrone_common.settings import Settings, setting
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_perception.images import Picture, PictureNode, PictureVehicle, picture_of
from xtdrone_perception.tracking.geolocation import Geolocator, Noise, Person, View
from xtdrone_perception.tracking.tracker import GroundDetection, Track, Tracker, TrackerSettings

from .detector import Detection, Detector, DetectorError, DetectorSettings, load_settings, settings_file

Vector = Sequence[float]

TIMEOUT = 3.0  # s without a new image
MOVED = 3.0  # m of flight after which an image must have changed


class CameraWatch:
    """Supervision of one camera.

    Attributes:
        fault: the fault, empty if there is none or nothing is known yet.
    """

    def __init__(self, timeout: float = TIMEOUT) -> None:
        """Start without an image.

        Args:
            timeout: simulated time without a new image after which a camera in flight has failed, s.
        """
        self.fault = ""
        self._timeout = timeout
        self._since: float | None = None
        self._stamp = -math.inf
        self._content: int | None = None
        self._begun: tuple[float, Vector | None] = (-math.inf, None)

    @property
    def seen(self) -> bool:
        """Whether an image has arrived."""
        return self._stamp > -math.inf

    def on_picture(self, now: float, stamp: float, content: int, place: Vector | None) -> None:
        """Check an image.

        Args:
            now: time, s.
            stamp: time of the exposure, s; an image without a later stamp than the last one is not new.
            content: checksum of the image.
            place: position of the vehicle, m; None if unknown or not in flight.
        """
        if stamp <= self._stamp:
            return
        self._stamp = stamp
        began, where = self._begun
        if content != self._content or where is None:
            self._content, self._begun = content, (now, place)
        elif place is not None and now - began >= self._timeout and math.dist(where, place) > MOVED:
            self.fault = f"its images have been the same since {began:.1f} s, in flight"
            self._since = now
            return
        self._since, self.fault = now, ""

    def update(self, now: float, flying: bool) -> None:
        """Check the time since the last image.

        Args:
            now: time, s.
            flying: whether the vehicle is in flight; on the ground the camera may be silent.
        """
        if not flying or self._since is None:
            self._since = now
        elif now - self._since > self._timeout:
            self.fault = f"no image for more than {self._timeout:g} s, in flight"


RATE = 50.0  # Hz; the gimbal attitude has no stamp, so its time is as accurate as the node's period
CAMERA_OFFSET = (0.041, 0.0, -0.122)  # of the typhoon's camera from base_link, m, FLU
MARGIN = 8.0  # px; a person expected closer to the edge may be outside the image
_COLOUR = (255, 60, 60)


@dataclass(frozen=True)
class DetectionOptions(Settings):
    """Private parameters of the node, for all its vehicles.

    Attributes:
        locator: computes positions on the ground.
        tracker: beginning and end of tracks.
    """

    locator: Geolocator
    tracker: TrackerSettings
    latency: float = setting(0.1, low=0.0, high=10.0, unit="s", text="simulated time from an image to its results")
    workers: int = setting(1, low=1, high=16, text="images of different vehicles processed at the same time")
    camera: str = setting("cgo3_camera", text="name of the camera's topics below the vehicle's namespace")
    camera_offset: tuple[float, float, float] = setting(
        CAMERA_OFFSET, unit="m", text="camera position relative to base_link, FLU"
    )
    persons: tuple[str, ...] = setting(("human", "person"), text="classes of objects located on the ground")


@dataclass(frozen=True)
class GroundOptions(Settings):
    """Private parameters of the ground and the range of detection."""

    ground: float = setting(0.0, low=-1e4, high=1e4, unit="m", text="height of the ground in the map frame")
    farthest: float = setting(200.0, low=1.0, high=1e4, unit="m", text="maximum distance of a located person")


def read_options() -> DetectionOptions:
    """Read the private parameters of all but the network.

    Raises:
        SettingError: a parameter is not allowed.
    """
    get = rospy.get_param
    place = GroundOptions.from_parameters(get)
    locator = Geolocator(
        place.ground,
        Person.from_mapping(get("~person", {}), rospy.resolve_name("~person")),
        Noise.from_mapping(get("~noise", {}), rospy.resolve_name("~noise")),
        farthest=place.farthest,
    )
    tracker = TrackerSettings.from_mapping(get("~tracker", {}), rospy.resolve_name("~tracker"))
    return DetectionOptions.from_parameters(get, locator=locator, tracker=tracker)


def read_detector() -> DetectorSettings:
    """Read the detector settings: the file named by ``~detector``, with entries replaced by private parameters.

    Raises:
        ArgumentError: the file or a value is invalid.
    """
    name = str(rospy.get_param("~detector", "search"))
    path = settings_file(name)
    changes = {
        field.name: rospy.get_param(f"~{field.name}")
        for field in fields(DetectorSettings)
        if rospy.has_param(f"~{field.name}")
    }
    try:
        return load_settings(path, changes)
    except DetectorError as error:
        raise ArgumentError(f"parameter ~detector: {error}") from error


class Detectors:
    """One copy of the network per worker, since a network processes one image at a time."""

    def __init__(self, settings: DetectorSettings, count: int) -> None:
        """Load the networks.

        Raises:
            DetectorError: the network cannot be loaded.
        """
        self._free: queue.SimpleQueue[Detector] = queue.SimpleQueue()
        for _ in range(count):
            self._free.put(Detector(settings))

    def detect(self, rgb: NDArray[np.uint8]) -> list[Detection]:
        """Return the objects in an image; thread-safe."""
        detector = self._free.get()
        try:
            return detector.detect(rgb)
        finally:
            self._free.put(detector)


class VehicleDetection(PictureVehicle):
    """Topics, tracks and camera state of one vehicle."""

    def __init__(self, kind: str, index: int, options: DetectionOptions) -> None:
        """Declare the topics.

        Args:
            kind: vehicle type, as ``typhoon_h480``.
            index: number of the vehicle.
            options: Options of the node.
        """
        self.name = f"{kind}_{index}"
        self._options = options
        self._pinhole: Pinhole | None = None
        self._poses, self._mounts = PoseHistory(scalar_last=True), PoseHistory(scalar_last=True)
        self._clear_state()
        darknet = f"/uav_{index}/darknet_ros"
        self._boxes = lockstep.Publisher(f"{darknet}/bounding_boxes", BoundingBoxes)
        self._count = lockstep.Publisher(f"{darknet}/found_object", ObjectCount)
        self._image = lockstep.Publisher(f"{darknet}/detection_image", Image, queue_size=1)
        self._objects = lockstep.Publisher(f"/xtdrone/{self.name}/objects", ObjectsOnGround)
        self._ok = lockstep.Publisher(f"/xtdrone/{self.name}/camera_ok", Bool, latch=True)
        camera = f"/{self.name}/{options.camera}"
        self._vehicle = VehicleTopics(self.name, "state", "pose", poses=self._poses)
        lockstep.Subscriber(f"/{self.name}/mavros/mount_control/orientation", Quaternion, self._on_mount)
        lockstep.Subscriber(f"{camera}/camera_info", CameraInfo, self._on_info)
        lockstep.Subscriber(f"{camera}/image_raw", Image, self._on_image, queue_size=2, buff_size=2**24)
        lockstep.add_reset_hook(self._restart)

    def _clear_state(self) -> None:
        self._tracker = Tracker(self._options.tracker)
        self._watch = CameraWatch()
        self._published_ok: bool | None = None
        self.forget_pictures()

    def _restart(self) -> None:
        self._mounts.clear()
        self._clear_state()

    # messages

    def _on_mount(self, message: Quaternion) -> None:
        entry = np.array([message.w, message.x, message.y, message.z])
        if is_pose(entry):
            self._mounts.add(rospy.Time.now().to_nsec(), entry)

    def _on_info(self, message: CameraInfo) -> None:
        fx, fy, cx, cy = message.K[0], message.K[4], message.K[2], message.K[5]
        if fx > 0.0 and fy > 0.0 and message.width and message.height:
            self._pinhole = Pinhole(message.width, message.height, fx, fy, cx, cy)
        else:
            rospy.logwarn_throttle(10.0, f"{self.name}: camera_info ignored: no focal lengths or no size")

    def _on_image(self, message: Image) -> None:
        try:
            rgb = picture_of(message)
        except ValueError as error:
            rospy.logwarn_throttle(10.0, f"{self.name}: image ignored: {error}")
            return
        pose = self._vehicle.pose if self._vehicle.armed else None
        place = None if pose is None else pose[:3].tolist()
        self._watch.on_picture(rospy.get_time(), message.header.stamp.to_sec(), zlib.crc32(message.data), place)
        self.put(Picture(message.header, rgb))

    # steps

    def publish_camera_state(self) -> None:
        """Publish on ``camera_ok`` whether the camera works, when this has changed."""
        self._watch.update(rospy.get_time(), self._vehicle.armed)
        ok = not self._watch.fault
        if ok == self._published_ok or not (self._watch.fault or self._watch.seen):
            return
        if not ok:
            rospy.logwarn(f"{self.name}: the camera has failed: {self._watch.fault}")
        elif self._published_ok is False:
            rospy.loginfo(f"{self.name}: the camera works again")
        self._published_ok = ok
        self._ok.publish(Bool(ok))

    def finish(self, picture: Picture, found: Sequence[Detection]) -> None:
        """Publish the results of an image."""
        super().finish(picture, found)
        header = picture.header
        boxes = BoundingBoxes(image_header=header)
        boxes.header.stamp = rospy.Time.now()
        boxes.header.frame_id = header.frame_id
        boxes.bounding_boxes = [box_message(entry) for entry in found]
        self._boxes.publish(boxes)
        count = ObjectCount(count=min(len(found), 127))
        count.header = boxes.header
        self._count.publish(count)
        if self._image.get_num_connections():
            self._image.publish(draw_boxes(picture, found))
        self._publish_tracks(header.stamp, found)

    def _publish_tracks(self, stamp: Any, detections: Sequence[Detection]) -> None:
        """Update and publish the tracks, if the camera pose at the exposure is known."""
        camera = self._camera_at(stamp.to_nsec())
        if camera is None or self._pinhole is None:
            rospy.logwarn_throttle(
                10.0, f"{self.name}: no positions on the ground: pose, mount orientation or camera_info is missing"
            )
            return
        view = View.of(self._pinhole, camera.position, camera.orientation)
        located = []
        for entry in detections:
            if entry.name not in self._options.persons:
                continue
            box = (entry.xmin, entry.ymin, entry.xmax, entry.ymax)
            point = self._options.locator.locate(view, box)
            if point is not None:
                located.append(GroundDetection(point, entry.name, entry.probability, box))
        try:
            tracks = self._tracker.update(stamp.to_sec(), located, lambda place: in_view(view, place, self._options))
        except ValueError as error:
            rospy.logwarn_throttle(10.0, f"{self.name}: positions ignored: {error}")
            return
        message = ObjectsOnGround(vehicle=self.name, dropped=self._dropped)
        message.header.stamp, message.header.frame_id = stamp, "map"
        message.camera = Pose(Point(*camera.position), Quaternion(*to_xyzw(camera.orientation)))
        message.objects = [object_message(track) for track in tracks]
        self._objects.publish(message)

    def _camera_at(self, time_ns: int) -> CameraPose | None:
        """Return the pose of the optical frame at a time, None if unknown."""
        pose, mount = self._poses.at(time_ns), self._mounts.at(time_ns)
        if pose is None or mount is None:
            return None
        position, attitude = pose[:3].tolist(), pose[3:].tolist()
        return optical_pose(camera_link_pose(position, attitude, mount.tolist(), self._options.camera_offset))


class YoloNode(PictureNode):
    """Detection for one or several vehicles in one process."""

    def __init__(self, kind: str, ids: Sequence[int], detector: DetectorSettings, options: DetectionOptions) -> None:
        """Load the networks and declare the topics.

        Args:
            kind: vehicle type, as ``typhoon_h480``.
            ids: numbers of the vehicles.
            detector: settings of the network.
            options: shared by the vehicles.

        Raises:
            ArgumentError: the network cannot be loaded.
        """
        try:
            detectors = Detectors(detector, options.workers)
        except DetectorError as error:
            raise ArgumentError(f"parameter ~detector: {error}") from error
        self._detections = [VehicleDetection(kind, index, options) for index in ids]
        super().__init__(self._detections, detectors.detect, options.latency, options.workers)

    def step(self) -> None:
        """Publish the results that are due, and the cameras' states; call it at 50 Hz."""
        super().step()
        for vehicle in self._detections:
            vehicle.publish_camera_state()


def box_message(entry: Detection) -> BoundingBox:
    """Return a detection as a message of darknet_ros."""
    return BoundingBox(
        probability=entry.probability,
        xmin=round(entry.xmin),
        ymin=round(entry.ymin),
        xmax=round(entry.xmax),
        ymax=round(entry.ymax),
        id=entry.class_id,
        Class=entry.name,
    )


def object_message(track: Track) -> ObjectOnGround:
    """Return a track as a message."""
    xmin, ymin, xmax, ymax = track.last.box
    box = Detection(0, track.object_class, track.last.probability, xmin, ymin, xmax, ymax)
    return ObjectOnGround(
        id=track.id,
        object_class=track.object_class,
        probability=track.probability,
        hits=track.hits,
        position=Point(*track.position.tolist()),
        covariance=track.position_covariance.reshape(-1).tolist(),
        velocity=Vector3(*track.velocity.tolist(), 0.0),
        box=box_message(box),
    )


def in_view(view: View, place: NDArray[np.float64], options: DetectionOptions) -> bool:
    """Return whether an image should show a person standing at a position (2,), m."""
    foot = options.locator.foot(place)
    middle = foot + np.array([0.0, 0.0, 0.5 * options.locator.person.height])
    x, y = view.pinhole.project(((middle - view.position) @ view.rotation)[None])[0]
    return bool(MARGIN <= x <= view.pinhole.width - MARGIN and MARGIN <= y <= view.pinhole.height - MARGIN)


def draw_boxes(picture: Picture, detections: Sequence[Detection]) -> Image:
    """Return an image with boxes drawn, as rgb8."""
    rgb = picture.pixels.copy()
    for entry in detections:
        corners = (round(entry.xmin), round(entry.ymin)), (round(entry.xmax), round(entry.ymax))
        cv2.rectangle(rgb, *corners, _COLOUR, 1)
        text = f"{entry.name} {entry.probability:.2f}"
        baseline = corners[0][1] - 3 if corners[0][1] > 14 else corners[1][1] + 12
        cv2.putText(rgb, text, (corners[0][0], baseline), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _COLOUR, 1, cv2.LINE_AA)
    height, width = rgb.shape[:2]
    message = Image(height=height, width=width, encoding="rgb8", step=3 * width, data=rgb.tobytes())
    message.header = picture.header
    return message
