"""Elements of SDF files: parsing with line numbers, and typed values, with errors that name file and line.

expat parses the XML, because its events carry line numbers and prefixes as written and let entities be rejected before
anything is expanded.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from xtdrone_common.files import MB, MOST_DEPTH, MOST_VALUES, shortened
from xtdrone_common.frames import to_xyzw
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler, to_euler
from xtdrone_worlds.worlds.sdf.world_records import SdfError

_log = logging.getLogger("rosout.sdf")  # a child of ROS's logger: shown on screen and on /rosout in a ROS node
LARGEST = 16 * MB  # maximum size of a file
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


@dataclass(eq=False)
class Element:
    """One element of a file.

    Attributes:
        tag: name with its prefix.
        attributes: as written.
        line: line of its start tag, from 1.
        children: children in document order.
        text: character data, without that of children.
        file: the file that contains the element.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    file: File
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def error(self, text: str) -> SdfError:
        """Return an error that names file, line and element."""
        return SdfError(f"{self.file.path}: line {self.line}: <{self.tag}>: {text}")

    def all(self, tag: str) -> Iterator[Element]:
        """Return the children with this tag."""
        return (child for child in self.children if child.tag == tag)

    def one(self, tag: str) -> Element | None:
        """Return the only child with this tag, or None.

        Raises:
            SdfError: there is more than one.
        """
        found = list(self.all(tag))
        if len(found) > 1:
            raise found[1].error(f"occurs a second time in <{self.tag}>, one is allowed")
        return found[0] if found else None

    def first(self, tag: str) -> Element | None:
        """Return the first child with this tag, with a warning about others, as Gazebo reads them; None without one."""
        found = list(self.all(tag))
        for other in found[1:]:
            other.warn_ignored(f"occurs a second time in <{self.tag}> and is ignored")
        return found[0] if found else None

    def required(self, tag: str) -> Element:
        """Return the only child with this tag.

        Raises:
            SdfError: the child is missing, or there is more than one.
        """
        found = self.one(tag)
        if found is None:
            raise self.error(f"needs a <{tag}>")
        return found

    def number_of(self, tag: str, default: float, low: float = -math.inf, high: float = math.inf) -> float:
        """Return the number in the only child with this tag, or ``default`` without one; see ``number``."""
        found = self.one(tag)
        return default if found is None else found.number(low, high)

    def boolean_of(self, tag: str, default: bool) -> bool:
        """Return the boolean in the only child with this tag, or ``default`` without one."""
        found = self.one(tag)
        return default if found is None else found.boolean()

    def name(self) -> str:
        """Return the attribute ``name``.

        Raises:
            SdfError: the attribute is missing or empty.
        """
        name = self.attributes.get("name", "").strip()
        if not name:
            raise self.error('needs an attribute name="..." that is not empty')
        return name

    def string(self) -> str:
        """Return the text without surrounding white space.

        Raises:
            SdfError: the text is empty.
        """
        text = self.text.strip()
        if not text:
            raise self.error("is empty")
        return text

    def boolean(self) -> bool:
        """Parse the text as a boolean: true, false, 1 or 0."""
        text = self.text.strip().lower()
        if text not in _BOOLEANS:
            raise self.error(f"{self.text.strip()!r} is not allowed, true or false")
        return _BOOLEANS[text]

    def number(self, low: float = -math.inf, high: float = math.inf) -> float:
        """Parse the text as a finite number within limits."""
        return self.numbers((1,), low, high)[0]

    def numbers(self, counts: Sequence[int], low: float = -math.inf, high: float = math.inf) -> tuple[float, ...]:
        """Parse the text as finite numbers within limits; ``counts`` lists the allowed numbers of values."""
        text = self.text.strip()
        try:
            values = tuple(float(word) for word in text.split())
        except ValueError:
            values = ()
        if len(values) not in counts or not all(math.isfinite(value) and low <= value <= high for value in values):
            many = " or ".join(str(count) for count in counts)
            limits = "".join(
                f", {word} {limit:g}" for word, limit in (("at least", low), ("at most", high)) if not math.isinf(limit)
            )
            raise self.error(f"{shortened(text)!r} is not allowed, {many} finite number{'s' * (many != '1')}{limits}")
        return values

    def warn_unknown(self, known: Sequence[str], silent: Sequence[str] = ()) -> None:
        """Warn of children that are neither supported (``known``) nor deliberately ignored (``silent``)."""
        for child in self.children:
            if child.tag not in known and child.tag not in silent:
                child.warn_ignored()

    def warn_ignored(self, why: str = "is not supported and ignored") -> None:
        """Log a warning about this element, once per file and tag."""
        self.file.note(logging.WARNING, self, why)

    def info(self, text: str) -> None:
        """Log a remark about this element, once per file and tag."""
        self.file.note(logging.INFO, self, text)


@dataclass(eq=False)
class File:
    """A file that is being read.

    Attributes:
        path: path of the file.
        told: tags and texts already logged.
        is_foreign: whether the content is from a request and may therefore only name files of installed models and ROS
            packages.
    """

    path: Path
    told: set[tuple[str, str]] = field(default_factory=set)
    is_foreign: bool = False

    def note(self, level: int, element: Element, text: str) -> None:
        """Log ``text`` once per tag."""
        if (element.tag, text) not in self.told:
            self.told.add((element.tag, text))
            _log.log(level, "%s: line %d: <%s> %s", self.path, element.line, element.tag, text)


def parse(text: str | bytes, path: Path, is_foreign: bool = False) -> Element:
    """Parse an XML text and return its root.

    Args:
        text: content of the file.
        path: path of the file, for messages and relative paths.
        is_foreign: see ``File``.

    Raises:
        SdfError: malformed XML, an entity, too many elements, or too deep nesting.
    """
    file = File(path, is_foreign=is_foreign)
    parser = expat.ParserCreate()
    parser.buffer_text = True
    count = 0
    stack: list[Element] = []
    roots: list[Element] = []
    pieces: list[list[str]] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MOST_VALUES or len(stack) >= MOST_DEPTH:
            many = f"{MOST_VALUES} elements" if count > MOST_VALUES else f"{MOST_DEPTH} elements within each other"
            raise SdfError(f"{path}: line {parser.CurrentLineNumber}: more than {many}")
        element = Element(tag, attributes, parser.CurrentLineNumber, file)
        (stack[-1].children if stack else roots).append(element)
        stack.append(element)
        pieces.append([])

    def end(_tag: str) -> None:
        stack.pop().text = "".join(pieces.pop())

    def characters(data: str) -> None:
        pieces[-1].append(data)  # joined at the end of the element: text between many children stays linear

    def entity(name: str, *_: object) -> None:
        raise SdfError(
            f"{path}: line {parser.CurrentLineNumber}: <!ENTITY {name}> is not allowed: write its text instead"
        )

    parser.EntityDeclHandler = entity
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = characters
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise SdfError(f"{path}: line {error.lineno}: not an XML file: {expat.ErrorString(error.code)}") from error
    except ValueError as error:  # an encoding that expat does not support
        raise SdfError(f"{path}: not an XML file: {error}") from error
    return roots[0]


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
