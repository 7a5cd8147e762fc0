"""XML with line numbers, and its values with messages that say where they stand."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from xtdrone_control.bounded_file import MB, MOST_DEPTH, MOST_VALUES
from xtdrone_sim.worlds.sdf.types import SdfError

_log = logging.getLogger("rosout.sdf")  # a child of ROS's: its words come on screen and on /rosout where there is ROS
LARGEST = 16 * MB  # of a file
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


@dataclass(eq=False)
class Element:
    """One element of a file.

    Attributes:
        tag: its name, with prefix.
        attributes: as the file has them.
        line: where it begins, from 1.
        children: in the file's order.
        text: its characters, without those of its children.
        file: the file's notes.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    file: File
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def error(self, text: str) -> SdfError:
        """Return an error that names this place."""
        return SdfError(f"{self.file.path}: line {self.line}: <{self.tag}>: {text}")

    def all(self, tag: str) -> Iterator[Element]:
        """Return the children of this tag."""
        return (child for child in self.children if child.tag == tag)

    def one(self, tag: str) -> Element | None:
        """Return the child of this tag, or None.

        Raises:
            SdfError: there are several.
        """
        found = list(self.all(tag))
        if len(found) > 1:
            raise found[1].error(f"stands here for the second time in <{self.tag}>, one is allowed")
        return found[0] if found else None

    def needed(self, tag: str) -> Element:
        """Return the child of this tag.

        Raises:
            SdfError: there is none.
        """
        found = self.one(tag)
        if found is None:
            raise self.error(f"needs a <{tag}>")
        return found

    def name(self) -> str:
        """Return the attribute ``name``.

        Raises:
            SdfError: it is missing or empty.
        """
        name = self.attributes.get("name", "").strip()
        if not name:
            raise self.error('needs an attribute name="..." that is not empty')
        return name

    def string(self) -> str:
        """Return the text without blanks around it.

        Raises:
            SdfError: it is empty.
        """
        text = self.text.strip()
        if not text:
            raise self.error("is empty")
        return text

    def boolean(self) -> bool:
        """Return the value: true, false, 1 or 0."""
        text = self.text.strip().lower()
        if text not in _BOOLEANS:
            raise self.error(f"{self.text.strip()!r} is not allowed, true or false")
        return _BOOLEANS[text]

    def number(self, low: float = -math.inf, high: float = math.inf) -> float:
        """Return the value, a finite number within limits."""
        return self.numbers((1,), low, high)[0]

    def numbers(self, counts: Sequence[int], low: float = -math.inf, high: float = math.inf) -> tuple[float, ...]:
        """Return the values; ``counts`` says how many are allowed."""
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
            raise self.error(f"{text!r} is not allowed, {many} finite number{'s' * (many != '1')}{limits}")
        return values

    def take(self, known: Sequence[str], silent: Sequence[str] = ()) -> None:
        """Warn of children that are neither read (``known``) nor without meaning here (``silent``)."""
        for child in self.children:
            if child.tag not in known and child.tag not in silent:
                child.ignored()

    def ignored(self, why: str = "is not supported and ignored") -> None:
        """Warn, once a file for each tag."""
        self.file.note(logging.WARNING, self, why)

    def info(self, text: str) -> None:
        """Say something of this place, once a file for each tag."""
        self.file.note(logging.INFO, self, text)


@dataclass(eq=False)
class File:
    """What is known of a file that is read: its path, and of which tags something has been said already."""

    path: Path
    told: set[tuple[str, str]] = field(default_factory=set)

    def note(self, level: int, element: Element, text: str) -> None:
        """Log ``text`` once for the element's tag."""
        if (element.tag, text) not in self.told:
            self.told.add((element.tag, text))
            _log.log(level, "%s: line %d: <%s> %s", self.path, element.line, element.tag, text)


def parse(text: str | bytes, path: Path) -> Element:
    """Return the root of an XML text; ``path`` names it in messages.

    Raises:
        SdfError: it is no well-formed XML.
    """
    file = File(path)
    parser = expat.ParserCreate()
    parser.buffer_text = True
    count = 0
    stack: list[Element] = []
    roots: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MOST_VALUES or len(stack) >= MOST_DEPTH:
            many = f"{MOST_VALUES} elements" if count > MOST_VALUES else f"{MOST_DEPTH} elements within each other"
            raise SdfError(f"{path}: line {parser.CurrentLineNumber}: more than {many}")
        element = Element(tag, attributes, parser.CurrentLineNumber, file)
        (stack[-1].children if stack else roots).append(element)
        stack.append(element)

    def end(_tag: str) -> None:
        stack.pop()

    def characters(data: str) -> None:
        stack[-1].text += data

    def entity(name: str, *_: object) -> None:
        raise SdfError(
            f"{path}: line {parser.CurrentLineNumber}: <!ENTITY {name}> is not allowed: write out what it stands for"
        )

    parser.EntityDeclHandler = entity
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = characters
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise SdfError(f"{path}: line {error.lineno}: not an XML file: {expat.ErrorString(error.code)}") from error
    except ValueError as error:  # an encoding that expat lacks
        raise SdfError(f"{path}: not an XML file: {error}") from error
    return roots[0]
