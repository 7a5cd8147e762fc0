"""A camera's images from drawn ones: projection through its lens, and the noise of its sensor."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import rospy
from numpy.typing import NDArray

from xtdrone_common.cameras import Lens, drawing_of
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_sim.cameras.cameras_of_fleet import Camera

Colours = NDArray[np.uint8]  # (height, width, 3) RGB


class Exposure:
    """The colour images of one exposure, each computed once."""

    def __init__(self, camera: Camera, stamp: rospy.Time, pictures: Sequence[bytes]) -> None:
        """Store the arguments; images are computed on demand.

        Args:
            camera: the camera.
            stamp: time of the exposure.
            pictures: pictures of each of its views, see ``camera_worker.DrawingProcess.draw``.
        """
        self._camera = camera
        self._stamp = stamp
        self._pictures = pictures
        self._made: dict[tuple[int, bool], Colours] = {}

    def raw(self, eye: int) -> Colours:
        """Return the image of the left or only camera, 0, or of the right one, 1."""
        return self._picture(eye, rectify=False)

    def rectify(self, eye: int) -> Colours:
        """Return the same image as seen by the pinhole; without a lens, the image itself."""
        return self._picture(eye, rectify=self._camera.mount.lens is not None)

    def _picture(self, eye: int, *, rectify: bool) -> Colours:
        key = (eye, rectify)
        if key not in self._made:
            mount = self._camera.mount
            noise = noise_of(self._camera, self._stamp, 1 + eye + 2 * rectify)
            self._made[key] = grainy(self._seen(eye, rectify), mount.image_noise, noise)
        return self._made[key]

    def _seen(self, eye: int, rectify: bool) -> Colours:
        """Return an image without noise."""
        mount = self._camera.mount
        if mount.lens is None or (rectify and mount.has_depth):
            return pixels_of(mount.pinhole, self._pictures[eye])
        drawing = drawing_of(mount.lens)
        first = eye * len(drawing.faces) + mount.has_depth
        faces = self._pictures[first : first + len(drawing.faces)]
        sheet = np.concatenate([pixels_of(drawing.pinhole, face) for face in faces])
        return without_lens(mount.lens, sheet) if rectify else through_lens(mount.lens, sheet)


def pixels_of(pinhole: Pinhole, picture: bytes) -> Colours:
    """Return the colours of a drawn image, (height, width, 3)."""
    size = pinhole.width * pinhole.height
    return np.frombuffer(picture, np.uint8, 3 * size).reshape(pinhole.height, pinhole.width, 3)


def through_lens(lens: Lens, sheet: Colours) -> Colours:
    """Return a lens's image from the images drawn for it, interpolated linearly; black where it has no rays.

    Args:
        lens: the lens.
        sheet: the images of ``drawing_of(lens)``, stacked vertically.
    """
    drawing = drawing_of(lens)
    return np.asarray(opencv().remap(sheet, drawing.columns, drawing.rows, opencv().INTER_LINEAR))


def without_lens(lens: Lens, sheet: Colours) -> Colours:
    """Return the image of the lens's pinhole from the same images; black outside the lens's view."""
    columns, rows = drawing_of(lens).plain
    return np.asarray(opencv().remap(sheet, columns, rows, opencv().INTER_LINEAR))


def grainy(picture: Colours, deviation: float, rng: np.random.Generator) -> Colours:
    """Return an image with normal noise in each channel, standard deviation in units of 1/255, clipped to 0..255."""
    if deviation == 0.0:
        return picture
    noise = np.float32(255.0 * deviation) * rng.standard_normal(picture.shape, np.float32)
    return np.clip(np.rint(picture + noise), 0.0, 255.0).astype(np.uint8)


def noise_of(camera: Camera, stamp: rospy.Time, *stream: int) -> np.random.Generator:
    """Return the generator of one exposure's noise, which depends on its time and not on earlier exposures.

    Args:
        camera: the camera.
        stamp: time of the exposure.
        stream: none for depths; 1 for the left or only colour image, 2 for the right one, 3 and 4 for rectified ones.
    """
    name = zlib.crc32(camera.topics.encode())
    return np.random.default_rng((camera.mount.seed, name, stamp.to_nsec(), *stream))


def opencv() -> Any:
    """Return OpenCV, which cameras without compressed topics or lenses do not load."""
    import cv2

    return cv2
