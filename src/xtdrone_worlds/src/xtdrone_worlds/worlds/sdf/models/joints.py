"""Joints of models: reading, and the division of a model into the rigid parts that its joints connect.

A hinge or slide splits a model in two: ``door`` with the links up to the joint, and ``door::leaf``, named after its
first link, with those beyond it. Fixed joints hold links together in one part.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from xtdrone_common.files import shortened
from xtdrone_common.poses import Pose, compose, inverse, rotate
from xtdrone_common.rotation import Vector
from xtdrone_worlds.worlds.sdf.world_records import SdfJoint, SdfLink, SdfModel
from xtdrone_worlds.worlds.sdf.xml_elements import Element, read_pose, write_pose

MOVING = ("revolute", "continuous", "prismatic", "ball")
"""Types of joints that move; a continuous one is a revolute one without limits."""
WORLD = "world"
"""Parent of a joint that holds a link to the world."""

_LIMIT_FREE = 1e16  # Gazebo's limit of a joint without one


def read_joint(element: Element, frames: dict[str, Pose]) -> SdfJoint:
    """Read a <joint> of a model.

    Args:
        element: element of a type in ``MOVING`` or "fixed".
        frames: pose of each link, and ``WORLD``, in the frame of the result.

    Raises:
        SdfError: an end is not in ``frames``, or a number is not allowed.
    """
    element.warn_unknown(("parent", "child", "pose", "axis"), ("physics", "sensor"))
    kind = element.attributes.get("type", "")
    parent, child = (_end(element, tag, frames) for tag in ("parent", "child"))
    place = compose(frames[child], read_pose(element))
    base = SdfJoint(element.name(), kind, parent, child, place.position)
    if kind in ("fixed", "ball"):
        return base
    axis = element.required("axis")
    axis.warn_unknown(("xyz", "limit", "dynamics", "use_parent_model_frame"), ("initial_position",))
    turn = frames[WORLD].orientation if axis.boolean_of("use_parent_model_frame", False) else place.orientation
    return _with_limits(replace(base, axis=rotate(turn, _direction(axis))), axis)


def _end(element: Element, tag: str, frames: dict[str, Pose]) -> str:
    end = element.required(tag)
    name = end.string().strip()
    if name not in frames or (tag == "child" and name == WORLD):
        raise end.error(f"{shortened(name)!r} does not exist; there are {shortened(', '.join(frames))}")
    return name


def _direction(axis: Element) -> Vector:
    element = axis.one("xyz")
    x, y, z = (0.0, 0.0, 1.0) if element is None else element.numbers((3,))
    length = math.hypot(x, y, z)
    if abs(length - 1.0) < 1e-12:
        return (x, y, z)
    if element is not None and not length > 1e-6:
        raise element.error(f"{x:g} {y:g} {z:g} is not allowed as an axis, a vector that is not zero")
    return (x / length, y / length, z / length)


def _with_limits(joint: SdfJoint, axis: Element) -> SdfJoint:
    limit, dynamics = axis.one("limit"), axis.one("dynamics")
    if limit is not None:
        limit.warn_unknown(("lower", "upper"), ("effort", "velocity", "stiffness", "dissipation"))
        if joint.kind != "continuous":
            joint = replace(joint, lower=_bound(limit, "lower", -math.inf), upper=_bound(limit, "upper", math.inf))
        if joint.lower > joint.upper:
            raise limit.error(f"lower {joint.lower:g} is not allowed above upper {joint.upper:g}")
    if dynamics is not None:
        dynamics.warn_unknown(("damping", "friction"), ("spring_reference", "spring_stiffness"))
        damping, friction = (dynamics.number_of(tag, 0.0, 0.0) for tag in ("damping", "friction"))
        joint = replace(joint, damping=damping, friction=friction)
    return joint


def _bound(limit: Element, tag: str, missing: float) -> float:
    value = limit.number_of(tag, missing)
    return value if abs(value) < _LIMIT_FREE else missing


class Groups:
    """Groups of connected names; joining them takes nearly constant time (a disjoint-set forest)."""

    def __init__(self, names: Iterable[str]) -> None:
        """Start with each name in a group of its own."""
        self._above = {name: name for name in names}

    def __contains__(self, name: str) -> bool:
        """Whether the name is in a group."""
        return name in self._above

    def of(self, name: str) -> str:
        """Return the name that stands for the group of ``name``."""
        above = self._above
        while above[name] != name:
            above[name] = name = above[above[name]]
        return name

    def join(self, parent: str, child: str) -> None:
        """Make the groups of two names one."""
        self._above[self.of(child)] = self.of(parent)


def divide(model: SdfModel, joints: Sequence[SdfJoint]) -> tuple[list[SdfModel], list[SdfJoint]]:
    """Divide a model into its rigid parts.

    Args:
        model: model with all links.
        joints: between its links, fixed ones too, in the model's frame.

    Returns:
        The parts, each except the first with its first link at its origin, and the moving joints between them, in the
        world, with names such as ``door::hinge``. A part that a fixed joint holds to the world is static.
    """
    if model.static or not joints:
        return [model], []
    groups = Groups((WORLD, *(link.name for link in model.links)))
    for joint in joints:
        if joint.kind == "fixed":
            groups.join(joint.parent, joint.child)
    parts: list[SdfModel] = []
    names: dict[str, str] = {}
    members: dict[str, list[SdfLink]] = {}
    for link in model.links:
        members.setdefault(groups.of(link.name), []).append(link)
    for root, links in members.items():
        part = _part(model, links, is_first=not parts, static=root == groups.of(WORLD))
        parts.append(part)
        names |= {link.name: part.name for link in links}
    names[WORLD] = WORLD
    moving = [
        replace(
            joint,
            name=f"{model.name}::{joint.name}",
            parent=names[joint.parent],
            child=names[joint.child],
            anchor=compose(model.pose, Pose(joint.anchor)).position,
            axis=rotate(model.pose.orientation, joint.axis),
        )
        for joint in joints
        if joint.kind != "fixed"
    ]
    return parts, moving


def _part(model: SdfModel, links: Sequence[SdfLink], *, is_first: bool, static: bool) -> SdfModel:
    if is_first:
        return replace(model, links=tuple(links), static=static)
    origin = links[0].pose
    back = inverse(origin)
    placed = [replace(link, pose=compose(back, link.pose)) for link in links[1:]]
    first = replace(links[0], pose=Pose())
    return SdfModel(f"{model.name}::{first.name}", compose(model.pose, origin), static, (first, *placed))


def read_joint_of_world(element: Element, models: Sequence[str]) -> SdfJoint:
    """Read a <joint> between models of a world, as ``write_joint`` writes it: its pose is in the world.

    Raises:
        SdfError: a type, an end or a number is not allowed.
    """
    if element.attributes.get("type", "") not in MOVING:
        raise element.error(f"type {element.attributes.get('type', '')!r} is not allowed, {', '.join(MOVING)}")
    return read_joint(element, {name: Pose() for name in (*models, WORLD)})


def write_joint(joint: SdfJoint) -> list[str]:
    """Write a joint between models as an element of the world."""
    axis: list[str] = []
    if joint.kind != "ball":
        ends = (("lower", joint.lower), ("upper", joint.upper))
        limits = [f"<{tag}>{value!r}</{tag}>" for tag, value in ends if math.isfinite(value)]
        axis = [
            "  <axis>",
            f"    <xyz>{' '.join(map(repr, joint.axis))}</xyz>",
            f"    <limit>{''.join(limits)}</limit>",
            f"    <dynamics><damping>{joint.damping!r}</damping><friction>{joint.friction!r}</friction></dynamics>",
            "  </axis>",
        ]
    return [
        f'<joint name="{joint.name}" type="{joint.kind}">',
        f"  <parent>{joint.parent}</parent><child>{joint.child}</child>",
        f"  {write_pose(Pose(joint.anchor))}",
        *axis,
        "</joint>",
    ]
