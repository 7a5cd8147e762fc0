"""Every MAV_CMD with zero parameters, disarmed: the replies of PX4 v1.14.3 and of this autopilot."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest
from autopilot_fakes import ORIGIN
from pymavlink.dialects.v20 import common as mavlink
from service_fakes import SYSTEM, Served

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_common import modes

_REFERENCE = Path(__file__).parent / "data" / "px4_command_acks.csv"

# Deliberate differences: result, texts, and the reason.
_ACCEPTED, _UNSUPPORTED = 0, 3
_OTHERWISE: dict[int, tuple[int, list[str], str]] = {
    84: (_UNSUPPORTED, [], "a multicopter has no transition"),
    2511: (_ACCEPTED, [], "as PX4's logger; the reference's presumably waited for a LOGGING_ACK after 2510"),
}


def _reference() -> list[tuple[int, str, int | None, list[str]]]:
    with _REFERENCE.open(newline="", encoding="utf-8") as file:
        return [
            (
                int(row["command"]),
                row["name"],
                int(row["result"]) if row["result"] else None,
                [text.removeprefix("TXT:") for text in row["text"].split("|") if text],
            )
            for row in csv.DictReader(file)
        ]


@pytest.mark.parametrize(("number", "name", "result", "texts"), _reference())
def test_zero_parameters_disarmed(number, name, result, texts):
    if number in _OTHERWISE:
        result, texts, _why = _OTHERWISE[number]
    served = Served()
    found_result, found_texts = served.command(number)
    # with a tab where PX4 also sends an event; the reference was recorded without
    assert (found_result, [text.rstrip("\t") for text in found_texts]) == (result, texts), name


def test_deviating_answers_are_in_the_reference():
    reference = {number: (result, texts) for number, _, result, texts in _reference()}
    for number, (result, texts, why) in _OTHERWISE.items():
        assert reference[number] != (result, texts)
        assert why


# checks around the handlers


def command_long(number, *params, system=SYSTEM, component=1):
    return mavlink.MAVLink_command_long_message(system, component, number, 0, *params, *[0.0] * (7 - len(params)))


def command_int(number, x, y, z=0.0, frame=0, params=(0.0, 0.0, 0.0, 0.0)):
    return mavlink.MAVLink_command_int_message(SYSTEM, 1, frame, number, 0, 0, *params, x, y, z)


@pytest.fixture
def served():
    return Served()


@pytest.mark.parametrize(("system", "component"), [(0, 1), (0, 0), (SYSTEM, 100), (SYSTEM + 1, 1)])
def test_commands_to_other_systems_are_ignored_silently(served, system, component):
    assert not served.ask(command_long(401, system=system, component=component))
    assert served.ask(command_long(401, component=0)), "all components include the autopilot"


def test_discovery_requests_may_be_broadcast(served):
    for number, name in ((519, "PROTOCOL_VERSION"), (520, "AUTOPILOT_VERSION")):
        served.ask(command_long(number, system=0))
        assert [found for found, _ in served.link.sent] == [name, "COMMAND_ACK"]


def test_the_autopilot_does_not_command_itself(served):
    served.link.client = mavlink.MAVLink(None, srcSystem=SYSTEM, srcComponent=1)
    assert not served.ask(command_long(401))
    served.link.client = mavlink.MAVLink(None, srcSystem=SYSTEM, srcComponent=195)
    (ack,) = served.ask(command_long(401))
    assert (ack.target_system, ack.target_component) == (SYSTEM, 195), "but a component of its system may"


def test_a_repeated_command_is_answered_again(served):
    message = command_long(401)
    message.confirmation = 3
    assert served.ask(message)[0].result == served.ask(message)[0].result == 0


def test_floats_and_integers_that_are_mixed_up_are_denied(served):
    assert served.ask(command_long(192, -1, 1, 0, math.nan, 2147483647, 2147483647, 500.0))[0].result == 2
    assert served.ask(command_int(192, 0x7FF80000, 0x7FF80000))[0].result == 2
    assert len(served.link.warnings) == 2


def test_reposition_takes_its_heading_in_radians(served):
    served.autopilot.place(0, 0.0, 0.0, -5.0)
    served.commander.armed = True
    message = command_int(192, 0x7FFFFFFF, 0x7FFFFFFF, math.nan, params=(-1.0, 1.0, 0.0, 1.5))
    assert served.ask(message)[0].result == 0
    assert served.autopilot.setpoint[0]["goal_yaw"] == pytest.approx(1.5)
    for flags in (0.0, 3.0, math.nan):  # no change of mode, or other flags
        assert served.command(192, -1, flags)[0] == 3


@pytest.mark.parametrize(
    ("place", "north", "up"),
    [
        ((0.0, 0.0, 0.0), 0.0, 2.5),
        ((0.0, 0.0, 12.0), 0.0, 12.0),
        ((math.nan, math.nan, 12.0), 0.0, 12.0),
        (None, 9.0, 12.0),
    ],
)
def test_a_takeoff_leads_to_its_place_unless_that_is_left_out(served, place, north, up):
    """By zeros too, in difference to PX4, which flies towards 0 N 0 E then."""
    if place is None:
        place = (*served.commander.view.to_global((9.0, 0.0, 0.0))[:2], 12.0)
    altitude = ORIGIN[2] + place[2] if place[2] else 0.0
    assert served.command(22, 0.0, 0.0, 0.0, math.nan, *place[:2], altitude)[0] == 0
    assert served.command(400, 1)[0] == 0
    # a float of COMMAND_LONG has steps of some 0.4 m here
    assert served.autopilot.setpoint[0]["goal_position"].tolist() == pytest.approx([north, 0.0, -up], abs=0.6)


def test_a_region_of_interest_is_looked_at(served):
    latitude, longitude, _ = served.commander.view.to_global((0.0, 100.0, 0.0))
    message = command_int(195, round(latitude * 1e7), round(longitude * 1e7), ORIGIN[2] + 10.0, frame=6)
    assert served.ask(message)[0].result == 0
    assert served.commander.navigator.mission._roi == pytest.approx((0.0, 100.0, -10.0), abs=0.02)
    assert served.command(197)[0] == 0


@pytest.mark.parametrize(
    ("function", "result"), [(0, None), (1, 0), (12, 0), (13, None), (33, 0), (41, None), (1101, 0), (1999, 0)]
)
def test_a_motor_test_is_answered_as_by_px4(served, function, result):
    assert served.command(310, 0.1, 1.0, 0, 0, function)[0] == result
    assert bool(served.autopilot.motor_tests) == (function in (1, 1101))
    served.commander.armed = True
    assert served.command(310, 0.1, 1.0, 0, 0, function)[0] == 2
    served.commander.armed = False
    served.parameters.set("COM_MOT_TEST_EN", 0)
    assert served.command(310, 0.1, 1.0, 0, 0, function)[0] == 2


def test_actuators_are_set(served):
    assert served.command(187, 0.5, math.nan, -2.0)[0] == 0
    assert served.commander.navigator.payload.actuators[:3] == [0.5, 0.0, -1.0]


def test_landing_starts_at_the_missions_land_start(served):
    home = served.commander.home
    items = [
        PlanItem(number, 6, (0.0, 0.0, 0.0, math.nan), home.latitude, home.longitude, 10.0)
        for number in (22, 16, 189, 16)
    ]
    land = PlanItem(21, 6, (0.0, 0.0, 0.0, math.nan), home.latitude, home.longitude, 0.0)
    served.commander.navigator.set_plan(plan.MISSION, [*items, land])
    served.autopilot.place(0, 0.0, 0.0, -10.0)
    served.commander.armed = True
    assert served.command(189)[0] == 0
    assert served.commander.mode is modes.AUTO_MISSION
    assert served.commander.navigator.plans.current >= 2


# versions


def test_versions(served):
    served.ask(command_long(512, 148))
    version = served.link.sent[0][1]
    assert version.flight_sw_version == 17695743
    assert version.uid == SYSTEM
    # the reference's without SET_ACTUATOR_CONTROL_TARGET (1024), rejected in lockstep; without MISSION_INT,
    # FENCE and RALLY, MAVSDK sends no plans and QGroundControl shows none
    assert version.capabilities == 60671 & ~1024
    served.ask(command_long(512, 300))
    version = served.link.sent[0][1]
    assert (version.version, version.min_version, version.max_version) == (200, 100, 200)
    assert served.ask(command_long(512, 259))[0].result == 2, "no camera"


def test_the_origin_is_sent_on_request(served):
    for _ in range(2):  # also unchanged
        assert served.command(512, 49)[0] == 0
        assert served.link.sent[0][1].altitude == 488_000
    served.autopilot.estimator[0]["origin"]["set"] = 0
    assert served.command(512, 49)[0] == 2


def test_flights_are_announced(served):
    served.ask(command_long(528))
    assert (served.link.sent[0][1].arming_time_utc, served.link.sent[0][1].flight_uuid) == (0, 0)
    assert served.command(400, 1)[0] == 0
    served.ask(command_long(528))
    assert served.link.sent[0][1].arming_time_utc == served.autopilot.time_us
    assert served.command(400, 0)[0] == 0
    served.ask(command_long(512, 264))
    assert (served.link.sent[0][1].arming_time_utc, served.link.sent[0][1].flight_uuid) == (0, 1)


# failures


@pytest.mark.parametrize(
    ("unit", "kind", "instance", "result"),
    [
        (4, 1, 0, 0),
        (4, 1, 1, 0),
        (4, 1, 2, 3),
        (0, 2, 0, 0),
        (8, 1, 0, 3),
        (102, 1, 0, 3),
        (101, 1, 4, 0),
        (101, 1, 5, 3),
        (101, 2, 1, 3),
        (100, 1, 0, 0),
        (4, 7, 0, 3),
        (4, 1, -1, 0),  # PX4 rounds up before it truncates: 0
        (4, 1, -2, 3),
        (math.nan, 1, 0, 3),
    ],
)
def test_failures_that_can_and_cannot_be_injected(served, unit, kind, instance, result):
    before = served.autopilot.failures.copy()
    assert served.command(420, unit, kind, instance)[0] == result
    assert (served.autopilot.failures == before).all() == (result != 0)


def test_failures_reach_the_records_and_are_mended(served):
    failures = served.autopilot.failures[0]
    served.command(420, 4, 1)
    served.command(420, 101, 1, 3)
    assert failures["gps"] == 1
    assert failures["motor"].tolist()[:4] == [0, 0, 1, 0]
    served.command(420, 101, 1, 0)
    assert failures["motor"].tolist()[:5] == [1, 1, 1, 1, 0], "all that the vehicle has"
    served.command(420, 101, 0, 0)
    served.command(420, 4, 0)
    assert not failures["motor"].any()
    assert not failures["gps"]


def test_no_failure_without_leave(served):
    served.parameters.set("SYS_FAILURE_EN", 0)
    assert served.command(420, 4, 1)[0] == 2
    assert not served.autopilot.failures[0]["gps"]


# storage, calibration, reboot


def test_parameters_are_stored_and_recalled(tmp_path):
    file = tmp_path / "iris_0.params"
    served = Served(Parameters({"MAV_SYS_ID": SYSTEM}, file))
    served.parameters.set("MPC_XY_P", 0.7)
    assert served.command(245, 1)[0] == 0
    assert "MPC_XY_P" in file.read_text()
    served.parameters.set("MPC_XY_P", 0.8)
    assert served.command(245, 0)[0] == 0
    assert served.parameters.get("MPC_XY_P") == 0.7
    assert served.command(245, 2)[0] == 0
    assert served.parameters.get("MPC_XY_P") == 0.95
    assert "MPC_XY_P" not in file.read_text()
    assert served.command(245, 9)[0] is None
    file.unlink()
    file.mkdir()
    assert served.command(245, 1)[0] == 4, "what cannot be stored has failed"
    served.commander.armed = True
    assert served.command(245, 1)[0] == 1


@pytest.mark.parametrize(("action", "result"), [(0, 0), (1, 0), (2, 2), (3, 2)])
def test_reboot(served, action, result):
    assert served.command(246, action)[0] == result
    assert served.commander.rebooting == (action == 1)
    served.commander.armed = True
    assert served.command(246, action)[0] == (2 if action else 0)
