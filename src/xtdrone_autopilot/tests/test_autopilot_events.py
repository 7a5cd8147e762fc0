"""Events: their ids, their arguments, and those that the commander sends."""

from __future__ import annotations

import struct

import pytest
from autopilot_fakes import Flight

from xtdrone_autopilot.commander.commander import Result
from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.events import event, event_id
from xtdrone_common import modes


def taken(flight):
    found = list(flight.commander.events)
    flight.commander.events.clear()
    return found


@pytest.mark.parametrize(("name", "hashed"), [("", 0x811C9DC5), ("a", 0xE40C292C), ("foobar", 0xBF9CF968)])
def test_numbers_are_fnv_1a(name, hashed):
    """The hash reproduces the test vectors on the page of the FNV authors."""
    assert event_id(name) == 1 << 24 | hashed & 0xFFFFFF


def test_arguments_are_packed():
    name = "commander_failsafe_enter_generic_hold"  # mode, action, delay
    found = event(name, events.CRITICAL, 5, 0x03040000, 6, 5, internal=events.WARNING)
    assert found.arguments == bytes([0, 0, 4, 3, 6, 5, 0])
    assert found.log_levels == 0x42
    assert found.time_us == 5


def test_arguments_beyond_their_range_are_cut_and_their_number_must_be_right():
    assert event("commander_armed_by", events.INFO, 0, 300).arguments == b"\xff"
    assert event("commander_armed_by", events.INFO, 0, -1).arguments == b"\x00"
    with pytest.raises(ValueError, match=r"shorter|longer"):
        event("commander_armed_by", events.INFO, 0, 4, 4)
    with pytest.raises(KeyError):
        event("no_such_event", events.INFO, 0)


def test_arming_and_disarming_are_announced_as_text_and_event():
    flight = Flight()
    taken(flight)
    flight.commander.texts.clear()
    flight.commander.arm_disarm(True)
    flight.commander.arm_disarm(False)
    assert list(flight.commander.texts) == [
        (6, "Armed by external command\t"),
        (6, "Disarmed by external command\t"),
    ]
    assert [(e.name, e.arguments) for e in taken(flight)] == [
        ("commander_armed_by", b"\x04"),
        ("commander_disarmed_by", b"\x04"),
    ]


def test_a_rejected_mode_is_named():
    flight = Flight()
    flight.commander.arm_disarm(True)
    flight.place(0.0, 0.0, -5.0)
    flight.run(0.2)
    taken(flight)
    assert flight.commander.request(modes.OFFBOARD) is Result.TEMPORARILY_REJECTED
    (found,) = taken(flight)
    assert found.name == "commander_modeswitch_not_avail"
    assert struct.unpack("<IB", found.arguments) == (modes.OFFBOARD.custom_mode, 7)
    flight.commander.texts.clear()
    flight.commander.request(modes.OFFBOARD)
    assert not flight.commander.texts, "at most one a second"


def test_checks_are_reported_on_change_at_most_every_two_seconds():
    flight = Flight()
    flight.run(3.0)
    taken(flight)
    flight.run(5.0)
    assert taken(flight) == []
    flight.commander.request(modes.AUTO_LAND)
    flight.run(1.2)
    first, *rest, last = taken(flight)
    assert (first.name, last.name) == ("commander_arming_check_summary", "commander_health_summary")
    assert "check_modes_cannot_takeoff" in [found.name for found in rest]
    flight.commander.request(modes.AUTO_LOITER)
    flight.run(0.2)
    assert taken(flight) == []
    flight.run(3.0)
    assert "check_modes_cannot_takeoff" not in [found.name for found in taken(flight)]


def test_the_summary_names_the_modes_that_can_be_armed_in():
    flight = Flight()
    flight.run(3.0)
    flight.autopilot.estimator["position_valid"] = 0
    taken(flight)
    flight.run(3.0)
    found = {e.name: e for e in taken(flight)}
    summary = found["commander_arming_check_summary"]
    chunk, errors, _warnings, can_arm, can_run = struct.unpack("<BIIII", summary.arguments)
    assert chunk == 0
    assert not can_run >> modes.AUTO_LOITER.state & 1
    assert errors >> events.LOCAL_POSITION & 1
    assert not can_arm >> modes.AUTO_LOITER.state & 1
    concerned, component = struct.unpack("<IB", found["check_modes_local_pos"].arguments)
    assert component == events.LOCAL_POSITION
    assert concerned >> modes.AUTO_LOITER.state & 1
    assert not concerned >> modes.STABILIZED.state & 1
