"""Vehicle models: the YAML files of ``config/vehicles`` as checked values and as records for the kernels."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from xtdrone_control.autopilot.autopilot import RotorLayout
from xtdrone_control.autopilot.state import MAX_ROTORS

from .battery import BatteryModel


def _config_folder() -> Path:
    """Return the package's ``config``: beside the sources, or where an installed package has it."""
    source = Path(__file__).resolve().parents[2] / "config"
    if source.is_dir():
        return source
    import rospkg  # only an installed package needs it

    return Path(rospkg.RosPack().get_path("xtdrone_sim")) / "config"


CONFIG = _config_folder()

MODEL = np.dtype(
    [
        ("mass", "f8"),  # kg
        ("inertia", "f8", 3),  # kg m^2, principal, body
        ("box", "f8", 3),  # m, collision box
        ("radius", "f8"),  # m, sphere around the box
        ("rotor_count", "i8"),
        ("rotor_position", "f8", (MAX_ROTORS, 3)),  # m, FLU
        ("rotor_direction", "f8", MAX_ROTORS),  # +1 counter-clockwise seen from above, -1 clockwise
        ("thrust_constant", "f8"),
        ("moment_constant", "f8"),
        ("time_constant_up", "f8"),
        ("time_constant_down", "f8"),
        ("max_speed", "f8"),
        ("input_scaling", "f8"),
        ("idle_speed", "f8"),
        ("drag_coefficient", "f8"),
        ("rolling_moment_coefficient", "f8"),
        ("linear_drag", "f8"),  # N s/m, of the body
        # sensors; densities per sqrt(Hz)
        ("gyro_noise_density", "f8"),
        ("gyro_random_walk", "f8"),
        ("gyro_turn_on_bias", "f8"),
        ("accel_noise_density", "f8"),
        ("accel_random_walk", "f8"),
        ("accel_turn_on_bias", "f8"),
        ("mag_noise", "f8"),
        ("mag_bias", "f8"),
        ("baro_noise", "f8"),
        ("baro_drift", "f8"),
        ("gps_horizontal_noise", "f8"),
        ("gps_vertical_noise", "f8"),
        ("gps_velocity_noise", "f8"),
        ("gps_wander", "f8"),
        ("gps_lead", "f8"),  # s, by which a fix is newer than the estimator takes it for
        ("gps_wander_time", "f8"),
        ("gps_satellites", "i8"),
        ("gps_hdop", "f8"),
        ("gps_vdop", "f8"),
        ("flow_fitted", "i8"),  # 1: it has such a sensor
        ("flow_noise", "f8"),  # rad/s
        ("flow_gyro_noise", "f8"),  # rad/s
        ("flow_least", "f8"),  # m, range within which it sees the ground's texture
        ("flow_largest", "f8"),
        ("range_fitted", "i8"),
        ("range_noise", "f8"),  # m
        ("range_least", "f8"),
        ("range_largest", "f8"),
    ],
    align=True,
)

# sensors that a vehicle may lack: section, prefix of the record's fields
_OPTIONAL_SENSORS = (("optical_flow", "flow"), ("range_finder", "range"))
_BATTERY_KINDS = ("drain", "cell")
_DIRECTIONS = {"ccw": 1.0, "cw": -1.0}
_ROTOR_FIELDS = (
    "thrust_constant",
    "moment_constant",
    "time_constant_up",
    "time_constant_down",
    "max_speed",
    "input_scaling",
    "idle_speed",
    "drag_coefficient",
    "rolling_moment_coefficient",
)


class ModelError(ValueError):
    """A vehicle or world description that cannot be used."""


@dataclass(frozen=True)
class VehicleModel:
    """One vehicle type.

    Attributes:
        name: type name, as ``iris``.
        record: ``MODEL`` record.
        parameters: PX4 parameters that this airframe sets.
        assumed_layout: what the autopilot takes the rotors' places for; None where it knows them.
        battery: its battery.
    """

    name: str
    record: np.void
    parameters: dict[str, float]
    battery: BatteryModel
    assumed_layout: RotorLayout | None = None

    @property
    def rotor_layout(self) -> RotorLayout:
        """Rotor places and moment ratios as the autopilot's allocator takes them (body FRD)."""
        if self.assumed_layout is not None:
            return self.assumed_layout
        count = int(self.record["rotor_count"])
        frd = self.record["rotor_position"][:count] * np.array([1.0, -1.0, -1.0])
        return RotorLayout(frd, self.record["rotor_direction"][:count] * self.record["moment_constant"])


def available(folder: str) -> list[str]:
    """Return the names that ``config/<folder>`` offers (vehicles, worlds)."""
    return sorted(path.stem for path in (CONFIG / folder).glob("*.yaml"))


