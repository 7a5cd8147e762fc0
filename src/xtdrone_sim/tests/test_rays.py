"""Rays against closed form: solids, triangles, the ground, vehicles and people, each ray at its own time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose, rotate
from xtdrone_common.rotation import from_euler
from xtdrone_sim.rays.ray_bundles import MOST, ROWS, gather
from xtdrone_sim.rays.scene import ActorInScene, RayScene, SceneAt, SceneError, cast
from xtdrone_sim.rays.surfaces import of_triangles, surfaces_of
from xtdrone_sim.rays.tree import build
from xtdrone_worlds.shapes.triangles import triangles_of
from xtdrone_worlds.shapes.visual import Box, Collision, Cylinder, Sphere, Visual
from xtdrone_worlds.worlds.sdf import SdfActor, SdfLink, SdfModel, load_world_file

TOLERANCE = 1e-9  # m


def model(name: str, geometry, pose: Pose, collides: bool = False) -> SdfModel:
    link = (
        SdfLink("link", collisions=(Collision(geometry),)) if collides else SdfLink("link", visuals=(Visual(geometry),))
    )
    return SdfModel(name, pose, links=(link,))


def around(n: int = 400, seed: int = 1) -> np.ndarray:
    directions = np.random.default_rng(seed).standard_normal((n, 3))
    return directions / np.linalg.norm(directions, axis=1)[:, None]


def from_point(rays: RayScene, point, directions, most: float = 100.0, **others):
    return rays.cast(np.tile(np.array(point, float), (len(directions), 1)), directions, most, **others)


def test_a_room_seen_from_inside_has_its_walls_where_they_are():
    size = np.array([8.0, 6.0, 5.0])
    scene = RayScene([model("room", Box(tuple(size)), Pose((0.0, 0.0, 10.0)))])
    eye, directions = np.array([1.0, -0.5, 10.7]), around()
    with np.errstate(divide="ignore"):
        walls = (0.5 * size * np.sign(directions) - (eye - [0.0, 0.0, 10.0])) / directions
    hits = from_point(scene, eye, directions)
    np.testing.assert_allclose(hits.ranges, walls.min(axis=1), atol=TOLERANCE)
    assert set(hits.owners) == {scene.number("room")}
    axis = walls.argmin(axis=1)
    np.testing.assert_allclose(hits.cosines, np.abs(directions[np.arange(len(axis)), axis]), atol=TOLERANCE)


@pytest.mark.parametrize("distance", [1.0, 30.0, 1000.0])
def test_a_turned_wall_is_met_where_its_plane_is(distance):
    yaw = 0.4
    normal = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    place = distance * normal
    wall = Pose((*place[:2], 50.0), from_euler(0.0, 0.0, yaw))
    scene = RayScene([model("wall", Box((0.2, 1000.0, 200.0)), wall, collides=True)])
    directions = around(2000)
    directions = directions[directions @ normal > 0.3]
    hits = from_point(scene, (0.0, 0.0, 20.0), directions, 1e4)
    expected = (distance - 0.1) / (directions @ normal)
    up = 20.0 + expected * directions[:, 2]
    met = (up > 0.0) & (up < 149.0) & (np.abs(expected * (directions @ [-normal[1], normal[0], 0.0])) < 499.0)
    assert met.sum() > 20
    np.testing.assert_allclose(hits.ranges[met], expected[met], rtol=1e-12)


def test_a_sphere_and_the_ground():
    scene = RayScene([model("ball", Sphere(2.0), Pose((0.0, 0.0, 3.0)))])
    offsets = np.linspace(-1.99, 1.99, 101)
    origins = np.stack([np.full(101, -10.0), offsets, np.full(101, 3.0)], axis=1)
    hits = scene.cast(origins, np.tile([5.0, 0.0, 0.0], (101, 1)), 50.0)
    np.testing.assert_allclose(hits.ranges, 10.0 - np.sqrt(4.0 - offsets**2), atol=TOLERANCE)
    np.testing.assert_allclose(hits.cosines, np.sqrt(4.0 - offsets**2) / 2.0, atol=1e-6)
    down = from_point(scene, (10.0, 0.0, 7.0), np.array([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(down.ranges, [7.0, 7.0 * math.sqrt(2.0), np.inf])
    assert down.owners.tolist() == [0, 0, -1]


@pytest.mark.parametrize("pose", [Pose((3.0, 0.0, 1.0)), Pose((3.0, 1.0, 2.0), from_euler(0.4, -0.3, 2.0))])
def test_a_cylinder_is_met_at_its_side_and_its_ends(pose):
    scene = RayScene([model("pole", Cylinder(0.5, 2.0), pose)])
    aims = np.random.default_rng(2).uniform(-0.9, 0.9, (300, 3)) * [0.35, 0.35, 1.0]
    eye = np.array([0.5, 0.5, 6.0])
    directions = np.array([np.array(pose.position) + rotate(pose.orientation, tuple(aim)) for aim in aims]) - eye
    hits = from_point(scene, eye, directions)
    unit = directions / np.linalg.norm(directions, axis=1)[:, None]
    back = (pose.orientation[0], *(-part for part in pose.orientation[1:]))
    local = np.array([rotate(back, tuple(p)) for p in eye + hits.ranges[:, None] * unit - pose.position])
    radius, height = np.hypot(local[:, 0], local[:, 1]), np.abs(local[:, 2])
    on_side = np.abs(radius - 0.5) < TOLERANCE
    on_end = np.abs(height - 1.0) < TOLERANCE
    assert np.all((on_side & (height < 1.0 + TOLERANCE)) | (on_end & (radius < 0.5 + TOLERANCE)))
    assert on_side.sum() > 20
    assert on_end.sum() > 10


def test_triangles_are_those_of_a_search_over_all_of_them():
    rng = np.random.default_rng(3)
    corners = rng.uniform(-5.0, 5.0, (500, 1, 3)) + rng.normal(0.0, 0.5, (500, 3, 3)) + [0.0, 0.0, 20.0]
    tree = build(of_triangles(corners, 7))
    scene = RayScene([])
    eye, directions = np.array([0.0, 0.0, 20.0]), around(1000)
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    system = np.stack(np.broadcast_arrays(-directions[:, None, :], b[None], c[None]), axis=-1)
    t, u, v = np.moveaxis(
        np.linalg.solve(system, np.broadcast_to((eye - a)[None, :, :, None], (*system.shape[:2], 3, 1))), 2, 0
    )[..., 0]
    met = (t > 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
    expected = np.where(met, t, np.inf).min(axis=1)
    layout = scene.layout._replace(trees=tree)
    places = scene.places(SceneAt({}, {}))
    places["root"][0] = 0
    n = len(directions)
    hits = cast(layout, places[None], np.zeros(n, int), np.zeros(n), np.tile(eye, (n, 1)), directions, 100.0)
    assert np.isfinite(expected).sum() > 300
    ground = np.where(directions[:, 2] < 0.0, -20.0 / directions[:, 2], np.inf)
    expected = np.minimum(expected, np.where(ground <= 100.0, ground, np.inf))
    np.testing.assert_allclose(hits.ranges, expected, rtol=1e-9)


def test_rays_do_not_pass_between_the_triangles_of_a_closed_surface():
    triangles = triangles_of(Sphere(1.0)).points + np.array([0.0, 0.0, 5.0])
    corners = triangles.reshape(-1, 3)
    tree = build(of_triangles(triangles, 1))
    edges = np.concatenate([corners, triangles.mean(axis=1), 0.5 * (triangles[:, 0] + triangles[:, 1])])
    eye = np.array([0.1, 0.2, 5.05])
    scene = RayScene([])
    places = scene.places(SceneAt({}, {}))
    places["root"][0] = 0
    n = len(edges)
    hits = cast(
        scene.layout._replace(trees=tree),
        places[None],
        np.zeros(n, int),
        np.zeros(n),
        np.tile(eye, (n, 1)),
        edges - eye,
        100.0,
    )
    np.testing.assert_allclose(hits.ranges, np.linalg.norm(edges - eye, axis=1), atol=1e-6)


def test_limits_and_rays_that_are_none():
    scene = RayScene([model("wall", Box((1.0, 9.0, 9.0)), Pose((10.0, 0.0, 1.0)))])
    directions = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]])
    hits = from_point(scene, (0.0, 0.0, 1.0), directions, 9.6)
    np.testing.assert_array_equal(hits.ranges, [9.5, np.nan, np.nan, np.nan])
    assert hits.owners.tolist() == [scene.number("wall"), -1, -1, -1]
    assert from_point(scene, (0.0, 0.0, 1.0), directions[:1], 9.4).ranges[0] == np.inf
    assert math.isnan(from_point(scene, (np.nan, 0.0, 1.0), directions[:1], 9.6).ranges[0])


def test_vehicles_and_people_are_met_where_they_are():
    world = load_world_file("empty")
    fleet = parse_fleet("iris:2")
    scene = RayScene(world.models, fleet, [SdfActor("ann"), SdfActor("bob")])
    there = SceneAt(
        {"iris_0::base_link": Pose((0.0, 0.0, 1.0)), "iris_1::base_link": Pose((5.0, 0.0, 1.0))},
        {"ann": ActorInScene(Pose((0.0, 5.0, 0.0)), 0.3)},
    )
    level = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    hits = from_point(scene, (0.0, 0.0, 1.0), level, scene=there, skip=scene.number("iris_0"))
    assert [scene.owners[k] if k >= 0 else None for k in hits.owners] == ["iris_1", "ann", None]
    assert hits.ranges[0] == pytest.approx(5.0 - 0.13, abs=1e-9)  # the iris's body is 0.26 m long
    assert 4.5 < hits.ranges[1] < 5.0
    own = from_point(scene, (0.0, 0.0, 1.0), level, scene=there)
    assert own.owners.tolist() == [scene.number("iris_0")] * 3
    above = from_point(scene, (0.0, 5.0, 10.0), np.array([[0.0, 0.0, -1.0]]), scene=there)
    assert 1.4 < 10.0 - above.ranges[0] < 2.1


def test_models_that_move_come_and_go():
    scene = RayScene([model("crate", Box((1.0, 1.0, 1.0)), Pose((5.0, 0.0, 0.5)))])
    ahead = np.array([[1.0, 0.0, 0.0]])

    def seen(at: SceneAt | None = None) -> float:
        return float(from_point(scene, (0.0, 0.0, 0.5), ahead, scene=at).ranges[0])

    assert seen() == pytest.approx(4.5)
    pushed = SceneAt({"crate::link": Pose((7.0, 0.0, 0.5))}, {})
    assert seen(pushed) == pytest.approx(6.5)
    assert seen() == pytest.approx(4.5)  # after a restart the scene no longer contains it
    scene.change([model("ball", Sphere(0.5), Pose((3.0, 0.0, 0.5)))], ["crate"])
    assert seen(SceneAt({"ball::link": Pose((3.0, 0.0, 0.5))}, {})) == pytest.approx(2.5)
    assert seen() == math.inf
    scene.change([], [])
    assert seen() == pytest.approx(4.5)


def test_each_ray_meets_what_is_there_at_its_time():
    scene = RayScene([], parse_fleet("iris:1"))
    ends = [
        SceneAt({"iris_0::base_link": Pose((x, 0.0, 5.0), from_euler(0.0, 0.0, turn))}, {})
        for x, turn in ((10.0, 0.0), (20.0, 0.0))
    ]
    places = np.stack([scene.places(at) for at in ends])
    shares = np.linspace(0.0, 1.0, 11)
    n = len(shares)
    hits = cast(
        scene.layout,
        places,
        np.zeros(n, int),
        shares,
        np.tile([0.0, 0.0, 5.0], (n, 1)),
        np.tile([1.0, 0.0, 0.0], (n, 1)),
        50.0,
    )
    np.testing.assert_allclose(hits.ranges, 10.0 + 10.0 * shares - 0.13, atol=TOLERANCE)


def test_too_many_triangles_are_refused(monkeypatch):
    monkeypatch.setattr("xtdrone_sim.rays.scene.MOST_TRIANGLES", 1)
    models = [model("a", Box((1.0, 1.0, 1.0)), Pose()), model("b", Box((1.0, 1.0, 1.0)), Pose())]
    with pytest.raises(SceneError, match="2 triangles are too many for rays, at most 1 are allowed; model 'a'"):
        RayScene(models)


def test_a_tree_of_equal_surfaces_is_built_and_searched():
    surfaces = surfaces_of([(Box((1.0, 1.0, 1.0)), Pose((5.0, 0.0, 1.0)))] * 3000, 1)
    tree = build(surfaces)
    assert len(tree.surfaces) == 3000
    scene = RayScene([])
    places = scene.places(SceneAt({}, {}))
    places["root"][0] = 0
    hits = cast(
        scene.layout._replace(trees=tree),
        places[None],
        np.zeros(1, int),
        np.zeros(1),
        np.array([[0.0, 0.0, 1.0]]),
        np.array([[1.0, 0.0, 0.0]]),
        9.0,
    )
    assert hits.ranges[0] == 4.5


def fans(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions (32 count, 3) of columns of a lidar, one in four with an axis-aligned ray."""
    eyes = np.repeat(rng.uniform([-8.0, -8.0, 0.5], [8.0, 8.0, 4.0], (count, 3)), 32, axis=0)
    azimuth, elevation = np.repeat(rng.uniform(-4.0, 4.0, count), 32), np.tile(np.linspace(-0.6, 0.6, 32), count)
    level = np.cos(elevation)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    directions[5::128] = np.eye(3)[rng.integers(0, 3, len(directions[5::128]))]
    return eyes, directions * rng.uniform(0.5, 2.0, (len(eyes), 1))


