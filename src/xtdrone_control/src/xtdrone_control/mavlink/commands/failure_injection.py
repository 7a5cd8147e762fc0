"""Failure injection by MAV_CMD_INJECT_FAILURE (PX4 ``SYS_FAILURE_EN``, MAVLink FAILURE_UNIT, FAILURE_TYPE)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xtdrone_control.autopilot.commander.commander import Result
from xtdrone_control.autopilot.state import (
    FAILURE_GARBAGE,
    FAILURE_OFF,
    FAILURE_OK,
    FAILURE_SLOW,
    FAILURE_STUCK,
    FAILURE_WRONG,
)

if TYPE_CHECKING:
    from xtdrone_control.mavlink.service_base import Vehicle

_SENSOR = frozenset({FAILURE_OK, FAILURE_OFF, FAILURE_STUCK, FAILURE_GARBAGE, FAILURE_WRONG, FAILURE_SLOW})
_SWITCH = frozenset({FAILURE_OK, FAILURE_OFF})
_MOTORS = 101

# FAILURE_UNIT to the field of the FAILURES record and the supported FAILURE_TYPEs; other units are not simulated
# (airspeed sensor, servos) or cannot fail
_UNITS: dict[int, tuple[str, frozenset[int]]] = {
    0: ("gyro", _SENSOR),
    1: ("accel", _SENSOR),
    2: ("mag", _SENSOR),
    3: ("baro", _SENSOR),
    4: ("gps", _SENSOR),
    5: ("optical_flow", _SENSOR),
    6: ("vio", _SENSOR),
    7: ("distance_sensor", _SENSOR),
    100: ("battery", _SWITCH),
    _MOTORS: ("motor", _SWITCH),
    104: ("rc_signal", _SWITCH),
}


def inject(vehicle: Vehicle, unit: int, kind: int, instance: int) -> Result:
    """Inject a failure into a unit, or clear it.

    Args:
        vehicle: vehicle of the unit.
        unit: FAILURE_UNIT.
        kind: FAILURE_TYPE; 0 clears the failure.
        instance: number of the instance, from 1; 0: all. Only motors have more than one.

    Returns:
        ACCEPTED; DENIED while SYS_FAILURE_EN is 0; UNSUPPORTED for a unit, instance or type that is not simulated.
    """
    if not vehicle.commander.parameters.get("SYS_FAILURE_EN"):
        return Result.DENIED
    field, kinds = _UNITS.get(unit, ("", frozenset()))
    count = vehicle.autopilot.rotor_count(vehicle.index) if unit == _MOTORS else 1
    if kind not in kinds or not 0 <= instance <= count:
        return Result.UNSUPPORTED
    record = vehicle.autopilot.failures[vehicle.index]
    if unit != _MOTORS:
        record[field] = kind
    elif instance:
        record[field][instance - 1] = kind
    else:
        record[field][:count] = kind
    return Result.ACCEPTED
