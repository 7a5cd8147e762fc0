"""The rendering process shows models that were added after the start, from its first picture on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.poses import Pose
from xtdrone_sim.cameras.camera_worker import Changes, DrawingProcess, Drawn
from xtdrone_sim.cameras.drawn_scene import View
from xtdrone_sim.rays.scene import SceneAt
from xtdrone_worlds.worlds.robots.robot_model import load_robot
from xtdrone_worlds.worlds.sdf import load_world_file, write_world

SIZE = (64, 48)
VIEW = View("camera", Pinhole.of_view(*SIZE, 1.0), 0.05, 100.0)
CAMERA = {"camera": Pose((-6.0, 0.0, 0.8))}


def picture(process: DrawingProcess, scene: SceneAt) -> np.ndarray:
    rows = process.draw([scene], VIEW)
    assert rows is not None, process.last_end
    return np.frombuffer(rows, np.uint8).reshape(SIZE[1], SIZE[0], 3).astype(int)


def blue(image: np.ndarray) -> int:
    """Return the number of pixels in the colour of the car's body."""
    return int(((image[:, :, 2] > image[:, :, 0] + 40) & (image[:, :, 2] < 200)).sum())


def test_a_robot_is_drawn_where_it_is() -> None:
    process = DrawingProcess(Drawn("empty", "iris:1", "tiny"))
    try:
        car = load_robot("car").model("car_0", Pose())
        process.change(Changes(write_world(replace(load_world_file("empty"), models=(car,))), ()))
        near = picture(process, SceneAt({**CAMERA, "car_0::base_link": Pose((2.0, 0.0, 0.0))}, {}))
        far = picture(process, SceneAt({**CAMERA, "car_0::base_link": Pose((20.0, 0.0, 0.0))}, {}))
        assert blue(near) > 4 * blue(far) > 0
        process.change(Changes(write_world(load_world_file("empty")), ()))
        assert blue(picture(process, SceneAt(CAMERA, {}))) == 0
        assert process.ended == 0
    finally:
        process.close()
