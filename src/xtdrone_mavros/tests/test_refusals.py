"""Texts for reasons that PX4 reports by events alone."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import pytest
from mavros_fakes import Bench
from mavros_msgs.srv import CommandBoolRequest
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.failsafe import Action, Cause
from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.events import Event, event
from xtdrone_autopilot.mavlink.wire.frame_packing import Format
from xtdrone_common import modes
from xtdrone_mavros.lib.refusals import Refusals
from xtdrone_mavros.plugins import PLUGINS

ALL_MODES = 0xFFFFFFFF
SECOND = 1_000_000_000
OFFBOARD_ONLY = 1 << modes.OFFBOARD.state
STREAM = ("check_modes_offboard_signal", events.ERROR, OFFBOARD_ONLY)
MISSION = ("check_modes_mission", events.INFO, 1 << modes.AUTO_MISSION.state)
STATION = ("check_rc_dl_no_dllink", events.INFO, ALL_MODES)
BATTERY = ("check_battery_critical", events.CRITICAL, ALL_MODES)


class Message(NamedTuple):
    """EVENT, decoded."""

    id: int
    log_levels: int
    arguments: Sequence[int]


def message(found: Event) -> Message:
    return Message(found.number, found.log_levels, tuple(found.arguments.ljust(40, b"\0")))


def report(*checks: tuple[str, int, int]) -> list[Event]:
    """Return the events of a report; checks are name, level and the affected modes."""
    return [
        event("commander_arming_check_summary", events.PROTOCOL, 0, 0, 0, 0, 0, 0),
        *(event(name, level, 0, concerned, events.SYSTEM) for name, level, concerned in checks),
        event("commander_health_summary", events.PROTOCOL, 0, 0, 0, 0, 0),
    ]


class Told:
    """A vehicle's rejections, and the texts for its user."""

    def __init__(self, mode: modes.Mode = modes.OFFBOARD) -> None:
        self.refusals = Refusals()
        self.refusals.custom_mode = mode.custom_mode

    def by(self, *found: Event, now_ns: int = 0) -> list[str]:
        lines = [line for entry in found for line in self.refusals.process(message(entry), now_ns)]
        return [text for _, text in lines]


def test_an_unrequested_report_is_not_shown() -> None:
    assert Told().by(*report(STREAM, MISSION)) == []


def test_a_rejection_is_explained_by_the_modes_failing_checks() -> None:
    told = Told()
    told.by(*report(MISSION))
    told.refusals.arming_refused(SECOND)
    assert told.by(*report(STREAM, MISSION, STATION, BATTERY), now_ns=SECOND) == [
        "Arming denied: No offboard signal; Critical battery"
    ]
    assert told.by(*report(STREAM, BATTERY), now_ns=SECOND) == []  # reported once


def test_a_rejection_without_a_known_reason_lists_all_failing_checks() -> None:
    told = Told(modes.AUTO_LOITER)
    told.refusals.arming_refused(0)
    assert told.by(*report(STREAM, STATION)) == ["Arming denied: No offboard signal"]
    told.refusals.arming_refused(0)
    assert told.by(*report()) == ["Arming denied: for a reason that is not known here"]


def test_a_late_report_does_not_explain_a_rejection() -> None:
    told = Told()
    told.refusals.arming_refused(0)
    assert told.by(*report(STREAM), now_ns=SECOND) == []


def test_checks_outside_the_catalogue_are_shown_by_number() -> None:
    told = Told()
    told.refusals.arming_refused(0)
    first, *last = report()
    strange = Message(0x01ABCDEF, events.ERROR, (*ALL_MODES.to_bytes(4, "little"), *[0] * 36))
    told.by(first)
    assert told.refusals.process(strange, 0) == []
    assert told.by(*last) == ["Arming denied: arming check 0x01abcdef, which is not known here"]


