"""SDF worlds: read, written, rejected with the place of the error, warned of once."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_common.geodesy.projection import Datum
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_worlds.data_files import data_path
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.shapes.visual import Box, Collision, Cylinder, Mesh, Sphere, Visual
from xtdrone_worlds.worlds.actors import Actors
from xtdrone_worlds.worlds.sdf import (
    Light,
    SdfActor,
    SdfError,
    SdfLink,
    SdfModel,
    SdfWorld,
    Trajectory,
    Waypoint,
    load_world_file,
    read_model,
    read_world,
    world_file,
    write_world,
)
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of
from xtdrone_worlds.worlds.urdf import Inertial, UrdfError, parse_urdf, read_urdf

CONE = data_path("models/scenery/meshes/cone_0.obj")
GRASS = data_path("models/scenery/textures/grass_0.jpg")
FILE = Path("/nowhere/test.world")


def world(inside: str, attributes: str = 'version="1.6"') -> str:
    return f"<sdf {attributes}>\n<world name='w'>\n{inside}\n</world>\n</sdf>"


def model(inside: str, name: str = "m", static: str = "<static>1</static>") -> str:
    return f"<model name='{name}'>{static}<link name='l'>{inside}</link></model>"


def visual(inside: str) -> str:
    return model(f"<visual name='v'>{inside}</visual>")


# any world allowed by the types


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


def triples(low: float, high: float) -> st.SearchStrategy[tuple[float, float, float]]:
    return st.tuples(*[numbers(low, high)] * 3)


ANGLES = numbers(-4.0, 4.0)
QUATERNIONS = st.tuples(ANGLES, ANGLES, ANGLES).map(lambda angles: from_euler(*angles))
POSES = st.builds(Pose, triples(-1e4, 1e4), QUATERNIONS)
COLOURS = st.tuples(*[numbers(0.0, 1.0)] * 4)
GEOMETRIES = st.one_of(
    st.builds(Box, triples(0.0, 100.0)),
    st.builds(Cylinder, numbers(0.0, 10.0), numbers(0.0, 10.0)),
    st.builds(Sphere, numbers(0.0, 10.0)),
    st.builds(Mesh, st.just(CONE), triples(0.1, 10.0)),
)
VISUALS = st.builds(Visual, GEOMETRIES, POSES, COLOURS, st.sampled_from([None, GRASS]))
NAMES = st.text("abcXYZ019_<>&'\"ä", min_size=1, max_size=6)
INERTIALS = st.builds(
    Inertial,
    numbers(0.1, 1e3),
    POSES,
    st.tuples(*[numbers(1.0, 10.0)] * 3, *[numbers(-0.3, 0.3)] * 3),
)
LINKS = st.builds(
    SdfLink,
    NAMES,
    POSES,
    st.lists(VISUALS, max_size=2).map(tuple),
    st.lists(st.builds(Collision, GEOMETRIES, POSES), max_size=2).map(tuple),
    st.none() | INERTIALS,
    st.booleans(),
)
TRAJECTORIES = st.builds(
    Trajectory,
    st.lists(st.tuples(numbers(0.0, 1e3), POSES), min_size=1, max_size=3, unique_by=lambda pair: pair[0]).map(
        lambda pairs: tuple(Waypoint(time, pose) for time, pose in sorted(pairs, key=lambda pair: pair[0]))
    ),
    st.booleans(),
    numbers(0.0, 100.0),
    st.booleans(),
)
ACTORS = st.builds(SdfActor, NAMES, st.sampled_from(["", "anna"]), POSES, st.none() | TRAJECTORIES, numbers(0.0, 10.0))
LIGHTS = st.builds(
    Light,
    st.tuples(numbers(-1.0, 1.0), numbers(-1.0, 1.0), numbers(-1.0, -0.1)),
    *[triples(0.0, 1.0)] * 3,
    st.booleans(),
)


@st.composite
def models_called(draw: st.DrawFn, name: str) -> SdfModel:
    """Draw static models with up to two links, and movable ones with one link that collides."""
    links = tuple(draw(st.lists(LINKS, max_size=2)))
    movable = len(links) == 1 and bool(links[0].collisions) and draw(st.booleans())
    return SdfModel(name, draw(POSES), not movable, links)


@st.composite
def worlds(draw: st.DrawFn) -> SdfWorld:
    names = draw(st.lists(NAMES, max_size=4, unique=True))
    cut = draw(st.integers(0, len(names)))
    models = tuple(draw(models_called(name)) for name in names[:cut])
    return SdfWorld(
        draw(NAMES),
        Datum(draw(numbers(-90.0, 90.0)), draw(numbers(-180.0, 180.0)), draw(numbers(-1000.0, 9000.0))),
        draw(numbers(0.1, 30.0)),
        draw(triples(-30.0, 30.0)),
        (draw(numbers(-1.0, 1.0)), draw(numbers(-1.0, 1.0)), draw(numbers(0.1, 1.0))),
        draw(numbers(-180.0, 180.0)),
        draw(numbers(0.0, 10.0)),
        draw(numbers(0.0, 1.0)),
        draw(LIGHTS),
        models,
        tuple(
            SdfActor(name, *(getattr(draw(ACTORS), field) for field in ("skin", "pose", "trajectory", "speed")))
            for name in names[cut:]
        ),
    )


@settings(max_examples=25, deadline=None, derandomize=True)
@given(worlds())
def test_written_files_can_be_read(made: SdfWorld) -> None:
    assert read_world(write_world(made), FILE) == made


# contents of Gazebo's files

GAZEBO = world(
    """
    <include><uri>model://sun</uri></include>
    <include><uri>model://ground_plane</uri></include>
    <physics name="default_physics" default="0" type="ode"><max_step_size>0.004</max_step_size></physics>
    <gravity>0 0 -9.8</gravity>
    <magnetic_field>6e-06 2.3e-05 -4.2e-05</magnetic_field>
    <wind><linear_velocity>1 2 0</linear_velocity></wind>
    <spherical_coordinates>
      <surface_model>EARTH_WGS84</surface_model>
      <latitude_deg>47.3</latitude_deg><longitude_deg>8.5</longitude_deg><elevation>100</elevation>
      <heading_deg>0</heading_deg>
    </spherical_coordinates>
    <scene><ambient>0.4 0.4 0.4 1</ambient><background>0.7 0.7 0.7 1</background><sky/></scene>
    <light name="sun" type="directional"><direction>-0.5 0.1 -0.9</direction><diffuse>0.8 0.8 0.8 1</diffuse></light>
    <model name="box">
      <static>true</static>
      <pose>1 2 0.5 0 0 1.5707963267948966</pose>
      <link name="link">
        <collision name="c"><geometry><box><size>1 2 1</size></box></geometry></collision>
        <visual name="v">
          <geometry><box><size>1 2 1</size></box></geometry>
          <material><script><uri>file://media/materials/scripts/gazebo.material</uri><name>Gazebo/Red</name></script></material>
        </visual>
      </link>
    </model>
    <actor name="walker">
      <skin><filename>walk.dae</filename></skin>
      <animation name="walking"><filename>walk.dae</filename></animation>
      <script>
        <loop>true</loop><delay_start>1.5</delay_start><auto_start>true</auto_start>
        <trajectory id="0" type="walking">
          <waypoint><time>0</time><pose>0 2 0 0 0 -1.57</pose></waypoint>
          <waypoint><time>2</time><pose>0 -2 0 0 0 -1.57</pose></waypoint>
        </trajectory>
      </script>
    </actor>
    """
)


def test_a_world_of_gazebos(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    read = read_world(GAZEBO, FILE)
    assert read.gravity == 9.8
    assert read.datum == Datum(47.3, 8.5, 100.0)
    assert read.magnetic_field == (0.06, 0.23, -0.42)
    assert read.declination == pytest.approx(math.degrees(math.atan2(0.06, 0.23)))
    assert read.wind == (1.0, 2.0, 0.0)
    assert read.light.direction == (-0.5, 0.1, -0.9)
    (box,) = read.models
    assert box.links[0].visuals[0].colour == (1.0, 0.0, 0.0, 1.0)
    low, high = box_of(box.links[0].collisions[0].geometry, box.pose)
    assert [*low, *high] == pytest.approx([0.0, 1.5, 0.0, 2.0, 2.5, 1.0])
    (actor,) = read.actors
    assert actor.skin == ""
    assert actor.trajectory is not None
    assert (actor.trajectory.delay_start, [point.time for point in actor.trajectory.waypoints]) == (1.5, [0.0, 2.0])
    words = "\n".join(caplog.messages)
    assert "line 15: <sky> is not supported" in words
    assert "line 6: <physics>" in words
    assert "'walk.dae' is not supported, skins are names of people" in words


def test_unspecified_values_are_those_of_the_empty_world() -> None:
    silent, empty = read_world(world(""), FILE), load_world_file("empty")
    assert silent == SdfWorld(
        "w",
        empty.datum,
        *(empty.gravity, empty.wind, empty.magnetic_field, empty.declination),
        *(empty.friction, empty.restitution),
    )


def test_unsupported_elements_are_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    read_world(
        world("\n".join([visual("<geometry><cone/></geometry>").replace("'m'", f"'m{k}'") for k in (1, 2)])), FILE
    )
    assert [message for message in caplog.messages if "cone" in message] == [
        f"{FILE}: line 3: <cone> is not supported and ignored"
    ]


def test_lamps_that_the_renderer_does_not_have_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    sun = "<light name='s' type='directional'><diffuse>1 0 0 1</diffuse></light>"
    lamps = "".join(f"<light name='{kind}' type='{kind}'/>\n" for kind in ("point", "spot"))
    assert read_world(world(sun + lamps + sun), FILE).light.diffuse == (1.0, 0.0, 0.0)
    said = "\n".join(caplog.messages)
    for words in ("of type 'point' is not supported and ignored", "of type 'spot' is", "beside the first directional"):
        assert said.count(words) == 1


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("<direction>0 0 1</direction>", "<direction>: '0 0 1' is not allowed, the third number is under 0: downwards"),
        ("<direction>0 0</direction>", "<direction>: '0 0' is not allowed, 3 finite numbers"),
        ("<diffuse>2 0 0 1</diffuse>", "<diffuse>: '2 0 0 1' is not allowed, 3 or 4 finite numbers"),
        ("<cast_shadows>maybe</cast_shadows>", "<cast_shadows>: 'maybe' is not allowed"),
    ],
)
def test_invalid_lights_are_reported(content: str, words: str) -> None:
    with pytest.raises(SdfError) as caught:
        read_world(world(f"<light name='s' type='directional'>{content}</light>"), FILE)
    assert words in str(caught.value)
    assert str(caught.value).startswith(f"{FILE}: line ")


# input that Gazebo accepts without an error

BOX = "<collision name='c'><geometry><box><size>1 1 1</size></box></geometry></collision>"
JOINT = "<joint name='j' type='{}'><parent>l</parent><child>k</child></joint>"


@pytest.mark.parametrize(
    ("inside", "reason"),
    [
        (f"<link name='l'>{BOX}</link>", ""),
        (f"<link name='l'>{BOX}</link><link name='k'/>" + JOINT.format("fixed"), ""),
        ("<link name='l'/>", "nothing of 'l' collides"),
        ("", "nothing of it collides"),
        (f"<link name='l'><kinematic>1</kinematic>{BOX}</link>", "its link 'l' is kinematic"),
        (f"<link name='l'>{BOX}</link><link name='k'/>", "its links l, k are not connected"),
        (f"<link name='l'>{BOX}</link><link name='k'/>" + JOINT.format("screw"), "its joint 'j' of type 'screw'"),
        (f"<link name='l'>{BOX}</link>" + JOINT.format("fixed"), "its joint 'j' does not connect two of its links"),
        (
            f"<link name='l'><inertial><mass>-1</mass></inertial>{BOX}</link>",
            "its link 'l' has a mass and inertia that are not physically possible",
        ),
        ("<link name='l'>" + BOX * 17 + "</link>", "'l' has 17 collision shapes"),
    ],
)
def test_models_that_are_not_static_move_or_stand_with_a_warning(
    inside: str, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    (read,) = read_world(world(f"<model name='m'>{inside}</model>"), FILE).models
    assert read.static == bool(reason)
    said = [message for message in caplog.messages if "is not static, but" in message]
    assert (len(said), reason in "".join(said)) == (int(bool(reason)), True)


def test_mass_and_weight_are_read() -> None:
    inertia = "<inertia><ixx>2</ixx><iyy>3</iyy><izz>4</izz><ixy>0.5</ixy></inertia>"
    inertial = f"<inertial><pose>0 0 1 0 0 0</pose><mass>5</mass>{inertia}</inertial><gravity>0</gravity>"
    (read,) = read_world(world(model(inertial + BOX, static="")), FILE).models
    assert not read.static
    assert read.links[0].inertial == Inertial(5.0, Pose((0.0, 0.0, 1.0)), (2.0, 3.0, 4.0, 0.5, 0.0, 0.0))
    assert not read.links[0].gravity


def test_the_first_of_two_gravities_counts_and_equal_times_are_jumps(caplog: pytest.LogCaptureFixture) -> None:
    points = "".join(
        f"<waypoint><time>{t}</time><pose>{x} 0 0 0 0 0</pose></waypoint>" for t, x in ((0, 0), (2, 4), (2, 9), (3, 9))
    )
    script = f"<script><trajectory id='0' type='w'>{points}</trajectory></script>"
    read = read_world(
        world(f"<gravity>0 0 -9.8</gravity><gravity>0 0 -1</gravity><actor name='a'>{script}</actor>"), FILE
    )
    assert read.gravity == 9.8
    assert "<gravity> occurs a second time in <world> and is ignored" in "".join(caplog.messages)
    actors = Actors(read.actors, [1.0])
    assert [actors.states(t)[0].position[0] for t in (1_000_000, 1_999_999, 2_000_000, 2_500_000)] == pytest.approx(
        [2.0, 4.0, 9.0, 9.0], abs=1e-4
    )


def test_a_polyline_is_an_extruded_polygon_with_holes(caplog: pytest.LogCaptureFixture) -> None:
    def line(*corners: str) -> str:
        return "<polyline>" + "".join(f"<point>{c}</point>" for c in corners) + "<height>2.5</height></polyline>"

    outer, hole = line("0 0", "4 0", "4 3", "0 3"), line("1 1", "2 1", "2 2", "1 2")
    (read,) = read_world(world(visual(f"<geometry>{outer}{hole}</geometry>")), FILE).models
    geometry = read.links[0].visuals[0].geometry
    low, high = box_of(geometry, Pose())
    assert [*low, *high] == [0.0, 0.0, 0.0, 4.0, 3.0, 2.5]
    assert isinstance(geometry, Mesh)
    mesh = trimesh.load_mesh(geometry.path)
    assert mesh.volume == pytest.approx((12.0 - 1.0) * 2.5)  # all faces look outwards
    read_world(world(visual(f"<geometry>{line('0 0', '1 0', '2 0')}</geometry>")), FILE)
    assert "<polyline> is left out: the outlines enclose no area" in "".join(caplog.messages)


def test_meshes_in_collada_and_stl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    red, blue = (trimesh.creation.box((1.0, 2.0, 3.0)) for _ in range(2))
    blue.apply_translation((0.0, 0.0, 5.0))
    for mesh, colour in ((red, [255, 0, 0, 255]), (blue, [0, 0, 255, 255])):
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(baseColorFactor=colour)
        )
    data = trimesh.exchange.dae.export_collada([red, blue])
    (tmp_path / "two.dae").write_bytes(data.replace(b"<asset>", b"<asset><unit meter='0.1' name='dm'/>", 1))
    (tmp_path / "one.stl").write_bytes(trimesh.exchange.stl.export_stl(red))
    (tmp_path / "bad.dae").write_text("<COLLADA><!-- nothing")
    shape = "<{0} name='s'><geometry><mesh><uri>{1}</uri><scale>2 2 2</scale></mesh></geometry></{0}>"
    files = (
        ("visual", "two.dae"),
        ("collision", "one.stl"),
        ("visual", "bad.dae"),
        ("visual", "model://none/a.obj"),
        ("visual", "x.fbx"),
    )
    models = [model(shape.format(*file), name) for name, file in zip("abcde", files, strict=True)]
    (tmp_path / "a.world").write_text(world("\n".join(models)))
    (tmp_path / "x.fbx").touch()
    a, b, c, d, e = load_world_file(str(tmp_path / "a.world")).models
    assert [shape.colour for shape in a.links[0].visuals] == [(1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)]
    boxes = [box_of(shape.geometry, Pose()) for shape in (*a.links[0].visuals, *b.links[0].collisions)]
    expected = [((-0.1, -0.2, -0.3), (0.1, 0.2, 0.3)), ((-0.1, -0.2, 0.7), (0.1, 0.2, 1.3)), ((-1, -2, -3), (1, 2, 3))]
    for (low, high), (lowest, highest) in zip(boxes, expected, strict=True):
        assert low.tolist() == pytest.approx(lowest)
        assert high.tolist() == pytest.approx(highest)
    assert [one.links[0].visuals for one in (c, d, e)] == [(), (), ()]
    said = "\n".join(caplog.messages)
    for words in (
        "bad.dae: not a DAE file",
        "'model://none/a.obj' is not found: the shape is left out",
        "'x.fbx' is left",
    ):
        assert words in said
    assert len({shape.geometry for shape in a.links[0].visuals}) == 2
    assert load_world_file(str(tmp_path / "a.world")).models[0] == a


@pytest.mark.parametrize("uri", ["file:///etc/x.obj", "/etc/x.obj", "x.obj", "model://../x.obj", "package://a/../../x"])
def test_a_request_names_no_files_but_those_of_models(uri: str) -> None:
    text = f"<sdf version='1.6'>{visual(f'<geometry><mesh><uri>{uri}</uri></mesh></geometry>')}</sdf>"
    with pytest.raises(SdfError, match="is not allowed in a request, model://NAME"):
        read_model(text, "request")
    assert read_model(f"<sdf version='1.6'>{model(BOX)}</sdf>", "request").name == "m"


# errors


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<sdf version='1.6'>\n<world name='w'>\n</sdf>", "line 3: not an XML file: mismatched tag"),
        ("<robot/>", "line 1: <robot>: is not allowed as the outermost element, <sdf> is"),
        (world("", 'version="2.0"'), "line 1: <sdf>: version '2.0' is not allowed, 1.5 to 1.7"),
        ("<sdf version='1.6'/>", "line 1: <sdf>: has 0 <world>, one is needed"),
        (world("<gravity>0 0 9.8</gravity>"), "line 3: <gravity>: '0 0 9.8' is not allowed, 0 0 and a number under 0"),
        (world("<gravity>0 0</gravity>"), "line 3: <gravity>: '0 0' is not allowed, 3 finite numbers"),
        (world("<magnetic_field>0 0 nan</magnetic_field>"), "<magnetic_field>: '0 0 nan' is not allowed, 3 finite"),
        (world(model("", static="<static>yes</static>")), "<static>: 'yes' is not allowed, true or false"),
        (world(model("") + "\n" + model("")), "line 2: <world>: two models or actors are called 'm'"),
        (world("<model><static>1</static></model>"), '<model>: needs an attribute name="..."'),
        (world(visual("<geometry/>")), "<geometry>: is empty, needs one of box, cylinder, sphere, mesh"),
        (world(visual("<geometry><box><size>1 -2 3</size></box></geometry>")), "<size>: '1 -2 3' is not allowed, 3"),
        (world(visual("<geometry><sphere/></geometry>")), "<sphere>: needs a <radius>"),
        (
            world("<include><uri>model://none</uri></include>"),
            "<uri>: 'model://none' is in none of /nowhere, ",
        ),
        (world("<include><uri>a/b</uri></include>"), "<uri>: 'a/b': /nowhere/a/b does not exist"),
        (world("<include><uri>http://x/y</uri></include>"), "<uri>: 'http://x/y' is not allowed, model://, package://"),
        (world("<model name='m'><static>1</static><pose frame='x'>0 0 0 0 0 0</pose></model>"), "relative to 'x'"),
        (
            world("<actor name='a'><script><trajectory id='0' type='w'><waypoint><time>1</time><pose/></waypoint>\n"
                  "<waypoint><time>0.9</time><pose/></waypoint></trajectory></script></actor>"),
            "line 4: <time>: '0.9' is not allowed, at least the one before (1)",
        ),
        (world("<xtdrone:extends>mars</xtdrone:extends>"), "<xtdrone:extends>: worlds: 'mars' is not known; there are"),
        (
            world("<spherical_coordinates><latitude_deg>91</latitude_deg></spherical_coordinates>"),
            "<latitude_deg>: '91' is not allowed, 1 finite number, at least -90, at most 90",
        ),
    ],
)  # fmt: skip
def test_errors_are_reported(text: str, words: str) -> None:
    with pytest.raises(SdfError) as caught:
        read_world(text, FILE)
    assert str(caught.value).startswith(f"{FILE}: line ")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<!DOCTYPE x [\n<!ENTITY a 'aaaa'>\n<!ENTITY b '&a;&a;'>]>\n<sdf>&b;</sdf>", "line 2: <!ENTITY a> is not"),
        ("<!DOCTYPE x [<!ENTITY % a SYSTEM 'file:///etc/passwd'> %a;]>\n<sdf/>", "line 1: <!ENTITY a> is not allowed"),
        ("<a>" * 101, "line 1: more than 100 elements within each other"),
        ("<sdf>" + "<a/>" * 200_000, "line 1: more than 200000 elements"),
    ],
)
def test_expanding_files_are_rejected(text: str, words: str) -> None:
    with pytest.raises(SdfError, match=words):
        read_world(text, FILE)
    with pytest.raises(UrdfError, match=r"<!ENTITY is not allowed|more than 200000 elements|not XML"):
        parse_urdf(text, FILE)


def test_large_files_are_rejected_by_their_size(tmp_path: Path) -> None:
    names = ("a.world", "a.sdf", "a.yaml", "a.urdf", "a.obj")
    for name in names:
        with (tmp_path / name).open("wb") as file:
            file.truncate(1 << 30)
    include = f"<include><uri>{tmp_path / 'a.sdf'}</uri></include>"
    for read in (
        lambda: load_world_file(str(tmp_path / "a.world")),
        lambda: load_world_file(str(tmp_path / "a.yaml")),
        lambda: read_world(world(include), FILE),
        lambda: box_of(Mesh(tmp_path / "a.obj"), Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))),
        lambda: read_urdf(tmp_path / "a.urdf"),
    ):
        with pytest.raises(ValueError, match=r"it has 1024\.0 MB, at most \d+ MB are allowed"):
            read()


# files beside the world


def test_included_models_and_worlds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "mine" / "hut"
    folder.mkdir(parents=True)
    (folder / "model.config").write_text("<model><sdf version='1.6'>hut.sdf</sdf></model>")
    mesh = "<geometry><mesh><uri>hut.obj</uri></mesh></geometry>"
    (folder / "hut.sdf").write_text(f"<sdf version='1.6'>{visual(mesh)}</sdf>")
    (folder / "hut.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 2\nf 1 2 3\n")
    monkeypatch.setenv("XTDRONE_MODELS", f"/none:{tmp_path / 'mine'}")
    include = "<include><uri>model://hut</uri><name>hut_{}</name><pose>{} 0 0 0 0 0</pose></include>"
    base, windy = tmp_path / "base.world", tmp_path / "windy.world"
    base.write_text(world(include.format(1, 5) + "<gravity>0 0 -3.7</gravity>"))
    windy.write_text(
        world(
            "<xtdrone:extends>base.world</xtdrone:extends>"
            + include.format(2, 7)
            + "<wind><linear_velocity>4 0 0</linear_velocity></wind>"
        )
    )
    read = load_world_file(str(windy))
    assert (read.gravity, read.wind) == (3.7, (4.0, 0.0, 0.0))
    assert [(m.name, m.pose.position) for m in read.models] == [("hut_1", (5.0, 0.0, 0.0)), ("hut_2", (7.0, 0.0, 0.0))]
    geometry = read.models[1].links[0].visuals[0].geometry
    assert geometry == Mesh(folder / "hut.obj")
    assert read_world(write_world(read), FILE) == read
    base.write_text(world("<xtdrone:extends>windy.world</xtdrone:extends>"))
    with pytest.raises(SdfError, match=r"windy\.world: line 3: .*'base\.world' includes this file again"):
        load_world_file(str(windy))


def test_names_mean_files() -> None:
    assert world_file("empty") == data_path("config/worlds/empty.yaml")
    assert world_file("outdoor").name == "outdoor.world"
    assert load_world_file("outdoor").models
    with pytest.raises(ModelError, match="'mars' is not known; there are empty, outdoor"):
        world_file("mars")
    with pytest.raises(ModelError, match=r"/none/x\.world: No such file"):
        load_world_file("/none/x.world")
