"""The autopilot's parameters: names, types and defaults of PX4 v1.14.

Kernels read the ``PARAMS`` record, which has one float64 field per kernel parameter, with its name in lower case, and
the records of ``derived_records``. All other code reads ``Parameters``. ``tables/parameters.csv`` has all, with the
defaults of a PX4 v1.14.3 SITL build; ``effect`` is "kernel" for parameters that kernels read, "other" for those that
other code reads, and "none" for those that are only stored, for compatibility with scripts for a real PX4.

To change a default for all vehicles, change it there; for one vehicle type, set it in the section ``parameters:`` of
``xtdrone_worlds/config/vehicles/<type>.yaml``, which takes precedence. That file also has the physical values (mass,
rotors, sensors), which are not parameters of the autopilot.
"""

from __future__ import annotations

import logging
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from struct import pack
from typing import Any

import numpy as np

from xtdrone_autopilot.parameters import dependent_parameters, former_parameters, parameter_file
from xtdrone_autopilot.parameters.derived_records import DERIVED
from xtdrone_autopilot.tables.reader import Converter, number, one_of, read_table

INT32 = 6  # MAV_PARAM_TYPE_INT32
FLOAT = 9  # MAV_PARAM_TYPE_REAL32

_log = logging.getLogger(__name__)
_INT32_RANGE = (-(1 << 31), (1 << 31) - 1)
_FLOAT_MAX = 3.4028234663852886e38
_CRC_FLIP = 0xFFFFFFFF
_STORED_ONLY = "stored, without effect in this simulation"

FIXED = frozenset({"MAV_COMP_ID", "MAV_SYS_ID"})
"""Parameters set by the fleet, which cannot be changed, not even by a file."""
VOLATILE = frozenset({"COM_FLIGHT_UUID", "LND_FLIGHT_T_HI", "LND_FLIGHT_T_LO"})
"""Parameters that change by themselves, which the hash of all parameters leaves out."""


class ParameterError(ValueError):
    """A parameter that does not exist, or a value that its type cannot hold."""


@dataclass(frozen=True)
class Parameter:
    """Definition of a parameter.

    Attributes:
        name: PX4's name.
        effect: "kernel" if kernels read the parameter, "other" if other code does, "none" if it is only stored.
        type: ``INT32`` or ``FLOAT``, the numbers of MAV_PARAM_TYPE.
        default: PX4's default.
        minimum: minimum sensible value; a smaller one is stored with a warning, as in PX4.
        maximum: largest sensible value, likewise.
        unit: unit, empty for none.
        text: short description.
    """

    name: str
    effect: str
    type: int
    default: float
    minimum: float
    maximum: float
    unit: str
    text: str

    @property
    def has_effect(self) -> bool:
        """Whether the parameter is read, not only stored."""
        return self.effect != "none"


_COLUMNS: dict[str, Converter] = {
    "name": str,
    "effect": one_of("kernel", "other", "none"),
    "default": number,
    "minimum": lambda text: number(text) if text else -math.inf,
    "maximum": lambda text: number(text) if text else math.inf,
    "unit": str,
    "text": str,
}


def _read_parameters() -> dict[str, Parameter]:
    """Return every parameter by name, in the order of the file."""
    found = {}
    for name, effect, default, minimum, maximum, unit, text in read_table("parameters", _COLUMNS):
        kind = INT32 if isinstance(default, int) else FLOAT
        found[name] = Parameter(name, effect, kind, default, minimum, maximum, unit, text or _STORED_ONLY)
    return found


_TABLE = _read_parameters()
_FIELDS = {name: name.lower() for name, entry in _TABLE.items() if entry.effect == "kernel"}
_TABLE = dict(sorted(_TABLE.items()))  # as PX4 lists them

NAMES: tuple[str, ...] = tuple(_TABLE)  # sorted
INDEX: dict[str, int] = {name: index for index, name in enumerate(NAMES)}  # as PARAM_VALUE.param_index
PARAMS = np.dtype(
    [*((field, "f8") for field in _FIELDS.values()), *((field, kind) for field, kind, _, _ in DERIVED)], align=True
)
_WRITERS = {name: (field, write) for field, _, write, names in DERIVED for name in names}


