"""Benchmark of the renderer: milliseconds per image of the world ``outdoor`` with people, by size and backend.

``python -m benchmarks.programs.renderer --width 320 640`` prints a table; ``--json FILE`` writes it.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_common.settings import check_range
from xtdrone_sim.cameras.drawn_scene import DrawnScene, View
from xtdrone_sim.cameras.rendering.renderer import BACKENDS, Renderer, RendererError
from xtdrone_sim.rays.scene import ActorInScene, SceneAt
from xtdrone_worlds.worlds.sdf import load_world_file

_HEIGHT = 20.0  # m, of the camera
_PITCH = math.radians(50.0)  # downwards
_FIELD = 2.0  # rad
_VIEWS = 8  # positions of the camera


def measure(width: int, height: int, backend: str, seconds: float) -> dict[str, Any]:
    """Measure the time per image of a camera above the people of a world.

    Args:
        width, height: pixels.
        backend: of ``BACKENDS``.
        seconds: minimum wall time of the measurement, above 0.

    Returns:
        width, height, backend, milliseconds (processor time, median), wall_milliseconds (median), images; and
        depth_milliseconds and stereo_milliseconds (wall, medians), of an image with depth and of a stereo pair.

    Raises:
        RendererError: there is no such renderer here.
        ValueError: a size or the backend is not allowed.
    """
    world = load_world_file("outdoor")
    with Renderer(backend) as renderer:
        scene = DrawnScene(renderer, world)
        view = View("camera", Pinhole.of_view(width, height, _FIELD), 0.05, 500.0)
        right = replace(view, pose=Pose((0.0, -0.12, 0.0)))
        x, y, _ = world.actors[0].pose.position
        turned = [from_euler(0.0, _PITCH, 2.0 * math.pi * k / _VIEWS) for k in range(_VIEWS)]
        places = [
            SceneAt(
                {"camera": Pose((x - 10.0 * math.cos(a), y - 10.0 * math.sin(a), _HEIGHT), turned[k])},
                {actor.name: ActorInScene(actor.pose, k / _VIEWS) for actor in world.actors},
            )
            for k, a in enumerate(2.0 * math.pi * k / _VIEWS for k in range(_VIEWS))
        ]
        used, waited = _times(scene, places, (view,), seconds)
        _, with_depth = _times(scene, places, (replace(view, depth=True),), seconds)
        _, of_pair = _times(scene, places, (view, right), seconds)
        name = renderer.backend
    return {
        "width": width,
        "height": height,
        "backend": name,
        "milliseconds": 1e3 * statistics.median(used),
        "wall_milliseconds": 1e3 * statistics.median(waited),
        "depth_milliseconds": 1e3 * statistics.median(with_depth),
        "stereo_milliseconds": 1e3 * statistics.median(of_pair),
        "pictures": len(used),
    }


def _times(
    scene: DrawnScene, places: Sequence[SceneAt], views: Sequence[View], seconds: float
) -> tuple[list[float], list[float]]:
    """Return processor and wall times, s, of exposures that draw all ``views``, after one that is not counted."""
    used: list[float] = []
    waited: list[float] = []
    for view in views:
        scene.draw(places[0], view)
    while sum(waited) < seconds or len(used) < len(places):
        cpu, wall = time.process_time(), time.perf_counter()
        for view in views:
            scene.draw(places[len(used) % len(places)], view)
        used.append(time.process_time() - cpu)
        waited.append(time.perf_counter() - wall)
    return used, waited


COLUMNS = (
    Column("size", "{width} x {height}"),
    Column("backend", "{backend}"),
    Column("CPU ms", "{milliseconds:.1f}"),
    Column("wall ms", "{wall_milliseconds:.1f}"),
    Column("with depth ms", "{depth_milliseconds:.1f}"),
    Column("stereo ms", "{stereo_milliseconds:.1f}"),
)


def main() -> int:
    """Measure the image sizes and backends of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, nargs="+", default=[320, 640], help="px")
    parser.add_argument("--height", type=int, nargs="+", help="px, one for each width (default: three quarters of it)")
    parser.add_argument("--backend", choices=BACKENDS, nargs="+", default=["egl", "tiny"])
    parser.add_argument("--seconds", type=float, default=3.0, help="minimum time of one measurement, s")
    return run(parser, _cases, COLUMNS, (RendererError,))


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    heights = arguments.height or [width * 3 // 4 for width in arguments.width]
    if len(heights) != len(arguments.width):
        raise ValueError(f"--height: {len(heights)} numbers for {len(arguments.width)} widths")
    check_range("--seconds", arguments.seconds, 0.001, unit="s")
    for width, height in zip(arguments.width, heights, strict=True):
        for backend in arguments.backend:
            yield measure(width, height, backend, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
