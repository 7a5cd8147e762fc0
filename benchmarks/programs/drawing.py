"""Benchmark of the drawing: images per second off-screen, with trails, topology and slots.

``python -m benchmarks.programs.drawing --vehicles 9 100 1000`` prints a table; ``--json FILE`` writes it.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_swarm.view.swarm_picture import Frame, SwarmView

SIZE = (640, 480)  # pixels
_PERIOD = 1.0 / 15.0  # s of simulated time between two frames
_LISTENED = 2  # neighbours of each vehicle
_WARM_UP = 60  # frames that fill the trails


def frames(count: int) -> Iterator[Frame]:
    """Yield frames of a lattice that sways as a whole while its vehicles circle around their slots; infinite.

    Args:
        count: vehicles.
    """
    side = int(np.ceil(count ** (1.0 / 3.0)))
    index = np.arange(count)
    lattice = 3.0 * np.stack([index % side, index // side % side, index // side**2], axis=1) + [0.0, 0.0, 5.0]
    later = np.repeat(np.arange(1, count), _LISTENED)
    edges = np.stack([later, np.maximum(0, later - np.tile([1, side], count - 1))], axis=1)
    for k in itertools.count():
        time_s = k * _PERIOD
        slots = lattice + np.array([1.5 * time_s, 2.0 * np.sin(0.5 * time_s), 0.0])
        phase = time_s + index
        circle = 1.2 * np.stack([np.cos(phase), np.sin(phase), 0.3 * np.sin(2.0 * phase)], axis=1)
        yield Frame(time_s, slots + circle, slots, edges, "lattice", "benchmark")


def measure(count: int, seconds: float, size: tuple[int, int] = SIZE) -> dict[str, Any]:
    """Measure how fast a swarm is drawn, by wall time.

    Args:
        count: vehicles, at least 2.
        seconds: minimum wall time of the measurement, above 0.
        size: of the images, pixels.

    Returns:
        vehicles, pictures_per_second.

    Raises:
        ValueError: a number is too small, or a size that :class:`SwarmView` refuses.
    """
    if count < 2 or not seconds > 0.0:
        raise ValueError(f"drawing: {count} vehicles and {seconds} s are not allowed, at least 2 and above 0")
    view = SwarmView([f"uav_{i}" for i in range(count)], size=size)
    states = frames(count)
    for frame in itertools.islice(states, _WARM_UP):
        view.update(frame)
    view.draw()
    spent, drawn = 0.0, 0
    while spent < seconds:
        frame = next(states)
        began = time.perf_counter()
        view.update(frame)
        view.draw()
        spent += time.perf_counter() - began
        drawn += 1
    return {"vehicles": count, "pictures_per_second": drawn / spent}


COLUMNS = (Column("vehicles", "{vehicles}"), Column("pictures/s", "{pictures_per_second:.1f}"))


def main() -> int:
    """Measure the swarm sizes of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=[9, 100, 1000], help="swarm sizes, at least 2")
    parser.add_argument("--seconds", type=float, default=3.0, help="minimum wall time of one measurement, s")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    if min(arguments.vehicles) < 2 or not arguments.seconds > 0.0:
        raise ValueError("vehicles: at least 2 each; seconds: above 0")
    for count in arguments.vehicles:
        yield measure(count, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