@pytest.mark.parametrize("first", [True, False], ids=["report first", "failsafe first"])
def test_a_failsafe_is_shown_with_its_reason(first: bool) -> None:
    told = Told()
    failsafe = event("commander_failsafe_enter_generic", events.CRITICAL, 0, modes.OFFBOARD.custom_mode, Action.POSCTL)
    if first:
        told.by(*report(STREAM, MISSION))
        assert told.by(failsafe) == ["Failsafe: position control: No offboard signal"]
    else:
        assert told.by(failsafe) == ["Failsafe: position control"]
        assert told.by(*report(STREAM, MISSION), now_ns=SECOND) == ["Failsafe: position control: No offboard signal"]
    assert told.by(*report(STREAM), now_ns=2 * SECOND) == []


def test_a_failsafe_with_a_cause_is_shown_as_text() -> None:
    failsafe = event(
        "commander_failsafe_enter_hold",
        events.CRITICAL,
        0,
        modes.AUTO_MISSION.custom_mode,
        Action.RETURN,
        5,
        Cause.BATTERY_LOW,
    )
    assert Told().by(failsafe) == ["Failsafe because of low battery: return in 5 s"]


def test_a_rejected_mode_is_shown_with_its_reason() -> None:
    told = Told(modes.AUTO_LOITER)
    told.by(*report(STREAM, MISSION))
    refused = event(
        "commander_modeswitch_not_avail",
        events.CRITICAL,
        0,
        modes.OFFBOARD.custom_mode,
        modes.number_of(modes.OFFBOARD),
    )
    assert told.by(refused) == ["Switching to offboard is not possible now: No offboard signal"]


def test_events_that_repeat_a_text_are_not_shown() -> None:
    assert Told().by(event("commander_armed_by", events.INFO, 0, 4)) == []


def test_a_reboot_makes_everything_void() -> None:
    told = Told()
    told.by(*report(STREAM)[:-1])
    told.refusals.arming_refused(0)
    told.refusals.reset()
    assert told.by(report()[-1]) == []


# ---- through the layer


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench(PLUGINS)
    yield made
    made.close()


def events_frame(found: Sequence[Event]) -> bytes:
    form = Format("EVENT")
    frames = []
    for i, entry in enumerate(found):
        values = (entry.number, 0, i, 0, 0, entry.log_levels, *entry.arguments.ljust(40, b"\0"))
        frames.append(form.frame(form.payload(values), i, 1, 1))
    return b"".join(frames)


def refuse(bench: Bench, *, arm: bool) -> None:
    """Call the arming service; the autopilot rejects the request before it sends the reason."""
    service = bench.ros.services["/iris_0/mavros/cmd/arming"]
    caller = threading.Thread(target=service, args=[CommandBoolRequest(value=arm)])
    bench.fcu.setblocking(True)
    bench.fcu.settimeout(10.0)
    caller.start()
    bench.fcu.recv(1000)
    bench.fcu.setblocking(False)
    bench.send(mavlink.MAVLink_command_ack_message(400, mavlink.MAV_RESULT_TEMPORARILY_REJECTED))
    caller.join(10.0)
    assert not caller.is_alive()


def test_a_rejected_arming_is_logged_and_published(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.take("statustext/recv")
    bench.send(mavlink.MAVLink_heartbeat_message(2, 12, 0x1D, modes.OFFBOARD.custom_mode, 3, 3))
    bench.received()
    refuse(bench, arm=True)
    bench.send_raw(events_frame(report(STREAM)))
    [text] = bench.published("statustext/recv")
    assert (text.severity, text.text) == (2, "Arming denied: No offboard signal")
    assert "iris_0: FCU: Arming denied: No offboard signal" in caplog.text


def test_a_rejected_disarming_does_not_count_as_arming(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.send(mavlink.MAVLink_heartbeat_message(2, 12, 0x9D, modes.OFFBOARD.custom_mode, 3, 3))
    bench.received()
    refuse(bench, arm=False)
    bench.send_raw(events_frame(report(STREAM)))
    assert "Arming denied" not in caplog.text


def test_a_text_in_pieces_is_one_line(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.take("statustext/recv")
    for i, piece in enumerate((b"x" * 50, b"y" * 50, b"")):
        bench.send(mavlink.MAVLink_statustext_message(4, piece, 7, i))
    [text] = bench.published("statustext/recv")
    assert text.text == "x" * 50 + "y" * 50
    assert f"iris_0: FCU: {text.text}" in caplog.text
