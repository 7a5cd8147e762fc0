"""The messages that a camera publishes, by kind.

======  =============================================================================================================
rgb     image_raw (rgb8), image_raw/compressed (JPEG), camera_info
depth   depth/image_raw (32FC1 or 16UC1), depth/camera_info, depth/points (PointCloud2 with x, y, z)
rgbd    as depth, with the colour in depth/points; color/image_raw, color/image_raw/compressed,
        color/camera_info
stereo  left/image_raw, left/image_raw/compressed, left/camera_info, and the same of right
======  =============================================================================================================

Depths are distances along the optical axis; those nearer than ``range_min`` or farther than ``range_max`` are NaN, or 0
in 16UC1 (REP 118). Clouds are organised like the image, in the optical frame, with NaN for such pixels. A stereo pair
without a lens is rectified: both images have the same rows, and the right one's P has -fx times the baseline
(sensor_msgs/CameraInfo). With a lens, image_raw is distorted and its camera_info has the coefficients; image_rect_color
beside it is the same image without distortion, as from image_proc; depths and their clouds are not distorted.
Compressed images are those of image_transport's plug-in ``compressed``, with its quality.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import rospy
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2, PointField

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_sim.cameras.cameras_of_fleet import Camera
from xtdrone_sim.cameras.lens_and_noise import Exposure, noise_of, opencv
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import CameraMount

COSTLY = ("depth/points", "image_raw/compressed", "image_rect_color")
"""Ends of the topics whose messages are created only for subscribers."""

_QUALITY = 80  # JPEG, default of compressed_image_transport

_IMAGE: dict[str, type] = {"image_raw": Image, "image_raw/compressed": CompressedImage, "camera_info": CameraInfo}
_DEPTH: dict[str, type] = {"depth/image_raw": Image, "depth/camera_info": CameraInfo, "depth/points": PointCloud2}


def _below(part: str) -> dict[str, type]:
    return {f"{part}/{topic}": kind for topic, kind in _IMAGE.items()}


_MESSAGES = {
    "rgb": _IMAGE,
    "depth": _DEPTH,
    "rgbd": _DEPTH | _below("color"),
    "stereo": _below("left") | _below("right"),
}


def topics_of(mount: CameraMount) -> dict[str, type]:
    """Return the types of a camera's messages by topic, below ``/VEHICLE/NAME/``."""
    kinds = _MESSAGES[mount.kind]
    if mount.lens is None:
        return kinds
    rectified = [topic.replace("image_raw", "image_rect_color") for topic in kinds if topic.endswith("image_raw")]
    return kinds | {topic: Image for topic in rectified if not topic.startswith("depth/")}


def messages(camera: Camera, stamp: rospy.Time, pictures: Sequence[bytes], wanted: Collection[str]) -> dict[str, Any]:
    """Return the messages of one exposure.

    Args:
        camera: the camera.
        stamp: time of the exposure.
        pictures: pictures of each of its views, see ``camera_worker.DrawingProcess.draw``.
        wanted: topics of ``topics_of`` to fill.
    """
    mount, pinhole = camera.mount, camera.mount.pinhole
    depth = None
    if mount.has_depth and {"depth/image_raw", "depth/points"} & set(wanted):
        depth = measure_depths(mount, _depths(pinhole, pictures[0]), noise_of(camera, stamp))
    colours = Exposure(camera, stamp, pictures)
    made: dict[str, Any] = {}
    for topic in wanted:
        eye = 1 if topic.startswith("right/") else 0
        part, _, what = topic.rpartition("/")
        if what == "camera_info":
            message: Any = camera_info(camera, right=eye == 1, rectified=part == "depth")
        elif what == "points":
            assert depth is not None
            message = cloud(pinhole, depth, colours.rectify(0) if mount.kind == "rgbd" else None)
        elif part == "depth":
            assert depth is not None
            message = _depth_image(depth, mount.encoding)
        elif what == "compressed":
            message = compress(colours.raw(eye))
        else:
            message = _image(colours.rectify(eye) if what == "image_rect_color" else colours.raw(eye))
        message.header.stamp = stamp
        message.header.frame_id = camera.frame_id
        made[topic] = message
    return made


