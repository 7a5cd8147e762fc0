"""QGroundControl's plan files: its files are read, written files are read back, unusable content is named."""

from __future__ import annotations

import copy
import itertools
import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.plans import qgc_plan
from xtdrone_autopilot.plans.qgc_plan import Plan, PlanError
from xtdrone_common.geodesy import projection

NAN = math.nan


def simple(command, params, frame=3, jump_id=1, **more):
    return {"type": "SimpleItem", "autoContinue": True, "command": command, "doJumpId": jump_id, "frame": frame,
            "params": params, **more}  # fmt: skip


DRAWN = {
    "fileType": "Plan",
    "geoFence": {
        "breachReturn": [47.3972, 8.5451, 20],
        "circles": [{"circle": {"center": [47.3976, 8.5446], "radius": 319.85}, "inclusion": True, "version": 1}],
        "polygons": [
            {"inclusion": False, "polygon": [[47.401, 8.541], [47.402, 8.541], [47.402, 8.543]], "version": 1}
        ],
        "version": 2,
    },
    "groundStation": "QGroundControl",
    "mission": {
        "cruiseSpeed": 15,
        "firmwareType": 12,
        "globalPlanAltitudeMode": 1,
        "hoverSpeed": 5,
        "items": [
            simple(22, [0, 0, 0, None, 47.39776, 8.54558, 20], Altitude=20, AltitudeMode=1, AMSLAltAboveTerrain=None),
            simple(530, [0, 2, None, None, None, None, None], frame=2, jump_id=2),
            {
                "TransectStyleComplexItem": {
                    "CameraCalc": {"CameraName": "Manual (no camera specs)", "version": 2},
                    "Items": [
                        simple(16, [0, 0, 0, None, 47.398, 8.545, 30], jump_id=3),
                        simple(206, [25, 0, 1, 0, 0, 0, 0], frame=2, jump_id=4),
                        simple(4501, [0, 0, 0, None, 47.399, 8.545, 30], jump_id=5),
                    ],
                    "version": 2,
                },
                "complexItemType": "survey",
                "type": "ComplexItem",
                "version": 5,
            },
            simple(16, [2, 0, 0, 90, 47.4, 8.546, 518.5], frame=0, jump_id=6, Altitude=518.5, AltitudeMode=2),
            simple(177, [3, 2, 0, 0, 0, 0, 0], frame=2, jump_id=7),
            simple(20, [0, 0, 0, 0, 0, 0, 0], frame=2, jump_id=8),
        ],
        "plannedHomePosition": [47.39774, 8.54559, 488.2],
        "vehicleType": 2,
        "version": 2,
    },
    "rallyPoints": {"points": [[47.3979, 8.5450, 25]], "version": 2},
    "version": 1,
}


def drawn(*path, value):
    """Return the text of the plan drawn in QGroundControl, with ``value`` at ``path``."""
    document = copy.deepcopy(DRAWN)
    target = document
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    return json.dumps(document)


def same(a, b):
    return repr(a) == repr(b)  # NaN is equal to itself here


def test_qgroundcontrols_files_are_read():
    found = qgc_plan.parse(json.dumps(DRAWN))
    assert [(item.command, item.frame) for item in found.mission] == [
        (22, 3), (530, 2), (16, 3), (206, 2), (4501, 3), (16, 0), (177, 2), (20, 2)
    ]  # fmt: skip
    assert same(found.mission[0], PlanItem(22, 3, (0.0, 0.0, 0.0, NAN), 47.39776, 8.54558, 20.0))
    assert same(found.mission[1], PlanItem(530, 2, (0.0, 2.0, NAN, NAN), 0.0, 0.0, 0.0))
    assert found.mission[6].params[:2] == (2.0, 2.0)  # doJumpId 3 is the survey's first item, of index 2
    assert [(item.command, item.params[0], item.z) for item in found.fence] == [
        (5002, 3.0, 0.0), (5002, 3.0, 0.0), (5002, 3.0, 0.0), (5003, 319.85, 0.0), (5000, 0.0, 20.0)
    ]  # fmt: skip
    assert same(found.rally, (PlanItem(5100, 3, (0.0,) * 4, 47.3979, 8.5450, 25.0, autocontinue=False),))
    assert found.home == (47.39774, 8.54559, 488.2)


