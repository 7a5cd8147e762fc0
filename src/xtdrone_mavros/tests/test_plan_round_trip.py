"""Download then upload: a mission flies again as it has flown, through every door, but for PX4's own conversions."""

from __future__ import annotations

import math
import struct
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.microservices import mission_items
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.plans import qgc_plan, waypoint_file
from xtdrone_autopilot.plans.qgc_plan import Plan
from xtdrone_mavros.link import plan_transfers
from xtdrone_mavros.programs import mavwp

PLACED = (16, 17, 19, 21, 22, 31, 80, 84, 85, 195, 201, 4501)
UNPLACED = (
    20, 80, 93, 112, 114, 177, 178, 179, 187, 189, 196, 197, 200, 201, 203, 204, 205, 206, 211, 214, 260, 530, 531, 532,
    1000, 1001, 2000, 2001, 2003, 2500, 2501, 3000, 42600,
)  # fmt: skip
NAN = math.nan


def float32(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


numbers = st.sampled_from((0.0, -1.0, 1.0, 2.0, 2.9, 90.0, -90.0, 359.5, 70000.0, NAN)) | st.floats(-1e6, 1e6).map(
    float32
)
params = st.tuples(numbers, numbers, numbers, numbers)


@st.composite
def messages(draw, integers):
    """Return a mission item as a client sends it."""
    placed = draw(st.booleans())
    command = draw(st.sampled_from(PLACED if placed else UNPLACED))
    frame = draw(st.sampled_from((0, 3, 5, 6) if integers else (0, 3))) if placed else 2
    a, *more = draw(params)
    if command in (plan.ROI, plan.SET_ROI):
        a = float(draw(st.sampled_from((0, 3) if placed else (0, 1, 2))))
    x, y = draw(st.floats(-80, 80)), draw(st.floats(-170, 170))
    if integers:
        scale = 1e7 if placed else 1.0
        x, y = round(x * scale), round(y * scale)
    else:
        x, y = float32(x), float32(y)
    z = draw(st.floats(-100, 5000).map(float32))
    make = mavlink.MAVLink_mission_item_int_message if integers else mavlink.MAVLink_mission_item_message
    return make(1, 1, 0, frame, command, 0, draw(st.integers(0, 1)), a, *more, x, y, z, 0)


def flown(item):
    """Return what the navigator makes of an item; the heading as a direction, north and east."""
    if not item.has_position and item.frame == plan.FRAME_MISSION:
        numbers = (*plan.jump(item.params), *item.params[2:]) if item.command == plan.JUMP else item.params
        return (item.command, item.autocontinue, *numbers, item.x, item.y, item.z)
    heading = math.cos(item.yaw), math.sin(item.yaw)
    radius = item.params[1] if item.command in (plan.WAYPOINT, plan.LOITER_TO_ALT, plan.LAND) else 0.0
    mode = item.params[0] if item.command == plan.SET_ROI else 0.0
    place = round(item.x * 1e7), round(item.y * 1e7), item.z
    extra = (*heading, item.time_inside, item.forces_heading, radius, mode)
    return (item.command, item.autocontinue, item.relative, *place, *extra)


def same(a, b):
    def equal(x, y):
        return (x != x and y != y) or math.isclose(x, y, rel_tol=1e-6, abs_tol=1e-4)

    return len(a) == len(b) and all(map(equal, a, b))


def expected(item):
    """Return what flies after a round trip: the same, but for PX4's two conversions."""
    found = list(flown(item))
    if item.command == plan.LOITER_TIME:  # MavlinkMissionManager::format_mavlink_mission_item: loiter_exit_xtrack
        degrees = 1.0 if item.params[3] > 0.0 else 0.0
        found[6:8] = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    if item.command == plan.SET_ROI and item.frame != plan.FRAME_MISSION:  # format: no case for it, param1 stays 0
        found[11] = 0.0
    return found


def written(item, integers=True):
    return mission_items.write(item, 0, False, plan.MISSION, integers, (1, 1))


def by_mavlink(item):
    return mission_items.parse(written(item), True)


def by_float_items(item):
    return mission_items.parse(written(item, False), False)


def by_mavros(item):
    waypoint = plan_transfers.to_waypoint(written(item))
    return mission_items.parse(plan_transfers.to_item(waypoint, 0, plan.MISSION, (1, 1)), True)


def by_mavwp(item):
    rows = [mavwp.to_row(plan_transfers.to_waypoint(written(item)))]
    (row,) = waypoint_file.read(waypoint_file.write(rows), "mission.txt")
    return mission_items.parse(plan_transfers.to_item(mavwp.to_waypoint(row), 0, plan.MISSION, (1, 1)), True)


def by_plan(item):
    found = qgc_plan.parse(qgc_plan.text_of(Plan((mission_items.parse(written(item), True),)))).mission[0]
    x, y = (found.x, found.y) if found.frame == plan.FRAME_MISSION else (found.x * 1e7, found.y * 1e7)
    placed = SimpleNamespace(
        command=found.command, frame=found.frame, autocontinue=found.autocontinue, x=round(x), y=round(y), z=found.z
    )
    placed.param1, placed.param2, placed.param3, placed.param4 = found.params
    return mission_items.parse(placed, True)


DOORS = {"MISSION_ITEM_INT": by_mavlink, "MAVROS": by_mavros, "mavwp's file": by_mavwp, "a .plan file": by_plan}


@pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)
def test_what_flies_flies_again_after_a_round_trip(door):
    @settings(max_examples=150, deadline=None, derandomize=True)
    @given(messages(integers=True))
    def law(message):
        item = mission_items.parse(message, True)
        assert same(flown(door(item)), expected(item)), (item, door(item))
        assert same(flown(door(door(item))), flown(door(item)))

    law()


