"""Motion blur: images of exposures with a duration, from the opening to the closing of the shutter.

An image with an exposure time is the mean of several, drawn at evenly spaced times of that interval, in which bodies
move from one scene to the next at constant speed. The motion of the camera and that of the objects in view blur the
image. With n images of an interval T, an edge that moves by d pixels becomes n steps of d / n.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from xtdrone_msgs.msg import SceneState

from xtdrone_common.poses import Pose
from xtdrone_common.rotation import Quaternion, Vector
from xtdrone_sim.rays.scene import ActorInScene, SceneAt
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import CameraMount

_MARGIN_US = 100_000  # several periods of the scenes


class RecentScenes:
    """The most recent scenes."""

    def __init__(self, longest: float, read: Callable[[SceneState], SceneAt]) -> None:
        """Start without a scene.

        Args:
            longest: the longest exposure, s.
            read: returns the poses of a message.
        """
        self._longest_us = round(1e6 * longest) + _MARGIN_US
        self._read = read
        self._kept: deque[tuple[int, SceneState]] = deque()
        self._poses: dict[int, SceneAt] = {}

    def clear(self) -> None:
        """Discard all scenes after a reset of simulated time."""
        self._kept.clear()
        self._poses.clear()

    def add(self, time_us: int, scene: SceneState) -> None:
        """Add the scene of a time, microseconds; one that is not later than the last is ignored."""
        if self._kept and time_us <= self._kept[-1][0]:
            return
        self._kept.append((time_us, scene))
        while len(self._kept) > 1 and self._kept[1][0] <= time_us - self._longest_us:
            self._poses.pop(self._kept.popleft()[0], None)

    def at(self, time_us: float) -> SceneAt:
        """Return the poses at a time, microseconds; before the first scene those of the first, and likewise at the end.

        Raises:
            ValueError: there is no scene.
        """
        if not self._kept:
            raise ValueError("scenes: none has been received yet")
        for earlier, later in pairwise(self._kept):
            if earlier[0] <= time_us < later[0]:
                part = (time_us - earlier[0]) / (later[0] - earlier[0])
                return interpolate(self._of(*earlier), self._of(*later), part) if part > 0.0 else self._of(*earlier)
        return self._of(*(self._kept[0] if time_us < self._kept[0][0] else self._kept[-1]))

    def _of(self, time_us: int, scene: SceneState) -> SceneAt:
        if time_us not in self._poses:
            self._poses[time_us] = self._read(scene)
        return self._poses[time_us]


def exposure_times(mount: CameraMount, closed_us: int) -> list[float]:
    """Return the times of the images of an exposure, microseconds; the one in the middle is that of its stamp.

    Args:
        mount: the camera.
        closed_us: time at which the shutter closes.
    """
    if mount.exposure == 0.0:
        return [float(closed_us)]
    count, whole = mount.exposure_pictures, 1e6 * mount.exposure
    return [closed_us - whole * (count - k - 0.5) / count for k in range(count)]


def middle_us(mount: CameraMount, closed_us: int) -> int:
    """Return the time in the middle of an exposure that ends at ``closed_us``, microseconds."""
    return closed_us - round(0.5e6 * mount.exposure)


def interpolate(before: SceneAt, after: SceneAt, part: float) -> SceneAt:
    """Return the poses at the fraction ``part``, 0 to 1, between one scene and the next.

    Links and actors that are in only one of the scenes keep their poses there.
    """
    links = {name: _interpolate(before.links.get(name, pose), pose, part) for name, pose in after.links.items()}
    links |= {name: pose for name, pose in before.links.items() if name not in links}
    actors = {
        name: ActorInScene(_interpolate(before.actors.get(name, state).pose, state.pose, part), state.phase)
        for name, state in after.actors.items()
    }
    return SceneAt(links, actors)


def _interpolate(before: Pose, after: Pose, part: float) -> Pose:
    if before == after:
        return after
    x, y, z = (a + part * (b - a) for a, b in zip(before.position, after.position, strict=True))
    place: Vector = (x, y, z)
    return Pose(place, _turn(before.orientation, after.orientation, part))


def _turn(before: Quaternion, after: Quaternion, part: float) -> Quaternion:
    """Return the orientation between two that differ little, by their normalised mean."""
    same = sum(a * b for a, b in zip(before, after, strict=True)) >= 0.0
    w, x, y, z = ((1.0 - part) * a + (part if same else -part) * b for a, b in zip(before, after, strict=True))
    length = (w * w + x * x + y * y + z * z) ** 0.5
    return w / length, x / length, y / length, z / length


def mean_of(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return the mean of images of one shape, rounded."""
    if len(pictures) == 1:
        return pictures[0]
    whole = np.zeros(pictures[0].shape, np.uint32)
    for picture in pictures:
        whole += picture
    return ((whole + len(pictures) // 2) // len(pictures)).astype(np.uint8)