def test_a_plan_of_a_mission_alone_is_read():
    text = json.dumps({key: DRAWN[key] for key in ("fileType", "version", "mission")})
    found = qgc_plan.parse(text)
    assert (found.fence, found.rally) == ((), ())


ITEM = ("mission", "items", 0)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("fileType",), "Mission", r'^p: fileType: "Mission" is not allowed, "Plan"$'),
        (("version",), 2, r"^p: version: 2 is not allowed, 1$"),
        (("mission",), [], r"^p: mission: \[\] is not allowed, an object$"),
        (("mission", "version"), True, r"^p: mission: version: true is not allowed, 2$"),
        (("mission", "firmwareType"), 4, r"^p: mission: firmwareType: 4 is not allowed, 12 or 0 or 3$"),
        (("mission", "plannedHomePosition"), [1], r"^p: mission: plannedHomePosition: \[1\] .* a list of 3$"),
        (("mission", "items"), {}, r"^p: mission: items: {} is not allowed, a list$"),
        ((*ITEM, "type"), "Item", r'^p: mission: items: item 1: type: "Item" is not allowed, "SimpleItem" or "Complex'),
        ((*ITEM, "frame"), 10, r"items: item 1: frame: 10 is not allowed, 0 or 2 or 3 or 5 or 6$"),
        (
            (*ITEM, "command"),
            183,
            r"items: item 1: command: 183 is not allowed, a MAV_CMD that PX4 accepts with a pos",
        ),
        ((*ITEM, "params"), [0] * 6, r"items: item 1: params: .* is not allowed, a list of 7$"),
        ((*ITEM, "params", 4), None, r"item 1: params: param 5: null is not allowed, a number from -90 to 90$"),
        ((*ITEM, "params", 5), 190, r"item 1: params: param 6: 190 is not allowed, a number from -180 to 180$"),
        ((*ITEM, "params", 0), "a", r'item 1: params: param 1: "a" is not allowed, a number'),
        ((*ITEM, "autoContinue"), 1, r"item 1: autoContinue: 1 is not allowed, true or false$"),
        ((*ITEM, "doJumpId"), 1.5, r"item 1: doJumpId: 1.5 is not allowed, a whole number"),
        (
            ("mission", "items", 2, "complexItemType"),
            "vtolLandingPattern",
            r'"vtolLanding.* is not allowed, "survey" or',
        ),
        (("mission", "items", 2, "complexItemType"), "StructureScan", r"item 3: polygon is missing$"),
        (("mission", "items", 2, "TransectStyleComplexItem", "Items", 1, "command"), 9, r"item 3: .*: item 2: command"),
        (("mission", "items", 4, "params", 0), 2.5, r"items: item 5: DO_JUMP to 2.5 is not allowed, .* \(1 to 8\)$"),
        (("mission", "items", 4, "params", 0), None, r"items: item 5: DO_JUMP to nan is not allowed"),
        (("geoFence", "version"), 3, r"geoFence: version: 3 is not allowed, 1 or 2$"),
        (("geoFence", "polygons", 0, "polygon"), [[1, 2]], r"polygon 1: polygon: .* at least 3 corners$"),
        (("geoFence", "circles", 0, "circle", "radius"), -1, r"circle 1: circle: radius: -1 is not allowed, a number"),
        (("rallyPoints", "points"), [[91, 0, 0]], r"rallyPoints: points: point 1: number 1: 91 is not allowed"),
    ],
)
def test_invalid_entries_are_reported(path, value, message):
    with pytest.raises(PlanError, match=message):
        qgc_plan.parse(drawn(*path, value=value), "p")


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, '{"fileType": NaN}', "null", "[]"])
def test_files_other_than_plans_are_reported(text):
    with pytest.raises(PlanError, match=r"^p: "):
        qgc_plan.parse(text, "p")


