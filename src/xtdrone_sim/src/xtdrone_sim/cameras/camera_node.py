"""The cameras of all vehicles as a ROS node.

=================================  ========================  ==========================================================
topic or service                   type                      content
=================================  ========================  ==========================================================
/T/CAMERA/image_raw                sensor_msgs/Image         rgb8; stamp: time of the exposure
/T/CAMERA/camera_info              sensor_msgs/CameraInfo    with each image, plumb_bob
/T/CAMERA/...                      ...                       compressed, depths, stereo pairs: see ``camera_messages``
/T/CAMERA/freeze                   std_srvs/SetBool          true: stops the images, as if the camera had failed
/xtdrone/scene (subscribed)        xtdrone_msgs/SceneState   poses of links and actors
/xtdrone/models (subscribed)       xtdrone_msgs/SceneModels  models added and deleted since the start
=================================  ========================  ==========================================================

T is a vehicle, e.g. ``typhoon_h480_0``, CAMERA the name of its camera, e.g. ``cgo3_camera``.

In a turn in which a camera is due, it captures the latest scene, whose time is the stamp of the image. Another process
draws the image, which is published after a fixed simulated time. Simulated time continues during the drawing, and waits
for an image only when its publication is due. Cameras without subscribers take no images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import rospy
from std_srvs.srv import SetBool, SetBoolResponse
from xtdrone_msgs.msg import SceneModels, SceneState

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError
from xtdrone_common.settings import Settings, setting
from xtdrone_lockstep.deferred_work import Deferred
from xtdrone_sim.cameras.camera_messages import COSTLY, messages, topics_of
from xtdrone_sim.cameras.camera_worker import Changes, DrawingProcess, Drawn
from xtdrone_sim.cameras.cameras_of_fleet import MOST_TURNS, Camera, Exposures, cameras_of, turn_rate
from xtdrone_sim.cameras.drawn_scene import View
from xtdrone_sim.cameras.rendering import BACKENDS
from xtdrone_sim.cameras.shutter import RecentScenes, exposure_times, middle_us
from xtdrone_sim.rays.live_rays import scene_of
from xtdrone_sim.rays.scene import SceneAt
from xtdrone_sim.sensors.sensor_nodes import rate_setting, read_start, run

USAGE = "cameras.py"
MOST_LATENCY = 10.0  # s
LEAST_RATE = 0.1  # Hz

_NAME = "cameras"


@dataclass(frozen=True)
class CameraSettings(Settings):
    """Private parameters of the node that determine when images are taken and how they are drawn."""

    rate: float = rate_setting(
        LEAST_RATE, MOST_TURNS, "images per second of each camera, 0 for the rate in its vehicle's file"
    )
    latency: float = setting(
        0.1, low=0.0, high=MOST_LATENCY, unit="s", text="simulated time from exposure to publication"
    )
    backend: str = setting("auto", choices=BACKENDS, text="OpenGL implementation of the renderer")
    shadows: bool = setting(False, text="shadows of the sun, by rays, unless the world's light has none")

    def rates(self, cameras: Sequence[Camera]) -> list[float]:
        """Return each camera's rate, Hz."""
        return [self.rate or camera.mount.rate for camera in cameras]


class _Shot(NamedTuple):
    """An image in progress: index of its camera and time of (the middle of) its exposure."""

    camera: int
    stamp: rospy.Time


