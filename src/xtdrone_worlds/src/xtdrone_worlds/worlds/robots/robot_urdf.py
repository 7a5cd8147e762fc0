"""A robot's description as URDF, and the frames of its wheels, for rviz and tf."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree import ElementTree

from xtdrone_common.poses import Pose, from_axis_angle
from xtdrone_common.rotation import Vector, to_euler
from xtdrone_worlds.shapes.visual import Box, Cylinder, Visual
from xtdrone_worlds.worlds.robots.robot_model import LINK, AnyRobot, BoatModel
from xtdrone_worlds.worlds.robots.robot_settings import JointMotion

_UP, _LEFT = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


class WheelJoint(NamedTuple):
    """A joint of a wheel or its steering.

    Attributes:
        name: as in the joint states.
        parent, child: links.
        position: position of the child in the parent, m.
        axis: axis in both.
    """

    name: str
    parent: str
    child: str
    position: Vector
    axis: Vector


def wheel_joints(model: AnyRobot) -> list[WheelJoint]:
    """Return the joints of a type, those of ``Drive.joints``, parents first."""
    if isinstance(model, BoatModel):
        return []
    height, joints = model.limits.wheel_radius, []
    for name, x, y, is_steered in model.wheels:
        parent, place = LINK, (x, y, height)
        if is_steered:
            joints.append(WheelJoint(f"{name}_steering_joint", parent, f"{name}_steering", place, _UP))
            parent, place = f"{name}_steering", (0.0, 0.0, 0.0)
        joints.append(WheelJoint(f"{name}_wheel_joint", parent, f"{name}_wheel", place, _LEFT))
    return joints


def wheel_frames(model: AnyRobot, states: Sequence[JointMotion]) -> list[tuple[str, str, Pose]]:
    """Return parent, child and pose in the parent of each wheel's frames.

    Args:
        model: type of the robot.
        states: states of ``Drive.joints``.
    """
    angles = {state.name: state.angle for state in states}
    return [
        (joint.parent, joint.child, Pose(joint.position, from_axis_angle(joint.axis, angles[joint.name])))
        for joint in wheel_joints(model)
    ]


def urdf_of(name: str, model: AnyRobot) -> str:
    """Return the description of a robot: ``base_link``, wheels, steering, and ``platform`` if it has one."""
    root = ElementTree.Element("robot", name=name)
    base = model.model(name, Pose(), wheels=False).links[0]
    _link(root, LINK, base.visuals)
    for joint in wheel_joints(model):
        assert not isinstance(model, BoatModel)
        _link(root, joint.child, (model.wheel,) if joint.axis == _LEFT else ())
        _joint(root, joint.name, "continuous", joint.parent, joint.child, joint.position, joint.axis)
    if model.platform is not None:
        _link(root, "platform", ())
        place = (model.ahead, 0.0, model.platform.height)
        _joint(root, "platform_joint", "fixed", LINK, "platform", place)
    return ElementTree.tostring(root, encoding="unicode")


def _link(root: ElementTree.Element, name: str, visuals: Sequence[Visual]) -> None:
    link = ElementTree.SubElement(root, "link", name=name)
    for number, visual in enumerate(visuals):
        one = ElementTree.SubElement(link, "visual")
        ElementTree.SubElement(
            one, "origin", xyz=_text(visual.pose.position), rpy=_text(to_euler(visual.pose.orientation))
        )
        form = ElementTree.SubElement(one, "geometry")
        if isinstance(visual.geometry, Box):
            ElementTree.SubElement(form, "box", size=_text(visual.geometry.size))
        elif isinstance(visual.geometry, Cylinder):
            radius, length = _text((visual.geometry.radius,)), _text((visual.geometry.length,))
            ElementTree.SubElement(form, "cylinder", radius=radius, length=length)
        material = ElementTree.SubElement(one, "material", name=f"{name}_{number}")
        ElementTree.SubElement(material, "color", rgba=_text(visual.colour))


def _joint(
    root: ElementTree.Element, name: str, kind: str, parent: str, child: str, place: Vector, axis: Vector | None = None
) -> None:
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=_text(place), rpy="0 0 0")
    if axis is not None:
        ElementTree.SubElement(joint, "axis", xyz=_text(axis))


def _text(values: Sequence[float]) -> str:
    return " ".join(f"{0.0 if math.isclose(value, 0.0, abs_tol=1e-12) else value:.9g}" for value in values)