@settings(max_examples=150, deadline=None, derandomize=True)
@given(messages(integers=False))
def test_what_flies_flies_again_by_float_items(message):
    item = mission_items.parse(message, False)
    assert same(flown(by_float_items(item)), expected(item))


def test_the_law_holds_for_every_command_that_px4_accepts():
    def accepted(positioned):
        return {command for command in range(0x10000) if mission_items.accepts(command, positioned)}

    fences_and_rally = set(range(5000, 5005)) | {5100}
    assert accepted(True) - fences_and_rally == set(PLACED)
    assert accepted(False) == set(UNPLACED)


@pytest.mark.parametrize(
    ("command", "frame", "sent", "returned"),
    [
        (plan.JUMP, 2, (0, -1, 0, 0), (0, 65535, 0, 0)),
        (plan.JUMP, 2, (2.7, 70000, NAN, 4), (2, 4464, NAN, 4)),
        (plan.LAND, 3, (5, 1.9, 3, -90), (0, 1, 0, 270)),
        (plan.LAND, 3, (0, -1, 0, NAN), (0, 65535, 0, NAN)),
        (plan.LOITER_TIME, 3, (4, 0.5, 30, 90), (4, 1, 30, 1)),
        (plan.LOITER_TO_ALT, 3, (1, -40, 3, 0), (1, -40, 0, 0)),
        (plan.FENCE_INCLUSION, 0, (2.6, 0, 0, 0), (3, 0, 0, 0)),
        (plan.DELAY, 2, (-1, 12, 30, NAN), (-1, 12, 30, NAN)),
    ],
)
def test_px4s_own_conversions(command, frame, sent, returned):
    """PX4 MavlinkMissionManager::parse_mavlink_mission_item and format_mavlink_mission_item."""
    item = mission_items.parse(
        mavlink.MAVLink_mission_item_int_message(1, 1, 0, frame, command, 0, 1, *map(float, sent), 0, 0, 10.0, 0), True
    )
    back = written(item)
    assert [back.param1, back.param2, back.param3, back.param4] == pytest.approx(returned, nan_ok=True)


def test_rally_points_above_sea_level_are_written_above_home():
    point = PlanItem(plan.RALLY_POINT, 0, (0.0,) * 4, 47.0, 8.0, 520.0, autocontinue=False)
    text = qgc_plan.text_of(Plan((), rally=(point,), home=(47.0, 8.0, 488.0)))
    (back,) = qgc_plan.parse(text).rally
    assert back.altitude(488.0) == pytest.approx(point.altitude(488.0))
    with pytest.raises(qgc_plan.PlanError, match="520 m, is not allowed without a home position"):
        qgc_plan.text_of(Plan((), rally=(point,)))
