"""Poses as SDF writes them: x y z, and roll pitch yaw or a quaternion x y z w."""

from __future__ import annotations

import math

from xtdrone_sim.vehicles.poses import from_rpy
from xtdrone_sim.vehicles.visual import Pose, Quaternion, Vector
from xtdrone_sim.worlds.sdf.tree import Element

_QUATERNION = "quat_xyzw"


def angles(q: Quaternion) -> Vector:
    """Return roll, pitch, yaw of (x, y, z, w), rad; ``from_rpy`` undoes it up to sign and rounding."""
    x, y, z, w = q
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def read_pose(holder: Element) -> Pose:
    """Return the <pose> of an element, or none at all where it has none.

    Raises:
        SdfError: it is in another frame than its holder's, or not six numbers (seven with a quaternion).
    """
    element = holder.one("pose")
    return Pose() if element is None else pose_of(element)


def pose_of(element: Element) -> Pose:
    """Return the pose that an element's text says; see ``read_pose``."""
    frame = element.attributes.get("relative_to") or element.attributes.get("frame")
    if frame and frame not in {"world", "__model__"}:
        raise element.error(f"relative to {frame!r} is not allowed, poses are in the frame of what holds them")
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
        return Pose((x, y, z), from_rpy(roll, pitch, yaw))
    qx, qy, qz, qw = values[3:]
    length = math.hypot(qx, qy, qz, qw)
    if abs(length - 1.0) > 1e-3:
        raise element.error(f"quaternion of length {length:g} is not allowed, of length 1")
    return Pose((x, y, z), (qx, qy, qz, qw))


def write_pose(pose: Pose, tag: str = "pose") -> str:
    """Return the pose as an element from which ``pose_of`` reads the same bits.

    With angles, which Gazebo Classic reads too, wherever that is possible; else with a quaternion.
    """
    place = " ".join(map(repr, pose.position))
    for digits in (4, 6, 9, 12, 15):
        rounded = [round(angle, digits) + 0.0 for angle in angles(pose.orientation)]
        if from_rpy(*rounded) == pose.orientation:
            return f"<{tag}>{place} {' '.join(map(repr, rounded))}</{tag}>"
    turn = " ".join(map(repr, pose.orientation))
    return f'<{tag} rotation_format="{_QUATERNION}">{place} {turn}</{tag}>'
