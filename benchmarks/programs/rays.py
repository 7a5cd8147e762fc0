"""Benchmark of the lidars' rays: rays per second on one core, by kind and number of lidars, in the world ``outdoor``.

``python -m benchmarks.programs.rays --lidars 1 6 --kind spinning`` prints a table; ``--json FILE`` writes it. The time
is that of a scan without its transport: skewed rays against the world, people and other vehicles, noise, message.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_common.settings import check_range
from xtdrone_sim.lidars.lidar_messages import scan_message
from xtdrone_sim.lidars.scan_measurement import begin_us, cast_scan, end_us, measure_scan
from xtdrone_sim.lidars.scene_history import SceneHistory
from xtdrone_sim.rays.scene import ActorInScene, RayScene, SceneAt
from xtdrone_sim.vehicles.mounts.fleet_sensor import Lidar
from xtdrone_sim.vehicles.mounts.lidar_mounts import KINDS, LidarMount
from xtdrone_worlds.worlds.sdf import load_world_file

_RATE = 10.0  # Hz
_RAYS = {"scan": 512, "spinning": 512 * 16, "pattern": 20_000}
_SPEED, _TURN, _HEIGHT = 3.0, 0.5, 2.0  # m/s, rad/s, m
_PERIOD_US = 20_000


def _mount(kind: str) -> LidarMount:
    return LidarMount(kind=kind, rate=_RATE, samples=20_000 if kind == "pattern" else 512, noise=0.01)


def measure(lidars: int, kind: str, seconds: float) -> dict[str, Any]:
    """Measure lidars of as many vehicles, which fly in circles.

    Args:
        lidars: 1 or more.
        kind: of ``KINDS``.
        seconds: minimum wall time of the measurement, above 0.

    Returns:
        lidars, kind, rays (of all lidars in a scan), million_rays_per_second (of processor time), real_time_factor.
    """
    world, fleet, mount = load_world_file("outdoor"), parse_fleet(f"iris:{lidars}"), _mount(kind)
    scene = RayScene(world.models, fleet, world.actors)
    history = SceneHistory(round(1e6 / _RATE))
    number, cast, used, waited = 0, 0, 0.0, 0.0
    for time_us in range(0, 1_000_000_000, _PERIOD_US):
        history.add(time_us, _scene(fleet, world.actors, time_us * 1e-6))
        if time_us < end_us(mount, number):
            continue
        cpu, wall = time.thread_time(), time.perf_counter()
        for vehicle in fleet:
            motion = history.motion(scene, f"{vehicle.name}::base_link", begin_us(mount, number), end_us(mount, number))
            assert motion is not None
            rays, hits = cast_scan(mount, number, motion, scene.number(vehicle.name))
            scan_message(
                Lidar(vehicle.name, mount.link, mount), number, measure_scan(mount, vehicle.name, number, rays, hits)
            )
        if number:  # the first scan loads the kernels
            used, waited, cast = used + time.thread_time() - cpu, waited + time.perf_counter() - wall, cast + 1
        number += 1
        if waited >= seconds and cast >= 3:
            break
    rays_of_all = lidars * _RAYS[kind]
    return {
        "lidars": lidars,
        "kind": kind,
        "rays": rays_of_all,
        "million_rays_per_second": 1e-6 * cast * rays_of_all / used,
        "real_time_factor": cast / _RATE / used,
    }


def _scene(fleet: Any, actors: Any, time_s: float) -> SceneAt:
    links = {}
    for k, vehicle in enumerate(fleet):
        angle = _TURN * time_s + 2.0 * np.pi * k / len(fleet)
        radius = _SPEED / _TURN
        place = (radius * float(np.cos(angle)), radius * float(np.sin(angle)), _HEIGHT)
        links[f"{vehicle.name}::base_link"] = Pose(place, from_euler(0.1, 0.0, angle))
    return SceneAt(links, {actor.name: ActorInScene(actor.pose, time_s % 1.0) for actor in actors})


COLUMNS = (
    Column("lidars", "{lidars}"),
    Column("kind", "{kind}"),
    Column("rays/scan", "{rays}"),
    Column("Mrays/s", "{million_rays_per_second:.2f}"),
    Column("real time", "{real_time_factor:.1f}x"),
)


def main() -> int:
    """Measure the numbers and kinds of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lidars", type=int, nargs="+", default=[1, 6])
    parser.add_argument("--kind", choices=KINDS, nargs="+", default=list(KINDS))
    parser.add_argument("--seconds", type=float, default=3.0, help="minimum time of one measurement, s")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    check_range("--seconds", arguments.seconds, 0.001, unit="s")
    for lidars in arguments.lidars:
        check_range("--lidars", lidars, 1, 100)
        for kind in arguments.kind:
            yield measure(lidars, kind, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
