"""Models that requests describe, by URDF or SDF, and the limits of their shapes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from xtdrone_common.poses import Pose, compose
from xtdrone_sim.gazebo.request_limits import FARTHEST, RequestError, check_vector
from xtdrone_worlds.worlds.sdf import SdfError, SdfLink, SdfModel, read_model
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of
from xtdrone_worlds.worlds.sdf.models.rigid_links import is_possible
from xtdrone_worlds.worlds.urdf import Description, Inertial, UrdfError, parse_urdf

MOST_SHAPES = 256  # of a model
_SIZES = (1e-3, 1e4)  # m, longest side of a shape
_STATIC = re.compile(r"<static>\s*(true|1)\s*</static>")


def model_of_urdf(text: str) -> SdfModel:
    """Return the model of a URDF; joints are fixed at 0, and a model with movable joints is static.

    Raises:
        RequestError: the URDF is invalid, or names a file outside ROS packages.
    """
    try:
        description = parse_urdf(text, Path("model_xml"), is_foreign=True)
        mass, centre, inertia = description.mass() if _has_mass(description) else (0.0, None, None)
    except UrdfError as error:
        raise RequestError(f"model_xml: {error}") from error
    inertial = None
    if centre is not None and inertia is not None:
        x, y, z = centre.tolist()
        ixx, ixy, ixz, _, iyy, iyz, _, _, izz = inertia.ravel().tolist()
        inertial = Inertial(mass, Pose((x, y, z)), (ixx, iyy, izz, ixy, ixz, iyz))
    parts = description.moving
    movable = len(parts) == 1 and bool(parts[0].collisions) and inertial is not None and is_possible(inertial)
    if not movable or _STATIC.search(text):
        inertial = None
    links = tuple(
        SdfLink(part.name, _pose_of(description, part.name), part.visuals, part.collisions, inertial) for part in parts
    )
    return SdfModel(description.name, Pose(), inertial is None, links)


def _has_mass(description: Description) -> bool:
    return any(link.inertial is not None and link.inertial.mass > 0.0 for link in description.links)


def _pose_of(description: Description, name: str) -> Pose:
    """Return the pose of a link in the root's frame with all joints at 0."""
    pose = Pose()
    while (joint := description.holder(name)) is not None:
        pose, name = compose(joint.pose, pose), joint.parent
    return pose


def model_of_sdf(text: str) -> SdfModel:
    """Return the model of an SDF.

    Raises:
        RequestError: the SDF is invalid.
    """
    try:
        return read_model(text, "model_xml")
    except SdfError as error:
        raise RequestError(str(error)) from error


def check_model(model: SdfModel) -> None:
    """Check the number and the size of a model's shapes.

    Raises:
        RequestError: there are too many, one is too small or large, or a mesh cannot be read.
    """
    count = sum(len(link.visuals) + len(link.collisions) for link in model.links)
    if not 0 < count <= MOST_SHAPES:
        raise RequestError(f"model_xml: {count} visuals and collisions are not allowed, 1 to {MOST_SHAPES}")
    low, high = _SIZES
    for link in model.links:
        shapes = [(shape.geometry, shape.pose) for shape in link.collisions]
        for geometry, pose in shapes + [(shape.geometry, shape.pose) for shape in link.visuals]:
            try:
                lowest, highest = box_of(geometry, pose)
            except SdfError as error:
                raise RequestError(f"model_xml: {error}") from error
            longest = float(np.max(np.asarray(highest) - np.asarray(lowest)))
            if not low <= longest <= high:
                words = f"a shape {longest:g} m long is not allowed, {low:g} to {high:g} m"
                raise RequestError(f"model_xml: link {link.name!r}: {words}")
        check_vector(f"model_xml: link {link.name!r}: position", link.pose.position, FARTHEST)