def _unknown(name: str) -> ParameterError:
    return ParameterError(f"parameter {name!r} does not exist{former_parameters.hint(name)}")


def describe(name: str) -> Parameter:
    """Return the definition of the parameter ``name``.

    Raises:
        ParameterError: there is no such parameter.
    """
    entry = _TABLE.get(name)
    if entry is None:
        raise _unknown(name)
    return entry


def _convert(entry: Parameter, value: float) -> int | float:
    """Return ``value`` converted to the parameter's type.

    Raises:
        ParameterError: not finite, a fraction for an integer, or out of the type's range.
    """
    if not math.isfinite(value):
        raise ParameterError(f"{entry.name}: {value} is not a finite number")
    if entry.type == INT32:
        if value != int(value) or not _INT32_RANGE[0] <= value <= _INT32_RANGE[1]:
            raise ParameterError(f"{entry.name}: {value} is not a 32-bit integer")
        return int(value)
    if abs(value) > _FLOAT_MAX:
        raise ParameterError(f"{entry.name}: {value} is too large for a 32-bit float")
    return float(value)


class _Recent(dict[str, "int | float"]):
    """The values that have been read since the last change: few of the parameters, so that they stay in the cache."""

    def __init__(self, values: Mapping[str, int | float]) -> None:
        super().__init__()
        self._all = values

    def __missing__(self, name: str) -> int | float:
        value = self._all.get(name)
        if value is None:
            raise _unknown(name)
        self[name] = value
        return value


