"""Battery and estimator of ``~get_readiness``: requested from the autopilot only while a caller needs them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from mavros_fakes import Bench
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.plugins import PLUGINS
from xtdrone_mavros.readiness import TelemetryDemand, TelemetryOf, readiness

HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 0x91, 6 << 16, 4, 3)
BATTERY = mavlink.MAVLink_battery_status_message(0, 0, 3, 0, [4100] * 10, 100, -1, -1, 83)
ESTIMATOR = mavlink.MAVLink_estimator_status_message(0, 1 | 2 | 32, *[0.0] * 8)
INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
IDS = {147, 230}  # BATTERY_STATUS, ESTIMATOR_STATUS


class Caller:
    """A vehicle's plugins with demand-driven telemetry, and a clock set by the test."""

    def __init__(self) -> None:
        self.now = 0.0
        self.demand = TelemetryDemand(self._refresh, lambda: self.now)
        self.bench: Bench | None = None
        self.bench = Bench([*PLUGINS, TelemetryOf(self.demand)])  # type: ignore[list-item]
        self.bench.send(HEARTBEAT)
        self.intervals()

    def _refresh(self) -> None:
        if self.bench is not None:
            self.bench.uas.refresh()

    def intervals(self) -> dict[int, float]:
        """Return the intervals (us) of battery and estimator requested from the autopilot since the last call."""
        assert self.bench is not None
        sent = [m for m in self.bench.received() if m.get_type() == "COMMAND_LONG" and m.command == INTERVAL]
        return {int(m.param1): m.param2 for m in sent if int(m.param1) in IDS}


@pytest.fixture
def caller() -> Iterator[Caller]:
    made = Caller()
    yield made
    assert made.bench is not None
    made.bench.close()


def test_streams_are_requested_by_a_caller_and_end_some_seconds_after_the_last(caller: Caller) -> None:
    bench = caller.bench
    assert bench is not None
    bench.send(BATTERY, ESTIMATOR)
    bench.uas.refresh()
    assert caller.intervals() == dict.fromkeys(IDS, -1.0)  # no caller needs them: the autopilot is asked to stop them
    caller.demand.ask()
    assert caller.intervals() == dict.fromkeys(IDS, 0.0)
    caller.now = 9.0
    caller.demand.ask()
    caller.now = 18.0
    caller.demand.tend()
    assert caller.demand.needed
    caller.now = 19.1
    caller.demand.tend()
    assert not caller.demand.needed
    bench.send(BATTERY, ESTIMATOR)
    bench.uas.refresh()
    assert caller.intervals() == dict.fromkeys(IDS, -1.0)


def test_battery_and_estimator_are_those_last_received(caller: Caller) -> None:
    bench = caller.bench
    assert bench is not None
    caller.demand.ask()
    unknown = readiness(bench.uas, telemetry=True)
    assert math.isnan(unknown.battery)
    assert not unknown.estimated
    bench.send(BATTERY, ESTIMATOR)
    known = readiness(bench.uas, telemetry=True)
    assert known.battery == pytest.approx(0.83)
    assert (known.estimated, known.estimator_flags) == (True, 1 | 2 | 32)
    assert bench.published("battery") == bench.published("estimator_status") == []  # no subscriber: nothing is decoded
    assert math.isnan(readiness(bench.uas).battery)
