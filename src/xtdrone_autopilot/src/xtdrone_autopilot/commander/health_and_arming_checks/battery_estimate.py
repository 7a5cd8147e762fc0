"""Battery estimate from voltage and current, modelled on PX4 v1.14's ``lib/battery``."""

from __future__ import annotations

import math
from collections.abc import Callable

from xtdrone_autopilot.commander.failsafe import BATTERY_CRITICAL, BATTERY_EMERGENCY, BATTERY_LOW, BATTERY_OK

Get = Callable[[str], float]

UNKNOWN_CURRENT = -1.0  # A, PX4's value for an unmeasured current
_MIN_VOLTAGE = 2.1  # V; a lower voltage means no battery
_SETTLING_US = 2_000_000  # after connection
_VOLTAGE_WEIGHT = 3e-3  # weight of the voltage estimate in the counted charge per update, at an empty battery
_AVERAGE_TIME = 50.0  # s, time constant of the average current for the remaining time


class BatteryEstimate:
    """Battery state of one vehicle.

    Attributes:
        connected: whether a battery is connected.
        voltage: V.
        current: A, -1 if not measured.
        discharged: charge used since start, mAh; 0 if the current is not measured.
        remaining: remaining charge, 0..1.
        warning: BATTERY_OK, _LOW, _CRITICAL or _EMERGENCY.
        time_remaining: s, NaN if the capacity (BAT1_CAPACITY) is unknown.
    """

    def __init__(self, get: Get) -> None:
        """Start without a battery; ``get`` returns a parameter by name."""
        self._get = get
        self.connected = False
        self.voltage = 0.0
        self.current = UNKNOWN_CURRENT
        self.discharged = 0.0
        self.remaining = 1.0
        self.warning = BATTERY_OK
        self.time_remaining = math.nan
        self._since_us: int | None = None
        self._last_us: int | None = None
        self._average = get("BAT_AVRG_CURRENT")

    def update(self, now_us: int, voltage: float, current: float, thrust: float, armed: bool) -> None:
        """Process a measurement; call at about 10 Hz.

        Args:
            now_us: simulated time, microseconds.
            voltage: V; less than 2.1 means no battery.
            current: A; -1 if not measured.
            thrust: collective thrust, 0..1, for the load compensation of the voltage without a measured current.
            armed: whether the vehicle is armed.
        """
        self.voltage, self.current = voltage, current
        self.connected = voltage >= _MIN_VOLTAGE
        if not self.connected:
            self._since_us = None
            return
        if self._since_us is None:
            self._since_us = now_us
        elapsed = 0.0 if self._last_us is None else (now_us - self._last_us) * 1e-6
        self._last_us = now_us
        used = current * elapsed / 3.6 if current >= 0.0 else 0.0  # mAh
        self.discharged += used
        by_voltage = self._charge_by_voltage(thrust)
        capacity = self._get("BAT1_CAPACITY")
        self._update_charge(by_voltage, used, capacity, now_us)
        if now_us - self._since_us >= _SETTLING_US:
            self.warning = self._warning()
        self._update_time_remaining(elapsed, capacity, armed)

    def _charge_by_voltage(self, thrust: float) -> float:
        """Return the charge, 0..1, for the load-compensated cell voltage."""
        get = self._get
        cell = self.voltage / max(get("BAT1_N_CELLS"), 1)
        resistance = get("BAT1_R_INTERNAL")
        if resistance >= 0.0 and self.current > 0.0:
            cell += resistance * self.current
        else:
            cell += thrust * get("BAT1_V_LOAD_DROP")
        empty, full = get("BAT1_V_EMPTY"), get("BAT1_V_CHARGED")
        return min(max((cell - empty) / (full - empty), 0.0), 1.0) if full > empty else 0.0

    def _update_charge(self, by_voltage: float, used: float, capacity: float, now_us: int) -> None:
        assert self._since_us is not None
        if capacity <= 0.0 or now_us - self._since_us < _SETTLING_US:
            self.remaining = by_voltage
            return
        weight = _VOLTAGE_WEIGHT * (1.0 - by_voltage)
        charge = (1.0 - weight) * self.remaining + weight * by_voltage - used / capacity
        self.remaining = min(max(charge, 0.0), max(1.0 - self.discharged / capacity, 0.0))

    def _warning(self) -> int:
        get = self._get
        if self.remaining < get("BAT_EMERGEN_THR"):
            return BATTERY_EMERGENCY
        if self.remaining < get("BAT_CRIT_THR"):
            return BATTERY_CRITICAL
        return BATTERY_LOW if self.remaining < get("BAT_LOW_THR") else BATTERY_OK

    def _update_time_remaining(self, elapsed: float, capacity: float, armed: bool) -> None:
        if capacity <= 0.0:
            self.time_remaining = math.nan
            return
        if armed and self.current >= 0.0:
            self._average += (self.current - self._average) * min(elapsed / _AVERAGE_TIME, 1.0)
        self.time_remaining = self.remaining * capacity * 3.6 / max(self._average, 1e-3)