class CameraNode:
    """Renders and publishes images, turn by turn.

    Attributes:
        lost: number of images lost so far, because the drawing process has ended or (outside lockstep) the previous
            image was still in progress.
    """

    def __init__(self, cameras: Sequence[Camera], settings: CameraSettings, turns: float) -> None:
        """Advertise topics and services.

        Args:
            cameras: all cameras of the node.
            settings: see ``CameraSettings``.
            turns: rate at which ``step`` is called, Hz.
        """
        self.lost = 0
        self._cameras = list(cameras)
        self._latency_us = round(settings.latency * 1e6)
        self._exposures = Exposures(settings.rates(cameras), turns)
        self._publishers = [
            {
                topic: lockstep.Publisher(f"{camera.topics}/{topic}", kind)
                for topic, kind in topics_of(camera.mount).items()
            }
            for camera in cameras
        ]
        self._frozen: set[int] = set()
        self._services = [
            rospy.Service(f"{camera.topics}/freeze", SetBool, lambda request, k=k: self._freeze(k, request.data))
            for k, camera in enumerate(cameras)
        ]
        self._scene: SceneState | None = None
        self._recent = RecentScenes(max((camera.mount.exposure for camera in cameras), default=0.0), scene_of)
        self._last: dict[int, rospy.Time] = {}  # stamp of each camera's latest image
        self._under_way: set[int] = set()
        self._drawer: DrawingProcess | None = None
        self._deferred = Deferred(1, wait=lockstep.is_active())
        self._changes: Changes | None = None
        lockstep.Subscriber("/xtdrone/scene", SceneState, self._take_scene, queue_size=1)
        lockstep.Subscriber("/xtdrone/models", SceneModels, self._take_models)
        lockstep.add_reset_hook(self._restart)

    def begin(self, drawer: DrawingProcess) -> None:
        """Start taking images with ``drawer``, which the node closes."""
        self._drawer = drawer
        if self._changes is not None:
            drawer.change(self._changes)

    def _take_models(self, message: SceneModels) -> None:
        self._changes = Changes(message.sdf, tuple(message.deleted))
        if self._drawer is not None:
            self._drawer.change(self._changes)

    def _take_scene(self, message: SceneState) -> None:
        self._scene = message
        self._recent.add(_microseconds(message.header.stamp), message)

    def _freeze(self, camera: int, frozen: bool) -> SetBoolResponse:
        (self._frozen.add if frozen else self._frozen.discard)(camera)
        words = "publishes no more images" if frozen else "publishes images again"
        text = f"{self._cameras[camera].topics} {words}"
        rospy.loginfo(text)
        return SetBoolResponse(True, text)

    def _restart(self) -> None:
        """Discard the state from before a reset of simulated time."""
        self._deferred.clear()
        self._scene = None
        self._recent.clear()
        self._last.clear()
        self._under_way.clear()

    def step(self) -> None:
        """Publish the images and expose the cameras that are due.

        Raises:
            DrawingError: images cannot be drawn.
        """
        now_us = _microseconds(rospy.Time.now())
        for shot, pictures in self._deferred.ready(now_us):
            self._under_way.discard(shot.camera)
            self._publish(shot, pictures)
        if self._scene is None or self._drawer is None:
            return
        stamp = self._scene.header.stamp
        for camera in self._exposures.due(now_us):
            if camera in self._frozen or not self._has_subscribers(camera) or self._last.get(camera) == stamp:
                continue
            self._last[camera] = stamp
            if camera in self._under_way and not lockstep.is_active():
                self.lost += 1
                continue
            views = self._cameras[camera].views
            if views[0].link not in self._scene.links:
                rospy.logwarn_throttle(10.0, f"/xtdrone/scene has no {views[0].link}: no images of its camera")
                continue
            mount, closed_us = self._cameras[camera].mount, _microseconds(stamp)
            opened_us = closed_us - round(1e6 * mount.exposure)
            if opened_us < 0:
                continue
            scenes = [self._recent.at(time_us) for time_us in exposure_times(mount, closed_us)]
            self._under_way.add(camera)
            shot = _Shot(camera, rospy.Time(0, 1000 * middle_us(mount, closed_us)) if mount.exposure else stamp)
            self._deferred.put(shot, now_us + self._latency_us, self._draw, scenes, views)

    def _draw(self, scenes: Sequence[SceneAt], views: Sequence[View]) -> list[bytes] | None:
        """Return the images of an exposure; None if one is lost. Called in a thread of ``Deferred``."""
        assert self._drawer is not None
        pictures = []
        for view in views:
            picture = self._drawer.draw(scenes, view)
            if picture is None:
                return None
            pictures.append(picture)
        return pictures

    def _has_subscribers(self, camera: int) -> bool:
        return any(publisher.get_num_connections() > 0 for publisher in self._publishers[camera].values())

    def _publish(self, shot: _Shot, pictures: list[bytes] | None) -> None:
        camera = self._cameras[shot.camera]
        if pictures is None:
            assert self._drawer is not None
            self.lost += 1
            rospy.logwarn(
                f"the process that draws images has ended ({self._drawer.last_end}) and was restarted, "
                f"an image of {camera.topics} is lost ({self.lost} in all)"
            )
            return
        if shot.camera in self._frozen:
            return
        publishers = self._publishers[shot.camera]
        wanted = [
            topic for topic, one in publishers.items() if not topic.endswith(COSTLY) or one.get_num_connections() > 0
        ]
        for topic, message in messages(camera, shot.stamp, pictures, wanted).items():
            publishers[topic].publish(message)

    def close(self) -> None:
        """End the drawing."""
        for service in self._services:
            service.shutdown()
        if self._drawer is not None:
            self._drawer.close()
        self._deferred.close()


def _microseconds(time: rospy.Time) -> int:
    return int(time.to_nsec() // 1000)


def main(arguments: Sequence[str]) -> None:
    """Serve all cameras of the fleet until shutdown.

    Raises:
        ArgumentError: an argument or parameter is not allowed.
        DrawingError: images cannot be drawn.
    """
    text, fleet, settings = read_start(_NAME, CameraSettings, "typhoon_h480", arguments)
    try:
        cameras = cameras_of(fleet)
        turns = turn_rate(settings.rates(cameras))
    except ValueError as error:
        raise ArgumentError(str(error)) from error
    if not cameras:
        raise ArgumentError(f"/xtdrone/fleet: no vehicle of {text!r} has a camera")
    lockstep.init_node(_NAME, rate=turns)
    node = CameraNode(cameras, settings, turns)

    def begin(world: str) -> None:
        node.begin(DrawingProcess(Drawn(world, text, settings.backend, settings.shadows)))

    run(begin, node.step, node.close)
