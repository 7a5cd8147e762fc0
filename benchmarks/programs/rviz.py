"""Benchmark of the off-screen rviz: frames per second of a film, and processor time per frame of each program.

``python -m benchmarks.programs.rviz --vehicles 9`` films vehicles that fly circles side by side, with slots,
topology, avoidance and trails, in the formation view.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rospy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3
from std_msgs.msg import Float32MultiArray, Header, Int32MultiArray

from benchmarks.process_use import CpuSample
from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.recording.topics import PATTERN_TOPIC, TOPOLOGY_TOPIC
from xtdrone_interaction.rviz.films.film_options import film_settings
from xtdrone_interaction.rviz.films.messages_from_bag import Timed
from xtdrone_interaction.rviz.films.playback import play
from xtdrone_interaction.rviz.films.view_nodes import StageError, check_tools
from xtdrone_interaction.rviz.view_configurations import Array

_TYPE = "iris"
_STEP_US = 40_000  # of poses and avoidance
_WARM_UP = 60  # turns: models are loaded, trails grow, Mesa compiles its shaders
_SPACING = 3.0  # m
_RADIUS = 2.0  # m, of the circles
_TURN = 0.5  # rad/s


class Circles:
    """A flight of vehicles that circle side by side until it is stopped; replaces a bag.

    Attributes:
        fleet, types, begin_us, flown: see :class:`xtdrone_interaction.rviz.films.playback.Record`.
        ended: set to end the flight.
    """

    begin_us = 1_000_000
    flown: Array | None = None

    def __init__(self, vehicles: int) -> None:
        """Place the vehicles on a square grid."""
        self.fleet = f"{_TYPE}:{vehicles}"
        self.ended = False
        self._names = [vehicle.name for vehicle in parse_fleet(self.fleet)]
        side = math.ceil(math.sqrt(vehicles))
        rows, columns = np.divmod(np.arange(vehicles), side)
        self._homes = np.stack([_SPACING * columns, _SPACING * rows, 4.0 + 0.5 * (rows % 3)], axis=1)
        self.types = {PATTERN_TOPIC: "std_msgs/Float32MultiArray", TOPOLOGY_TOPIC: "std_msgs/Int32MultiArray"}
        for name in self._names:
            self.types[f"/{name}/mavros/local_position/pose"] = "geometry_msgs/PoseStamped"
            self.types[f"/xtdrone/{name}/avoid_vel"] = "geometry_msgs/Vector3"

    def messages(self, topics: Collection[str]) -> Iterator[Timed]:
        """Yield the messages of ``topics`` in the order of their times, until ``ended``."""
        count = len(self._names)
        heard = np.zeros((count, count), int)
        heard[1:, 0] = 1  # all hear the leader, and each its neighbour
        heard[np.arange(1, count), np.arange(count - 1)] = 1
        slots = (self._homes[1:] - self._homes[0]).T  # 3 x (n - 1), by rows
        yield Timed(self.begin_us, PATTERN_TOPIC, Float32MultiArray(data=slots.ravel()))
        yield Timed(self.begin_us, TOPOLOGY_TOPIC, Int32MultiArray(data=heard.ravel()))
        now_us = self.begin_us
        while not self.ended:
            angle = _TURN * 1e-6 * now_us
            across = Vector3(0.5 * math.cos(angle), 0.5 * math.sin(angle), 0.0)
            turn = Quaternion(0.0, 0.0, math.sin(0.5 * angle), math.cos(0.5 * angle))
            circle = [_RADIUS * math.cos(angle), _RADIUS * math.sin(angle), 0.0]
            header = Header(stamp=rospy.Time(0, 1000 * now_us), frame_id="map")
            for name, place in zip(self._names, self._homes + circle, strict=True):
                pose = PoseStamped(header, Pose(Point(*place), turn))
                yield Timed(now_us, f"/{name}/mavros/local_position/pose", pose)
                yield Timed(now_us, f"/xtdrone/{name}/avoid_vel", across)
            now_us += _STEP_US


def measure(vehicles: int, width: int, height: int, antialiasing: bool, seconds: float) -> dict[str, Any]:
    """Film circling vehicles and return the figures.

    Args:
        vehicles: number of vehicles.
        width, height: of a frame, pixels.
        antialiasing: whether edges are smoothed.
        seconds: minimum wall time of the measurement.

    Returns:
        vehicles, width, height, antialiasing, frames and elapsed (s), frames_per_second, cpu_per_frame (ms by
        program), others_cpu (cores used by other programs).

    Raises:
        FleetError, OptionError: the number of vehicles or the size is not allowed.
        StageError: no film was made.
    """
    flight = Circles(vehicles)
    turns = 0
    samples: list[tuple[int, float, CpuSample]] = []  # at the measurement's beginning and end

    def on_turn(_: int) -> None:
        nonlocal turns
        turns += 1
        enough = bool(samples) and time.monotonic() - samples[0][1] >= seconds
        if turns == _WARM_UP or (enough and not flight.ended):
            samples.append((turns, time.monotonic(), CpuSample.take(os.getpid())))
            flight.ended = enough

    with tempfile.TemporaryDirectory(prefix="xtdrone-rviz-") as folder:
        film = Path(folder) / "film.mp4"
        rough = [] if antialiasing else ["--rough"]
        settings = film_settings(["formation", "--size", f"{width}x{height}", "--out", str(film), *rough])
        play(settings, flight, Path(folder), on_turn)
    (first, begin, before), (last, end, after) = samples
    frames, elapsed = last - first, end - begin
    use = after.since(before)
    return {
        "vehicles": vehicles,
        "width": width,
        "height": height,
        "antialiasing": antialiasing,
        "frames": frames,
        "elapsed": elapsed,
        "frames_per_second": frames / elapsed,
        "cpu_per_frame": {name: 1e3 * seconds / frames for name, seconds in use.programs.items()},
        "others_cpu": use.others / elapsed,
    }


COLUMNS = (
    Column("vehicles", "{vehicles}"),
    Column("size", "{width} x {height}"),
    Column("antialiasing", "{antialiasing}"),
    Column("frames", "{frames}"),
    Column("frames/s", "{frames_per_second:.1f}"),
)


def main() -> int:
    """Measure the film of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, default=9)
    parser.add_argument("--width", type=int, default=1280, help="px")
    parser.add_argument("--height", type=int, default=720, help="px")
    parser.add_argument("--antialiasing", action=argparse.BooleanOptionalAction, default=True, help="smooth edges")
    parser.add_argument("--rough", dest="antialiasing", action="store_false", help="same as --no-antialiasing")
    parser.add_argument("--seconds", type=float, default=5.0, help="minimum time of the measurement, s")
    return run(parser, _cases, COLUMNS, (StageError,))


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    check_tools()
    yield measure(arguments.vehicles, arguments.width, arguments.height, arguments.antialiasing, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
