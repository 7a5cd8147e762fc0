"""Reader of URDF files: links and joints of a vehicle with their visuals, collisions and inertias.

Supported elements are ``link`` (inertial, visual, collision), ``joint`` (fixed, revolute, continuous) and ``material``;
shapes are box, cylinder, sphere and mesh (Wavefront .obj). Files are named by ``package://PACKAGE/...``, ``file://...``
or a path relative to the folder of the URDF. Other elements (transmission, gazebo, sensor) are ignored; xacro files
must be expanded first.
"""

from __future__ import annotations

import itertools
import math
import os
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.files import MB, MOST_VALUES, ContentError, read_text
from xtdrone_common.poses import Pose, compose, rotate
from xtdrone_common.rotation import from_euler
from xtdrone_worlds.data_files import package_folder
from xtdrone_worlds.shapes.visual import Box, Collision, Colour, Cylinder, Geometry, Mesh, Sphere, Vector, Visual

FIXED, REVOLUTE, CONTINUOUS = "fixed", "revolute", "continuous"
_LARGEST = 16 * MB
MOST_LINKS = 1000
MOST_IN_CHAIN = 100
"""Largest number of joints between a link and the root: work on chains grows with their square."""
_KINDS = (FIXED, REVOLUTE, CONTINUOUS)
_SHAPES = ("box", "cylinder", "sphere", "mesh")
_MESHES = (".obj",)
_TEXTURES = (".png", ".jpg", ".jpeg")
LONGEST_URI = 1000  # characters
_URI = re.compile(r"(?P<attribute>filename\s*=\s*)(?P<quote>[\"'])(?P<uri>.*?)(?P=quote)")


class UrdfError(ValueError):
    """An invalid URDF file; the message names file, element, value and what is allowed."""


@dataclass(frozen=True)
class Inertial:
    """Mass of a link.

    Attributes:
        mass: mass, kg.
        pose: pose of the centre of mass in the link's frame.
        inertia: ixx, iyy, izz, ixy, ixz, iyz, kg m^2, about the centre of mass along the axes of ``pose``.
    """

    mass: float
    pose: Pose
    inertia: tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Link:
    """A rigid part; its inertial, visuals and collisions have poses in its frame."""

    name: str
    visuals: tuple[Visual, ...] = ()
    collisions: tuple[Collision, ...] = ()
    inertial: Inertial | None = None


@dataclass(frozen=True)
class Joint:
    """A joint between two links.

    Attributes:
        name: name, unique in its file.
        kind: ``fixed``, ``revolute`` or ``continuous``.
        parent, child: names of the links.
        pose: pose of the child's frame in the parent's frame at joint position 0.
        axis: unit vector of the axis of rotation, child's frame.
        lower, upper: limits of the joint position, rad; infinite without a limit.
        velocity: maximum speed, rad/s; infinite without a limit.
    """

    name: str
    kind: str
    parent: str
    child: str
    pose: Pose = field(default_factory=Pose)
    axis: Vector = (1.0, 0.0, 0.0)
    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf


@dataclass(frozen=True)
class Description:
    """A vehicle's links and joints, which form a tree.

    Attributes:
        name: name of the robot.
        links, joints: parents before their children.
        text: the URDF with file names that any node can resolve, for ``robot_description``.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...] = ()
    text: str = ""

    @property
    def root(self) -> str:
        """Name of the root link: the vehicle's body."""
        return self.links[0].name

    @cached_property
    def _holders(self) -> dict[str, Joint]:
        return {joint.child: joint for joint in self.joints}

    def holder(self, link: str) -> Joint | None:
        """Return the joint whose child is ``link``; None for the root."""
        return self._holders.get(link)

    def link(self, name: str) -> Link:
        """Return a link.

        Raises:
            UrdfError: unknown name.
        """
        for link in self.links:
            if link.name == name:
                return link
        names = ", ".join(link.name for link in self.links)
        raise UrdfError(f"{self.name}: link {name!r} does not exist; there are {names}")

    def joint(self, name: str) -> Joint:
        """Return a joint.

        Raises:
            UrdfError: unknown name.
        """
        for joint in self.joints:
            if joint.name == name:
                return joint
        names = ", ".join(joint.name for joint in self.joints) or "none"
        raise UrdfError(f"{self.name}: joint {name!r} does not exist; there are {names}")

    def carrier(self, link: str) -> tuple[str, Pose]:
        """Return the moving link to which ``link`` is fixed (itself if its joint turns), and its pose in that frame."""
        pose = Pose()
        while (joint := self.holder(link)) is not None and joint.kind == FIXED:
            pose = compose(joint.pose, pose)
            link = joint.parent
        return link, pose

    @cached_property
    def moving(self) -> tuple[Link, ...]:
        """The body and the links on turning joints, each merged with the links fixed to it; parents before children."""
        visuals: dict[str, list[Visual]] = {}
        collisions: dict[str, list[Collision]] = {}
        for link in self.links:
            name, pose = self.carrier(link.name)
            visuals.setdefault(name, []).extend(replace(v, pose=compose(pose, v.pose)) for v in link.visuals)
            collisions.setdefault(name, []).extend(replace(c, pose=compose(pose, c.pose)) for c in link.collisions)
        return tuple(Link(name, tuple(visuals[name]), tuple(collisions[name])) for name in visuals)

    def mass(self) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """Return the total mass properties of all links at joint positions 0.

        Returns:
            Mass, kg; centre of mass, shape (3,), m, root frame; inertia about it along the root's axes, (3, 3), kg m^2.
        """
        poses: dict[str, Pose] = {self.root: Pose()}
        for joint in self.joints:
            poses[joint.child] = compose(poses[joint.parent], joint.pose)
        parts = [(link.inertial, compose(poses[link.name], link.inertial.pose)) for link in self.links if link.inertial]
        return combine_masses(parts)