def compress(picture: NDArray[np.uint8]) -> CompressedImage:
    """Return an image (height, width, 3) RGB as JPEG, with the format that image_transport writes and reads."""
    cv2 = opencv()
    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    _, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    return CompressedImage(format="rgb8; jpeg compressed bgr8", data=data.tobytes())


def _image(picture: NDArray[np.uint8]) -> Image:
    height, width, _ = picture.shape
    return Image(height=height, width=width, encoding="rgb8", step=3 * width, data=picture.tobytes())


def _depths(pinhole: Pinhole, picture: bytes) -> NDArray[np.float32]:
    size = pinhole.width * pinhole.height
    return np.frombuffer(picture, np.float32, size, 3 * size).reshape(pinhole.height, pinhole.width)


def measure_depths(mount: CameraMount, depth: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return depths (height, width), m, as the camera measures them: with noise, NaN outside its range."""
    seen = (depth >= mount.range_min) & (depth <= mount.range_max)
    out = np.where(seen, depth, np.float32(np.nan))
    if mount.noise > 0.0:
        out = out + np.float32(mount.noise) * out * out * rng.standard_normal(out.shape, np.float32)
    return out.astype(np.float32)


def _depth_image(depth: NDArray[np.float32], encoding: str) -> Image:
    height, width = depth.shape
    values: NDArray[Any] = depth
    if encoding == "16UC1":
        values = np.round(np.clip(np.nan_to_num(1000.0 * depth, nan=0.0), 0.0, 65535.0)).astype(np.uint16)
    return Image(height=height, width=width, encoding=encoding, step=values.itemsize * width, data=values.tobytes())


def cloud(pinhole: Pinhole, depth: NDArray[np.float32], colours: NDArray[np.uint8] | None) -> PointCloud2:
    """Return the points of a depth image, optical frame, m.

    Args:
        pinhole: projection.
        depth: (height, width), m.
        colours: (height, width, 3) for a field ``rgb``, 0xRRGGBB in the bits of a float32; None: without.
    """
    height, width = depth.shape
    names = ["x", "y", "z"] + (["rgb"] if colours is not None else [])
    points = np.empty((height, width, len(names)), np.float32)
    points[..., 0] = depth * ((np.arange(width) + 0.5 - pinhole.cx) / pinhole.fx).astype(np.float32)
    points[..., 1] = depth * ((np.arange(height) + 0.5 - pinhole.cy) / pinhole.fy).astype(np.float32)[:, None]
    points[..., 2] = depth
    if colours is not None:
        red, green, blue = (colours[..., k].astype(np.uint32) for k in range(3))
        points[..., 3] = (red << 16 | green << 8 | blue).view(np.float32)
    fields = [PointField(name, 4 * k, PointField.FLOAT32, 1) for k, name in enumerate(names)]
    return PointCloud2(
        height=height,
        width=width,
        fields=fields,
        point_step=4 * len(names),
        row_step=4 * len(names) * width,
        data=points.tobytes(),
    )


def camera_info(camera: Camera, *, right: bool = False, rectified: bool = False) -> CameraInfo:
    """Return a camera's calibration; its stamp is zero.

    Args:
        camera: the camera.
        right: whether it is the right camera of a stereo pair.
        rectified: whether the images are without distortion, such as depths.
    """
    p = camera.mount.pinhole
    info = CameraInfo(height=p.height, width=p.width, distortion_model="plumb_bob", D=[0.0] * 5)
    lens = camera.mount.lens
    if lens is not None and not rectified:
        info.distortion_model, info.D = lens.model, list(lens.coefficients)
    info.header.frame_id = camera.frame_id
    info.K = [p.fx, 0.0, p.cx, 0.0, p.fy, p.cy, 0.0, 0.0, 1.0]
    info.R = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    shift = -p.fx * camera.mount.baseline if right else 0.0
    info.P = [p.fx, 0.0, p.cx, shift, 0.0, p.fy, p.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info
