"""Markers of a world's models and people."""

import math
from dataclasses import replace

import pytest
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from xtdrone_common.poses import Pose
from xtdrone_interaction.rviz.films.record_view import flown_world
from xtdrone_interaction.rviz.world_markers import WorldMarkers
from xtdrone_worlds.shapes.visual import Box, Cylinder, Mesh, Sphere, Visual
from xtdrone_worlds.worlds.sdf import SdfActor, SdfLink, SdfModel, load_world_file

WALL = SdfModel("wall", Pose((5.0, 0.0, 0.0)), links=(SdfLink("link", visuals=(
    Visual(Box((1.0, 4.0, 2.0)), Pose((0.0, 0.0, 1.0)), (0.8, 0.1, 0.2, 1.0)),
    Visual(Cylinder(0.5, 3.0), Pose((2.0, 0.0, 1.5))),
)),))  # fmt: skip
BALL = SdfModel("ball", Pose((0.0, 0.0, 4.0)), False, (SdfLink("link", visuals=(Visual(Sphere(0.25)),)),))


@pytest.fixture
def world(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return replace(load_world_file("empty"), models=(WALL, BALL), actors=(SdfActor("actor_0"),))


def update(screen, markers):
    """Apply the changes to rviz's screen, by namespace and number, and return them."""
    changes = markers.changes(Header(frame_id="map"))
    for marker in changes:
        if marker.action == Marker.DELETE:
            del screen[marker.ns, marker.id]
        else:
            screen[marker.ns, marker.id] = marker
    return changes


def place(marker):
    p = marker.pose.position
    return p.x, p.y, p.z


def test_each_shape_is_shown_in_its_place_once(world):
    markers, screen = WorldMarkers(world), {}
    update(screen, markers)
    assert {key[0] for key in screen} == {"world", "people"}
    box, post, ball = (screen["world", number] for number in range(3))
    assert (box.type, place(box), (box.scale.x, box.scale.y, box.scale.z)) == (Marker.CUBE, (5, 0, 1), (1, 4, 2))
    assert (box.color.r, box.color.a) == (0.8, 1.0)
    assert (post.type, place(post), (post.scale.x, post.scale.z)) == (Marker.CYLINDER, (7, 0, 1.5), (1, 3))
    assert (ball.type, place(ball), ball.scale.x) == (Marker.SPHERE, (0, 0, 4), 0.5)
    assert all(marker.header.frame_id == "map" for marker in screen.values())
    assert update(screen, markers) == []
    markers.restart()
    assert len(update(screen, markers)) == len(screen) == 4


def test_what_has_moved_is_sent_again_alone(world):
    markers, screen = WorldMarkers(world), {}
    update(screen, markers)
    markers.on_poses({"ball": Pose((1.0, 2.0, 0.25)), "iris_0": Pose((9.0, 9.0, 9.0))})
    (ball,) = update(screen, markers)
    assert (ball.ns, ball.id, place(ball)) == ("world", 2, (1, 2, 0.25))


def test_added_and_deleted_models_appear_and_disappear(world):
    markers, screen = WorldMarkers(world), {}
    update(screen, markers)
    crate = replace(BALL, name="crate", pose=Pose((3.0, 3.0, 0.5)))
    markers.on_models([crate], ["wall", "actor_0"])
    update(screen, markers)
    assert sorted(place(marker) for marker in screen.values()) == [(0, 0, 4), (3, 3, 0.5)]
    markers.on_models([], [])
    update(screen, markers)
    assert len(screen) == 4
    assert sorted(place(marker) for marker in screen.values() if marker.ns == "world") == [
        (0, 0, 4), (5, 0, 1), (7, 0, 1.5)
    ]  # fmt: skip


def test_a_person_walks_and_stands(world):
    markers, screen = WorldMarkers(world), {}
    update(screen, markers)
    standing = screen["people", 0].mesh_resource
    assert standing.startswith("file:///")
    postures = []
    for step in range(1, 11):
        markers.on_poses({"actor_0": Pose((0.1 * step, 0.0, 0.0))})
        update(screen, markers)
        postures.append(screen["people", 0].mesh_resource)
    assert standing not in postures
    assert len(set(postures)) > 5
    markers.on_poses({"actor_0": Pose((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))})
    update(screen, markers)
    assert screen["people", 0].mesh_resource == standing


def test_a_textured_mesh_has_its_picture_and_colour_beside_it(world, tmp_path):
    from PIL import Image

    mesh, texture = tmp_path / "sheet.obj", tmp_path / "grey.png"
    mesh.write_text("mtllib other.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl other\nf 1/1 2/1 3/1\n")
    Image.new("RGB", (2, 2), (50, 50, 50)).save(texture)
    sheet = Visual(Mesh(mesh, (2.0, 2.0, 1.0)), colour=(0.5, 1.0, 0.25, 1.0), texture=texture)
    model = SdfModel("sheet", links=(SdfLink("link", visuals=(sheet,)),))
    (marker,) = WorldMarkers(replace(world, models=(model,), actors=())).changes(Header())
    assert marker.mesh_use_embedded_materials
    assert marker.scale.x == 2.0
    copy = type(mesh)(marker.mesh_resource.removeprefix("file://"))
    text = copy.read_text()
    assert "other" not in text
    assert text.startswith("mtllib mesh.mtl\nusemtl look\n")
    assert "Kd 0.500 1.000 0.250" in (copy.parent / "mesh.mtl").read_text()
    with Image.open(copy.parent / "look.png") as picture:
        assert picture.getpixel((0, 0))[0] > 50


def test_the_folder_of_a_bag_names_its_world(tmp_path):
    bag = tmp_path / "flight.bag"
    assert flown_world(bag) == ""
    for text, world in (("{", ""), ('{"settings": []}', ""), ('{"settings": {"world": "outdoor"}}', "outdoor")):
        (tmp_path / "report.json").write_text(text)
        assert flown_world(bag) == world
    (tmp_path / "search.world").write_text("")
    assert flown_world(bag) == str(tmp_path / "search.world")


def test_a_jump_is_no_walk(world):
    markers, screen = WorldMarkers(world), {}
    update(screen, markers)
    standing = screen["people", 0].mesh_resource
    markers.on_poses({"actor_0": Pose((30.0, math.pi, 0.0))})
    update(screen, markers)
    assert screen["people", 0].mesh_resource == standing
    assert place(screen["people", 0])[0] == 30.0
