"""Pictures of scenes against the closed form, with both of pybullet's renderers."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.poses import Pose
from xtdrone_sim.cameras.rendering import Renderer, RendererError
from xtdrone_worlds.shapes.triangles import MeshError, read_obj, triangles_of
from xtdrone_worlds.shapes.visual import Box, Cylinder, Mesh, Sphere, Visual
from xtdrone_worlds.worlds.sdf import Light

SKY = Light(direction=(0.2, -0.3, -1.0), diffuse=(0.6, 0.6, 0.6), ambient=(0.4, 0.4, 0.4), background=(0.6, 0.8, 1.0))
SKY_RGB = [153, 204, 255]
RED = (1.0, 0.0, 0.0, 1.0)
QUAD = """# a square that looks along +z
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
f 1/1 2/2 3/3 -1/4
"""


@pytest.fixture(params=["tiny", "egl"])
def renderer(request: pytest.FixtureRequest) -> Iterator[Renderer]:
    try:
        made = Renderer(request.param)
    except RendererError as error:
        pytest.skip(str(error))
    with made:
        yield made


def _turn(axis: tuple[float, float, float], angle: float) -> tuple[float, float, float, float]:
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis) * math.sin(0.5 * angle)
    return (math.cos(0.5 * angle), x, y, z)


@pytest.mark.parametrize(
    "pinhole",
    [
        Pinhole.of_view(640, 360, 2.0),
        Pinhole(320, 240, 150.0, 170.0, 120.3, 160.7),
        Pinhole.of_view(1280, 960, 2.0),
    ],
    ids=["typhoon", "off-centre", "large"],
)
def test_spheres_are_seen_where_the_closed_form_has_them(renderer: Renderer, pinhole: Pinhole) -> None:
    camera = Pose((3.0, -2.0, 10.0), _turn((0.3, -0.5, 0.8), 2.0))
    w, x, y, z = camera.orientation
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    seen = np.array([(0.1, 0.2, 3.0), (-4.0, 1.5, 6.0), (3.5, -1.4, 5.0), (2.0, 2.5, 9.0), (-1.0, -2.0, 20.0)])
    radius = 0.5
    bodies = []
    for place in seen @ turn.T + camera.position:
        bodies.append(renderer.add([Visual(Sphere(radius), colour=RED)]))
        renderer.place(bodies[-1], Pose(tuple(place)))
    labels = renderer.draw(pinhole, camera, labels=True).labels
    columns, rows = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    rays = pinhole.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for body, centre in zip(bodies, seen, strict=True):
        hit = (centre @ centre - (rays @ centre) ** 2 < radius**2).reshape(labels.shape)
        drawn = labels == body
        assert hit.sum() > 30
        for axis in (columns, rows):
            assert axis[drawn].mean() == pytest.approx(axis[hit].mean(), abs=0.5)
        assert math.sqrt(drawn.sum() / math.pi) == pytest.approx(math.sqrt(hit.sum() / math.pi), abs=0.5)
    assert set(np.unique(labels)) == {-1, *bodies}


def test_shapes_cover_the_expected_pixels(renderer: Renderer) -> None:
    """Box and cylinder show from above, a mesh from its outer side only, in one body and in several colours."""
    camera = Pose((0.0, 0.0, 10.0), _turn((1.0, 0.0, 0.0), math.pi))  # looks down; y of the world is up in the picture
    pinhole = Pinhole(640, 480, 400.0, 400.0, 320.0, 240.0)
    green, blue = (0.0, 1.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)
    body = renderer.add(
        [
            Visual(Box((2.0, 1.0, 2.0)), Pose((2.0, 2.0, 0.0)), RED),
            Visual(Cylinder(1.0, 2.0), Pose((-2.0, 2.0, 0.0)), green),
            Visual(Box((1.0, 2.0, 1.0)), Pose((-2.0, -2.0, 0.5), _turn((0.0, 0.0, 1.0), math.pi / 2)), blue),
        ]
    )
    picture = renderer.draw(pinhole, camera, light=SKY, labels=True)
    scale = 400.0 / 9.0  # pixels a metre, at the upper faces, 9 m below the camera

    def of(channel: int) -> np.ndarray:
        others = [k for k in range(3) if k != channel]
        return (picture.rgb[:, :, channel] > 100) & (picture.rgb[:, :, others].max(axis=2) == 0)

    def area(mask: np.ndarray) -> float:
        return mask.sum() / scale**2

    assert picture.rgb[0, 0].tolist() == SKY_RGB
    # Upper faces, and the part of the sides that is visible in perspective.
    assert area(of(0)) == pytest.approx(2.0 * 1.0 + _sides(2.0, 1.0, 2.0, 2.0), rel=0.03)
    assert area(of(2)) == pytest.approx(2.0 * 1.0 + _sides(2.0, 1.0, 2.0, 2.0, 1.0), rel=0.03)
    assert picture.labels is not None
    assert ((picture.labels == body) == (picture.rgb != SKY_RGB).any(axis=2)).all()
    upper_disc = of(1)[240 - int(3.2 * scale) : 240 - int(0.9 * scale)]
    assert area(upper_disc) >= math.pi * 0.98


def _sides(width: float, depth: float, x: float, y: float, low: float = 0.0) -> float:
    """Return the area, scaled to the upper face's distance of 9 m, of the two sides of a box that a camera sees.

    The outline is the upper face's and the lower one's convex hull; the box of size ``width`` by ``depth`` is centred
    at (x, y), its lower face at 11 m (``low`` less).
    """
    shrink = 9.0 / (11.0 - low)
    upper = [(x + sx * width / 2, y + sy * depth / 2) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    lower = [(px * shrink, py * shrink) for px, py in upper]
    from shapely import MultiPoint

    return float(MultiPoint(upper + lower).convex_hull.area - width * depth)


def test_textures_are_seen_the_right_way_round(renderer: Renderer, tmp_path: Path) -> None:
    quarters = np.zeros((64, 64, 3), np.uint8)
    quarters[:32, :32], quarters[:32, 32:], quarters[32:, :32], quarters[32:, 32:] = (
        (255, 0, 0),
        (0, 255, 0),
        (0, 0, 255),
        (255, 255, 0),
    )
    Image.fromarray(quarters).save(tmp_path / "quarters.png")
    (tmp_path / "quad.obj").write_text(QUAD)
    camera = Pose((0.0, 0.0, 5.0), _turn((1.0, 0.0, 0.0), math.pi))
    pinhole = Pinhole(320, 240, 200.0, 200.0, 160.0, 120.0)
    white = (1.0, 1.0, 1.0, 1.0)
    shapes = [
        renderer.add([Visual(Mesh(tmp_path / "quad.obj"), Pose(), white, tmp_path / "quarters.png")]),
        renderer.add([Visual(Box((2.0, 2.0, 2.0)), Pose((0.0, 0.0, -1.0)), white, tmp_path / "quarters.png")]),
    ]
    for shown, hidden in (shapes, shapes[::-1]):
        renderer.hide(hidden)
        renderer.place(shown, Pose())
        rgb = renderer.draw(pinhole, camera, light=SKY).rgb
        wanted = [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]]
        found = [[rgb[y, x].astype(int) for x in (140, 180)] for y in (100, 140)]
        assert np.abs(np.array(found) - wanted).max() < 30
    renderer.hide(shapes[0])
    renderer.place(shapes[1], Pose((0.0, 0.0, 0.0), _turn((1.0, 0.0, 0.0), math.pi)))
    dimmed = renderer.add([Visual(Mesh(tmp_path / "quad.obj"), Pose((0.0, 0.0, 3.0)), (0.5, 0.5, 0.5, 1.0))])
    night = Light((0.0, 0.0, -1.0), (0.2, 0.1, 0.1), (0.3, 0.2, 0.1), (0.0, 0.0, 0.0))
    rgb = renderer.draw(pinhole, camera, light=night).rgb
    assert rgb[120, 160].tolist() == pytest.approx([64, 38, 26], abs=3)
    renderer.place(dimmed, Pose((0.0, 0.0, 0.0), _turn((1.0, 0.0, 0.0), math.pi)))  # its back side is not drawn
    renderer.hide(shapes[1])
    assert not renderer.draw(pinhole, camera, light=night).rgb.any()


def test_bodies_of_one_shape_and_those_after_them_keep_their_textures(renderer: Renderer, tmp_path: Path) -> None:
    (tmp_path / "quad.obj").write_text(QUAD)
    camera = Pose((0.0, 0.0, 5.0), _turn((1.0, 0.0, 0.0), math.pi))
    pinhole = Pinhole(320, 240, 200.0, 200.0, 160.0, 120.0)
    white = (1.0, 1.0, 1.0, 1.0)
    colours = [(250, 0, 0), (0, 250, 0), (250, 0, 0), (0, 0, 250), (0, 250, 0)]
    bodies = []
    for colour in colours:
        texture = tmp_path / f"{'_'.join(map(str, colour))}.png"
        Image.fromarray(np.full((16, 16, 3), colour, np.uint8)).save(texture)
        bodies.append(renderer.add([Visual(Mesh(tmp_path / "quad.obj"), Pose(), white, texture)]))
        renderer.hide(renderer.add([Visual(Box((1.0, 1.0, 1.0)))]))
    for body, colour in zip(bodies, colours, strict=True):
        for other in bodies:
            renderer.hide(other)
        renderer.place(body, Pose())
        assert renderer.draw(pinhole, camera, light=SKY).rgb[120, 160].astype(int) == pytest.approx(colour, abs=10)


def test_hidden_bodies_reappear(renderer: Renderer) -> None:
    pinhole, camera = Pinhole.of_view(64, 48, 1.0), Pose()
    body = renderer.add([Visual(Sphere(1.0), Pose((0.0, 0.0, 5.0)))])
    shown = renderer.draw(pinhole, camera, labels=True)
    renderer.hide(body)
    hidden = renderer.draw(pinhole, camera, labels=True)
    renderer.place(body, Pose())
    again = renderer.draw(pinhole, camera, labels=True)
    assert shown.labels is not None
    assert hidden.labels is not None
    assert (shown.labels == body).sum() > 100
    assert (hidden.labels == -1).all()
    assert (again.rgb == shown.rgb).all()
    assert renderer.draw(pinhole, camera).labels is None


def test_close_and_far_objects_are_resolved_together(renderer: Renderer) -> None:
    """The depth buffer resolves two sheets 4 cm apart at 60 m, behind an object at 0.3 m."""
    green, blue = (0.0, 1.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)
    sheets = [renderer.add([Visual(Box((80.0, 80.0, 0.001)), colour=colour)]) for colour in (green, blue)]
    renderer.place(sheets[0], Pose((0.0, 0.0, 60.0)))
    renderer.place(sheets[1], Pose((0.0, 0.0, 60.04)))
    leg = renderer.add([Visual(Box((0.02, 1.0, 0.02)), Pose((0.1, 0.0, 0.3)), RED)])
    renderer.add([Visual(Sphere(0.2), Pose((0.0, 0.0, -0.3)), RED)])
    pinhole = Pinhole.of_view(160, 120, 1.0)
    for shown in ({sheets[0], leg}, {sheets[0]}):
        picture = renderer.draw(pinhole, Pose(), 0.05, 500.0, labels=True)
        assert picture.labels is not None
        assert set(np.unique(picture.labels)) == shown
        assert (picture.rgb[picture.labels == sheets[0]][:, 2] == 0).all()
        assert (picture.rgb[picture.labels == leg][:, 1] == 0).all()
        renderer.hide(leg)


def test_the_ground_is_seen_to_the_horizon(renderer: Renderer) -> None:
    ground = renderer.add([Visual(Box((500.0, 500.0, 0.02)), Pose((0.0, 0.0, -0.01)), (0.3, 0.5, 0.2, 1.0))])
    camera = Pose((0.0, 0.0, 5.0), _turn((-1.0, 0.0, 0.0), math.pi / 2))  # looks north, level
    labels = renderer.draw(Pinhole.of_view(160, 120, 1.5), camera, far=1000.0, labels=True).labels
    assert labels is not None
    assert (labels[:58] == -1).all()
    assert (labels[63:] == ground).all()


def test_drawing_prints_nothing(renderer: Renderer, capfd: pytest.CaptureFixture[str]) -> None:
    renderer.add([Visual(Sphere(1.0))])
    for width in (64, 64, 64, 80):
        renderer.draw(Pinhole.of_view(width, 48, 1.0), Pose())
        ctypes.CDLL(None).fflush(None)
    assert capfd.readouterr() == ("", "")


def test_invalid_values_are_reported(tmp_path: Path) -> None:
    with Renderer("tiny") as renderer:
        pinhole = Pinhole.of_view(64, 48, 1.0)
        with pytest.raises(ValueError, match=r"near: 0.0 is not allowed, 0.001 to 1000 m"):
            renderer.draw(pinhole, Pose(), near=0.0)
        with pytest.raises(ValueError, match=r"far: 0.05 is not allowed"):
            renderer.draw(pinhole, Pose(), near=0.1, far=0.05)
        with pytest.raises(ValueError, match=r"orientation: .* a quaternion \(w, x, y, z\) of length 1"):
            renderer.draw(pinhole, Pose(orientation=(1.0, 1.0, 0.0, 0.0)))
        with pytest.raises(ValueError, match=r"texture: there is no file .*none.png"):
            renderer.add([Visual(Sphere(1.0), texture=tmp_path / "none.png")])
        with pytest.raises(ValueError, match=r"colour: 2 is not allowed, 0 to 1"):
            renderer.add([Visual(Sphere(1.0), colour=(2, 0, 0, 1))])
        with pytest.raises(KeyError):
            renderer.place(99, Pose())
        body = renderer.add([Visual(Sphere(1.0))])
        with pytest.raises(ValueError, match=r"position: .* finite"):
            renderer.place(body, Pose((math.nan, 0.0, 0.0)))
    with pytest.raises(ValueError, match=r"backend: 'cuda' is not allowed, auto, egl or tiny"):
        Renderer("cuda")


@pytest.mark.parametrize(
    ("text", "words"),
    [("v 0 0 0\n", "has no faces"), ("v 0 0 0\nf 1 2 3\n", "line 2: 'f 1 2 3'"), ("v 0 0 x\n", "line 1: 'v 0 0 x'")],
)
def test_unreadable_meshes_are_reported(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "broken.obj"
    file.write_text(text)
    with pytest.raises(MeshError, match=words):
        read_obj(file)
    with pytest.raises(MeshError, match="No such file"):
        read_obj(tmp_path / "none.obj")


@pytest.mark.parametrize("geometry", [Box((1.0, 2.0, 3.0)), Cylinder(0.5, 2.0), Sphere(1.5)])
def test_triangles_are_closed_and_look_outwards(geometry: Box | Cylinder | Sphere) -> None:
    triangles = triangles_of(geometry)
    a, b, c = triangles.points.transpose(1, 0, 2)
    volume = np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6.0
    exact = {
        Box: 6.0,
        Cylinder: math.pi * 0.5**2 * 2.0,
        Sphere: 4.0 / 3.0 * math.pi * 1.5**3,
    }[type(geometry)]
    assert volume == pytest.approx(exact, rel=0.04)
    faces = np.cross(b - a, c - a)
    assert (np.einsum("ni,nki->nk", faces, triangles.normals) > 0.0).all()
    edges = np.round(triangles.points[:, [[0, 1], [1, 2], [2, 0]]], 9).reshape(-1, 2, 3)
    there = {(tuple(p), tuple(q)) for p, q in (edges + 0.0).tolist()}
    assert {(q, p) for p, q in there} == there
