"""Heightmaps, glTF meshes and models in YAML: their positions, collisions, and bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from xtdrone_common.fleet import StartPose
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.cameras.drawn_scene import ground_level
from xtdrone_sim.physics.world import World
from xtdrone_sim.rays.scene import RayScene
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.shapes.visual import Mesh
from xtdrone_worlds.worlds.catalogue import load_world
from xtdrone_worlds.worlds.sdf import SdfError, SdfWorld, load_world_file, read_world, write_world
from xtdrone_worlds.worlds.sdf.geometries import heightmaps
from xtdrone_worlds.worlds.sdf.geometries.heightmaps import read_heightmap
from xtdrone_worlds.worlds.sdf.geometries.mesh_files import MOST_TRIANGLES, check_wavefront, read_mesh
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of

SIDE = 65
SIZE = (64.0, 64.0, 8.0)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def ramp(path: Path, side: int = SIDE, *, deep: bool = True) -> Path:
    """Write a picture of a slope that rises along y, from black below to white at the top of the picture."""
    values = np.linspace(1.0, 0.0, side)[:, None] * np.ones((1, side))
    scale, kind = (65535, np.uint16) if deep else (255, np.uint8)
    Image.fromarray(np.round(values * scale).astype(kind)).save(path)
    return path


def yaml_world(folder: Path, models: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(f"extends: empty\nmodels:\n{models}\n")
    return path


def heights(world: SdfWorld, places: np.ndarray) -> np.ndarray:
    """Return the heights at which rays from above hit at positions (n, 2)."""
    origins = np.column_stack([places, np.full(len(places), 50.0)])
    hits = RayScene(world.models).cast(origins, np.tile((0.0, 0.0, -1.0), (len(places), 1)), 100.0)
    return 50.0 - hits.ranges


# heightmaps


@pytest.mark.parametrize("deep", [True, False])
def test_terrain_rises_as_its_picture_says(deep: bool, tmp_path: Path) -> None:
    ramp(tmp_path / "hill.png", deep=deep)
    world = load_world_file(str(yaml_world(tmp_path, "- {name: hill, heightmap: hill.png, size: [64, 64, 8]}")))
    places = np.random.default_rng(1).uniform(-31.9, 31.9, (300, 2))
    expected = SIZE[2] * (places[:, 1] / SIZE[1] + 0.5)
    # 8 bits have steps of 8/255 m
    assert heights(world, places) == pytest.approx(expected, abs=1e-3 if deep else 0.02)
    outside = np.array([[40.0, 0.0], [0.0, -33.0]])
    assert heights(world, outside) == pytest.approx(0.0)
    assert ground_level(world.models) == pytest.approx(-0.12)


def test_terrain_of_sdf_is_that_of_yaml(tmp_path: Path) -> None:
    ramp(tmp_path / "hill.png")
    shape = "<geometry><heightmap><uri>hill.png</uri><size>64 64 8</size><pos>0 0 1</pos></heightmap></geometry>"
    file = tmp_path / "a.world"
    file.write_text(
        "<sdf version='1.6'><world name='w'>"
        "<model name='hill'><static>1</static><pose>5 0 0 0 0 0</pose><link name='l'>"
        f"<visual name='v'>{shape}</visual><collision name='c'>{shape}</collision></link></model></world></sdf>"
    )
    world = load_world_file(str(file))
    assert heights(world, np.array([[5.0, 0.0], [10.0, 16.0]])) == pytest.approx([5.0, 7.0], abs=1e-3)
    assert read_world(write_world(world), file) == world
    link = world.models[0].links[0]
    assert len(link.visuals) == 1
    assert len(link.collisions) == 4  # tiles of 32 x 32 cells
    boxes = np.array([np.concatenate(box_of(tile.geometry, Pose())) for tile in link.collisions])
    assert boxes[:, 5].min() == pytest.approx(5.0, abs=1e-3)  # the lower tiles end half-way up


def test_a_large_picture_is_reduced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert 2 * (heightmaps.MOST_POINTS - 1) ** 2 <= MOST_TRIANGLES
    monkeypatch.setattr(heightmaps, "MOST_POINTS", 70)
    files = read_heightmap(ramp(tmp_path / "big.png", 1025), (1024.0, 1024.0, 100.0))
    mesh = trimesh.load_mesh(files[0], process=False)
    assert len(mesh.faces) == 2 * 69**2
    assert mesh.bounds.tolist() == [[-512.0, -512.0, 0.0], [512.0, 512.0, 100.0]]
    assert np.asarray(mesh.vertices)[:, 2] == pytest.approx(100.0 * (mesh.vertices[:, 1] / 1024.0 + 0.5), abs=0.01)
    assert (mesh.face_normals[:, 2] > 0.9).all()
    assert read_heightmap(tmp_path / "big.png", (1024.0, 1024.0, 100.0)) == files


def test_a_vehicle_lands_on_terrain_and_a_ball_rolls_down(tmp_path: Path) -> None:
    """A ball on a slope of angle a accelerates with 5/7 g sin a, if it does not slip (solid sphere)."""
    ramp(tmp_path / "hill.png")
    models = (
        "- {name: hill, heightmap: hill.png, size: [64, 64, 8]}\n"
        "- {name: ball, sphere: 0.3, mass: 2, pose: [3, 16, 6.31]}"
    )
    path = yaml_world(tmp_path, models)
    world = World(load_world(str(path)), [load_vehicle("iris")], [StartPose(0.0, 0.0, 4.3)], 0.004)
    actuators, armed = np.zeros((1, 8)), np.zeros(1, np.int32)
    start = world.bodies.by_number[1].pose.position
    for _ in range(250):
        world.step(actuators, armed)
    x, y, z = world.bodies.by_number[1].pose.position
    slope = np.arctan(8.0 / 64.0)
    along = np.hypot(y - start[1], z - start[2])
    assert along == pytest.approx(0.5 * 5.0 / 7.0 * 9.80665 * np.sin(slope) * 1.0**2, rel=0.1)
    assert y < start[1]
    assert x == pytest.approx(3.0, abs=0.05)
    v = world.plant[0]
    assert (0, 1) in world.collisions or v["contact"] != 0
    assert 4.0 < v["position"][2] < 4.2  # on the slope, 4 m above z = 0
    assert abs(v["position"][1]) < 0.5


# glTF


def gltf(path: Path, *, colour: list[int] | None = None, picture: Image.Image | None = None) -> Path:
    """Write a box of 1 x 2 x 3 m (glTF: width, height, depth), raised by 5 m."""
    mesh = trimesh.creation.box((1.0, 2.0, 3.0))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=colour, baseColorTexture=picture)
    uv = np.zeros((len(mesh.vertices), 2)) if picture is not None else None
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    scene = trimesh.Scene()
    scene.add_geometry(mesh, transform=trimesh.transformations.translation_matrix((0.0, 5.0, 0.0)))
    scene.export(path)
    return path


@pytest.mark.parametrize("ending", ["glb", "gltf"])
def test_gltf_stands_upright(ending: str, tmp_path: Path) -> None:
    """In glTF y is up and z points to the front; here z is up."""
    (tmp_path / ending).mkdir()
    path = gltf(tmp_path / ending / f"box.{ending}", colour=[255, 0, 0, 255])
    (part,) = read_mesh(path)
    low, high = box_of(Mesh(part.path), Pose())
    assert [*low, *high] == pytest.approx([-0.5, -1.5, 4.0, 0.5, 1.5, 6.0])
    assert part.colour == (1.0, 0.0, 0.0, 1.0)
    mesh = trimesh.load_mesh(part.path)
    assert mesh.volume == pytest.approx(6.0)  # not mirrored


def test_a_texture_inside_glb_is_used(tmp_path: Path) -> None:
    path = gltf(tmp_path / "box.glb", picture=Image.new("RGB", (4, 4), (10, 200, 30)))
    (part,) = read_mesh(path)
    assert part.texture is not None
    assert Image.open(part.texture).getpixel((0, 0)) == (10, 200, 30)


def test_a_changed_buffer_is_read_again(tmp_path: Path) -> None:
    path = gltf(tmp_path / "box.gltf", colour=[255, 0, 0, 255])
    first = read_mesh(path)
    names = [buffer["uri"] for buffer in json.loads(path.read_text())["buffers"]]
    assert names
    file = next(file for name in names if len((file := tmp_path / name).read_bytes()) == 8 * 12)
    data = np.frombuffer(file.read_bytes(), np.float32).copy()
    file.write_bytes((2.0 * data).astype(np.float32).tobytes())
    assert read_mesh(path) != first


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.glb", b"glTF", "not a GLB file"),
        ("a.glb", b"", "not a GLB file"),
        ("a.gltf", b"{", "not a GLTF file"),
        ("a.gltf", b"[1]", "not a GLTF file"),
        ("a.gltf", b'{"asset": {"version": "2.0"}}', "it has 0 triangles, 1 to 300000 are allowed"),
        ("a.gltf", b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "none.bin", "byteLength": 9}]}', "a.gltf: "),
        ("a.obj", b"v 0 0 0\n", "it has 0 triangles, 1 to 300000 are allowed"),
    ],
)
def test_broken_meshes_are_named(name: str, content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SdfError, match=words):
        (check_wavefront if name.endswith(".obj") else read_mesh)(path)


def test_a_million_triangles_are_left_out_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    facet = np.zeros((), np.dtype([("normal", "<3f4"), ("corners", "<9f4"), ("attribute", "<u2")]))
    facet["corners"] = (0, 0, 0, 1, 0, 0, 0, 1, 0)
    many = np.repeat(facet, 1_000_000)
    (tmp_path / "many.stl").write_bytes(bytes(80) + np.uint32(len(many)).tobytes() + many.tobytes())
    (tmp_path / "many.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0" + "\nf 1 2 3" * 1_000_000)
    shapes = "".join(
        f"<visual name='{n}'><geometry><mesh><uri>{n}</uri></mesh></geometry></visual>"
        for n in ("many.stl", "many.obj")
    )
    file = tmp_path / "a.world"
    file.write_text(
        f"<sdf version='1.6'><world name='w'><model name='m'><static>1</static><link name='l'>{shapes}</link></model>"
        "</world></sdf>"
    )
    assert load_world_file(str(file)).models[0].links[0].visuals == ()
    said = "\n".join(caplog.messages)
    for name in ("many.stl", "many.obj"):
        assert f"{tmp_path / name}: it has 1000000 triangles, 1 to 300000 are allowed" in said
    with pytest.raises(SdfError, match=r"models 'm' mesh: .*it has 1000000 triangles"):
        load_world_file(str(yaml_world(tmp_path, "- {name: m, mesh: many.stl}")))


# models in YAML


def test_models_in_yaml(tmp_path: Path) -> None:
    gltf(tmp_path / "car.glb", colour=[255, 0, 0, 255])
    path = yaml_world(
        tmp_path,
        "- {name: wall, box: [4, 0.2, 2], pose: [5, 0, 1, 0, 0, 1.5], colour: [1, 0, 0]}\n"
        "- {name: drum, cylinder: [0.3, 0.9], mass: 12, pose: [0, 3, 0.45]}\n"
        "- {name: ball, sphere: 0.5, mass: 2, pose: [2, 3, 4]}\n"
        "- {name: crate, box: [1, 2, 3], mass: 12, pose: [6, 6, 1.5]}\n"
        "- {name: car, mesh: car.glb, scale: 0.5, mass: 3}",
    )
    wall, drum, ball, crate, car = load_world_file(str(path)).models
    assert (wall.static, drum.static, ball.static, crate.static, car.static) == (True, False, False, False, False)
    assert wall.pose == Pose((5.0, 0.0, 1.0), from_euler(0.0, 0.0, 1.5))
    assert wall.links[0].visuals[0].colour == (1.0, 0.0, 0.0, 1.0)
    moments = [model.links[0].inertial.inertia[:3] for model in (drum, ball, crate) if model.links[0].inertial]
    assert moments[0] == pytest.approx((1.08, 1.08, 0.54))
    assert moments[1] == pytest.approx((0.2, 0.2, 0.2))
    assert moments[2] == pytest.approx((13.0, 10.0, 5.0))
    assert car.links[0].inertial is not None
    assert car.links[0].inertial.pose.position == pytest.approx((0.0, 0.0, 2.5))
    assert car.links[0].visuals[0].colour == (1.0, 0.0, 0.0, 1.0)


def test_a_model_with_mass_falls_and_rests(tmp_path: Path) -> None:
    path = yaml_world(tmp_path, "- {name: ball, sphere: 0.5, mass: 2, pose: [4, 3, 2]}")
    world = World(load_world(str(path)), [load_vehicle("iris")], [StartPose(0.0, 0.0)], 0.004)
    for _ in range(100):
        world.step(np.zeros((1, 8)), np.zeros(1, np.int32))
    fall = 0.5 * 9.80665 * 0.4**2
    assert world.bodies.by_number[0].pose.position[2] == pytest.approx(2.0 - fall, abs=0.02)
    for _ in range(500):
        world.step(np.zeros((1, 8)), np.zeros(1, np.int32))
    assert world.bodies.by_number[0].pose.position[2] == pytest.approx(0.5, abs=0.01)
    assert not world.bodies.awake


@pytest.mark.parametrize(
    ("models", "words"),
    [
        ("- 3", r"models\[0\]: 3 is not allowed, a mapping with name, pose"),
        ("  x: 3", "models: {'x': 3} is not allowed, a list of at most 10000 mappings"),
        ("- {box: [1, 1, 1]}", r"models\[0\] name: None is not allowed, text that is not empty"),
        ("- {name: a}", "models 'a': has no shape, one of box, cylinder, sphere, mesh, heightmap is needed"),
        ("- {name: a, box: [1, 1, 1], sphere: 1}", "models 'a': has box and sphere, one of"),
        ("- {name: a, box: [1, -1, 1]}", r"models 'a' box: \[1, -1, 1\] is not allowed, three sides, m, 0.0001 to"),
        ("- {name: a, box: [1, 1]}", r"models 'a' box: \[1, 1\] is not allowed, three sides"),
        ("- {name: a, sphere: .nan}", "models 'a' sphere: nan is not allowed, a radius, m"),
        ("- {name: a, sphere: true}", "models 'a' sphere: True is not allowed, a radius"),
        ("- {name: a, sphere: 1, mass: 0}", "models 'a' mass: 0 is not allowed, kg, 0.001 to 1e"),
        ("- {name: a, sphere: 1, mass: heavy}", "models 'a' mass: 'heavy' is not allowed, kg"),
        (
            "- {name: a, sphere: 1, pose: [1, 2]}",
            r"models 'a' pose: \[1, 2\] is not allowed, x, y, z, m, and opt",
        ),
        ("- {name: a, sphere: 1, colour: [2, 0, 0]}", "models 'a' colour: .* is not allowed, red, green, blue"),
        ("- {name: a, sphere: 1, color: [1, 0, 0]}", r"models\[0\]: 'color' is not known; there are name, pose, mass"),
        ("- {name: a, sphere: 1, scale: 2}", "models 'a' scale: 2 is not allowed, it belongs to mesh"),
        ("- {name: a, sphere: 1}\n- {name: a, sphere: 1}", "two models are called 'a'"),
        ("- {name: ground_plane, sphere: 1}", "two models are called 'ground_plane'"),
        ("- {name: a, mesh: none.glb}", "models 'a' mesh: 'none.glb': .*none.glb does not exist"),
        ("- {name: a, mesh: 3}", "models 'a' mesh: 3 is not allowed, a file"),
        ("- {name: a, heightmap: none.png, size: [1, 1, 1]}", "models 'a' heightmap: 'none.png': .* does not exist"),
        ("- {name: a, heightmap: mine.yaml, size: [1, 1, 1]}", "models 'a' heightmap: .*mine.yaml: not a PNG or JPEG"),
        ("- {name: a, heightmap: mine.yaml}", "models 'a': size is missing, sides and height of the terrain"),
        ("- {name: a, heightmap: mine.yaml, size: [1, 1, 1], mass: 2}", "models 'a' mass: 2 is not allowed, a height"),
    ],
)
def test_wrong_models_are_named(models: str, words: str, tmp_path: Path) -> None:
    path = yaml_world(tmp_path, models)
    with pytest.raises(SdfError, match=f"^{path}: {words}" if not words.startswith("two") else words):
        load_world_file(str(path))


@pytest.mark.parametrize(("side", "words"), [(1, "it has 1 x 1 pixels, at least 2 x 2"), (0, "not a PNG or JPEG file")])
def test_a_picture_that_is_no_terrain(side: int, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"none") if not side else Image.new("L", (side, side)).save(path)
    with pytest.raises(SdfError, match=words):
        read_heightmap(path, (1.0, 1.0, 1.0))


def test_terrain_stands_even_if_it_is_not_static(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    ramp(tmp_path / "hill.png")
    shape = "<geometry><heightmap><uri>hill.png</uri><size>64 64 8</size></heightmap></geometry>"
    text = (
        "<sdf version='1.6'><world name='w'><model name='hill'><link name='l'>"
        f"<collision name='c'>{shape}</collision></link></model></world></sdf>"
    )
    assert read_world(text, tmp_path / "a.world").models[0].static
    assert "is not static, but its link 'l' is terrain" in "".join(caplog.messages)
