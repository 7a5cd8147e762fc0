"""Tracking of setpoints by responses: errors and delays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import signal

from xtdrone_interaction.metrics.spectrum import uniform
from xtdrone_interaction.recording.flight_from_ulog import FlightLog, euler
from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series

_MOST_DELAY = 1.0  # s; longer delays are not detected
_LEAST_LIKENESS = 0.5  # correlation; below it a response does not follow, and its delay is undefined
_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Tracking:
    """Tracking quality of a response.

    Attributes:
        name: quantity and unit.
        rms: of the error.
        greatest: error.
        delay: of the response behind the setpoint, s; None if nothing moves or the response does not follow.
    """

    name: str
    rms: float
    greatest: float
    delay: float | None


def tracking(name: str, wanted: Series, actual: Series, start: float, end: float, turn: float = 0.0) -> Tracking | None:
    """Compare a response with its setpoint.

    Args:
        name: for the result.
        wanted: setpoint, (t, 1); NaN where there is none.
        actual: response, (t, 1).
        start, end: span of the comparison, s.
        turn: full turn in the quantity's unit, for angles; else 0.
    """
    made = uniform(actual, start, end)
    if made is None or not len(wanted):
        return None
    values, step = made
    grid = actual.time[(actual.time >= start) & (actual.time <= end)][0] + step * np.arange(len(values))
    # a setpoint holds until the next one; stamps are rounded
    last = np.searchsorted(wanted.time, grid + 0.05 * step, "right") - 1
    setpoint = np.where(last >= 0, wanted.value[np.maximum(last, 0), 0], np.nan)
    did = values[:, 0]
    error = did - setpoint
    if turn:
        error = (error + turn / 2) % turn - turn / 2
    good = np.isfinite(error)
    if good.sum() < 16:
        return None
    delay = None if turn else _delay(setpoint[good], did[good], step)
    return Tracking(name, float(np.sqrt(np.mean(error[good] ** 2))), float(np.abs(error[good]).max()), delay)


def _delay(setpoint: Array, did: Array, step: float) -> float | None:
    """Return the delay of ``did`` behind ``setpoint`` by their correlation, s; None if they do not correlate."""
    setpoint, did = setpoint - setpoint.mean(), did - did.mean()
    if setpoint.std() < 1e-9 or did.std() < 1e-9:
        return None
    most = min(round(_MOST_DELAY / step), len(setpoint) // 2)
    likeness = signal.correlate(did, setpoint, "full")[len(setpoint) - 1 : len(setpoint) + most]
    best = int(likeness.argmax())
    if likeness[best] < _LEAST_LIKENESS * np.linalg.norm(setpoint) * np.linalg.norm(did) or best == most:
        return None
    return float(step * best)


class SetpointPair(NamedTuple):
    """A response and its setpoint.

    Attributes:
        name: quantity and unit.
        actual: response, (t, 1).
        wanted: setpoint, (t, 1).
        turn: full turn in the unit of an angle; else 0.
    """

    name: str
    actual: Series
    wanted: Series | None
    turn: float = 0.0


def pairs(log: FlightLog) -> dict[str, list[SetpointPair]]:
    """Return all responses with their setpoints, by group."""
    found: dict[str, list[SetpointPair]] = {"Position": [], "Velocity": [], "Attitude": [], "Rates": []}
    place, setpoint = (
        log.series("vehicle_local_position", *_AXES),
        log.series("vehicle_local_position_setpoint", *_AXES),
    )
    moving = log.series("vehicle_local_position", "vx", "vy", "vz")
    moving_setpoint = log.series("vehicle_local_position_setpoint", "vx", "vy", "vz")
    signs = (1.0, 1.0, -1.0)
    for i, (name, sign) in enumerate(zip(("north [m]", "east [m]", "up [m]"), signs, strict=True)):
        if place is not None and np.isfinite(place.value[:, i]).any():
            found["Position"].append(SetpointPair(name, place.column(i, sign), _column_or_none(setpoint, i, sign)))
    for i, (name, sign) in enumerate(zip(("north [m/s]", "east [m/s]", "up [m/s]"), signs, strict=True)):
        if moving is not None and np.isfinite(moving.value[:, i]).any():
            found["Velocity"].append(
                SetpointPair(name, moving.column(i, sign), _column_or_none(moving_setpoint, i, sign))
            )
    attitude, wanted = _angles(log, "vehicle_attitude", "q"), _angles(log, "vehicle_attitude_setpoint", "q_d")
    for i, name in enumerate(("roll [°]", "pitch [°]", "yaw [°]")):
        if attitude is not None:
            found["Attitude"].append(SetpointPair(name, attitude.column(i), _column_or_none(wanted, i), 360.0))
    rates, wanted = body_rates(log), log.series("vehicle_rates_setpoint", "roll", "pitch", "yaw")
    degrees = float(np.degrees(1.0))
    for i, name in enumerate(("roll [°/s]", "pitch [°/s]", "yaw [°/s]")):
        if rates is not None:
            found["Rates"].append(SetpointPair(name, rates.column(i, degrees), _column_or_none(wanted, i, degrees)))
    return {what: group for what, group in found.items() if group}


def body_rates(log: FlightLog) -> Series | None:
    """Return the body rates, rad/s FRD, (t, 3); logs before PX4 v1.10 have them with the attitude."""
    rates = log.array("vehicle_angular_velocity", "xyz", 3)
    return rates or log.series("vehicle_attitude", "rollspeed", "pitchspeed", "yawspeed")


def trackings(log: FlightLog) -> list[tuple[str, Tracking]]:
    """Return the group and the tracking of all responses, from the first arming to the last disarming."""
    rows = []
    for what, group in pairs(log).items():
        for pair in group:
            if pair.wanted is not None:
                found = tracking(pair.name, pair.wanted, pair.actual, *log.flown, pair.turn)
                if found is not None:
                    rows.append((what, found))
    return rows


def _column_or_none(series: Series | None, column: int, scale: float = 1.0) -> Series | None:
    return None if series is None else series.column(column, scale)


def _angles(log: FlightLog, topic: str, name: str) -> Series | None:
    quaternion = log.array(topic, name, 4)
    return None if quaternion is None else Series(quaternion.time, euler(quaternion.value))
