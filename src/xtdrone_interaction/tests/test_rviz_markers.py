"""Markers of a swarm in rviz, and the views' configurations."""

import math

import numpy as np
import pytest
import yaml
from visualization_msgs.msg import Marker

from xtdrone_common.fleet import parse_fleet
from xtdrone_coordination.patterns import Patterns
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.rviz.markers import SwarmMarkers, ground_view
from xtdrone_interaction.rviz.view_configurations import (
    FOR_MARKERS,
    MARKERS_TOPIC,
    SHIPPED,
    make_view,
    marker_parameters,
    shipped_folder,
)

NAMES = ["iris_0", "iris_1", "iris_2"]
PLACES = [(0.0, 0.0, 5.0), (3.0, 0.0, 5.0), (0.0, 3.0, 5.5)]


def shown(markers, time=0.0):
    """Return the markers on rviz's screen, by namespace and number."""
    screen = {}
    for array in [markers.array(time)] if isinstance(markers, SwarmMarkers) else markers:
        for marker in array.markers:
            if marker.action == Marker.DELETEALL:
                screen.clear()
            elif marker.action == Marker.DELETE:
                screen.pop((marker.ns, marker.id), None)
            else:
                screen[marker.ns, marker.id] = marker
    return screen


def points(marker):
    return [(p.x, p.y, p.z) for p in marker.points]


@pytest.fixture
def markers():
    made = SwarmMarkers(NAMES)
    for name, place in zip(NAMES, PLACES, strict=True):
        made.on_position(name, 0.0, place)
    return made


def test_names_stand_above_their_vehicles(markers):
    screen = shown(markers)
    for number, (name, place) in enumerate(zip(NAMES, PLACES, strict=True)):
        label = screen["names", number]
        position = label.pose.position
        assert label.text == name
        assert (position.x, position.y) == place[:2]
        assert 0.0 < position.z - place[2] < 1.5


def test_lines_and_letters_grow_with_the_scale_and_spots_stand_at_the_vehicles():
    def seen(**options):
        made = SwarmMarkers(NAMES, **options)
        for time, place in enumerate(PLACES):
            made.on_position("iris_1", float(time), place)
        return shown(made, 2.0)

    near, afar = seen(), seen(scale=6.0, spot=2.0)
    assert afar["names", 1].scale.z == pytest.approx(6.0 * near["names", 1].scale.z)
    assert afar["trails", 1].scale.x == pytest.approx(6.0 * near["trails", 1].scale.x)
    assert ("spots", 1) not in near
    sphere = afar["spots", 1]
    assert (sphere.pose.position.x, sphere.pose.position.y, sphere.pose.position.z) == PLACES[2]
    assert sphere.scale.x == sphere.scale.y == sphere.scale.z == 2.0
    assert afar["names", 1].pose.position.z > PLACES[2][2] + 1.0


@pytest.mark.parametrize("options", [{"scale": 0.0}, {"scale": math.inf}, {"spot": -1.0}, {"spot": math.nan}])
def test_an_invalid_size_is_rejected(options):
    with pytest.raises(ValueError, match="not allowed"):
        SwarmMarkers(NAMES, **options)


def test_slots_stand_about_the_leader(markers):
    markers.on_pattern(np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 1.0]]))
    assert points(shown(markers)["slots", 0]) == [(3.0, 0.0, 5.0), (0.0, 3.0, 6.0)]
    markers.on_position("iris_0", 1.0, (10.0, 0.0, 5.0))
    assert points(shown(markers)["slots", 0]) == [(13.0, 0.0, 5.0), (10.0, 3.0, 6.0)]


def test_an_edge_points_from_sender_to_receiver(markers):
    adjacency = np.zeros((3, 3), int)
    adjacency[2, 1] = 1  # vehicle 2 listens to 1
    markers.on_topology(adjacency)
    assert points(shown(markers)["topology", 0]) == [PLACES[1], PLACES[2]]


def test_a_topology_for_another_swarm_is_rejected(markers):
    with pytest.raises(ValueError, match="16 values are not allowed, 3 x 3"):
        markers.on_topology(np.zeros(16, int))


