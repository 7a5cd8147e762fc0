"""Mass of links, and which models can move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from xtdrone_common.files import shortened
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import has_heightmap
from xtdrone_worlds.worlds.sdf.models.joints import MOVING, WORLD, Groups
from xtdrone_worlds.worlds.sdf.world_records import DEFAULT_INERTIAL, SdfLink, SdfModel
from xtdrone_worlds.worlds.sdf.xml_elements import Element, read_pose
from xtdrone_worlds.worlds.urdf import Inertial

INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
"""Elements of <inertia>, in the order of ``Inertial.inertia``."""
MOST_SHAPES = 16
"""Largest number of collision shapes of a body; Bullet's limit."""

_MOST_MASS = 1e6  # kg


def read_inertial(link: Element) -> Inertial | None:
    """Read the <inertial> of a link; missing values are those of Gazebo, 1 kg and 1 kg m^2 about each axis.

    Raises:
        SdfError: a value is not a finite number.
    """
    element = link.one("inertial")
    if element is None:
        return None
    element.warn_unknown(("mass", "pose", "inertia"), ("density",))
    inertia = element.one("inertia")
    values = list(DEFAULT_INERTIAL.inertia)
    if inertia is not None:
        inertia.warn_unknown(INERTIA)
        for number, tag in enumerate(INERTIA):
            values[number] = inertia.number_of(tag, values[number])
    ixx, iyy, izz, ixy, ixz, iyz = values
    return Inertial(
        element.number_of("mass", DEFAULT_INERTIAL.mass), read_pose(element), (ixx, iyy, izz, ixy, ixz, iyz)
    )


def why_standing(model: Element, parts: Sequence[SdfModel]) -> str:
    """Return the reason why a model that is not static cannot move; "" if it can.

    Args:
        model: its element.
        parts: its rigid parts, see ``joints.divide``.
    """
    for element in model.all("link"):
        if has_heightmap(element):
            return f"its link {element.name()!r} is terrain"
        if element.boolean_of("kinematic", False):
            return f"its link {element.name()!r} is kinematic"
    for part in parts:
        reason = "" if part.static else _why_not_a_body(part.links)
        if reason:
            return reason
    return ""


def _why_not_a_body(links: Sequence[SdfLink]) -> str:
    """Return the reason why links cannot be one rigid body; "" if they can."""
    shapes = sum(len(link.collisions) for link in links)
    if not shapes:
        return f"nothing of {' and '.join(repr(link.name) for link in links) or 'it'} collides: it would fall forever"
    if shapes > MOST_SHAPES:
        return f"{links[0].name!r} has {shapes} collision shapes, a body at most {MOST_SHAPES}"
    for link in links:
        if link.inertial is not None and not is_possible(link.inertial):
            return f"its link {link.name!r} has a mass and inertia that are not physically possible"
    return ""


def why_loose(model: Element, links: Sequence[SdfLink]) -> str:
    """Return the reason why links and joints do not form one model; "" if they do."""
    names = [link.name for link in links]
    groups = Groups((WORLD, *names))
    for joint in model.all("joint"):
        name, kind = joint.attributes.get("name", ""), joint.attributes.get("type", "")
        if kind not in (*MOVING, "fixed"):
            return f"its joint {name!r} of type {kind!r} is not supported"
        ends = [joint.one(tag) for tag in ("parent", "child")]
        parent, child = ("" if end is None else end.text.strip() for end in ends)
        if parent not in groups or child not in groups or child == WORLD:
            return f"its joint {name!r} does not connect two of its links or one with the world"
        groups.join(parent, child)
    if len({groups.of(name) for name in names}) > 1:
        return f"its links {shortened(', '.join(names))} are not connected"
    return ""


def is_possible(inertial: Inertial) -> bool:
    """Return whether mass and inertia are positive and not extreme."""
    ixx, iyy, izz, ixy, ixz, iyz = inertial.inertia
    moments = np.linalg.eigvalsh([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    return 0.0 < inertial.mass <= _MOST_MASS and bool(moments[0] > 0.0)
