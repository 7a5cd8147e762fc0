"""Voltages of a battery's cells."""

from __future__ import annotations

from typing import Any

_NO_CELL = 65535
_CONTINUED = 65534  # the next field's voltage is added


def cell_voltages(battery: Any) -> list[float]:
    """Return the voltages (V) of a BATTERY_STATUS as MAVROS reads them (sys_status.cpp, handle_battery_status).

    Fields after the first unused one are ignored. A cell of 0 V counts in ``voltages``, where 65535 marks an unused
    field, but not in ``voltages_ext``, where MAVLink 2 cuts zeros off. A cell above 65.534 V continues in the next
    field.
    """
    cells: list[float] = []
    carried = 0.0
    for fields, ends in ((battery.voltages, (_NO_CELL,)), (battery.voltages_ext, (_NO_CELL, 0))):
        for millivolts in fields:
            if millivolts in ends:
                break
            carried += millivolts / 1000.0
            if millivolts != _CONTINUED:
                cells.append(carried)
                carried = 0.0
    return cells
