#!/usr/bin/env python3
"""A detector of your own: find the largest red object in a camera's images, and print where it lies on the ground.

To run it::

    ./xtdrone launch multi_vehicle vehicles:=iris_downward_camera:1 cameras:=true
    python src/xtdrone_perception/examples/red_object.py iris_downward_camera_0      # in './xtdrone shell'
"""

import math
import sys

import cv2
import numpy as np
from sensor_msgs.msg import CameraInfo, Image

import xtdrone_lockstep as lockstep
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_control.vehicle_program import run_node
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_perception.images import picture_of
from xtdrone_perception.tags.tag_poses import optical_frame
from xtdrone_perception.tracking.geolocation import Geolocator, View

OFFSET, DOWN = (0.0, 0.0, -0.05), (0.0, 0.5 * math.pi, 0.0)  # of the camera in base_link: m, FLU; roll, pitch, yaw, rad
LEAST = 20  # px


def find_red(rgb):
    """Return the middle (x, y), px, of the largest red area of an image (height, width, 3), or None."""
    red = (rgb[..., 0] > 120) & (rgb[..., 1:] < 80).all(axis=-1)
    _, _, boxes, middles = cv2.connectedComponentsWithStats(red.astype(np.uint8))
    sizes = boxes[1:, cv2.CC_STAT_AREA]  # the first one is the background
    return tuple(middles[1 + sizes.argmax()]) if len(sizes) and sizes.max() >= LEAST else None


class RedObject:
    """Detector for the downward camera of one vehicle."""

    def __init__(self, name):
        """Subscribe to pose and camera."""
        self.place = None
        self._vehicle, self._pinhole = VehicleTopics(name, "pose"), None
        lockstep.Subscriber(f"/{name}/camera/camera_info", CameraInfo, self._on_info)
        lockstep.Subscriber(f"/{name}/camera/image_raw", Image, self._on_image, queue_size=1, buff_size=2**24)

    def _on_info(self, message):
        fx, _, cx, _, fy, cy = message.K[:6]
        self._pinhole = Pinhole(message.width, message.height, fx, fy, cx, cy)

    def _on_image(self, message):
        pixel, pose = find_red(picture_of(message)), self._vehicle.pose
        if pixel is None or pose is None or self._pinhole is None:
            return
        camera = optical_frame(pose[:3], pose[3:], OFFSET, DOWN)
        self.place = Geolocator().point(View.of(self._pinhole, camera.position, camera.orientation), pixel)

    def step(self):
        """Print a new position."""
        if self.place is not None:
            print(f"{self._vehicle.name}: red object at ({self.place[0]:.1f}, {self.place[1]:.1f}) m", flush=True)
            self.place = None


if __name__ == "__main__":
    lockstep.init_node("red_object", rate=10.0)
    run_node(RedObject(sys.argv[1]))
