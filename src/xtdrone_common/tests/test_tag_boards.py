"""Boards of tags in the format of apriltag_ros."""

from __future__ import annotations

import pytest

from xtdrone_common.settings import SettingError
from xtdrone_common.tag_boards import LANDING, Tag, TagBoard, boards_of, parse_boards


def test_standalone_tags_and_bundles_are_boards(tmp_path):
    layout = "[{id: 2, size: 0.2, x: 1}, {id: 1, size: 0.1}]"
    text = f"standalone_tags: [{{id: 5, size: 0.3}}]\ntag_bundles: [{{name: b, layout: {layout}}}]"
    file = tmp_path / "tags.yaml"
    file.write_text(text)
    assert boards_of(str(file)) == (
        TagBoard("tag_5", (Tag(5, 0.3),)),
        TagBoard("b", (Tag(1, 0.1), Tag(2, 0.2, 1.0))),
    )
    assert boards_of("landing") == (LANDING,)
    assert LANDING.extent == pytest.approx((-0.64, 0.64, -0.64, 0.64))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], "a mapping with standalone_tags and tag_bundles"),
        ({}, "tags: 0 is not allowed, 1 to 100 tags"),
        ({"standalone_tags": [{"id": 587, "size": 1}]}, "standalone_tags: id: 587 is not allowed, 0 to 586"),
        ({"standalone_tags": [{"id": 0, "size": -1}]}, "standalone_tags: size: -1"),
        ({"standalone_tags": [{"id": 0}]}, "mappings with id and size"),
        ({"standalone_tags": [{"id": 0, "size": 1}, {"id": 0, "size": 2}]}, "tags: 0 is not allowed, each tag once"),
        ({"tag_bundles": [{"name": "b", "layout": [{"id": 0, "size": 1, "z": 0.1}]}]}, "layout: z: 0.1"),
        ({"tag_bundles": [{"name": "b", "layout": 3}]}, "layout: '3' is not allowed, a list"),
    ],
)
def test_a_wrong_board_is_named(given, words):
    with pytest.raises(SettingError) as caught:
        parse_boards(given)
    assert words in str(caught.value)
    with pytest.raises(SettingError, match="tags: 'nothing' is not allowed, landing, or the path"):
        boards_of("nothing")
