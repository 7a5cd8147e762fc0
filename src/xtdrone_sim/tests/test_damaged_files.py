"""Damaged files, as users and attackers send them: every reader raises its own error, in bounded time."""

from __future__ import annotations

import base64
import io
import json
import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from xtdrone_common.fleet import FleetError
from xtdrone_common.fleet.fleet_as_text import read_fleet_file
from xtdrone_sim.lidars.ray_patterns import PatternError, read_pattern
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.data_files import data_path
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.shapes.triangles import MeshError, read_obj
from xtdrone_worlds.worlds.sdf import SdfError, load_world_file
from xtdrone_worlds.worlds.sdf.geometries.heightmaps import read_heightmap
from xtdrone_worlds.worlds.sdf.geometries.mesh_files import MOST_NODES, check_wavefront, read_mesh
from xtdrone_worlds.worlds.urdf import UrdfError, read_urdf

DIGITS = b"9" * 5000
WORDS = (
    *(b"\0", b"\xff", b"nan", b"inf", b"-1", b"0", b"1e308", b"1e999", b"null", b"[]", b"{}", b"true", b"'x'", b"<"),
    *(DIGITS, b"0x" + b"f" * 5000, b"1" + b":59" * 2000, b"99999999999999999999"),
)
WHOLES = (b"", b"\0", b"[]", b"{}", b"null", DIGITS, b"[" * 3000, b"- " * 3000, b"<a>" * 3000, b"a: &a [*a]")


def damaged(seed: bytes, rounds: int = 30) -> Iterator[bytes]:
    """Yield damaged copies of a file: cut, with other bytes, and with other numbers."""
    dice = random.Random(7)
    yield from WHOLES
    numbers = list(re.finditer(rb"-?\d+\.?\d*", seed))
    for _ in range(rounds):
        yield seed[: dice.randrange(len(seed))]
        changed = bytearray(seed)
        for _ in range(dice.randrange(1, 6)):
            changed[dice.randrange(len(seed))] = dice.randrange(256)
        yield bytes(changed)
        at = dice.choice(numbers) if numbers else re.compile(b"").match(seed)
        assert at is not None
        yield seed[: at.start()] + dice.choice(WORDS) + seed[at.end() :]


