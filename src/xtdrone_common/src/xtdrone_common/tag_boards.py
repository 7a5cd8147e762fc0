"""Boards of AprilTags of the family 36h11: sizes and positions of their tags.

A board is a bundle of tags in one plane, in the format of apriltag_ros (``tags.yaml``)::

    standalone_tags: [{id: 5, size: 0.3}]
    tag_bundles: [{name: board, layout: [{id: 0, size: 0.16}, {id: 1, size: 0.48, x: -0.4, y: 0.4}]}]

``size`` is the edge of a tag's black square, m. Seen from its front, a tag has x to the right, y upwards and z towards
the observer, as in the images of the family's authors (Wang and Olson, AprilTag 2, IROS 2016).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_common.files import load_yaml, read_text
from xtdrone_common.settings import SettingError, check_range

FAMILY_SIZE = 587  # tags of 36h11
MOST_TAGS = 100
_PLANE = ("z", "qx", "qy", "qz")  # fields of apriltag_ros that must be 0


@dataclass(frozen=True)
class Tag:
    """A tag of a board.

    Attributes:
        id: number in the family.
        size: edge of the black square, m.
        x, y: its middle on the board, m.
    """

    id: int
    size: float
    x: float = 0.0
    y: float = 0.0


@dataclass(frozen=True)
class TagBoard:
    """One or more tags in one plane.

    Attributes:
        name: Name of its frame.
        tags: Tags in ascending order of their numbers.
    """

    name: str
    tags: tuple[Tag, ...]

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Minimum x, maximum x, minimum y and maximum y of the black squares, m."""
        return (
            min(tag.x - 0.5 * tag.size for tag in self.tags),
            max(tag.x + 0.5 * tag.size for tag in self.tags),
            min(tag.y - 0.5 * tag.size for tag in self.tags),
            max(tag.y + 0.5 * tag.size for tag in self.tags),
        )


LANDING = TagBoard(
    "landing",
    (Tag(0, 0.16), Tag(1, 0.48, -0.4, 0.4), Tag(2, 0.48, 0.4, 0.4), Tag(3, 0.48, -0.4, -0.4), Tag(4, 0.48, 0.4, -0.4)),
)
"""Board of a landing platform of 1.4 x 1.4 m: four tags that are visible from 6 m and more, and one for the last 0.5 m.
"""

BOARDS = {"landing": (LANDING,)}


def boards_of(name: str) -> tuple[TagBoard, ...]:
    """Return the boards of an entry of ``BOARDS``, or of a file.

    Raises:
        SettingError: ``name`` is neither, or a value is not allowed.
        ContentError, OSError: the file cannot be read.
    """
    if name in BOARDS:
        return BOARDS[name]
    if not name.endswith((".yaml", ".yml")):
        raise SettingError("tags", name, f"{', '.join(BOARDS)}, or the path of a YAML file")
    return parse_boards(load_yaml(read_text(Path(name).expanduser())))


def parse_boards(given: object) -> tuple[TagBoard, ...]:
    """Return the boards of a mapping in the format of apriltag_ros.

    Raises:
        SettingError: a value is not allowed, there is no tag, or a tag occurs twice.
    """
    if not isinstance(given, Mapping) or not set(given) <= {"standalone_tags", "tag_bundles"}:
        raise SettingError("tags", str(given)[:60], "a mapping with standalone_tags and tag_bundles")
    boards = []
    for entry in _list(given, "standalone_tags"):
        tag = _tag(entry, "standalone_tags")
        boards.append(TagBoard(str(entry.get("name", f"tag_{tag.id}")), (tag,)))
    for number, entry in enumerate(_list(given, "tag_bundles")):
        if not isinstance(entry, Mapping):
            raise SettingError("tag_bundles", str(entry)[:60], "mappings with name and layout")
        tags = sorted((_tag(part, "layout") for part in _list(entry, "layout")), key=lambda tag: tag.id)
        boards.append(TagBoard(str(entry.get("name", f"bundle_{number}")), tuple(tags)))
    ids = [tag.id for board in boards for tag in board.tags]
    if not ids or not all(board.tags for board in boards) or len(ids) > MOST_TAGS:
        raise SettingError("tags", len(ids), f"1 to {MOST_TAGS} tags, and in each bundle at least one")
    for tag_id in ids:
        if ids.count(tag_id) > 1:
            raise SettingError("tags", tag_id, "each tag once")
    return tuple(boards)


def _list(given: Mapping[Any, Any], name: str) -> Sequence[Any]:
    entries = given.get(name) or []
    if not isinstance(entries, list):
        raise SettingError(name, str(entries)[:60], "a list")
    return entries


def _tag(entry: Any, name: str) -> Tag:
    if not isinstance(entry, Mapping) or not {"id", "size"} <= set(entry):
        raise SettingError(name, str(entry)[:60], "mappings with id and size, and in a bundle x and y")
    for field in _PLANE:
        if entry.get(field, 0) != 0:
            raise SettingError(
                f"{name}: {field}", entry[field], "0: the tags of a bundle lie in one plane, turned alike"
            )
    number = entry["id"]
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < FAMILY_SIZE:
        raise SettingError(f"{name}: id", number, f"0 to {FAMILY_SIZE - 1}")
    size = check_range(f"{name}: size", entry["size"], 1e-3, 100.0, "m")
    x, y = (check_range(f"{name}: {axis}", entry.get(axis, 0.0), -100.0, 100.0, "m") for axis in "xy")
    return Tag(number, size, x, y)