def test_a_missing_or_binary_file_is_reported(tmp_path):
    with pytest.raises(PlanError, match=r"none\.plan: cannot be read: No such file or directory$"):
        qgc_plan.read(tmp_path / "none.plan")
    (tmp_path / "b.plan").write_bytes(b"\xff\xfe")
    with pytest.raises(PlanError, match=r"b\.plan: cannot be read: "):
        qgc_plan.read(tmp_path / "b.plan")


# ---- what QGroundControl and Mission Planner write


def test_an_unknown_home_is_read():
    for home in (None, [], [None, None, None], [0, 0, None]):
        assert qgc_plan.parse(drawn("mission", "plannedHomePosition", value=home)).home == (0.0, 0.0, 0.0)
    assert qgc_plan.parse(drawn("mission", "plannedHomePosition", value=[47.1, 8.1, None])).home == (47.1, 8.1, 0.0)
    assert qgc_plan.parse(drawn("mission", "plannedHomePosition", value=[47.1, 8.1])).home == (47.1, 8.1, 0.0)


def test_unset_speeds_and_altitudes_are_read():
    assert qgc_plan.parse(drawn("mission", "cruiseSpeed", value=None)).cruise_speed == 15.0
    assert qgc_plan.parse(drawn("rallyPoints", "points", value=[[47.1, 8.1, None]])).rally[0].z == 0.0
    assert qgc_plan.parse(drawn("geoFence", "breachReturn", value=[47.1, 8.1, None])).fence[-1].z == 0.0
    assert qgc_plan.parse(drawn("mission", "items", 0, "command", value=22.0)).mission[0].command == plan.TAKEOFF


def test_fences_of_version_1_are_read():
    """QGroundControl 3.2's: a single inclusive polygon, and parameters."""
    corners = [[47.0, 8.0], [47.1, 8.0], [47.1, 8.1]]
    fence = {"parameters": [{"compId": 1, "name": "GF_ACTION", "value": 1}], "polygon": corners, "version": 1}
    found = qgc_plan.parse(drawn("geoFence", value=fence)).fence
    assert [(item.command, item.params[0], item.x, item.y) for item in found] == [(5001, 3.0, *c) for c in corners]
    assert qgc_plan.parse(drawn("geoFence", value={"polygon": [], "version": 1})).fence == ()


def test_items_of_version_1_are_read():
    old = {"autoContinue": True, "command": 16, "coordinate": [47.0, 8.0, 30], "doJumpId": 1, "frame": 3, "param1": 2,
           "param2": 0, "param3": 0, "param4": None, "type": "SimpleItem"}  # fmt: skip
    found = qgc_plan.parse(drawn(*ITEM, value=old)).mission[0]
    assert same(found, PlanItem(16, 3, (2.0, 0.0, 0.0, NAN), 47.0, 8.0, 30.0))


STRUCTURE = {
    "CameraCalc": {"AdjustedFootprintFrontal": 4, "AdjustedFootprintSide": 5, "DistanceToSurface": 10, "version": 2},
    "EntranceAltitude": 25,
    "GimbalPitch": -10,
    "Layers": 2,
    "ScanBottomAlt": 6,
    "StartFromTop": False,
    "StructureHeight": 20,
    "complexItemType": "StructureScan",
    "polygon": [],
    "type": "ComplexItem",
    "version": 3,
}