def test_avoidance_is_an_arrow_that_goes_when_it_ends(markers):
    markers.on_avoidance("iris_1", (0.0, -1.0, 0.5))
    first = markers.array(0.0)
    assert points(shown([first])["avoidance", 1]) == [PLACES[1], (3.0, -1.0, 5.5)]
    markers.on_avoidance("iris_1", (0.0, 0.0, 0.0))
    assert ("avoidance", 1) not in shown([first, markers.array(0.1)])


def test_a_trail_has_the_requested_length_and_ends_at_the_vehicle():
    markers = SwarmMarkers(NAMES, trail=2.0)
    for k in range(100):
        markers.on_position("iris_0", 0.1 * k, (0.3 * k, 0.0, 5.0))
    trail = points(shown(markers, 9.9)["trails", 0])
    assert trail[-1] == pytest.approx((29.7, 0.0, 5.0))
    assert trail[0][0] == pytest.approx(0.3 * 79, abs=0.31)


def test_detections_appear_and_disappear(markers):
    things = [(5.0, 6.0, 0.0), (7.0, 6.0, 0.0)]
    arrays = []
    for time, seen in enumerate([things, things[:1], []]):
        markers.on_detections("iris_0", (0.0, 0.0, 5.0), seen)
        arrays.append(markers.array(float(time)))
        screen = shown(arrays)
        bodies = sorted(key for key in screen if key[0] == "detections")
        assert [screen[key].pose.position.x for key in bodies] == [foot[0] for foot in seen]
        assert (("sightlines", 0) in screen) == bool(seen)
    assert points(shown(arrays[:1])["sightlines", 0])[:2] == [(0.0, 0.0, 5.0), (5.0, 6.0, 0.0)]


def test_a_view_is_a_closed_line_just_above_the_ground(markers):
    corners = np.array([[0, 0, 0], [4, 0, 0], [5, 3, 0], [-1, 3, 0]], float)
    markers.on_view("iris_0", corners)
    line = np.array(points(shown(markers)["views", 0])).reshape(-1, 2, 3)
    assert (
        sorted(map(tuple, line[:, 0, :2])) == sorted(map(tuple, line[:, 1, :2])) == sorted(map(tuple, corners[:, :2]))
    )
    assert ((line[..., 2] > 0.0) & (line[..., 2] < 0.2)).all()


def test_a_find_remains_until_a_time_reset(markers):
    markers.on_find((5.0, 6.0), "found by iris_0")
    first = markers.array(0.0)
    assert shown([first])["finds", 1].text == "found by iris_0"
    markers.restart()
    assert shown([first, markers.array(0.0)]) == {}


def test_a_list_without_points_is_never_shown_and_no_marker_twice(markers):
    markers.on_detections("iris_0", (0.0, 0.0, 5.0), [(5.0, 6.0, 0.0)])
    markers.on_find((5.0, 6.0), "found by iris_0")
    for state in (SwarmMarkers(NAMES), markers):
        seen = set()
        for number, marker in enumerate(state.array(0.0).markers):
            assert marker.header.frame_id == "map"
            if marker.action == Marker.DELETEALL:
                assert number == 0  # rviz needs it first
                continue
            assert (marker.ns, marker.id) not in seen
            seen.add((marker.ns, marker.id))
            if marker.action == Marker.ADD and marker.type in (Marker.LINE_LIST, Marker.LINE_STRIP, Marker.SPHERE_LIST):
                assert marker.points
                assert len(marker.colors) in (0, len(marker.points))
            assert not marker.text or marker.type == Marker.TEXT_VIEW_FACING  # rviz logs a warning for any other type


@pytest.mark.parametrize("trail", [-1.0, math.nan, math.inf])
def test_a_trail_of_no_length_is_rejected(trail):
    with pytest.raises(ValueError, match="0 or more"):
        SwarmMarkers(NAMES, trail)


def test_no_vehicles_are_rejected():
    with pytest.raises(ValueError, match="no vehicles"):
        SwarmMarkers([])


