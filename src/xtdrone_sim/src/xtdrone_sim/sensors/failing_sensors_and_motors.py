"""Failure injection for sensors and motors (MAV_CMD_INJECT_FAILURE, ``autopilot.failures``).

| failure | effect on a sensor | effect on a motor |
|---|---|---|
| off | no samples; GPS reports no fix | stops |
| stuck | repeats the value at the onset of the failure | repeats the command at the onset |
| garbage | adds random errors up to ``_GARBAGE`` | random command |
| wrong | adds a constant offset | command times 1.2 |
| slow | one sample in ten; gyroscope and accelerometer hold it in between | half of the command |

Random numbers come from the vehicle's own counter, so the same failure reproduces the same flight.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_autopilot.state import (
    FAILURE_GARBAGE,
    FAILURE_OFF,
    FAILURE_OK,
    FAILURE_SLOW,
    FAILURE_STUCK,
    FAILURE_WRONG,
    MAX_ROTORS,
)
from xtdrone_sim.kernel import kernel
from xtdrone_sim.vehicles.vehicle_model import MODEL

_GYRO, _ACCEL, _MAG, _BARO, _GPS, _FLOW, _RANGE, _VISION = range(8)
_UNITS = 8
_WIDTH = 6  # largest number of values in one sample
_SLOW_SHARE = 10
_WRONG_MOTOR, _SLOW_MOTOR = 1.2, 0.5

# largest error of ``garbage`` and offset of ``wrong``, by unit
_GARBAGE = (10.0, 50.0, 2.0, 1000.0, 1000.0, 5.0, 20.0, 100.0)  # rad/s, m/s^2, gauss, m, m, rad/s, m, m
_OFFSET = (0.5, 2.0, 0.4, 50.0, 100.0, 0.5, 5.0, 10.0)
_METRES_PER_DEGREE = 111_194.9  # of latitude, on geo's sphere
_GARBAGE_SPEED = 30.0  # m/s

MEMORY = np.dtype(
    [
        ("counter", "i8"),  # state of the random numbers
        ("samples", "i8", _UNITS),  # of each unit while it fails
        ("held", "i4", _UNITS),  # 1: ``value`` holds the unit's sample
        ("value", "f8", (_UNITS, _WIDTH)),
        ("motor_held", "i4", MAX_ROTORS),
        ("motor", "f8", MAX_ROTORS),
    ],
    align=True,
)


@kernel
def _random(b):
    """Return the next number in -1..1 (a 64-bit linear congruential generator, D. Knuth's MMIX constants)."""
    b.counter = b.counter * 6364136223846793005 + 1442695040888963407
    return (b.counter >> 32) / 2147483648.0


@kernel
def _spoil(b, unit, kind, values):
    """Apply a failure to ``values`` (_WIDTH,), a unit's new sample; return 0 for no sample."""
    if kind == FAILURE_OFF:
        return 0
    if kind in (FAILURE_STUCK, FAILURE_SLOW):
        renew = kind == FAILURE_SLOW and b.samples[unit] % _SLOW_SHARE == 0
        if not b.held[unit] or renew:
            b.held[unit] = 1
            for i in range(_WIDTH):
                b.value[unit, i] = values[i]
        for i in range(_WIDTH):
            values[i] = b.value[unit, i]
        return 1
    for i in range(_WIDTH):
        if kind == FAILURE_GARBAGE:
            values[i] += _GARBAGE[unit] * _random(b)
        elif kind == FAILURE_WRONG:
            values[i] += _OFFSET[unit]
    return 1


@kernel
def _vector(b, unit, kind, vector, work):
    """Apply a failure to a sample that is one vector; return 0 for no sample."""
    for i in range(vector.shape[0]):
        work[i] = vector[i]
    if not _spoil(b, unit, kind, work):
        return 0
    for i in range(vector.shape[0]):
        vector[i] = work[i]
    return 1


@kernel
def _comes(b, unit, kind):
    """Count a sample of a failing unit; return whether it is delivered: a slow unit drops nine of ten."""
    b.samples[unit] += 1
    return kind != FAILURE_SLOW or b.samples[unit] % _SLOW_SHARE == 0


@kernel
def _spoil_gps(b, s, kind, work):
    """Apply a failure to a GPS sample: offsets in metres north, east and up; only garbage affects the velocity."""
    work[0], work[1], work[2] = 0.0, 0.0, 0.0
    place = (s.gps_lat, s.gps_lon, s.gps_alt)
    if kind == FAILURE_STUCK:
        work[0], work[1], work[2] = place
        work[3], work[4], work[5] = s.gps_vel[0], s.gps_vel[1], s.gps_vel[2]
        _spoil(b, _GPS, kind, work)
        s.gps_lat, s.gps_lon, s.gps_alt = work[0], work[1], work[2]
        s.gps_vel[0], s.gps_vel[1], s.gps_vel[2] = work[3], work[4], work[5]
    elif kind in (FAILURE_GARBAGE, FAILURE_WRONG):
        _spoil(b, _GPS, kind, work)
        s.gps_lat += work[0] / _METRES_PER_DEGREE
        s.gps_lon += work[1] / _METRES_PER_DEGREE
        s.gps_alt += work[2]
        if kind == FAILURE_GARBAGE:
            for i in range(3):
                s.gps_vel[i] += _GARBAGE_SPEED * _random(b)
    elif kind == FAILURE_OFF:
        s.gps_fix = 0
        s.gps_satellites = 0


@kernel
def _spoil_baro(b, s, kind, work):
    work[0], work[1], work[2] = s.baro_alt, s.baro_pressure, s.baro_temperature
    before = s.baro_alt
    if kind == FAILURE_STUCK:
        _spoil(b, _BARO, kind, work)
        s.baro_alt, s.baro_pressure, s.baro_temperature = work[0], work[1], work[2]
    elif kind in (FAILURE_GARBAGE, FAILURE_WRONG):
        _spoil(b, _BARO, kind, work)
        s.baro_alt = work[0]
        s.baro_pressure -= 12.0 * (s.baro_alt - before)  # Pa; 12 Pa a metre near the ground


@kernel
def spoil_sensors(sensors, failures, memory, work):
    """Apply the failures to this step's samples of all vehicles.

    Args:
        sensors, failures, memory: record arrays, shape (n,).
        work: (_WIDTH,) scratch.
    """
    for i in range(sensors.shape[0]):
        s, f, b = sensors[i], failures[i], memory[i]
        s.imu_missing = f.gyro == FAILURE_OFF or f.accel == FAILURE_OFF
        if f.gyro:
            _comes(b, _GYRO, f.gyro)
            _vector(b, _GYRO, f.gyro, s.gyro, work)
        if f.accel:
            _comes(b, _ACCEL, f.accel)
            _vector(b, _ACCEL, f.accel, s.accel, work)
        if f.mag and s.mag_fresh:
            s.mag_fresh = _comes(b, _MAG, f.mag) and _vector(b, _MAG, f.mag, s.mag, work)
        if f.baro and s.baro_fresh:
            _spoil_baro(b, s, f.baro, work)
            s.baro_fresh = f.baro != FAILURE_OFF and _comes(b, _BARO, f.baro)
        if f.gps and s.gps_fresh:
            _spoil_gps(b, s, f.gps, work)
            s.gps_fresh = f.gps != FAILURE_OFF and _comes(b, _GPS, f.gps)
        if f.optical_flow and s.flow_fresh:
            s.flow_fresh = _comes(b, _FLOW, f.optical_flow) and _vector(b, _FLOW, f.optical_flow, s.flow_rate, work)
        if f.distance_sensor and s.range_fresh:
            work[0] = s.range_distance
            fresh = _spoil(b, _RANGE, f.distance_sensor, work)
            s.range_distance = work[0]
            s.range_fresh = fresh and _comes(b, _RANGE, f.distance_sensor)
        if f.vio and s.vision_fresh:
            s.vision_fresh = _comes(b, _VISION, f.vio) and _vector(b, _VISION, f.vio, s.vision_position, work)
        _release(b, f)


@kernel
def _release(b, f):
    """Clear the held samples of units that work again."""
    kinds = (f.gyro, f.accel, f.mag, f.baro, f.gps, f.optical_flow, f.distance_sensor, f.vio)
    for unit in range(_UNITS):
        if kinds[unit] == FAILURE_OK:
            b.held[unit] = 0
            b.samples[unit] = 0


@kernel
def spoil_motors(commands, models, failures, memory):
    """Apply the failures to the motor commands (n, MAX_ROTORS), 0..1, in place; "off" stops the motor."""
    for i in range(commands.shape[0]):
        m, f, b = models[i], failures[i], memory[i]
        for k in range(m.rotor_count):
            kind = f.motor[k]
            if kind != FAILURE_STUCK:
                b.motor_held[k] = 0
            if kind == FAILURE_OFF:
                commands[i, k] = -m.idle_speed / m.input_scaling
            elif kind == FAILURE_STUCK:
                if not b.motor_held[k]:
                    b.motor_held[k] = 1
                    b.motor[k] = commands[i, k]
                commands[i, k] = b.motor[k]
            elif kind == FAILURE_GARBAGE:
                commands[i, k] = 0.5 + 0.5 * _random(b)
            elif kind == FAILURE_WRONG:
                commands[i, k] = min(_WRONG_MOTOR * commands[i, k], 1.0)
            elif kind == FAILURE_SLOW:
                commands[i, k] *= _SLOW_MOTOR


class Failing:
    """Failures of a fleet.

    Attributes:
        any: whether any unit fails at present; updated by ``look``.
    """

    def __init__(self, failures: np.ndarray, models: np.ndarray, seed: int) -> None:
        """Apply the failures in ``failures`` ((n,) ``FAILURES``), a record that the autopilots write.

        Args:
            failures: record of the autopilots.
            models: (n,) ``MODEL``.
            seed: seed of the simulation.
        """
        assert models.dtype == MODEL
        self.any = False
        self._failures = failures
        self._numbers = failures.view(np.int32)
        self._models = models
        self._memory = np.zeros(len(failures), MEMORY)
        self._memory["counter"] = self._counters = (np.arange(len(failures)) + 1) * 2_654_435_761 + seed
        self._work = np.zeros(_WIDTH)
        self._commands = np.zeros((len(failures), MAX_ROTORS))

    def forget(self, index: int) -> None:
        """Reset the memory of vehicle ``index``, because another vehicle takes its place."""
        self._memory[index] = np.zeros(1, MEMORY)[0]
        self._memory["counter"][index] = self._counters[index]

    def look(self) -> bool:
        """Return whether any unit fails."""
        failing = bool(self._numbers.any())
        if self.any and not failing:
            self._memory["held"] = 0
            self._memory["motor_held"] = 0
        self.any = failing
        return failing

    def sensors(self, sensors: np.ndarray) -> None:
        """Apply the failures to this step's samples; called once more after all failures end, to restore samples."""
        spoil_sensors(sensors, self._failures, self._memory, self._work)

    def motors(self, commands: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``commands`` (n, MAX_ROTORS) with the failures applied."""
        self._commands[:] = commands
        spoil_motors(self._commands, self._models, self._failures, self._memory)
        return self._commands