def test_neighbouring_rays_meet_together_what_each_meets_alone():
    rng = np.random.default_rng(4)
    trees = [
        model(f"tree_{k}", Cylinder(0.3, 6.0), Pose((x, y, 3.0), from_euler(*rng.normal(0.0, 0.1, 2), 0.0)))
        for k, (x, y) in enumerate(rng.uniform(-9.0, 9.0, (60, 2)))
    ]
    others = [
        model(f"box_{k}", shape, Pose((*rng.uniform(-9.0, 9.0, 2), 1.0), from_euler(*rng.normal(0.0, 1.0, 3))))
        for k, shape in enumerate([Box((2.0, 0.5, 1.0)), Sphere(0.7)] * 10)
    ]
    scene = RayScene([*trees, *others], parse_fleet("iris:2"), [SdfActor("ann"), SdfActor("bob")])
    people = {name: ActorInScene(Pose((x, -2.0, 0.0)), 0.3) for name, x in (("ann", 1.0), ("bob", 3.0))}

    def places_at(time: float) -> np.ndarray:
        poses = [Pose((4.0 * k + time, 1.0, 2.0), from_euler(0.1, 0.2 * time, 1.0)) for k in range(2)]
        return scene.places(SceneAt({f"iris_{k}::base_link": pose for k, pose in enumerate(poses)}, people))

    places = np.stack([places_at(0.0), places_at(1.0)])
    origins, directions = fans(rng, 250)
    n = len(origins)
    segments, shares = np.zeros(n, int), np.repeat(rng.uniform(0.0, 1.0, n // 32), 32)

    def hits(rays: slice):
        return cast(scene.layout, places, segments[rays], shares[rays], origins[rays], directions[rays], 15.0, 0)

    together, alone = hits(slice(None)), [hits(slice(k, k + 1)) for k in range(n)]
    bundle = np.empty((ROWS, MOST))
    assert gather(32, segments, shares, origins, directions, bundle) > 8  # they are cast together
    assert len(set(together.owners)) > 40
    for part, parts in zip(together, zip(*alone, strict=True), strict=True):
        np.testing.assert_array_equal(part, np.concatenate(parts))