class Parameters:
    """The parameters of one vehicle.

    A value out of its sensible range is stored, with a warning, as PX4 does. A change may set other parameters, see
    ``dependent_parameters``.

    Attributes:
        get: returns the value of a parameter by name, int or float by its type; raises ParameterError for an unknown
            name.
        changes: number of value changes.
        on_change: callback of the logger for every value change, with name and new value; may be None.
        on_limit: callback for every parameter that has been lowered to the maximum set by another one.
    """

    def __init__(self, overrides: Mapping[str, float] | None = None, file: Path | None = None) -> None:
        """Initialise with the defaults, then load ``file``.

        Args:
            overrides: defaults of the airframe and the world that replace PX4's, by name.
            file: parameter file, loaded now and written by ``save``; None for none.

        Raises:
            ParameterError: an unknown name or a value that the parameter cannot hold, in ``overrides``.
        """
        self._record: Any = None
        self._file = file
        self.on_change: Callable[[str, int | float], None] | None = None
        self.on_limit: dependent_parameters.Notice = lambda _text, _event, _value: None
        self.changes = 0
        self._adjusted: set[str] = set()
        self._defaults = {name: entry.default for name, entry in _TABLE.items()}
        self._values: dict[str, int | float] = dict(self._defaults)
        self._recent = _Recent(self._values)
        self.get: Callable[[str], int | float] = self._recent.__getitem__
        for name, value in (overrides or {}).items():
            self._store(name, value)
        self._adjust()
        self._defaults = dict(self._values)
        self._adjusted.clear()
        self.load()

    def default(self, name: str) -> int | float:
        """Return the vehicle's default of a parameter: the airframe's if it has one, else PX4's.

        Raises:
            ParameterError: there is no such parameter.
        """
        value = self._defaults.get(name)
        if value is None:
            raise _unknown(name)
        return value

    def set(self, name: str, value: float, kind: int | None = None) -> int | float:
        """Store ``value``, adjust the parameters that depend on it, and return ``value`` in the parameter's type.

        Args:
            name: PX4's name.
            value: number; whole for an INT32 parameter.
            kind: type declared by the sender, ``INT32`` or ``FLOAT``; None to skip the check.

        Raises:
            ParameterError: an unknown name, a type other than ``kind``, or a value that the type cannot hold.
        """
        stored = self._store(name, value, kind)
        if name in dependent_parameters.NAMES:
            self._adjust()
        return stored

    def take_adjusted(self) -> list[str]:
        """Return the parameters that have been changed by changes of others since the last call, sorted."""
        names, self._adjusted = sorted(self._adjusted), set()
        return names

    def _adjust(self) -> None:
        before = {name: self._values[name] for name in dependent_parameters.NAMES}
        dependent_parameters.adjust(self.get, self._store, self.on_limit)
        self._adjusted.update(name for name, value in before.items() if self._values[name] != value)

    def _store(self, name: str, value: float, kind: int | None = None) -> int | float:
        """Store ``value`` in the parameter and in the attached record; see ``set``."""
        entry = describe(name)
        if kind is not None and kind != entry.type:
            raise ParameterError(f"{name}: type {kind} is not allowed, its MAV_PARAM_TYPE is {entry.type}")
        stored = _convert(entry, value)
        if not entry.minimum <= stored <= entry.maximum:
            _log.warning("%s: %s is outside %s..%s %s", name, stored, entry.minimum, entry.maximum, entry.unit)
        changed = stored != self._values[name]
        self._values[name] = stored
        self._recent.pop(name, None)
        if self._record is not None:
            self._write(name, stored)
        if changed:
            self.changes += 1
            if self.on_change is not None:
                self.on_change(name, stored)
        return stored

    def _write(self, name: str, stored: float) -> None:
        if name in _FIELDS:
            self._record[_FIELDS[name]] = stored
        elif name in _WRITERS:
            field, write = _WRITERS[name]
            write(self.get, self._record[field])

    def reset(self) -> None:
        """Reset all parameters to the vehicle's defaults."""
        for name, value in self._defaults.items():
            self._store(name, value)

    def load(self) -> None:
        """Load the file, and reset parameters that it does not contain; do nothing without a file.

        Rows with an unknown name, a wrong type or an invalid value are skipped with a warning.
        """
        if self._file is None:
            return
        self.reset()
        for name, value, kind in parameter_file.read_rows(self._file):
            if name in FIXED and value != self._values[name]:
                _log.warning("parameter file %s: %s = %s is skipped, as the fleet sets it", self._file, name, value)
                continue
            try:
                self._store(name, value, kind)
            except ParameterError as error:
                _log.warning("parameter file %s: skipped: %s", self._file, error)
        self._adjust()
        self._adjusted.clear()  # no client has asked: PX4 sends no values at boot or after a load

    def save(self) -> bool:
        """Write the values other than defaults to the file; return False on an error. Do nothing without a file."""
        if self._file is None:
            return True
        changed = [
            (name, value, _TABLE[name].type) for name, value in self._values.items() if value != self._defaults[name]
        ]
        try:
            system, component = int(self._values["MAV_SYS_ID"]), int(self._values["MAV_COMP_ID"])
            parameter_file.write_changed(self._file, changed, system, component)
        except OSError as error:
            _log.warning("parameters cannot be saved: %s: %s", self._file, error.strerror or error)
            return False
        return True

    def write_to(self, record: Any) -> None:
        """Attach ``record``, one element of a ``PARAMS`` array: write the kernel parameters now and at every change."""
        self._record = record
        for name, field in _FIELDS.items():
            record[field] = self._values[name]
        for field, _, write, _ in DERIVED:
            write(self.get, record[field])

    def hash(self) -> int:
        """Return PX4's CRC-32 over names and values, with which a ground station validates its cached list.

        Parameters that change by themselves are left out.
        """
        crc = 0
        for name in NAMES:
            if name in VOLATILE:
                continue
            value = self._values[name]
            data = name.encode() + pack("<i" if isinstance(value, int) else "<f", value)
            # PX4 starts from 0 and does not invert; zlib inverts before and after
            crc = zlib.crc32(data, crc ^ _CRC_FLIP) ^ _CRC_FLIP
        return crc
