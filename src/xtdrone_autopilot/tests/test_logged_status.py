"""The logged status topics, against PX4 v1.14's ``getVehicleControlMode`` (commander/ModeUtil/control_mode.cpp)."""

from __future__ import annotations

import pytest

from xtdrone_autopilot.logger.message_definitions import message_format
from xtdrone_autopilot.logger.topics_on_change import control_flags
from xtdrone_autopilot.state import TASK_GOTO, TASK_RATES
from xtdrone_common import modes

_HOLDING = "rates attitude altitude climb_rate position velocity"
_PX4 = {
    modes.MANUAL: "manual rates attitude",
    modes.STABILIZED: "manual rates attitude",
    modes.ALTCTL: "manual rates attitude altitude climb_rate",
    modes.POSCTL: f"manual {_HOLDING}",
    modes.ACRO: "manual rates",
    modes.OFFBOARD: f"offboard {_HOLDING}",
    modes.AUTO_FOLLOW_TARGET: _HOLDING,
    modes.ORBIT: _HOLDING,
    modes.DESCEND: "auto rates attitude climb_rate",
    modes.TERMINATION: "termination",
}


def _enabled(mode: modes.Mode, task: int) -> set[str]:
    found = {name for name, enabled in control_flags(mode, task).items() if enabled}
    return {name[len("flag_control_") : -len("_enabled")] for name in found if name.startswith("flag_control_")}


@pytest.mark.parametrize("mode", modes.ALL, ids=lambda mode: mode.label)
def test_control_mode_has_the_flags_of_px4(mode):
    assert _enabled(mode, TASK_GOTO) == set(_PX4.get(mode, f"auto {_HOLDING}").split())


def test_offboard_body_rates_disable_the_outer_controllers():
    assert _enabled(modes.OFFBOARD, TASK_RATES) == {"offboard", "rates"}


def test_every_flag_is_a_field_of_the_message():
    fields = {field.name for field in message_format("vehicle_control_mode").fields}
    assert control_flags(modes.MANUAL, TASK_GOTO).keys() <= fields
