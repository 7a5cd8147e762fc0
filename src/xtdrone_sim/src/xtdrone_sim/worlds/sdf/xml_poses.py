"""Poses in SDF files: x y z with roll pitch yaw or a quaternion x y z w, reading and writing."""

from __future__ import annotations

import math

from xtdrone_control.frames import to_xyzw
from xtdrone_control.rotation import from_euler, to_euler
from xtdrone_sim.shapes.visual import Pose
from xtdrone_sim.worlds.sdf.xml_elements import Element

_QUATERNION = "quat_xyzw"


def read_pose(parent: Element) -> Pose:
    """Read the <pose> of an element; the identity if it has none.

    Raises:
        SdfError: the pose is relative to another frame, or does not have six numbers (seven with a quaternion).
    """
    element = parent.one("pose")
    return Pose() if element is None else pose_of(element)


def pose_of(element: Element) -> Pose:
    """Parse the text of an element as a pose; see ``read_pose``."""
    frame = element.attributes.get("relative_to") or element.attributes.get("frame")
    if frame and frame not in {"world", "__model__"}:
        raise element.error(f"relative to {frame!r} is not allowed, poses are in the frame of the enclosing element")
    if element.attributes.get("degrees", "false") not in {"false", "0"}:
        raise element.error("degrees are not allowed, angles are in rad")
    form = element.attributes.get("rotation_format", "euler_rpy")
    if form not in {"euler_rpy", _QUATERNION}:
        raise element.error(f"rotation_format {form!r} is not allowed, euler_rpy or {_QUATERNION}")
    if not element.text.strip():
        return Pose()
    values = element.numbers((7,) if form == _QUATERNION else (6,))
    x, y, z = values[:3]
    if form != _QUATERNION:
        roll, pitch, yaw = values[3:]
        return Pose((x, y, z), from_euler(roll, pitch, yaw))
    qx, qy, qz, qw = values[3:]
    length = math.hypot(qx, qy, qz, qw)
    if abs(length - 1.0) > 1e-3:
        raise element.error(f"quaternion of length {length:g} is not allowed, of length 1")
    return Pose((x, y, z), (qw, qx, qy, qz))


def write_pose(pose: Pose, tag: str = "pose") -> str:
    """Write a pose as an element that ``pose_of`` restores bit for bit.

    Angles, which Gazebo Classic supports, are written if they are exact, otherwise a quaternion.
    """
    place = " ".join(map(repr, pose.position))
    for digits in (4, 6, 9, 12, 15):
        rounded = [round(angle, digits) + 0.0 for angle in to_euler(pose.orientation)]
        if from_euler(*rounded) == pose.orientation:
            return f"<{tag}>{place} {' '.join(map(repr, rounded))}</{tag}>"
    turn = " ".join(map(repr, to_xyzw(pose.orientation)))
    return f'<{tag} rotation_format="{_QUATERNION}">{place} {turn}</{tag}>'
