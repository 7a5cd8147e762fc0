"""The maps of a recorded flight against the true surfaces of its world: clouds and octrees of the bag, saved maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_interaction.metrics.odometry_errors import Trajectory, trajectory_of
from xtdrone_interaction.missions.true_surfaces import Sight, TrueWorld, sight_of
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.recorded_flight import RecordError, Recording
from xtdrone_planning.octree.octree_format import Octree, OctreeError, count_nodes, decode, read_file

Array = NDArray[np.float64]

_OCTREE_ENDINGS = (".bt", ".ot")
_CLOUD_ENDINGS = (".ply", ".xyz", ".txt")
_CLOUD, _OCTREES = "/local_map", ("/octomap_binary", "/octomap_full")
_TYPES = ("sensor_msgs/PointCloud2", "octomap_msgs/Octomap")
TOGETHER = "together"
"""Name of the union of several saved maps."""
MERGED = "merged_map"
"""Name of a saved map that was merged of others; it is no part of their union."""
_LEAST_WAY = 2  # poses
_POINT = 12  # bytes of a cloud's point


def read_map(path: Path) -> Array:
    """Return the points of a saved map: centres of an octree's occupied voxels, or a cloud's points, (n, 3) m.

    Raises:
        RecordError: it cannot be read.
    """
    endings = (*_OCTREE_ENDINGS, *_CLOUD_ENDINGS)
    if path.suffix not in endings:
        raise RecordError(f"map: {str(path)!r} is not allowed, a file with one of the endings {', '.join(endings)}")
    try:
        points = _points_of(path)
    except (OctreeError, OSError, ValueError, LookupError, AttributeError) as error:
        raise RecordError(f"map: {path}: {error}") from error
    wrong = ~np.isfinite(points).all(axis=1)
    if wrong.any():
        raise RecordError(f"map: {path}: point {points[wrong][0].tolist()} is not allowed, finite numbers")
    return points


def _points_of(path: Path) -> Array:
    if path.suffix in _OCTREE_ENDINGS:
        return read_file(path).middles()
    if path.suffix == ".ply":
        import trimesh  # slow to import

        cloud: Any = trimesh.load(path)
        return np.asarray(cloud.vertices, np.float64)
    return np.loadtxt(path, usecols=(0, 1, 2), ndmin=2)


def octrees_in(folder: Path) -> list[Path]:
    """Return the octrees saved in a folder."""
    return sorted(path for path in folder.iterdir() if path.suffix in _OCTREE_ENDINGS)


def join_clouds(messages: Sequence[Any], voxel: float) -> Array:
    """Return the points of several clouds (x, y, z of float32), one of each voxel of side ``voxel`` m, the latest.

    Raises:
        RecordError: a cloud has other fields, too.
    """
    for message in messages:
        if message.point_step != _POINT:
            raise RecordError(f"cloud: point_step {message.point_step} is not allowed, {_POINT}: x, y, z of float32")
    clouds = [np.frombuffer(bytes(message.data), "<f4").reshape(-1, 3) for message in reversed(messages)]
    if not clouds:
        return np.empty((0, 3))
    points = np.concatenate(clouds).astype(float)
    _, chosen = np.unique(np.floor(points / voxel).astype(np.int64), axis=0, return_index=True)
    found: Array = points[np.sort(chosen)]
    return found


def map_rows(
    bags: Sequence[Path], world: str, files: Sequence[Path] = (), seed: int = 0, part: int | None = None
) -> list[dict[str, Any]]:
    """Return the accuracy of all maps of a flight as plain data; see ``MapAccuracy``.

    Args:
        bags: of the flight, with the true odometry.
        world: name or file.
        files: saved maps.
        seed: of the points drawn on surfaces.
        part: number of the flight in a bag whose simulated time was reset, from 1; None for the longest.

    Raises:
        RecordError: no such world, or a map that cannot be read.
        BagError: the bag cannot be read.
    """
    try:
        truth = TrueWorld(world)
    except (ValueError, OSError) as error:
        raise RecordError(f"world: {error}") from error
    endings = (_CLOUD, *_OCTREES)
    listed = read_bag(bags, part=part, wanted=lambda name: False).topics
    names = [topic.name for topic in listed if topic.name.endswith(endings) and topic.type in _TYPES]
    recording = read_bag(
        bags, part=part, keep=names, wanted=lambda name: name in names or name.endswith("/ground_truth/odom")
    )
    ways = _ways(recording)
    maps = [(name.strip("/"), _recorded(recording, name)) for name in names]
    saved = [(path.name, read_map(path)) for path in files]
    maps += saved
    maps += unite(saved)
    compared = [(name, truth.compare(points, _of_vehicle(ways, name), seed)) for name, points in maps]
    return [{"map": name, **accuracy} for name, accuracy in compared if accuracy is not None]


def unite(saved: Sequence[tuple[str, Array]]) -> list[tuple[str, Array]]:
    """Return the union of several saved maps, given by file name and points (n, 3), as a map; empty for one."""
    parts = [points for name, points in saved if Path(name).stem != MERGED]
    return [(TOGETHER, np.concatenate(parts))] if len(parts) > 1 else []


def _ways(recording: Recording) -> dict[str, tuple[Trajectory, Sight]]:
    """Return the true path of each vehicle, and its field of view."""
    ways = {name: trajectory_of(series) for name, series in recording.true_poses.items()}
    return {name: (way, sight_of(name)) for name, way in ways.items() if len(way) >= _LEAST_WAY}


def _of_vehicle(ways: dict[str, tuple[Trajectory, Sight]], name: str) -> list[tuple[Trajectory, Sight]]:
    """Return the path of the vehicle named by a topic or file (as map.iris_0.bt); all paths if it names none."""
    named = [way for vehicle, way in ways.items() if vehicle in name.replace("/", ".").split(".")]
    return named or list(ways.values())


def _recorded(recording: Recording, name: str) -> Array:
    messages = [message for _, message in recording.messages.get(name, [])]
    if name.endswith(_CLOUD):
        return join_clouds(messages, 0.1)
    if not messages:
        return np.empty((0, 3))
    last = messages[-1]
    data = np.asarray(last.data, np.int8).tobytes()
    try:
        return decode(Octree(data, count_nodes(data, last.binary), last.resolution, last.binary)).middles()
    except OctreeError as error:
        raise RecordError(f"{name}: {error}") from error
