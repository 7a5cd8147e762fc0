"""The station's images, parameters and node graph, without a ROS master and a browser."""

from __future__ import annotations

import math
import struct
from typing import Any

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import CompressedImage, Image

from xtdrone_interaction import command_options
from xtdrone_interaction.topics.discovery import join_topics
from xtdrone_interaction.web.images.image_jpeg import ImageError, jpeg_of
from xtdrone_interaction.web.images.image_room import pack_picture
from xtdrone_interaction.web.inspection.node_graph_room import links
from xtdrone_interaction.web.parameters.declared_settings import declared_for, read_declared
from xtdrone_interaction.web.parameters.parameter_room import _px4_definitions, check_ros_value, flattened, px4_value
from xtdrone_interaction.web.server.methods import CallError


def image(pixels: np.ndarray, encoding: str, padding: int = 0) -> Image:
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    return Image(height=height, width=width, encoding=encoding, step=padded.shape[1], data=padded.tobytes())


def shown(message: Any, width: int = 640) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(jpeg_of(message, width).jpeg, np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.parametrize(
    ("encoding", "colour"),
    [("rgb8", (200, 100, 30)), ("bgr8", (30, 100, 200)), ("rgba8", (200, 100, 30, 9)), ("bgra8", (30, 100, 200, 9))],
)
def test_colours_are_right_in_every_order_and_with_padded_rows(encoding: str, colour: tuple[int, ...]) -> None:
    pixels = np.full((32, 48, len(colour)), colour, np.uint8)
    bgr = shown(image(pixels, encoding, padding=5))
    assert bgr.shape == (32, 48, 3)
    assert np.abs(bgr.astype(int) - (30, 100, 200)).max() <= 4


def test_depths_are_coloured_and_large_images_made_smaller() -> None:
    depth = np.full((60, 100), 1.0, np.float32)
    depth[:, 50:] = 19.0
    depth[:30] = np.nan
    near, far, none = (shown(image(depth, "32FC1"))[y, x].astype(int) for y, x in ((45, 20), (45, 80), (10, 20)))
    assert near[2] > 100 > near[0]
    assert far[0] > 100 > far[2]
    assert none.max() < 20
    picture = jpeg_of(image((depth * 1000).astype(np.uint16), "16UC1"), 64)
    assert (picture.width, picture.height) == (100, 60)
    assert cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), 1).shape[:2] == (38, 64)


def test_a_jpeg_of_the_right_size_is_passed_on_unchanged() -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    assert jpeg_of(CompressedImage(format="jpeg", data=jpeg), 64).jpeg == jpeg


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (Image(encoding="yuv422", height=1, width=1), "encoding: 'yuv422' is not allowed, one of rgb8"),
        (Image(encoding="rgb8", height=2, width=2, step=6, data=b"12345"), "data: 5 bytes are not 2 rows of 6 bytes"),
        (Image(encoding="rgb8", height=2, width=2, step=1, data=b"1" * 12), "for 2 px rgb8"),
        (Image(encoding="mono8", height=0, width=9), "data: 0 bytes are not 0 rows"),
        (CompressedImage(format="jpeg", data=b"\xff\xd8cut"), "data: 5 bytes of format 'jpeg' are not an image"),
        (CompressedImage(format="png"), "are not an image"),
    ],
)
def test_what_is_no_image_is_refused(message: Any, text: str) -> None:
    with pytest.raises(ImageError) as error:
        jpeg_of(message, 640)
    assert text in str(error.value)


def test_a_frame_is_laid_out_as_the_page_reads_it() -> None:
    picture = jpeg_of(image(np.zeros((8, 16, 3), np.uint8), "rgb8"), 640)
    frame = b"\x02" + pack_picture(7, 12.5, picture)
    # The offsets of readImageFrame in web_page/panels/images.js.
    assert (frame[0], frame[1]) == (2, 1)
    assert struct.unpack_from("<I", frame, 4) == (7,)
    assert struct.unpack_from("<d", frame, 8) == (12.5,)
    assert struct.unpack_from("<HH", frame, 16) == (16, 8)
    assert frame[24:] == picture.jpeg


# ---- parameters


def test_px4_values_are_checked_by_type_range_and_unit() -> None:
    definitions = _px4_definitions()
    speed, action = definitions["MPC_XY_VEL_MAX"], definitions["COM_LOW_BAT_ACT"]
    assert px4_value("MPC_XY_VEL_MAX", speed, 5).real == 5.0
    assert px4_value("COM_LOW_BAT_ACT", action, 2.0).integer == 2
    for value in (700, -1, math.nan, "5", None, True):
        with pytest.raises(CallError, match=r"MPC_XY_VEL_MAX: .* is not allowed, a number from 0 to 20 m/s"):
            px4_value("MPC_XY_VEL_MAX", speed, value)
    with pytest.raises(CallError, match=r"COM_LOW_BAT_ACT: 1.5 is not allowed, an integer"):
        px4_value("COM_LOW_BAT_ACT", action, 1.5)


@pytest.mark.parametrize("value", [None, math.nan, 2**40, [1, None], {"a": [math.inf]}, "x" * 20_000])
def test_the_parameter_server_gets_only_what_it_can_hold(value: Any) -> None:
    with pytest.raises(CallError, match="/a: "):
        check_ros_value("/a", value)
    check_ros_value("/a", {"b": [1, 2.5, "c", True]})


def test_parameters_have_their_own_nodes_declaration() -> None:
    tables = read_declared((command_options.repository() / "docs" / "settings.md").read_text())
    speed = declared_for(tables, "/simulator/speed")
    assert speed is not None
    assert speed.meaning.startswith("target real-time factor")
    assert declared_for(tables, "/lockstep/wait") is None
    assert declared_for(tables, "/cameras/speed") is None
    rate = declared_for(tables, "/cameras/rate")
    assert rate is not None
    assert rate.unit == "Hz"
    assert flattened({"a": {"b": 1, "c": {}}, "d": [1]}) == {"/a/b": 1, "/d": [1]}


def test_links_join_the_topics_of_two_nodes() -> None:
    graph = join_topics(
        [("/t", ["/a"]), ("/u", ["/a"]), ("/v", ["/b"])], [("/t", ["/b", "/a"]), ("/u", ["/b"])], [], {}
    )
    assert links(graph) == [{"from": "/a", "to": "/b", "topics": ["/t", "/u"]}]
