"""Poses as SDF writes them: x y z, and roll pitch yaw or a quaternion x y z w."""

from __future__ import annotations

import math

from ..visual import Pose, Quaternion, Vector
from .tree import Element

_QUATERNION = "quat_xyzw"
_LEVEL = (0.0, 0.0, 0.0, 1.0)


def quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation about the fixed axes x, y, z in this order, rad, as (x, y, z, w)."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def angles(q: Quaternion) -> Vector:
    """Return roll, pitch, yaw of (x, y, z, w), rad; ``quaternion`` undoes it up to sign and rounding."""
    x, y, z, w = q
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Return ``v`` turned by the unit quaternion (x, y, z, w)."""
    x, y, z, w = q
    tx, ty, tz = 2.0 * (y * v[2] - z * v[1]), 2.0 * (z * v[0] - x * v[2]), 2.0 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


def compose(outer: Pose, inner: Pose) -> Pose:
    """Return ``inner``, given in the frame ``outer``, in the frame in which ``outer`` is given."""
    ox, oy, oz, ow = outer.orientation
    ix, iy, iz, iw = inner.orientation
    turned = rotate(outer.orientation, inner.position)
    return Pose(
        (
            outer.position[0] + turned[0],
            outer.position[1] + turned[1],
            outer.position[2] + turned[2],
        ),
        (
            ow * ix + ox * iw + oy * iz - oz * iy,
            ow * iy - ox * iz + oy * iw + oz * ix,
            ow * iz + ox * iy - oy * ix + oz * iw,
            ow * iw - ox * ix - oy * iy - oz * iz,
        ),
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
        return Pose((x, y, z), quaternion(roll, pitch, yaw))
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
        if quaternion(*rounded) == pose.orientation:
            return f"<{tag}>{place} {' '.join(map(repr, rounded))}</{tag}>"
    turn = " ".join(map(repr, pose.orientation))
    return f'<{tag} rotation_format="{_QUATERNION}">{place} {turn}</{tag}>'
