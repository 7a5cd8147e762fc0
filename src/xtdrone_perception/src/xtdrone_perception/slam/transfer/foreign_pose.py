"""Conversion of sensor poses from third-party odometry or SLAM to poses of the vehicle in map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xtdrone_common.cameras.camera_pose import LINK_FROM_OPTICAL
from xtdrone_common.frames import to_xyzw
from xtdrone_common.pose_matrices import inverse, pose_of, turned_about_z
from xtdrone_common.settings import SettingError, Settings, setting

Array = NDArray[np.float64]

STATIC = -1
"""Time of a transform that holds at all times."""

_UNIT = 0.05  # tolerance of a quaternion's norm


@dataclass(frozen=True)
class PlaceSettings(Settings):
    """Frames of the third-party program."""

    start: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-1e5, high=1e5, unit="m", text="origin of the other program's frame in map, ENU"
    )
    heading: float = setting(
        0.0, low=-6.3, high=6.3, unit="rad", text="heading of the x axis of that frame in map, from east to north"
    )
    sensor_position: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-5.0, high=5.0, unit="m",
        text="position in base_link of the sensor whose pose is received, FLU",
    )  # fmt: skip


def read_starts(value: object, count: int) -> list[tuple[float, float, float]]:
    """Return the starts of several vehicles, x, y, z, m in map, from a parameter.

    Raises:
        SettingError: it is not a list of ``count`` lists of three finite numbers.
    """
    try:
        starts = np.array(value, float)
    except (TypeError, ValueError):
        starts = np.empty(0)
    if starts.shape != (count, 3) or not np.isfinite(starts).all():
        raise SettingError("starts", value, f"a list of {count} lists of x, y, z, m")
    return [(x, y, z) for x, y, z in starts.tolist()]


def pose_from(position: Array, quaternion: Array) -> Array | None:
    """Return a received pose (4, 4).

    Args:
        position: (3,) m.
        quaternion: (w, x, y, z).

    Returns:
        None if a number is not finite, or the quaternion's norm is not close to 1.
    """
    norm = float(np.linalg.norm(quaternion))
    if not (np.isfinite(position).all() and abs(norm - 1.0) <= _UNIT):  # false for NaN
        return None
    w, x, y, z = quaternion / norm
    return pose_of(position, Rotation.from_quat([x, y, z, w]))


class ForeignFrame:
    """Converts poses of a sensor in the third-party program's frame to poses of the vehicle in map."""

    def __init__(self, settings: PlaceSettings, optical: bool) -> None:
        """Prepare the transforms.

        Args:
            settings: Settings of the frames.
            optical: whether poses refer to the optical frame (x right, y down, z ahead) of a forward camera; otherwise
                to a frame with the axes of base_link (FLU).
        """
        self._frame = pose_of(settings.start, turned_about_z(settings.heading))
        turn = Rotation.from_quat(to_xyzw(LINK_FROM_OPTICAL)) if optical else Rotation.identity()
        self._body = inverse(pose_of(settings.sensor_position, turn))

    def vehicle(self, position: Array, quaternion: Array, height: float | None = None) -> Array | None:
        """Return the pose (4, 4) of base_link in map.

        Args:
            position: (3,) m, of the sensor.
            quaternion: (w, x, y, z), of the sensor.
            height: of base_link in map, m, from another sensor, for programs that work in the plane; None: that of the
                pose.

        Returns:
            None if ``pose_from`` rejects the pose.
        """
        sensor = pose_from(position, quaternion)
        if sensor is None:
            return None
        pose = self._frame @ sensor @ self._body
        if height is not None:
            pose[2, 3] = height
        return pose


class TransformChain:
    """The newest transforms of /tf and /tf_static, which are composed to chains."""

    def __init__(self) -> None:
        """Start without any."""
        self._parents: dict[str, tuple[str, int, Array]] = {}  # child to parent, ns or a negative number, pose

    def clear(self) -> None:
        """Forget all transforms."""
        self._parents.clear()

    def add(self, parent: str, child: str, stamp_ns: int, pose: Array) -> None:
        """Store the pose (4, 4) of ``child`` in ``parent`` at a time, ns; 0: not given, ``STATIC``: at all times."""
        self._parents[child.lstrip("/")] = (parent.lstrip("/"), stamp_ns, pose)

    def pose(self, parent: str, child: str) -> tuple[int, Array] | None:
        """Return the pose of a frame in one of its ancestors.

        Returns:
            The time of the newest link between them, ns, 0 if none is given, and the pose (4, 4) of ``child`` in
            ``parent``; None if they are not linked, or by static transforms only, which measure nothing.
        """
        parent, child = parent.lstrip("/"), child.lstrip("/")
        pose, frame, newest = np.eye(4), child, STATIC
        for _ in range(len(self._parents)):
            if frame == parent or frame not in self._parents:
                break
            frame, stamp_ns, step = self._parents[frame]
            pose, newest = step @ pose, max(newest, stamp_ns)
        return (newest, pose) if frame == parent and newest != STATIC else None


class ChainWatch:
    """Tells new poses of a chain of transforms from repeated ones."""

    def __init__(self) -> None:
        """Start without a pose."""
        self._last: tuple[int, Array] | None = None

    def is_new(self, found: tuple[int, Array]) -> bool:
        """Return whether time (ns) and pose (4, 4) are not those of the call before.

        The time tells it; where the transforms have none (0), a pose that has not changed in any bit is not a new
        measurement.
        """
        last, self._last = self._last, found
        if last is None or found[0] != last[0]:
            return True
        return found[0] == 0 and not np.array_equal(found[1], last[1])
