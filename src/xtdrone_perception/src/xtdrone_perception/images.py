"""Camera images as arrays, and their processing in threads of a node for one or several vehicles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import rospy
from numpy.typing import NDArray
from std_msgs.msg import Header

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import ScanError, image_rows
from xtdrone_lockstep.deferred_work import Deferred

_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


def picture_of(message: Any) -> NDArray[np.uint8]:
    """Return the colours of an image, (height, width, 3) red, green, blue.

    Raises:
        ScanError: The encoding is unknown, or the size does not match the data.
    """
    if message.encoding not in ("rgb8", "bgr8"):
        raise ScanError(f"encoding: {message.encoding!r} is not allowed, rgb8 or bgr8")
    rgb = image_rows(message, 3).reshape(message.height, message.width, 3)
    return np.ascontiguousarray(rgb if message.encoding == "rgb8" else rgb[..., ::-1])


def grey_of(message: Any) -> NDArray[np.uint8]:
    """Return the grey values of an image, (height, width).

    Raises:
        ScanError: The encoding is unknown, or the size does not match the data.
    """
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        raise ScanError(f"encoding: {message.encoding!r} is not allowed, {', '.join(_CHANNELS)}")
    rows = np.ascontiguousarray(image_rows(message, channels))
    if channels == 1:
        return rows
    code = cv2.COLOR_RGB2GRAY if message.encoding == "rgb8" else cv2.COLOR_BGR2GRAY
    return np.asarray(cv2.cvtColor(rows.reshape(message.height, message.width, 3), code))


class Picture(NamedTuple):
    """An image to be processed: the header of its message, and its pixels, (height, width) or (height, width, 3)."""

    header: Header
    pixels: NDArray[np.uint8]


class PictureVehicle:
    """A vehicle whose images are processed one at a time; of those that arrive meanwhile, the newest waits."""

    def __init__(self) -> None:
        """Begin without an image."""
        self.forget_pictures()

    def forget_pictures(self) -> None:
        """Forget all images, because simulated time was reset."""
        self._waiting: Picture | None = None
        self._working = False
        self._dropped = 0

    def put(self, picture: Picture) -> None:
        """Let an image wait, in place of one that waits already."""
        self._dropped += self._waiting is not None
        self._waiting = picture

    def take(self) -> Picture | None:
        """Return the next image to process, None if there is none or one is being processed."""
        if self._working or self._waiting is None:
            return None
        picture, self._waiting = self._waiting, None
        self._working = True
        return picture

    def finish(self, picture: Picture, found: Any) -> None:
        """Publish the results of an image."""
        self._working = False


class PictureNode:
    """Processes images of vehicles; results are published a fixed simulated time after their processing began."""

    def __init__(
        self, vehicles: Sequence[PictureVehicle], process: Callable[..., Any], latency: float, workers: int = 1
    ) -> None:
        """Start the workers.

        Args:
            vehicles: Vehicles whose images are processed.
            process: Returns the results of an image's pixels; called by the workers.
            latency: Simulated time from an image to its results, s.
            workers: Images processed at the same time.
        """
        self._vehicles, self._process = vehicles, process
        self._latency_us = round(latency * 1e6)
        self._work = Deferred(workers, wait=lockstep.is_active())
        lockstep.add_reset_hook(self._work.clear)

    def step(self) -> None:
        """Publish the results that are due and start processing waiting images; call it at 50 Hz."""
        now_us = rospy.Time.now().to_nsec() // 1000
        for (vehicle, picture), found in self._work.ready(now_us):
            vehicle.finish(picture, found)
        for vehicle in self._vehicles:
            picture = vehicle.take()
            if picture is not None:
                self._work.put((vehicle, picture), now_us + self._latency_us, self._process, picture.pixels)

    def close(self) -> None:
        """Stop the workers."""
        self._work.close()
