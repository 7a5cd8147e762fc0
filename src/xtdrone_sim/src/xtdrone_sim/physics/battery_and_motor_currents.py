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

from xtdrone_autopilot.autopilot import Autopilot
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_autopilot.state import FAILURE_OFF, MAX_ROTORS
from xtdrone_sim.kernel import kernel
from xtdrone_sim.physics.world import World
from xtdrone_sim.vehicles.vehicle_model import BatteryModel

_RPM = 60.0 / (2.0 * math.pi)
# open-circuit voltage of a lithium-polymer cell over its charge, V
_CHARGES = np.array([0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
_CELL_VOLTAGES = np.array([3.3, 3.55, 3.65, 3.72, 3.79, 3.87, 4.0, 4.18])
_NAMES = ("SIM_BAT_DRAIN", "SIM_BAT_MIN_PCT", "BAT1_N_CELLS", "BAT1_V_EMPTY", "BAT1_V_CHARGED", "BAT1_V_LOAD_DROP")
_TURNING = 10.0  # rad/s above which a motor counts as turning

BATTERY = np.dtype(
    [
        # the vehicle's model, see ``BatteryModel``
        ("cells", "i4"),
        ("capacity", "f8"),
        ("resistance", "f8"),
        ("motor_power", "f8"),
        ("idle_power", "f8"),
        ("avionics_power", "f8"),
        # the vehicle's parameters
        ("drain_time", "f8"),  # s
        ("least_charge", "f8"),  # 0..1
        ("number", "f8"),  # of cells
        ("empty_voltage", "f8"),  # V, of the battery, as below
        ("full_voltage", "f8"),
        ("failed_voltage", "f8"),
        # state
        ("charge", "f8"),  # 0..1
        ("voltage", "f8"),  # V
        ("current", "f8"),  # A; -1: not measured
        ("power", "f8", MAX_ROTORS),  # W, of each motor
    ],
    align=True,
)
_MODEL_FIELDS = ("cells", "capacity", "resistance", "motor_power", "idle_power", "avionics_power")


@kernel
def _drain(batteries, speeds, cubes, armed, elapsed):
    """Update the motors' power, and charge and voltage of batteries of model ``drain``.

    Args:
        batteries: (n,) ``BATTERY``.
        speeds: (n, MAX_ROTORS) rad/s.
        cubes: (n, MAX_ROTORS) their third power.
        armed: (n,) non-zero when motors run.
        elapsed: s since the last call.
    """
    for i in range(batteries.shape[0]):
        b = batteries[i]
        for k in range(MAX_ROTORS):
            b.power[k] = b.motor_power * cubes[i, k] + b.idle_power if speeds[i, k] > _TURNING else 0.0
        if b.cells:
            continue
        b.charge = max(b.charge - elapsed / b.drain_time if armed[i] else 1.0, b.least_charge)
        b.voltage = b.empty_voltage + b.charge * (b.full_voltage - b.empty_voltage)
        b.current = -1.0


@kernel
def _report(batteries, speeds, failures, sensors):
    """Write the batteries' and motor controllers' values to ``sensors`` (n,), with failures of batteries."""
    for i in range(batteries.shape[0]):
        b, s = batteries[i], sensors[i]
        if failures[i] == FAILURE_OFF:
            b.voltage = b.failed_voltage
        s.battery_voltage = b.voltage
        s.battery_current = b.current
        for k in range(MAX_ROTORS):
            s.esc_rpm[k] = speeds[i, k] * _RPM
            s.esc_current[k] = b.power[k] / max(b.voltage, 1.0)


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
        self._records = np.zeros(len(models), BATTERY)
        self._records["charge"] = 1.0
        self._any_cells = False
        for index, model in enumerate(models):
            self._set_model(index, model)
        self._last_us: int | None = None
        self._sensors, self._speeds = autopilot.sensors, world.plant["rotor_speed"]
        self._failures, self._armed = autopilot.failures["battery"], autopilot.setpoint["armed"]
        self._changes = -1  # of all vehicles' parameters
        self._read_parameters()
        self.update(autopilot.time_us)

    def _set_model(self, index: int, model: BatteryModel) -> None:
        for name in _MODEL_FIELDS:
            self._records[name][index] = getattr(model, name)
        self._any_cells = bool(self._records["cells"].any())

    @property
    def charge(self) -> NDArray[np.float64]:
        """True charge of each battery, 0..1."""
        charge: NDArray[np.float64] = self._records["charge"]
        return charge

    def fit(self, index: int, model: BatteryModel) -> None:
        """Give the new vehicle at ``index`` the full battery of its model; its current parameters apply."""
        self._set_model(index, model)
        self._changes = -1
        self._read_parameters()
        self.reset(index)

    def reset(self, index: int) -> None:
        """Replace the battery of vehicle ``index`` with a full one, and write its sensor values."""
        battery, sensors = self._records[index], self._sensors[index]
        battery["charge"] = 1.0
        full = battery["number"] * _CELL_VOLTAGES[-1] if battery["cells"] else battery["full_voltage"]
        sensors["battery_voltage"] = battery["voltage"] = full
        sensors["battery_current"] = 0.0 if battery["cells"] else -1.0

    def update(self, time_us: int) -> None:
        """Advance to simulated time ``time_us`` (microseconds) and write the sensor values; called at 10 Hz."""
        elapsed = 0.0 if self._last_us is None else (time_us - self._last_us) * 1e-6
        self._last_us = time_us
        self._read_parameters()
        cubes = self._speeds**3  # a kernel's third power differs from numpy's in the last bit
        _drain(self._records, self._speeds, cubes, self._armed, elapsed)
        if self._any_cells:
            self._discharge(elapsed)
        _report(self._records, self._speeds, self._failures, self._sensors)

    def _read_parameters(self) -> None:
        """Read the parameters again after a change."""
        changes = sum([p.changes for p in self._parameters])
        if changes == self._changes:
            return
        self._changes = changes
        table = np.array([[p.get(name) for name in _NAMES] for p in self._parameters], float)
        drain, least, number, empty, full, load_drop = table.T
        records = self._records
        records["drain_time"], records["least_charge"] = np.maximum(drain, 1e-3), least / 100.0
        records["number"], records["failed_voltage"] = number, number * (empty - load_drop)
        records["empty_voltage"], records["full_voltage"] = number * empty, number * full

    def _discharge(self, elapsed: float) -> None:
        """Update charge, voltage and current of batteries of model ``cell``."""
        batteries = self._records[self._records["cells"] != 0]
        power = np.ascontiguousarray(batteries["power"]).sum(axis=1) + batteries["avionics_power"]
        rest = batteries["number"] * np.interp(batteries["charge"], _CHARGES, _CELL_VOLTAGES)
        resistance = batteries["resistance"]
        # V I = P with V = rest - R I; the power is limited to the battery's maximum
        inside = np.maximum(rest**2 - 4.0 * resistance * power, 0.0)
        current = (rest - np.sqrt(inside)) / (2.0 * resistance)
        used = current * elapsed / (3600.0 * batteries["capacity"])
        batteries["charge"] = np.maximum(batteries["charge"] - used, 0.0)
        batteries["voltage"] = rest - resistance * current
        batteries["current"] = current
        self._records[self._records["cells"] != 0] = batteries