def read_description(folder: str, name: str) -> dict[str, Any]:
    """Return the YAML of ``config/<folder>/<name>.yaml``, or of the file ``name`` if it is a path.

    ``extends: NAME`` in it takes everything from another description and says only what differs.

    Raises:
        ModelError: no such description, or not a YAML mapping.
    """
    is_path = name.endswith((".yaml", ".yml"))
    path = Path(name) if is_path else CONFIG / folder / f"{name}.yaml"
    if not is_path and not path.is_file():
        raise ModelError(f"{folder}: {name!r} is not known; there are {', '.join(available(folder))}")
    try:
        description = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        names = ", ".join(available(folder))
        raise ModelError(f"{folder}: {path}: {error.strerror or error}; by name there are {names}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ModelError(f"{path}: not a YAML file: {error}") from error
    if not isinstance(description, dict):
        raise ModelError(f"{path}: a mapping is needed, got {type(description).__name__}")
    base = description.pop("extends", None)
    return description if base is None else _merged(read_description(folder, str(base)), description)


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the values of ``changes``; mappings are merged in turn."""
    merged = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merged(base[key], value) if both else value
    return merged


def load_vehicle(name: str) -> VehicleModel:
    """Return the vehicle type ``name``.

    Raises:
        ModelError: unknown type, or a field that is missing, not a number or not positive.
    """
    description = read_description("vehicles", name)
    record = np.zeros(1, MODEL)[0]
    try:
        _fill_body(record, description)
        _fill_rotors(record, description)
        _fill_sensors(record, description["sensors"])
        assumed = _assumed_layout(record, description.get("control_allocation"))
    except (KeyError, TypeError) as error:
        raise ModelError(f"vehicle {name!r}: field {error} is missing or of the wrong kind") from error
    parameters = {str(key): float(value) for key, value in description.get("parameters", {}).items()}
    return VehicleModel(Path(name).stem, record, parameters, _battery(description.get("battery", {})), assumed)


def _battery(description: dict[str, Any]) -> BatteryModel:
    fields = dict(description)
    kind = fields.pop("model", "drain")
    if kind not in _BATTERY_KINDS:
        raise ModelError(f"battery model {kind!r} is not allowed, {' or '.join(_BATTERY_KINDS)}")
    allowed = [field.name for field in dataclass_fields(BatteryModel) if field.name != "cells"]
    for name in fields:
        if name not in allowed:
            raise ModelError(f"battery: field {name!r} is not known; there are {', '.join(allowed)}")
    values = {name: _positive(fields, name) for name in fields}
    return BatteryModel(cells=kind == "cell", **values)


def _positive(description: dict[str, Any], field: str) -> float:
    value = float(description[field])
    if not value > 0.0 or not np.isfinite(value):
        raise ModelError(f"{field}: {value} is not allowed, it must be positive")
    return value


def _fill_body(record: np.void, description: dict[str, Any]) -> None:
    record["mass"] = _positive(description, "mass")
    for field, source in (("inertia", "inertia"), ("box", "collision_box")):
        values = np.asarray(description[source], float)
        if values.shape != (3,) or not np.all(values > 0.0):
            raise ModelError(f"{source}: {description[source]} is not allowed, three positive numbers")
        record[field] = values
    record["radius"] = 0.5 * float(np.linalg.norm(record["box"]))
    drag = float(description.get("linear_drag", 0.0))
    if not (np.isfinite(drag) and drag >= 0.0):
        raise ModelError(f"linear_drag: {drag} is not allowed, a number of at least 0")
    record["linear_drag"] = drag


def _fill_rotors(record: np.void, description: dict[str, Any]) -> None:
    for field in _ROTOR_FIELDS:
        record[field] = float(description["rotor_model"][field])
    for field in ("thrust_constant", "time_constant_up", "time_constant_down", "max_speed", "input_scaling"):
        _positive(description["rotor_model"], field)
    rotors = description["rotors"]
    if not 4 <= len(rotors) <= MAX_ROTORS:
        raise ModelError(f"rotors: {len(rotors)} is not allowed, 4 to {MAX_ROTORS}")
    record["rotor_count"] = len(rotors)
    for i, rotor in enumerate(rotors):
        if rotor["direction"] not in _DIRECTIONS:
            raise ModelError(f"rotor {i}: direction {rotor['direction']!r} is not allowed, ccw or cw")
        record["rotor_position"][i] = rotor["position"]
        record["rotor_direction"][i] = _DIRECTIONS[rotor["direction"]]


def _assumed_layout(record: np.void, description: dict[str, Any] | None) -> RotorLayout | None:
    """Return the layout of ``control_allocation``: ``positions`` (x, y a rotor, m, FLU) and ``moment_ratio`` (m).

    Raises:
        ModelError: not one position a rotor.
    """
    if description is None:
        return None
    count = int(record["rotor_count"])
    positions = np.asarray(description["positions"], float)
    if positions.shape != (count, 2):
        raise ModelError(f"control_allocation: positions of shape {positions.shape} are not allowed, ({count}, 2)")
    frd = np.column_stack([positions[:, 0], -positions[:, 1], np.zeros(count)])
    return RotorLayout(frd, record["rotor_direction"][:count] * _positive(description, "moment_ratio"))


def _fill_sensors(record: np.void, sensors: dict[str, Any]) -> None:
    for field, value in sensors["imu"].items():
        record[field] = float(value)
    for prefix, sensor in (("mag", "magnetometer"), ("baro", "barometer"), ("gps", "gps")):
        for field, value in sensors[sensor].items():
            record[f"{prefix}_{field}"] = value
    for section, prefix in _OPTIONAL_SENSORS:
        for field, value in (sensors.get(section) or {}).items():
            record[f"{prefix}_{field}"] = float(value)
            record[f"{prefix}_fitted"] = 1
