"""Batteries and motor controllers of all vehicles: voltage, currents, rotor speeds, at 10 Hz.

Two models, selected by the vehicle's description (``battery: {model: ...}``):

``drain`` (the default): PX4 SITL's battery simulator. The charge falls linearly from full to empty within SIM_BAT_DRAIN
seconds while the vehicle is armed, to no less than SIM_BAT_MIN_PCT, and is full again after disarming; the current is
not measured (-1 A). A real PX4 v1.14.3 showed 100 %, 16.2 V and -1 A on the ground, with its 60 s and 50 %.

``cell``: motors and avionics draw the charge; the voltage is that of the cells at this charge, minus the drop at the
internal resistance. A motor draws ``motor_power`` * speed^3 + ``idle_power``. The charge persists after disarming.

Currents of individual motors (SENSORS.esc_current) follow from the motor powers in both models.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.autopilot.autopilot import Autopilot
from xtdrone_control.autopilot.parameters.parameters import Parameters
from xtdrone_control.autopilot.state import FAILURE_OFF
from xtdrone_sim.physics.world import World
from xtdrone_sim.vehicles.vehicle_model import BatteryModel

_RPM = 60.0 / (2.0 * math.pi)
# open-circuit voltage of a lithium-polymer cell over its charge, V
_CHARGES = np.array([0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
_CELL_VOLTAGES = np.array([3.3, 3.55, 3.65, 3.72, 3.79, 3.87, 4.0, 4.18])
_NAMES = ("SIM_BAT_DRAIN", "SIM_BAT_MIN_PCT", "BAT1_N_CELLS", "BAT1_V_EMPTY", "BAT1_V_CHARGED", "BAT1_V_LOAD_DROP")
_TURNING = 10.0  # rad/s above which a motor counts as turning


class Batteries:
    """The batteries of all vehicles; writes ``battery_*`` and ``esc_*`` of the autopilot's ``sensors``."""

    def __init__(
        self, world: World, autopilot: Autopilot, models: Sequence[BatteryModel], parameters: Sequence[Parameters]
    ) -> None:
        """Start with full batteries.

        Args:
            world: provides the rotor speeds.
            autopilot: its ``sensors`` are written, its ``failures`` are read.
            models: one per vehicle.
            parameters: one per vehicle: SIM_BAT_*, BAT1_*.
        """
        self._parameters = parameters
        self._cells = np.array([m.cells for m in models])
        self._any_cells = bool(self._cells.any())
        self._capacity = np.array([m.capacity for m in models])
        self._resistance = np.array([m.resistance for m in models])
        self._motor_power = np.array([m.motor_power for m in models])[:, None]
        self._idle_power = np.array([m.idle_power for m in models])[:, None]
        self._avionics_power = np.array([m.avionics_power for m in models])
        self._charge = np.ones(len(models))  # 0..1
        self._voltage = np.zeros(len(models))
        self._last_us: int | None = None
        sensors, self._rotor_speed = autopilot.sensors, world.plant["rotor_speed"]
        self._failures, self._armed = autopilot.failures["battery"], autopilot.setpoint["armed"]
        self._shown_voltage, self._shown_current = sensors["battery_voltage"], sensors["battery_current"]
        self._rpm, self._motor_current = sensors["esc_rpm"], sensors["esc_current"]
        self._changes = -1  # of all vehicles' parameters
        self._read_parameters()
        self.update(autopilot.time_us)

    @property
    def charge(self) -> NDArray[np.float64]:
        """True charge of each battery, 0..1."""
        return self._charge

    def fit(self, index: int, model: BatteryModel) -> None:
        """Fit another vehicle at ``index`` with the full battery of its model; its parameters are those of now."""
        self._cells[index] = model.cells
        self._capacity[index], self._resistance[index] = model.capacity, model.resistance
        self._motor_power[index], self._idle_power[index] = model.motor_power, model.idle_power
        self._avionics_power[index] = model.avionics_power
        self._any_cells = bool(self._cells.any())
        self._changes = -1
        self._read_parameters()
        self.reset(index)

    def reset(self, index: int) -> None:
        """Replace the battery of vehicle ``index`` by a full one, and write its sensor values."""
        self._charge[index] = 1.0
        full = self._number * float(_CELL_VOLTAGES[-1]) if self._cells[index] else self._full_voltage
        self._shown_voltage[index] = self._voltage[index] = full[index]
        self._shown_current[index] = 0.0 if self._cells[index] else -1.0

    def update(self, time_us: int) -> None:
        """Advance to simulated time ``time_us`` (microseconds) and write the sensor values; called at 10 Hz."""
        elapsed = 0.0 if self._last_us is None else (time_us - self._last_us) * 1e-6
        self._last_us = time_us
        self._read_parameters()
        speed = self._rotor_speed
        power = np.where(speed > _TURNING, self._motor_power * speed**3 + self._idle_power, 0.0)
        charge, volts = self._drain(elapsed)
        current: NDArray[np.float64] | float = -1.0
        if self._any_cells:
            used, cell_volts, drawn = self._discharge(elapsed, power.sum(axis=1) + self._avionics_power)
            charge = np.where(self._cells, used, charge)
            volts = np.where(self._cells, cell_volts, volts)
            current = np.where(self._cells, drawn, -1.0)
        self._charge = charge
        self._voltage = np.where(self._failures == FAILURE_OFF, self._failed_voltage, volts)
        self._shown_voltage[:] = self._voltage
        self._shown_current[:] = current
        np.multiply(speed, _RPM, out=self._rpm)
        np.divide(power, np.maximum(self._voltage, 1.0)[:, None], out=self._motor_current)

    def _read_parameters(self) -> None:
        """Read the parameters again after a change."""
        changes = sum([p.changes for p in self._parameters])
        if changes != self._changes:
            self._changes = changes
            table = np.array([[p.get(name) for name in _NAMES] for p in self._parameters], float)
            drain, least, self._number, empty, full, load_drop = np.ascontiguousarray(table.T)
            self._drain_time, self._least_charge = np.maximum(drain, 1e-3), least / 100.0
            self._empty_voltage, self._full_voltage = self._number * empty, self._number * full
            self._failed_voltage = self._number * (empty - load_drop)

    def _drain(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Return charge (0..1) and voltage (V) of batteries of model ``drain``."""
        charge = np.where(self._armed != 0, self._charge - elapsed / self._drain_time, 1.0)
        charge = np.maximum(charge, self._least_charge)
        return charge, self._empty_voltage + charge * (self._full_voltage - self._empty_voltage)

    def _discharge(self, elapsed: float, power: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return charge (0..1), voltage (V) and current (A) of batteries of model ``cell``."""
        rest = self._number * np.interp(self._charge, _CHARGES, _CELL_VOLTAGES)
        # V I = P with V = rest - R I; the power is limited to the battery's maximum
        inside = np.maximum(rest**2 - 4.0 * self._resistance * power, 0.0)
        current = (rest - np.sqrt(inside)) / (2.0 * self._resistance)
        charge = np.maximum(self._charge - current * elapsed / (3600.0 * self._capacity), 0.0)
        return charge, rest - self._resistance * current, current
