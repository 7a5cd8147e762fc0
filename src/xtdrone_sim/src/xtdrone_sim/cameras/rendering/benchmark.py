"""Benchmark of the renderer: milliseconds a picture of the world ``outdoor`` with people, by size and backend.

``python -m xtdrone_sim.cameras.rendering.benchmark --width 320 640`` prints a table; ``--json FILE`` writes it.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from pathlib import Path
from typing import Any

from xtdrone_control.checks import check_range
from xtdrone_control.pinhole import Pinhole
from xtdrone_sim.cameras.drawn_scene import ActorState, DrawnScene, SceneAt, View
from xtdrone_sim.cameras.rendering.renderer import BACKENDS, Renderer, RendererError
from xtdrone_sim.vehicles.poses import from_rpy
from xtdrone_sim.vehicles.visual import Pose
from xtdrone_sim.worlds.sdf import load_world_file

_HEIGHT = 20.0  # m, of the camera
_PITCH = math.radians(50.0)  # downwards
_FIELD = 2.0  # rad
_VIEWS = 8  # places of the camera


def measure(width: int, height: int, backend: str, seconds: float) -> dict[str, Any]:
    """Return how long a picture takes, of a camera that flies over the world's people.

    Args:
        width, height: pixels.
        backend: of ``BACKENDS``.
        seconds: least wall time of the measurement, above 0.

    Returns:
        width, height, backend, milliseconds (processor time, median), wall_milliseconds (median), pictures.

    Raises:
        RendererError: there is no such renderer here.
        ValueError: a size or the backend is not allowed.
    """
    world = load_world_file("outdoor")
    with Renderer(backend) as renderer:
        scene = DrawnScene(renderer, world)
        view = View("camera", Pinhole.of_view(width, height, _FIELD), 0.05, 500.0)
        x, y, _ = world.actors[0].pose.position
        turned = [from_rpy(0.0, _PITCH, 2.0 * math.pi * k / _VIEWS) for k in range(_VIEWS)]
        places = [
            SceneAt(
                {"camera": Pose((x - 10.0 * math.cos(a), y - 10.0 * math.sin(a), _HEIGHT), turned[k])},
                {actor.name: ActorState(actor.pose, k / _VIEWS) for actor in world.actors},
            )
            for k, a in enumerate(2.0 * math.pi * k / _VIEWS for k in range(_VIEWS))
        ]
        scene.draw(places[0], view)
        used: list[float] = []
        waited: list[float] = []
        while sum(waited) < seconds or len(used) < _VIEWS:
            cpu, wall = time.process_time(), time.perf_counter()
            scene.draw(places[len(used) % _VIEWS], view)
            used.append(time.process_time() - cpu)
            waited.append(time.perf_counter() - wall)
        name = renderer.backend
    return {
        "width": width,
        "height": height,
        "backend": name,
        "milliseconds": 1e3 * statistics.median(used),
        "wall_milliseconds": 1e3 * statistics.median(waited),
        "pictures": len(used),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, nargs="+", default=[320, 640], help="px")
    parser.add_argument("--height", type=int, nargs="+", help="px, one for each width; by default three quarters of it")
    parser.add_argument("--backend", choices=BACKENDS, nargs="+", default=["egl", "tiny"])
    parser.add_argument("--seconds", type=float, default=3.0, help="least time of one measurement, s")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    heights = arguments.height or [width * 3 // 4 for width in arguments.width]
    if len(heights) != len(arguments.width):
        parser.error(f"--height: {len(heights)} numbers for {len(arguments.width)} widths")
    results = []
    print(f"{'size':>10} {'backend':>8} {'CPU ms':>8} {'wall ms':>8}")
    try:
        check_range("--seconds", arguments.seconds, 0.001, unit="s")
        for width, height in zip(arguments.width, heights, strict=True):
            for backend in arguments.backend:
                row = measure(width, height, backend, arguments.seconds)
                results.append(row)
                size = f"{width} x {height}"
                cpu, wall = row["milliseconds"], row["wall_milliseconds"]
                print(f"{size:>10} {row['backend']:>8} {cpu:8.1f} {wall:8.1f}", flush=True)
    except (ValueError, RendererError) as error:
        parser.error(str(error))
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
