"""Poses of frames in the map frame: from /tf and /tf_static, and for vehicles without TF from the simulator.

The pose of a vehicle's body is the one that the page draws, unless a node publishes its frame; the frames of its links
and sensors follow from its description, as ``robot_tf.py`` publishes them.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import rospy
import tf2_py
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from xtdrone_common.fleet import Vehicle
from xtdrone_common.frames import to_xyzw
from xtdrone_common.pose_matrices import pose_of
from xtdrone_interaction.web.layers.layer_content import LayerError
from xtdrone_sim.tf.vehicle_frames import RobotFrames
from xtdrone_sim.tf.vehicle_tf_node import transform
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.descriptions import ModelError

MAP = "map"
_SAME = ("", MAP, "world", "local_origin")
"""Frames that are the map frame, unless TF has them."""
_MEMORY = 10.0  # s
_AUTHORITY = "web_station"  # in tf2's warnings
log = logging.getLogger("xtdrone.web")

Array = NDArray[np.float64]


class FramesInMap:
    """Looks up frames; its methods may be called in any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._fleet: tuple[Vehicle, ...] = ()
        self._bodies: list[str] = []
        self._known: dict[str, TransformStamped] = {}  # fixed frames by child; TF's replace the descriptions'
        self._told: set[str] = set()  # children whose poses come from TF
        self._time = -1.0  # of the newest poses of vehicles, s
        self._buffer = tf2_py.BufferCore(rospy.Duration.from_sec(_MEMORY))

    def is_of(self, fleet: Sequence[Vehicle]) -> bool:
        """Return whether the vehicles are those of the last ``set_fleet``."""
        return tuple(fleet) == self._fleet

    def set_fleet(self, fleet: Sequence[Vehicle]) -> None:
        """Load the fixed frames of the vehicles' descriptions, which may take a while."""
        if self.is_of(fleet):
            return
        bodies, fixed = [], []
        for vehicle in fleet:
            try:
                frames = RobotFrames(vehicle.name, load_vehicle(vehicle.model))
            except ModelError as error:
                log.warning("%s: its frames are unknown: %s", vehicle.name, error)
                bodies.append(f"{vehicle.name}/base_link")
                continue
            bodies.append(frames.body)
            fixed += [transform(frame, rospy.Time()) for frame in (*frames.fixed, *frames.at_rest())]
        with self._lock:
            self._fleet, self._bodies = tuple(fleet), bodies
            for entry in fixed:
                if entry.child_frame_id not in self._told:
                    self._known[entry.child_frame_id] = entry
            self._restart()

    def set_vehicles(self, rows: Array, time: float) -> None:
        """Store the poses of the vehicles.

        Args:
            rows: (n, 10) of the fleet's frame, in the order of the fleet; NaN for absent vehicles.
            time: s of ROS time.
        """
        with self._lock:
            if time == self._time:  # tf2 would warn of poses at the same time
                return
            if time < self._time:  # a reset
                self._restart()
            self._time = time
            stamp = rospy.Time.from_sec(time)
            for body, row in zip(self._bodies, rows, strict=False):
                if body not in self._told and np.isfinite(row[:7]).all() and np.linalg.norm(row[3:7]) > 0.0:
                    self._buffer.set_transform(_stamped(body, row[:3], row[3:7] / np.linalg.norm(row[3:7]), stamp), "")

    def hear(self, message: TFMessage) -> None:
        """Store transforms of /tf."""
        entries = _usable(message.transforms)
        with self._lock:
            for entry in entries:
                self._known.pop(entry.child_frame_id, None)
                self._note(entry.child_frame_id)
            for entry in entries:  # after all are noted, as a new frame makes the buffer forget
                self._buffer.set_transform(entry, _AUTHORITY)

    def hear_static(self, message: TFMessage) -> None:
        """Store transforms of /tf_static."""
        with self._lock:
            for entry in _usable(message.transforms):
                self._note(entry.child_frame_id)
                self._known[entry.child_frame_id] = entry
                self._buffer.set_transform_static(entry, _AUTHORITY)

    def pose(self, frame: str, topic: str, stamp: rospy.Time) -> Array:
        """Return the pose (4, 4) of a frame in the map frame at a time, or the newest one if that time is not known.

        Args:
            frame: of a message's header.
            topic: of the message; ``base_link`` alone is that of the topic's vehicle.
            stamp: of the message.

        Raises:
            LayerError: no chain of transforms connects the frame to the map frame.
        """
        name = frame.lstrip("/")
        with self._lock:
            if name == "base_link" and not self._has(name):
                name = next((body for body in self._bodies if topic.startswith(f"/{body.split('/')[0]}/")), name)
            if name == MAP or (name in _SAME and not self._has(name)):
                return np.eye(4)
            for time in (stamp, rospy.Time()):
                with suppress(tf2_py.TransformException, ValueError):  # ValueError: a name that C cannot hold
                    return _matrix(self._buffer.lookup_transform_core(MAP, name, time).transform)
        raise LayerError(f"frame_id: {frame[:80]!r} is not allowed, one that TF connects to {MAP!r}")

    def _has(self, name: str) -> bool:
        return bool(name) and name in self._told

    def _note(self, child: str) -> None:
        """Register a frame of TF; its poses from other sources are discarded."""
        if child not in self._told:
            self._told.add(child)
            self._restart()

    def _restart(self) -> None:
        """Forget all poses but the fixed ones."""
        self._buffer.clear()
        for entry in self._known.values():
            self._buffer.set_transform_static(entry, _AUTHORITY)


def _usable(transforms: Iterable[TransformStamped]) -> list[TransformStamped]:
    """Return the transforms whose numbers are those of a pose; tf2 would print the others on every lookup."""
    found = []
    for entry in transforms:
        place, turn = entry.transform.translation, entry.transform.rotation
        numbers = np.array([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])
        if np.isfinite(numbers).all() and abs(np.linalg.norm(numbers[3:]) - 1.0) < 0.1:
            found.append(entry)
    return found


def _stamped(child: str, position: Array, quaternion: Array, stamp: rospy.Time) -> TransformStamped:
    place = Transform(Vector3(*position.tolist()), Quaternion(*to_xyzw(quaternion.tolist())))
    return TransformStamped(Header(stamp=stamp, frame_id=MAP), child, place)


def _matrix(found: Any) -> Array:
    place, turn = found.translation, found.rotation
    return pose_of([place.x, place.y, place.z], Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]))
