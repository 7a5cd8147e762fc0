"""Events are broadcast, numbered, and sent again on request."""

from __future__ import annotations

import pytest
from service_fakes import SYSTEM, Served

from xtdrone_autopilot.events.events import CRITICAL, INFO, event, event_id
from xtdrone_autopilot.mavlink.wire.frame_packing import Format

_FIRST = 0xFFFF - 10 + 1
_REQUEST = Format("REQUEST_EVENT")


@pytest.fixture
def served():
    served = Served()
    served.commander.events.clear()
    return served


def happen(served, count=1, name="commander_armed_by"):
    for i in range(count):
        served.commander.events.append(event(name, CRITICAL, served.autopilot.time_us, i, internal=INFO))


def request(served, first, last, system=SYSTEM):
    served.link.sent.clear()
    payload = _REQUEST.payload((first & 0xFFFF, last & 0xFFFF, system, 1))
    served.ask(_REQUEST.frame(payload, 0, 255, 190))
    return [(name, m.sequence) for name, m in served.link.sent]


def events(found):
    return [m for _, name, m in found if name == "EVENT"]


def test_events_go_to_everybody_at_the_next_look(served):
    served.run(0.2)
    happen(served, 2)
    served.other.sent.clear()
    first, second = events(served.run(0.1))
    assert (first.sequence, second.sequence) == (_FIRST, _FIRST + 1)
    assert first.id == 1 << 24 | first.id & 0xFFFFFF
    assert first.log_levels == INFO << 4 | CRITICAL
    assert (first.destination_system, first.destination_component) == (0, 0)
    assert bytes(second.arguments) == b"\1" + bytes(39)
    assert first.event_time_boot_ms == (served.autopilot.time_us - 100_000) // 1000
    assert [m.sequence for name, m in served.other.sent if name == "EVENT"] == [_FIRST, _FIRST + 1]
    assert not events(served.run(1.0)), "each once"


def test_the_latest_sequence_is_sent_every_three_seconds(served):
    found = [(t, m) for t, name, m in served.run(20.0) if name == "CURRENT_EVENT_SEQUENCE"]
    assert len(found) == 7, "as the reference had it"
    assert {m.flags for _, m in found} == {1}, "nothing has happened yet"
    happen(served)
    (last,) = (m for _, name, m in served.run(3.0) if name == "CURRENT_EVENT_SEQUENCE")
    assert (last.sequence, last.flags) == (_FIRST, 0)


def test_missed_events_are_sent_again(served):
    happen(served, 15)
    served.run(0.1)
    assert request(served, _FIRST + 3, _FIRST + 3) == [("EVENT", _FIRST + 3)]
    wrapped = [(_FIRST + i) & 0xFFFF for i in range(8, 13)]
    assert request(served, wrapped[0], wrapped[-1]) == [("EVENT", number) for number in wrapped]
    assert 0 in wrapped


def test_requests_for_expired_events_are_answered_with_an_error(served):
    happen(served, 30)
    served.run(0.1)
    oldest = (_FIRST + 10) & 0xFFFF
    assert request(served, _FIRST, _FIRST) == [("RESPONSE_EVENT_ERROR", _FIRST)]
    error = served.link.sent[0][1]
    assert (error.sequence_oldest_available, error.target_system, error.target_component) == (oldest, 255, 190)
    found = request(served, _FIRST, _FIRST + 29)
    assert found[0] == ("RESPONSE_EVENT_ERROR", _FIRST), "once, not for each"
    assert found[1:] == [("EVENT", (oldest + i) & 0xFFFF) for i in range(20)]


def test_requests_to_others_are_not_answered(served):
    happen(served)
    served.run(0.1)
    assert request(served, _FIRST, _FIRST, system=SYSTEM + 1) == []


def test_arming_is_an_event(served):
    assert served.command(400, 1)[0] == 0
    assert event_id("commander_armed_by") in [m.id for m in events(served.run(0.1))]
