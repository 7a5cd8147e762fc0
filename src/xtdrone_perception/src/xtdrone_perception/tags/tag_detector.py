"""Detection of AprilTags of the family 36h11 in grey images, by OpenCV's aruco module.

Corners are refined to subpixel accuracy. OpenCV's dictionary has the family's patterns rotated by 180 degrees; the
order of the corners is that of the authors' images, so that poses agree with apriltag_ros.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from xtdrone_common.settings import Settings, setting


@dataclass(frozen=True)
class TagDetectorSettings(Settings):
    """Settings of the detection."""

    least_edge: float = setting(12.0, low=8.0, high=1000.0, unit="px", text="minimum edge length of a tag")
    corrected_bits: int = setting(
        2, low=0, high=5, text="maximum number of wrong bits of a tag; higher values find more tags and more false ones"
    )


class SeenTag(NamedTuple):
    """A tag in an image.

    Attributes:
        id: number in the family.
        corners: upper left, upper right, lower right, lower left as printed, (4, 2) pixels; the centre of the image's
            upper left pixel is (0.5, 0.5).
    """

    id: int
    corners: NDArray[np.float64]


class TagDetector:
    """Finds the tags in images; one thread at a time."""

    _LEAST_RATE = 1e-3  # of OpenCV's perimeter rate, relative to the image's longer side

    def __init__(self, settings: TagDetectorSettings) -> None:
        """Prepare the dictionary."""
        self._settings = settings
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        self._parameters = parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.relativeCornerRefinmentWinSize = 0.4
        parameters.cornerRefinementMinAccuracy = 0.01
        parameters.cornerRefinementMaxIterations = 50
        parameters.errorCorrectionRate = settings.corrected_bits / max(1, family.maxCorrectionBits)
        self._detector = cv2.aruco.ArucoDetector(family, parameters)

    def detect(self, grey: NDArray[np.uint8]) -> list[SeenTag]:
        """Return the tags of an image, (height, width), by id; of several with the same id, the largest."""
        rate = 4.0 * self._settings.least_edge / max(grey.shape)
        self._parameters.minMarkerPerimeterRate = max(rate, self._LEAST_RATE)
        self._detector.setDetectorParameters(self._parameters)
        found, ids, _ = self._detector.detectMarkers(grey)
        best: dict[int, SeenTag] = {}
        for number, corners in zip([] if ids is None else ids.ravel().tolist(), found, strict=True):
            tag = SeenTag(number, np.roll(corners.reshape(4, 2).astype(float), 2, axis=0) + 0.5)
            if number not in best or _area(tag) > _area(best[number]):
                best[number] = tag
        return [best[number] for number in sorted(best)]


def _area(tag: SeenTag) -> float:
    return abs(float(cv2.contourArea(tag.corners.astype(np.float32))))