def test_a_camera_that_looks_down_sees_a_rectangle_below():
    # optical frame: z ahead (down), x right (east), y down in the picture (south)
    corners = ground_view((10.0, 20.0, 8.0), (0.0, 1.0, 0.0, 0.0), (400.0, 400.0), (800, 400))
    assert corners == pytest.approx(np.array([[2, 24, 0], [18, 24, 0], [18, 16, 0], [2, 16, 0]], float))


def test_a_camera_that_sees_the_horizon_has_no_view():
    half = math.sqrt(0.5)
    assert len(ground_view((0.0, 0.0, 8.0), (half, -half, 0.0, 0.0), (400.0, 400.0), (800, 400))) == 0
    assert len(ground_view((0.0, 0.0, -1.0), (0.0, 1.0, 0.0, 0.0), (400.0, 400.0), (800, 400))) == 0


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_views_are_those_that_are_made(name):
    vehicles = [vehicle.name for vehicle in parse_fleet(SHIPPED[name])]
    text = (shipped_folder() / f"{name}.rviz").read_text(encoding="utf-8")
    assert text == make_view(name, vehicles), "python -m xtdrone_interaction.rviz.view_configurations writes them"
    displays = yaml.safe_load(text)["Visualization Manager"]["Displays"]
    assert [d["TF Prefix"] for d in displays if d["Class"] == "rviz/RobotModel"] == vehicles
    assert MARKERS_TOPIC in [d.get("Marker Topic") for d in displays]


def test_the_formation_s_camera_stands_still_for_a_flight_that_it_can_show_from_nearby():
    near, far = np.array([[-2.0, -2.0, 0.0], [3.0, 3.0, 4.0]]), np.array([[0.0, 0.0, 0.0], [300.0, 0.0, 9.0]])
    assert_seen(make_view("formation", NAMES, near), near)
    frames = [yaml.safe_load(make_view("formation", NAMES, flown)) for flown in (near, far, None)]
    targets = [frame["Visualization Manager"]["Views"]["Current"]["Target Frame"] for frame in frames]
    assert targets == ["map", "iris_0/base_link", "iris_0/base_link"]


@pytest.mark.parametrize("count", [1, 2, 3, 6, 9, 18, 30])
@pytest.mark.parametrize("pattern", ["origin", "cube", "pyramid", "triangle"])
def test_the_view_of_the_formation_has_all_slots_in_it(count, pattern):
    names = [f"iris_{number}" for number in range(count)]
    slots = np.vstack([np.zeros(3), Patterns(count).offsets(pattern) if count > 1 else np.empty((0, 3))])
    assert_seen(make_view("formation", names), slots)


@pytest.mark.parametrize(("east", "north"), [(0.0, 0.0), (115.0, 60.0), (-300.0, 900.0), (3000.0, 10.0)])
def test_the_view_of_a_search_has_the_whole_flight_in_it(east, north):
    flown = np.array([[0.0, 0.0, 0.0], [east, north, 16.0]])
    assert_seen(make_view("search", ["typhoon_h480_0"], flown), flown)
    scale = marker_parameters("search", flown)["scale"]
    assert 0.1 <= scale <= 50.0
    assert scale > 6.0 or max(abs(east), abs(north)) < 120.0
    assert marker_parameters("search") == FOR_MARKERS["search"]


def assert_seen(text, places):
    """Check that all points, (k, 3), m in the frame of a view, are in its picture."""
    view = yaml.safe_load(text)["Visualization Manager"]["Views"]["Current"]
    pitch, yaw = view["Pitch"], view["Yaw"]
    away = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    camera = np.array([view["Focal Point"][axis] for axis in "XYZ"]) + view["Distance"] * away
    right = np.cross([0.0, 0.0, 1.0], away)
    right /= np.linalg.norm(right)
    seen = places - camera
    depth = -seen @ away
    assert (depth > 1.0).all()
    high = math.tan(math.pi / 8.0)  # half of rviz's field of view
    assert (abs(seen @ right) / depth < high * 16.0 / 9.0).all()
    assert (abs(seen @ np.cross(away, right)) / depth < high).all()


def test_an_unknown_view_is_rejected():
    with pytest.raises(OptionError, match="'top' is unknown; there are: vehicle, formation, search"):
        make_view("top", NAMES)