@pytest.mark.parametrize("order", [1, -1])
def test_a_structure_scan_is_expanded_as_in_qgroundcontrol(order):
    """StructureScanComplexItem::appendMissionItems: a ring of waypoints outside the outline in each layer."""
    corners = [projection.reproject(north, east, 47.0, 8.0) for north, east in ((0, 0), (0, 40), (30, 40), (30, 0))]
    scan = STRUCTURE | {"polygon": [list(corner) for corner in corners[::order]]}
    found = qgc_plan.parse(drawn("mission", "items", value=[scan])).mission
    layer = [16, 206, 16, 16, 16, 16, 206]
    assert [item.command for item in found] == [16, 196, *layer, *layer, 197, 16]
    assert [item.z for item in found if item.command == 16] == [25.0, *[8.0] * 5, *[12.0] * 5, 25.0]
    assert (found[1].x, found[1].z) == (-10.0, 90.0)
    assert [item.params[0] for item in found if item.command == 206] == [5.0, 0.0, 5.0, 0.0]
    ring = [projection.project(item.x, item.y, 47.0, 8.0) for item in found[2:8] if item.command == 16]
    assert {(round(north), round(east)) for north, east in ring} == {(-10, -10), (-10, 50), (40, 50), (40, -10)}
    assert ring[0] == pytest.approx(ring[4])
    east_of_north = sum(a[0] * b[1] - b[0] * a[1] for a, b in itertools.pairwise(ring))
    assert east_of_north > 0.0  # clockwise: the camera looks to the right


@pytest.mark.parametrize(
    ("corners", "layers", "allowed"),
    [
        ([[47.0, 8.0]] * 3, 2, "at least 3 different corners"),
        ([[47.0, 8.0], [47.0, 8.001]] + [[47.0, 8.0]] * 2, 2, "at least 3 different corners"),
        ([[47.0, 8.0], [47.0, 8.001], [47.001, 8.0]] * 100, 1000, "at most 65534 mission items"),
    ],
)
def test_a_structure_scan_without_an_area_or_of_too_many_items_is_refused(corners, layers, allowed):
    scan = STRUCTURE | {"polygon": corners, "Layers": layers}
    with pytest.raises(qgc_plan.PlanError, match=f"{allowed}$"):
        qgc_plan.parse(drawn("mission", "items", value=[scan]))


