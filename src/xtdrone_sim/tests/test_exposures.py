"""The exposure times of each camera, and failures of the rendering process."""

from __future__ import annotations

import math
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.cameras.camera_worker import DrawingError, DrawingProcess, Drawn
from xtdrone_sim.cameras.cameras_of_fleet import Exposures, cameras_of, turn_rate
from xtdrone_sim.cameras.drawn_scene import View
from xtdrone_sim.rays.scene import SceneAt

LINK = "typhoon_h480_0::cgo3_camera_link"
VIEW = View(LINK, Pinhole.of_view(64, 36, 2.0), 0.1, 500.0)
DOWN = SceneAt({LINK: Pose((1.0, 2.0, 20.0), from_euler(0.0, 0.5 * math.pi, 0.0))}, {})


@pytest.mark.parametrize(
    ("rate", "turns"), [(10.0, 10.0), (2.0, 10.0), (3.0, 12.0), (7.0, 14.0), (0.7, 10.5), (30.0, 30.0)]
)
def test_turns_are_a_multiple_of_the_rate(rate: float, turns: float) -> None:
    assert turn_rate([rate] * 6) == pytest.approx(turns)


@pytest.mark.parametrize("rate", [0.0, -1.0, 51.0, math.nan])
def test_invalid_rates_are_rejected(rate: float) -> None:
    with pytest.raises(ValueError, match=r"rate: .* is not allowed, 0.1 to 50 Hz"):
        turn_rate([rate])


@pytest.mark.parametrize(("rate", "count"), [(2.0, 6), (5.0, 6), (10.0, 6), (3.0, 4), (0.5, 3)])
def test_cameras_expose_evenly_at_their_rate_and_spread(rate: float, count: int) -> None:
    turns = turn_rate([rate] * count)
    exposures = Exposures([rate] * count, turns)
    length = 8.0
    times = [-(-k * 1_000_000 // round(turns * 1000) * 1000 // 4000) * 4000 for k in range(round(turns * length))]
    due = [exposures.due(time) for time in times]
    most = max(map(len, due))
    assert most == math.ceil(count * rate / turns - 1e-9)  # the load is spread evenly over the turns
    for camera in range(count):
        at = [turn for turn, cameras in enumerate(due) if camera in cameras]
        assert len(at) == round(rate * length)
        assert set(np.diff(at)) == {round(turns / rate)}


def test_rates_may_differ() -> None:
    exposures = Exposures([10.0, 4.0], 10.0)
    due = [exposures.due(round(k * 1e5)) for k in range(100)]
    assert sum(0 in cameras for cameras in due) == 100
    assert sum(1 in cameras for cameras in due) == 40


def test_a_fleets_cameras_have_upstreams_names() -> None:
    cameras = cameras_of(parse_fleet("iris:1,typhoon_h480:2"))
    assert [camera.topics for camera in cameras] == ["/typhoon_h480_0/cgo3_camera", "/typhoon_h480_1/cgo3_camera"]
    assert cameras[1].frame_id == "typhoon_h480_1/cgo3_camera_optical_frame"
    assert cameras[1].views[0].link == "typhoon_h480_1::cgo3_camera_link"


@pytest.fixture
def process() -> Iterator[DrawingProcess]:
    made = DrawingProcess(Drawn("empty", "typhoon_h480:1", "tiny"))
    yield made
    made.close()


def test_a_killed_drawing_process_loses_only_its_picture(process: DrawingProcess) -> None:
    first = process.draw([DOWN], VIEW)
    assert first is not None
    assert len(first) == 64 * 36 * 3
    os.kill(process.pid, signal.SIGKILL)
    assert process.draw([DOWN], VIEW) is None
    assert (process.ended, process.last_end) == (1, "signal 9")
    assert process.draw([DOWN], VIEW) == first
    with pytest.raises(DrawingError, match=r"camera's link: 'x::y' is not in the scene; there are typhoon_h480_0::"):
        process.draw([DOWN], View("x::y", VIEW.pinhole, 0.1, 500.0))
    assert process.draw([DOWN], VIEW) == first


def test_closing_over_a_picture_starts_no_other_process(process: DrawingProcess) -> None:
    assert process.draw([DOWN], VIEW) is not None
    os.kill(process.pid, signal.SIGSTOP)
    drawn: list[bytes | None] = []
    thread = threading.Thread(target=lambda: drawn.append(process.draw([DOWN], VIEW)))
    thread.start()
    process.close()
    thread.join()
    assert (drawn, process.ended) == ([None], 0)


def test_a_world_that_cannot_be_drawn_is_reported(tmp_path: Path) -> None:
    process = DrawingProcess(Drawn(str(tmp_path / "none.world"), "typhoon_h480:1", "tiny"))
    try:
        with pytest.raises(DrawingError, match=r"none.world.*No such file"):
            process.draw([DOWN], VIEW)
    finally:
        process.close()
