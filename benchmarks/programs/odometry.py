"""Benchmark of the work on a lidar's scan of 1024 columns: lidar odometry, local map, octree; ms of processor time.

``python -m benchmarks.programs.odometry --rings 16 --kind odometry`` prints a table; ``--json FILE`` writes it. The
scans are those of a flight along a street of the world ``city`` at 3 m/s. The time includes reading a message, but not
creating it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_common.clouds import points_of, read_cloud
from xtdrone_common.pose_matrices import pose_of
from xtdrone_common.poses import Pose
from xtdrone_common.settings import check_range
from xtdrone_perception.slam.deskewing import motion_of
from xtdrone_perception.slam.lidar_odometry import LidarOdometry, RegistrationOptions
from xtdrone_planning.mapping.range_images import LidarImages, LidarMapping
from xtdrone_planning.mapping.voxel_grid import LocalMap, MapSettings
from xtdrone_planning.octree.octree_map import GlobalMap, OctreeSettings
from xtdrone_sim.lidars.lidar_messages import scan_message
from xtdrone_sim.lidars.scan_measurement import begin_us, cast_scan, end_us, measure_scan
from xtdrone_sim.lidars.scene_history import SceneHistory
from xtdrone_sim.rays.scene import RayScene, SceneAt
from xtdrone_sim.vehicles.mounts.fleet_sensor import Lidar
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount
from xtdrone_worlds.worlds.catalogue import load_world

KINDS = ("odometry", "local_map", "octree")

_RATE, _SPEED, _HEIGHT = 10.0, 3.0, 3.0  # Hz, m/s, m
_COLUMNS, _SCANS, _LIFT = 1024, 20, 0.06
_NAME = "iris_0"
_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])

Work = Callable[[Any, int], None]
"""Function that processes a cloud with its time, ns."""


def _place(time_us: int) -> tuple[float, float, float]:
    return _SPEED * time_us * 1e-6, 0.0, _HEIGHT


def _clouds(rings: int) -> list[Any]:
    """Return the clouds of a flight."""
    mount = LidarMount(
        kind="spinning", rate=_RATE, samples=_COLUMNS, channels=rings, vertical_min=-0.2618, vertical_max=0.2618,
        range_max=100.0, noise=0.02, position=(0.0, 0.0, _LIFT),
    )  # fmt: skip
    scene, history = RayScene(load_world("city").models), SceneHistory(round(1e6 / _RATE))
    clouds: list[Any] = []
    for time_us in range(0, 1_000_000_000, 20_000):
        history.add(time_us, SceneAt({f"{_NAME}::base_link": Pose(_place(time_us), (1.0, 0.0, 0.0, 0.0))}, {}))
        number = len(clouds)
        if time_us < end_us(mount, number):
            continue
        motion = history.motion(scene, f"{_NAME}::base_link", begin_us(mount, number), end_us(mount, number))
        assert motion is not None
        rays, hits = cast_scan(mount, number, motion, -1)
        clouds.append(
            scan_message(Lidar(_NAME, mount.link, mount), number, measure_scan(mount, _NAME, number, rays, hits))
        )
        if len(clouds) == _SCANS:
            break
    return clouds


def _odometry() -> Work:
    core = LidarOdometry(
        RegistrationOptions(),
        pose_of((0.0, 0.0, _LIFT), Rotation.identity()),
        pose_of(_place(0), Rotation.identity()),
    )
    velocity = np.array([_SPEED, 0.0, 0.0])

    def work(cloud: Any, stamp_ns: int) -> None:
        scan = read_cloud(cloud)
        motion = motion_of(np.array([0.0, scan.duration]), Rotation.identity(2), velocity)
        predicted = core.pose.copy()
        predicted[:3, 3] += velocity / _RATE
        core.accept(core.register(core.points_of(scan, motion), predicted))

    return work


def _mapped(fed: Any, rings: int) -> Work:
    """Return the function that inserts a cloud into a local map or an octree."""
    images = LidarImages(LidarMapping(columns=_COLUMNS, channels=rings))

    def work(cloud: Any, stamp_ns: int) -> None:
        for ns in range(stamp_ns - 10_000_000, stamp_ns + 120_000_000, 10_000_000):
            fed.poses.add(ns, np.concatenate([_place(ns // 1000), _LEVEL]))
        fed.enter(images.image(points_of(cloud)), stamp_ns, (0.0, 0.0, _LIFT))
        if isinstance(fed, GlobalMap):
            fed.update()

    return work


def measure(rings: int, kind: str, seconds: float) -> dict[str, Any]:
    """Measure one kind of work on scans of ``rings`` x 1024 rays.

    Args:
        rings: planes of the lidar.
        kind: of ``KINDS``.
        seconds: minimum wall time of the measurement, above 0.

    Returns:
        rings, kind, rays, milliseconds (of processor time, a scan), most_milliseconds.
    """
    clouds = _clouds(rings)
    used: list[float] = []
    begin = 0.0
    while len(used) < 3 or time.perf_counter() - begin < seconds:
        works = {
            "odometry": _odometry,
            "local_map": lambda: _mapped(LocalMap(MapSettings(), 0.5), rings),
            "octree": lambda: _mapped(GlobalMap(OctreeSettings()), rings),
        }
        work = works[kind]()
        for number, cloud in enumerate(clouds):
            cpu = time.thread_time()
            work(cloud, round(number / _RATE * 1e9))
            if number:  # the first scan loads the kernels, and has no map to register to
                used.append(time.thread_time() - cpu)
            else:
                begin = begin or time.perf_counter()
    return {
        "rings": rings,
        "kind": kind,
        "rays": rings * _COLUMNS,
        "milliseconds": 1e3 * float(np.median(used)),
        "most_milliseconds": 1e3 * max(used),
    }


COLUMNS = (
    Column("rings", "{rings}"),
    Column("kind", "{kind}"),
    Column("rays/scan", "{rays}"),
    Column("ms/scan", "{milliseconds:.1f}"),
    Column("most", "{most_milliseconds:.1f}"),
)


def main() -> int:
    """Measure the numbers and kinds of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rings", type=int, nargs="+", default=[16])
    parser.add_argument("--kind", choices=KINDS, nargs="+", default=list(KINDS))
    parser.add_argument("--seconds", type=float, default=3.0, help="minimum time of one measurement, s")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    check_range("--seconds", arguments.seconds, 0.001, unit="s")
    for rings in arguments.rings:
        check_range("--rings", rings, 1, 128)
        for kind in arguments.kind:
            yield measure(rings, kind, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