def combine_masses(parts: Sequence[tuple[Inertial, Pose]]) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Return mass, kg, centre of mass (3,), m, and inertia (3, 3) about it, kg m^2, of parts of one rigid body.

    Args:
        parts: inertial of each part, and the pose of its centre of mass in the body's frame.
    """
    centre, total = np.zeros(3), np.zeros((3, 3))
    mass = sum((inertial.mass for inertial, _ in parts), 0.0)
    for inertial, pose in parts:
        centre += inertial.mass / mass * np.array(pose.position)
    for inertial, pose in parts:
        turn = np.column_stack([rotate(pose.orientation, axis) for axis in np.eye(3).tolist()])
        ixx, iyy, izz, ixy, ixz, iyz = inertial.inertia
        own = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        r = np.array(pose.position) - centre
        total += turn @ own @ turn.T + inertial.mass * (r @ r * np.eye(3) - np.outer(r, r))
    return mass, centre, total


def resolve(uri: str, folder: Path) -> Path:
    """Return the file for a URI in a URDF.

    Args:
        uri: ``package://PACKAGE/...``, ``file://...`` or a path, relative to ``folder`` unless absolute.
        folder: folder of the URDF.

    Raises:
        UrdfError: unknown package or unsupported scheme.
    """
    scheme, separator, rest = uri.partition("://")
    if not separator:
        return folder / uri
    if scheme == "file":
        return Path(rest)
    if scheme != "package":
        raise UrdfError(f"{uri!r} is not allowed, package://PACKAGE/..., file:///... or a path from the URDF's folder")
    package, _, path = rest.partition("/")
    try:
        return package_folder(package) / path
    except LookupError as error:
        raise UrdfError(f"{uri!r}: {error.args[0]}") from error


def read_urdf(path: Path) -> Description:
    """Read a URDF file.

    Raises:
        UrdfError: the file cannot be read, or its content is invalid.
    """
    try:
        text = read_text(path, _LARGEST)
    except (OSError, ContentError) as error:
        raise UrdfError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    return parse_urdf(text, path)


def parse_urdf(text: str, path: Path, is_foreign: bool = False) -> Description:
    """Parse a URDF.

    Args:
        text: content of the file.
        path: path of the file, for messages and relative file names.
        is_foreign: whether the content is from a request and may therefore only name files of ROS packages.

    Raises:
        UrdfError: see ``read_urdf``.
    """
    if "<!ENTITY" in text:
        raise UrdfError(f"{path}: <!ENTITY is not allowed: write its text instead")
    if text.count("<") > MOST_VALUES:
        raise UrdfError(f"{path}: more than {MOST_VALUES} elements")
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UrdfError(f"{path}: not XML: {error}") from error
    if robot.tag != "robot":
        raise UrdfError(f"{path}: element <{robot.tag}> is not allowed at the top, <robot>")
    if "xacro" in text:
        raise UrdfError(f"{path}: xacro is not supported, expand it first: xacro FILE.xacro > FILE.urdf")
    return _Reader(path, robot, is_foreign).read(text)


class _Reader:
    """State of the reader of one file."""

    def __init__(self, path: Path, robot: Element, is_foreign: bool) -> None:
        self._path = path
        self._robot = robot
        self._is_foreign = is_foreign
        self._materials: dict[str, tuple[Colour, Path | None]] = {}

    def read(self, text: str) -> Description:
        name = self._robot.get("name", self._path.stem)
        count = sum(element.tag == "link" for element in self._robot)
        if count > MOST_LINKS:
            raise self._fail("links", f"{count} are not allowed, at most {MOST_LINKS}")
        for element in self._robot.findall("material"):
            self._materials[self._name(element, "material")] = self._look(element, "material")
        links = [self._link(element) for element in self._robot.findall("link")]
        joints = [self._joint(element) for element in self._robot.findall("joint")]
        ordered = self._tree(links, joints)
        return Description(name, *ordered, text if self._is_foreign else _URI.sub(self._resolve_match, text))

    def _fail(self, where: str, problem: str) -> UrdfError:
        return UrdfError(f"{self._path}: {where}: {problem}")

    def _resolve_match(self, match: re.Match[str]) -> str:
        """Return a ``filename=...`` that does not depend on the folder of the URDF."""
        uri = match["uri"]
        known = uri if uri.startswith("package://") else f"file://{resolve(uri, self._path.parent).resolve()}"
        return f"{match['attribute']}{match['quote']}{known}{match['quote']}"

    # values

    def _name(self, element: Element, where: str) -> str:
        name = element.get("name", "").strip()
        if not name:
            raise self._fail(where, "attribute 'name' is missing")
        return name

    def _numbers(
        self, element: Element, attribute: str, count: int, where: str, default: str | None = None
    ) -> list[float]:
        text = element.get(attribute, default)
        place = f"{where}, <{element.tag}> {attribute}"
        if text is None:
            raise self._fail(place, "the attribute is missing")
        try:
            values = [float(part) for part in text.split()]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            wanted = "a number" if count == 1 else f"{count} numbers"
            raise self._fail(place, f"{text[:100]!r} is not allowed, {wanted}")
        return values

    def _positive(self, element: Element, attribute: str, where: str, count: int = 1) -> list[float]:
        values = self._numbers(element, attribute, count, where)
        if min(values) <= 0.0:
            raise self._fail(
                f"{where}, <{element.tag}> {attribute}", f"{element.get(attribute)!r} is not allowed, above 0"
            )
        return values

    def _origin(self, element: Element, where: str) -> Pose:
        origin = element.find("origin")
        if origin is None:
            return Pose()
        x, y, z = self._numbers(origin, "xyz", 3, where, "0 0 0")
        roll, pitch, yaw = self._numbers(origin, "rpy", 3, where, "0 0 0")
        return Pose((x, y, z), from_euler(roll, pitch, yaw))

    def _file(self, element: Element, where: str, suffixes: tuple[str, ...]) -> Path:
        uri = element.get("filename", "")
        place = f"{where}, <{element.tag}> filename"
        if len(uri) > LONGEST_URI:
            raise self._fail(place, f"{uri[:80]!r}...: {len(uri)} characters are not allowed, at most {LONGEST_URI}")
        if self._is_foreign and (not uri.startswith("package://") or ".." in uri.split("/")):
            raise self._fail(place, f"{uri!r} is not allowed in a request, package://NAME/... without '..'")
        try:
            path = resolve(uri, self._path.parent)
        except UrdfError as error:
            raise self._fail(place, str(error)) from error
        if path.suffix.lower() not in suffixes:
            raise self._fail(place, f"{uri!r} is not allowed, a file that ends with {' or '.join(suffixes)}")
        if not os.path.isfile(path):  # false for a name that the file system rejects, too
            raise self._fail(place, f"{uri!r}: there is no file {path}")
        return path

    # elements

    def _link(self, element: Element) -> Link:
        name = self._name(element, "link")
        where = f"link {name!r}"
        visuals = tuple(self._visual(part, place) for part, place in _number(element, "visual", where))
        collisions = tuple(
            Collision(self._geometry(part, place), self._origin(part, place))
            for part, place in _number(element, "collision", where)
        )
        inertial = element.find("inertial")
        return Link(name, visuals, collisions, None if inertial is None else self._inertial(inertial, where))

    def _inertial(self, element: Element, where: str) -> Inertial:
        where = f"{where}, inertial"
        (mass,) = self._positive(self._part(element, "mass", where), "value", where)
        matrix = self._part(element, "inertia", where)
        diagonal = [self._numbers(matrix, axis, 1, where)[0] for axis in ("ixx", "iyy", "izz")]
        others = [self._numbers(matrix, axis, 1, where, "0")[0] for axis in ("ixy", "ixz", "iyz")]
        if min(diagonal) < 0.0:
            raise self._fail(f"{where}, <inertia>", f"{min(diagonal):g} is not allowed, at least 0")
        ixx, iyy, izz, ixy, ixz, iyz = *diagonal, *others
        return Inertial(mass, self._origin(element, where), (ixx, iyy, izz, ixy, ixz, iyz))

    def _part(self, element: Element, tag: str, where: str) -> Element:
        part = element.find(tag)
        if part is None:
            raise self._fail(where, f"element <{tag}> is missing")
        return part

    def _visual(self, element: Element, where: str) -> Visual:
        material = element.find("material")
        look = (Visual.colour, None) if material is None else self._material(material, where)
        return Visual(self._geometry(element, where), self._origin(element, where), *look)

    def _material(self, element: Element, where: str) -> tuple[Colour, Path | None]:
        if element.find("color") is not None or element.find("texture") is not None:
            return self._look(element, where)
        name = self._name(element, f"{where}, material")
        if name not in self._materials:
            names = ", ".join(self._materials) or "none"
            raise self._fail(
                where, f"material {name!r} has no colour and is not defined by the robot; there are {names}"
            )
        return self._materials[name]

    def _look(self, element: Element, where: str) -> tuple[Colour, Path | None]:
        colour, texture = element.find("color"), element.find("texture")
        rgba: Colour = (1.0, 1.0, 1.0, 1.0) if texture is not None else Visual.colour
        if colour is not None:
            r, g, b, a = self._numbers(colour, "rgba", 4, where)
            if not all(0.0 <= part <= 1.0 for part in (r, g, b, a)):
                raise self._fail(f"{where}, <color> rgba", f"{colour.get('rgba')!r} is not allowed, 0 to 1")
            rgba = (r, g, b, a)
        return rgba, None if texture is None else self._file(texture, where, _TEXTURES)

    def _geometry(self, element: Element, where: str) -> Geometry:
        geometry = self._part(element, "geometry", where)
        shapes = [shape for shape in geometry if isinstance(shape.tag, str)]
        if len(shapes) != 1 or shapes[0].tag not in _SHAPES:
            tags = ", ".join(f"<{shape.tag}>" for shape in shapes) or "nothing"
            raise self._fail(f"{where}, <geometry>", f"{tags} is not allowed, one of {', '.join(_SHAPES)}")
        return self._shape(shapes[0], where)

    def _shape(self, shape: Element, where: str) -> Geometry:
        if shape.tag == "box":
            x, y, z = self._positive(shape, "size", where, 3)
            return Box((x, y, z))
        if shape.tag == "cylinder":
            (radius,), (length,) = (self._positive(shape, name, where) for name in ("radius", "length"))
            return Cylinder(radius, length)
        if shape.tag == "sphere":
            return Sphere(self._positive(shape, "radius", where)[0])
        x, y, z = self._numbers(shape, "scale", 3, where, "1 1 1")
        return Mesh(self._file(shape, where, _MESHES), (x, y, z))

    def _joint(self, element: Element) -> Joint:
        name = self._name(element, "joint")
        where = f"joint {name!r}"
        kind = element.get("type", "")
        if kind not in _KINDS:
            raise self._fail(f"{where}, type", f"{kind!r} is not allowed, {', '.join(_KINDS)}")
        parent, child = (self._part(element, tag, where).get("link", "") for tag in ("parent", "child"))
        joint = Joint(name, kind, parent, child, self._origin(element, where))
        return joint if kind == FIXED else self._turning(joint, element, where)

    def _turning(self, joint: Joint, element: Element, where: str) -> Joint:
        axis = element.find("axis")
        x, y, z = (1.0, 0.0, 0.0) if axis is None else self._numbers(axis, "xyz", 3, where)
        length = math.sqrt(x * x + y * y + z * z)
        if length == 0.0:
            raise self._fail(f"{where}, <axis> xyz", "'0 0 0' is not allowed, a direction")
        joint = replace(joint, axis=(x / length, y / length, z / length))
        limit = element.find("limit")
        if limit is None:
            if joint.kind == REVOLUTE:
                raise self._fail(where, "element <limit> is missing; a joint without limits is of type continuous")
            return joint
        if limit.get("velocity") is not None:
            joint = replace(joint, velocity=self._positive(limit, "velocity", where)[0])
        if joint.kind == CONTINUOUS:
            return joint
        (lower,), (upper,) = (self._numbers(limit, name, 1, where, "0") for name in ("lower", "upper"))
        if not lower <= 0.0 <= upper:
            raise self._fail(
                f"{where}, <limit>", f"lower {lower:g}, upper {upper:g} is not allowed, 0 must lie between"
            )
        return replace(joint, lower=lower, upper=upper)

    def _tree(self, links: list[Link], joints: list[Joint]) -> tuple[tuple[Link, ...], tuple[Joint, ...]]:
        """Return links and joints sorted with parents before children."""
        self._only_once("link", [link.name for link in links])
        self._only_once("joint", [joint.name for joint in joints])
        by_name = {link.name: link for link in links}
        for joint in joints:
            for end in (joint.parent, joint.child):
                if end not in by_name:
                    raise self._fail(f"joint {joint.name!r}", f"link {end!r} does not exist")
        self._only_once("child link of joints", [joint.child for joint in joints])
        children = {joint.child for joint in joints}
        roots = [link for link in links if link.name not in children]
        if len(roots) != 1:
            names = _list(link.name for link in roots) or "none"
            raise self._fail("links", f"{names}: exactly one link must not be the child of a joint")
        below: dict[str, list[Joint]] = {}
        for joint in joints:
            below.setdefault(joint.parent, []).append(joint)
        ordered, held, depths = [roots[0]], [], {roots[0].name: 0}
        for link in ordered:
            own = below.get(link.name, [])
            held += own
            ordered += [by_name[joint.child] for joint in own]
            depths |= {joint.child: depths[link.name] + 1 for joint in own}
        deepest = max(depths.values())
        if deepest > MOST_IN_CHAIN:
            raise self._fail("joints", f"a chain of {deepest} is not allowed, at most {MOST_IN_CHAIN}")
        if len(ordered) < len(links):
            lost = _list(sorted(set(by_name) - {link.name for link in ordered}))
            raise self._fail("joints", f"{lost}: the joints form a loop")
        return tuple(ordered), tuple(held)

    def _only_once(self, what: str, names: list[str]) -> None:
        for name, count in Counter(names).items():
            if count > 1:
                raise self._fail(what, f"{name!r} is given {count} times")


def _list(names: Iterable[str]) -> str:
    """Return up to 20 names for a message."""
    shown = list(itertools.islice(names, 21))
    return ", ".join(shown[:20]) + (", ..." if len(shown) > 20 else "")


def _number(element: Element, tag: str, where: str) -> Iterator[tuple[Element, str]]:
    """Yield the elements with a tag and their names for messages."""
    for number, part in enumerate(element.findall(tag), start=1):
        yield part, f"{where}, {tag} {number}"