MISSION_PLANNER = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t-35.3632621\t149.1652374\t584.080000\t1
1\t0\t3\t22\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t-35.36318\t149.16524\t20.000000\t1
2\t0\t3\t178\t1.00000000\t4.00000000\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t0.000000\t1
3\t0\t0\t16\t2.00000000\t0.00000000\t0.00000000\t0.00000000\t-35.36218\t149.16524\t610.000000\t1
4\t0\t3\t177\t3.00000000\t2.00000000\t0.00000000\t0.00000000\t0.00000000\t0.00000000\t0.000000\t1
"""


def test_a_mission_of_mission_planner_is_read():
    found = qgc_plan.parse(MISSION_PLANNER)
    assert found.home == (-35.3632621, 149.1652374, 584.08)
    assert [(item.command, item.frame) for item in found.mission] == [(22, 3), (178, 2), (16, 0), (177, 2)]
    assert found.mission[3].params[:2] == (2.0, 2.0)  # the index without home's item


def test_a_mission_of_mavros_has_no_home_item():
    found = qgc_plan.parse("QGC WPL 120\r\n0\t1\t3\t22\t0.0\t0.0\t0.0\tnan\t47.0\t8.0\t10.0\t1\r\n")
    assert (found.home, len(found.mission)) == ((0.0, 0.0, 0.0), 1)
    assert math.isnan(found.mission[0].params[3])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("QGC WPL 130\n", "p, line 1: 'QGC WPL 130' is not allowed, QGC WPL 110 or QGC WPL 120"),
        ("QGC WPL 120\n0\t0\t3\t183\t0\t0\t0\t0\t1\t1\t1\t1\n", "p: item 1: command 183 in frame 3 is not allowed"),
        ("QGC WPL 120\n0\t0\t10\t16\t0\t0\t0\t0\t1\t1\t1\t1\n", "p: item 1: command 16 in frame 10 is not allowed"),
    ],
)
def test_invalid_mission_files_are_reported(text, message):
    with pytest.raises(PlanError, match=message):
        qgc_plan.parse(text, "p")


# ---- round trip

numbers = st.floats(-1e6, 1e6) | st.just(NAN)
places = st.tuples(st.floats(-90, 90), st.floats(-180, 180), st.floats(-1000, 9000))
params = st.tuples(numbers, numbers, numbers, numbers)
placed = st.builds(
    lambda command, frame, p, place, on: PlanItem(command, frame, p, *place, autocontinue=on),
    st.sampled_from((plan.WAYPOINT, plan.TAKEOFF, plan.LAND, plan.LOITER_TIME, plan.SET_ROI_LOCATION)),
    st.sampled_from((0, 3)),
    params,
    places,
    st.booleans(),
)
unplaced = st.builds(
    lambda command, p, z: PlanItem(command, 2, p, z, -z, z),
    st.sampled_from((plan.CHANGE_SPEED, plan.MOUNT_CONTROL, plan.RETURN, plan.DELAY)),
    params,
    st.floats(-1e6, 1e6),
)


@st.composite
def missions(draw):
    items = draw(st.lists(placed | unplaced, min_size=1, max_size=6))
    for at in draw(st.lists(st.integers(0, len(items) - 1), max_size=2)):
        target = draw(st.integers(0, len(items) - 1))
        items[at] = PlanItem(plan.JUMP, 2, (float(target), 3.0, 0.0, 0.0), 0.0, 0.0, 0.0)
    return tuple(items)


@st.composite
def fences(draw):
    items = []
    for command in draw(st.lists(st.sampled_from((plan.FENCE_INCLUSION, plan.FENCE_EXCLUSION)), max_size=2)):
        corners = draw(st.lists(places, min_size=3, max_size=6))
        items += [PlanItem(command, 0, (float(len(corners)), 0.0, 0.0, 0.0), x, y, 0.0, False) for x, y, _ in corners]
    for command in draw(
        st.lists(st.sampled_from((plan.FENCE_CIRCLE_INCLUSION, plan.FENCE_CIRCLE_EXCLUSION)), max_size=2)
    ):
        x, y, _ = draw(places)
        items.append(PlanItem(command, 0, (draw(st.floats(0, 1e4)), 0.0, 0.0, 0.0), x, y, 0.0, False))
    return tuple(items)


rallies = st.lists(
    st.builds(lambda p: PlanItem(plan.RALLY_POINT, 3, (0.0,) * 4, *p, autocontinue=False), places), max_size=3
)
plans = st.builds(lambda m, f, r, home: Plan(m, f, tuple(r), home, 12.0, 4.0), missions(), fences(), rallies, places)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(plans)
def test_written_values_are_read_back(content):
    assert same(qgc_plan.parse(qgc_plan.text_of(content)), content)


def test_a_file_holds_it_and_looks_like_qgroundcontrols(tmp_path):
    content = qgc_plan.parse(json.dumps(DRAWN))
    qgc_plan.write(tmp_path / "a.plan", content)
    assert same(qgc_plan.read(tmp_path / "a.plan"), content)
    document = json.loads((tmp_path / "a.plan").read_text())
    assert document["mission"]["items"][5] == DRAWN["mission"]["items"][3] | {"AMSLAltAboveTerrain": None}
    assert document["geoFence"] == DRAWN["geoFence"]
    assert document["mission"]["items"][6]["params"][0] == 3  # the doJumpId of the third item


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (Plan((PlanItem(16, 3, (math.inf, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0),)), "item 1: inf is not allowed"),
        (Plan((PlanItem(16, 1, (0.0,) * 4, 0.0, 0.0, 0.0),)), "item 1: frame 1 is not allowed"),
        (Plan((), home=(NAN, 0.0, 0.0)), "not finite is not allowed"),
        (Plan((), fence=(PlanItem(5001, 0, (3.0, 0, 0, 0), 1.0, 1.0, 0.0),) * 2), "fence item 1: a polygon of 3"),
        (Plan((), fence=(PlanItem(16, 0, (3.0, 0, 0, 0), 1.0, 1.0, 0.0),)), "fence item 1: command 16"),
    ],
)
def test_write_errors_are_reported(content, message):
    with pytest.raises(PlanError, match=message):
        qgc_plan.text_of(content)