def gltf(last: int = 2) -> dict[str, Any]:
    """Return one triangle as glTF; ``last`` is the index of its last corner."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    data = base64.b64encode(points + np.array([0, 1, last], "<u2").tobytes()).decode()
    uri = f"data:application/octet-stream;base64,{data}"
    return {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": 42, "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3",
                       "min": [0, 0, 0], "max": [1, 1, 0]},
                      {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}],
    }  # fmt: skip


def picture() -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.arange(81, dtype=np.uint8).reshape(9, 9)).save(file, "PNG")
    return file.getvalue()


URDF = b"""<robot name="r"><link name="a"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>
<visual><origin xyz="0 0 0" rpy="0 0 0"/><geometry><box size="1 1 1"/></geometry></visual></link><link name="b"/>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><limit lower="-1" upper="1" velocity="2"/></joint>
</robot>"""
OWN = b"extends: iris\nmass: 2\nsensors: {gps: {wander: 1}}\nparameters: {MPC_X: 1}\nrotor_model: {max_speed: 1000}\n"
MODELS = b"models:\n- {name: a, box: [1, 2, 3], pose: [1, 2, 3], mass: 2}\n- {name: b, sphere: 1.5}\n"
STL = b"""solid a
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid a
"""
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\n"
SDF = b"""<sdf version="1.6"><world name="w"><gravity>0 0 -9.8</gravity><magnetic_field>1e-5 2e-5 -4e-5</magnetic_field>
<model name="m"><pose>1 2 3 0 0 0</pose><link name="l"><collision name="c"><geometry><box><size>1 1 1</size></box>
</geometry></collision></link></model></world></sdf>"""

READERS: dict[str, tuple[Callable[[Path], object], bytes, type[Exception] | tuple[type[Exception], ...]]] = {
    "vehicle.urdf": (read_urdf, URDF, UrdfError),
    "vehicle.yaml": (lambda path: load_vehicle(str(path)), OWN, ModelError),
    "whole.yaml": (
        lambda path: load_vehicle(str(path)), (data_path("config/vehicles/iris.yaml")).read_bytes(), ModelError,
    ),
    "world.yaml": (
        lambda path: load_world_file(str(path)), (data_path("config/worlds/empty.yaml")).read_bytes() + MODELS,
        (ModelError, SdfError),
    ),
    "world.world": (lambda path: load_world_file(str(path)), SDF, (ModelError, SdfError)),
    "mesh.gltf": (read_mesh, json.dumps(gltf()).encode(), SdfError),
    "mesh.stl": (read_mesh, STL, SdfError),
    "mesh.dae": (read_mesh, b"<COLLADA/>", SdfError),
    "mesh.obj": (read_obj, OBJ, MeshError),
    "checked.obj": (check_wavefront, OBJ, SdfError),
    "terrain.png": (lambda path: read_heightmap(path, (1.0, 1.0, 1.0)), picture(), SdfError),
    "rays.csv": (read_pattern, b"Time/s,Azimuth/deg,Zenith/deg\n0,1,90\n1,2,91\n", PatternError),
    "fleet.yaml": (read_fleet_file, b"- {name: iris_0, pose: [1, 2, 0]}\n- {name: solo_0, id: 7}\n", FleetError),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_rejected_by_the_readers_own_error(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    read, seed, declared = READERS[name]
    rejected = 0
    for number, content in enumerate(damaged(seed, 8 if name == "whole.yaml" else 30)):
        path = tmp_path / f"{number}_{name}"
        path.write_bytes(content)
        try:
            read(path)
        except declared:
            rejected += 1
    assert rejected > 10
    for bad in (tmp_path / f"a\0{name}", tmp_path / ("a" * 300 + name)):
        with pytest.raises(declared):
            read(bad)


def meshes_of(tmp_path: Path, **changes: Any) -> tuple[Any, ...]:
    path = tmp_path / "mesh.gltf"
    path.write_text(json.dumps({**gltf(), **changes}))
    return read_mesh(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"nodes": [{"mesh": 0}] * 100_000, "scenes": [{"nodes": list(range(100_000))}]}, "it has 100000 nodes"),
        ({"nodes": [{"mesh": 0, "children": [k + 1]} for k in range(MOST_NODES)] + [{"mesh": 0}]}, "it has 2001 nodes"),
        ({"accessors": [{"componentType": 5126, "count": 10**12, "type": "VEC3"}]}, "1000000000000 values"),
        (gltf(9), "corner 9 does not exist|index 9 is out of bounds"),
    ],
)
def test_numbers_of_gltf_are_checked_before_they_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], message: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert len(meshes_of(tmp_path)) == 1
    with pytest.raises(SdfError, match=message):
        meshes_of(tmp_path, **changes)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("colour: red", "vehicle: field 'colour' is not known"),
        ("sensors: {gps: {jitter: 1}}", "sensors: gps: field 'jitter' is not known"),
        ("sensors: {imu: {mass: 1}}", "sensors: imu: field 'mass' is not known"),
        ("sensors: {sonar: {noise: 1}}", "sensors: field 'sonar' is not known"),
        ("rotor_model: {speed: 1}", "rotor_model: field 'speed' is not known"),
        ("sensors: {gps: {wander: .inf}}", "gps_wander: inf is not allowed"),
        ("sensors: {gps: {wander: far}}", "is missing or of the wrong kind"),
        ("parameters: [1]", "is missing or of the wrong kind"),
        ("mass: 0x" + "f" * 399, "a number of 401 characters is not allowed"),
    ],
)
def test_unknown_fields_and_values_of_a_vehicle_are_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(f"extends: iris\n{line}\n")
    with pytest.raises(ModelError, match=message):
        load_vehicle(str(path))


def test_all_vehicles_and_worlds_of_the_package_are_read() -> None:
    for path in data_path("config/vehicles").glob("*.yaml"):
        load_vehicle(path.stem)
    for path in data_path("config/worlds").glob("*.yaml"):
        load_world_file(path.stem)
