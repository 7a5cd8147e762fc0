"""Vehicle models: YAML files and their URDFs as validated values and as records for the kernels.

A vehicle type is a file ``TYPE.yaml`` in a folder listed in the environment variable ``XTDRONE_VEHICLES``, or in the
package's ``config/vehicles``. The YAML defines its dynamics, the URDF its shape and the positions of its sensors.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import Any

import numpy as np

from xtdrone_autopilot.control.control_allocator import RotorLayout
from xtdrone_autopilot.state import MAX_ROTORS
from xtdrone_sim.vehicles.mounts.body_sensors import ImuMount, UwbMount, read_imus, read_uwb
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import (
    CameraMount,
    GimbalMount,
    MountError,
    read_cameras,
    read_gimbal,
    read_landing_gear,
)
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount, read_lidars
from xtdrone_worlds.data_files import data_folders
from xtdrone_worlds.descriptions import ModelError, find, folders, read_description
from xtdrone_worlds.shapes.visual import Box, Collision, Visual
from xtdrone_worlds.worlds.urdf import Description, Joint, Link, UrdfError, read_urdf

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
        ("gps_lead", "f8"),  # s, time by which a fix is newer than the estimator assumes
        ("gps_wander_time", "f8"),
        ("gps_satellites", "i8"),
        ("gps_hdop", "f8"),
        ("gps_vdop", "f8"),
        ("flow_fitted", "i8"),  # 1: sensor fitted
        ("flow_noise", "f8"),  # rad/s
        ("flow_gyro_noise", "f8"),  # rad/s
        ("flow_least", "f8"),  # m, minimum of the range in which the ground's texture is visible
        ("flow_largest", "f8"),
        ("range_fitted", "i8"),
        ("range_noise", "f8"),  # m
        ("range_least", "f8"),
        ("range_largest", "f8"),
    ],
    align=True,
)

URDF = "urdf"  # as mass or inertia: use the values of the URDF's links
_MOST_OFFSET = 0.01  # m, maximum distance of the centre of mass from the body's origin
_MOST_PRODUCT = 0.05  # maximum product of inertia, as a fraction of the smallest moment

# sensors that a vehicle may lack: section, prefix of the record's fields
_OPTIONAL_SENSORS = (("optical_flow", "flow"), ("range_finder", "range"))
_BATTERY_KINDS = ("drain", "cell")
_FIELDS = (
    *("extends", "urdf", "mass", "inertia", "collision_box", "linear_drag", "rotor_model", "rotors"),
    *("control_allocation", "sensors", "cameras", "gimbal", "lidars", "imus", "uwb", "landing_gear", "battery"),
    *("parameters", "simplified"),
)
_SENSORS = {"imu": "", "magnetometer": "mag_", "barometer": "baro_", "gps": "gps_"}
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


@dataclass(frozen=True)
class BatteryModel:
    """Battery and power consumption of a vehicle.

    Attributes:
        cells: whether charge and voltage are computed from the currents; otherwise the battery drains by SIM_BAT_DRAIN.
        capacity: capacity, Ah.
        resistance: internal resistance of the whole battery, ohm.
        motor_power: power of a motor over the cube of its speed, W s^3/rad^3.
        idle_power: additional power of a turning motor, W.
        avionics_power: constant power, W.
    """

    cells: bool = False
    capacity: float = 5.0
    resistance: float = 0.015
    motor_power: float = 1.5e-7
    idle_power: float = 3.0
    avionics_power: float = 5.0


@dataclass(frozen=True)
class VehicleModel:
    """One vehicle type.

    Attributes:
        name: type name, e.g. ``iris``.
        record: ``MODEL`` record.
        parameters: PX4 parameters that this airframe sets.
        assumed_layout: rotor positions assumed by the autopilot; None: the true ones.
        battery: battery and power consumption.
        urdf: links and joints; the root is the body, with the centre of mass at its origin, x ahead, z up.
        cameras: mounted cameras.
        lidars: mounted lidars.
        imus: additional IMUs.
        uwb: sensors of ranges to other vehicles.
        gimbal: mounted gimbal; None without one.
        landing_gear: joints, at 0 on the ground and at their upper limits in flight.
    """

    name: str
    record: np.void
    parameters: dict[str, float]
    battery: BatteryModel
    urdf: Description
    assumed_layout: RotorLayout | None = None
    cameras: tuple[CameraMount, ...] = ()
    gimbal: GimbalMount | None = None
    landing_gear: tuple[Joint, ...] = ()
    lidars: tuple[LidarMount, ...] = ()
    imus: tuple[ImuMount, ...] = ()
    uwb: tuple[UwbMount, ...] = ()

    @property
    def rotor_layout(self) -> RotorLayout:
        """Rotor positions and moment ratios for the autopilot's control allocator (body FRD)."""
        if self.assumed_layout is not None:
            return self.assumed_layout
        count = int(self.record["rotor_count"])
        frd = self.record["rotor_position"][:count] * np.array([1.0, -1.0, -1.0])
        return RotorLayout(frd, self.record["rotor_direction"][:count] * self.record["moment_constant"])


def load_vehicle(name: str) -> VehicleModel:
    """Return the vehicle type ``name``.

    Args:
        name: a type, or a YAML file.

    Raises:
        ModelError: unknown type, or a field that is missing, not a number or not positive.
    """
    description = read_description("vehicles", name)
    record = np.zeros(1, MODEL)[0]
    try:
        _check_fields("vehicle", description, _FIELDS)
        urdf = _description(description, find("vehicles", name).parent)
        _fill_body(record, description, urdf)
        _fill_rotors(record, description)
        _fill_sensors(record, description["sensors"])
        assumed = _assumed_layout(record, description.get("control_allocation"))
        cameras = read_cameras(description.get("cameras"), urdf)
        lidars = read_lidars(description.get("lidars"), urdf, find("vehicles", name).parent)
        imus = read_imus(description.get("imus"))
        uwb = read_uwb(description.get("uwb"))
        _check_topics({"lidars": lidars, "imus": imus, "uwb": uwb})
        gimbal = read_gimbal(description.get("gimbal"), urdf)
        gear = read_landing_gear(description.get("landing_gear"), urdf)
        parameters = {str(key): float(value) for key, value in description.get("parameters", {}).items()}
        battery = _battery(description.get("battery", {}))
    except ModelError:
        raise
    except (MountError, UrdfError) as error:
        raise ModelError(f"vehicle {name!r}: {error}") from error
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
        words = str(error)[:200]
        raise ModelError(f"vehicle {name!r}: field {words} is missing or of the wrong kind") from error
    bad = [field for field in MODEL.names or () if not np.isfinite(record[field]).all()]
    if bad:
        raise ModelError(f"vehicle {name!r}: {bad[0]}: {record[bad[0]]} is not allowed, finite numbers")
    return VehicleModel(
        Path(name).stem, record, parameters, battery, urdf, assumed, cameras, gimbal, gear, lidars, imus, uwb
    )


def _check_fields(place: str, given: Mapping[str, Any], known: Sequence[str]) -> None:
    """Check that no field of a mapping is unknown.

    Raises:
        ModelError: one is.
    """
    for field in given:
        if field not in known:
            raise ModelError(f"{place}: field {str(field)[:60]!r} is not known; there are {', '.join(known)}")


def _check_topics(sensors: Mapping[str, Sequence[LidarMount | ImuMount | UwbMount]]) -> None:
    """Check that no name, and therefore no topic, occurs in two lists of sensors.

    Raises:
        MountError: a name occurs twice.
    """
    first: dict[str, str] = {}
    for kind, mounts in sensors.items():
        for mount in mounts:
            if first.setdefault(mount.name, kind) != kind:
                raise MountError(f"{kind}: name {mount.name!r} is not allowed, an entry of {first[mount.name]} has it")


def _description(description: dict[str, Any], folder: Path) -> Description:
    """Return the URDF of a vehicle; without one, its visual shape is the collision box.

    Args:
        description: the vehicle's YAML.
        folder: folder of the YAML; the URDF is searched there, then in ``XTDRONE_VEHICLES``, then in ``models``.

    Raises:
        ModelError: the URDF does not exist.
        UrdfError: the URDF is invalid.
    """
    name = description.get("urdf")
    if name is None:
        size = description.get("collision_box") or (1.0, 1.0, 1.0)  # an invalid box is rejected with the body
        box = Box((float(size[0]), float(size[1]), float(size[2])))
        return Description("vehicle", (Link("base_link", (Visual(box),), (Collision(box),)),))
    places = list(dict.fromkeys([folder, *folders("vehicles"), *data_folders("models")]))
    for place in places:
        path = place / str(name)
        if os.path.isfile(path):  # false for a name that the file system rejects, too
            return read_urdf(path)
    raise ModelError(f"urdf: {str(name)!r} does not exist; searched in {', '.join(map(str, places))}")


def _battery(description: dict[str, Any]) -> BatteryModel:
    fields = dict(description)
    kind = fields.pop("model", "drain")
    if kind not in _BATTERY_KINDS:
        raise ModelError(f"battery model {kind!r} is not allowed, {' or '.join(_BATTERY_KINDS)}")
    allowed = [field.name for field in dataclass_fields(BatteryModel) if field.name != "cells"]
    _check_fields("battery", fields, allowed)
    values = {name: _positive(fields, name) for name in fields}
    return BatteryModel(cells=kind == "cell", **values)


def _positive(description: dict[str, Any], field: str) -> float:
    value = float(description[field])
    if not value > 0.0 or not np.isfinite(value):
        raise ModelError(f"{field}: {value} is not allowed, it must be positive")
    return value


def _fill_body(record: np.void, description: dict[str, Any], urdf: Description) -> None:
    record["mass"] = _weigh(urdf)[0] if description["mass"] == URDF else _positive(description, "mass")
    inertia = _weigh(urdf)[1] if description["inertia"] == URDF else description["inertia"]
    for field, source, given in (
        ("inertia", "inertia", inertia),
        ("box", "collision_box", description["collision_box"]),
    ):
        values = np.asarray(given, float)
        if values.shape != (3,) or not np.all(values > 0.0):
            raise ModelError(f"{source}: {given} is not allowed, three positive numbers")
        record[field] = values
    record["radius"] = 0.5 * float(np.linalg.norm(record["box"]))
    drag = float(description.get("linear_drag", 0.0))
    if not (np.isfinite(drag) and drag >= 0.0):
        raise ModelError(f"linear_drag: {drag} is not allowed, a number of at least 0")
    record["linear_drag"] = drag


def _weigh(urdf: Description) -> tuple[float, list[float]]:
    """Return mass, kg, and principal inertia, kg m^2, of the URDF's links.

    Raises:
        ModelError: the total mass is 0, or the centre of mass and the principal axes are not the origin and the axes of
            the body, as the plant assumes.
    """
    mass, centre, inertia = urdf.mass()
    if mass <= 0.0:
        raise ModelError(f"mass: {URDF} is not allowed, no link of the URDF has an <inertial>")
    if np.abs(centre).max() > _MOST_OFFSET:
        where = " ".join(f"{part:.4f}" for part in centre)
        raise ModelError(
            f"mass: {URDF}: the centre of mass at {where} m is not allowed, within {_MOST_OFFSET} of {urdf.root}"
        )
    products = np.abs(inertia - np.diag(np.diag(inertia))).max()
    if products > _MOST_PRODUCT * np.diag(inertia).min():
        raise ModelError(
            f"inertia: {URDF}: products of inertia of {products:.2g} kg m^2 are too large, at most "
            f"{_MOST_PRODUCT:g} of the minimum moment {np.diag(inertia).min():.2g}"
        )
    return mass, np.diag(inertia).tolist()


def _fill_rotors(record: np.void, description: dict[str, Any]) -> None:
    _check_fields("rotor_model", description["rotor_model"], _ROTOR_FIELDS)
    for field in _ROTOR_FIELDS:
        record[field] = float(description["rotor_model"][field])
    for field in ("thrust_constant", "time_constant_up", "time_constant_down", "max_speed", "input_scaling"):
        _positive(description["rotor_model"], field)
    rotors = description["rotors"]
    if not 4 <= len(rotors) <= MAX_ROTORS:
        raise ModelError(f"rotors: {len(rotors)} is not allowed, 4 to {MAX_ROTORS}")
    record["rotor_count"] = len(rotors)
    for i, rotor in enumerate(rotors):
        _check_fields(f"rotor {i}", rotor, ("position", "direction"))
        if rotor["direction"] not in _DIRECTIONS:
            raise ModelError(f"rotor {i}: direction {rotor['direction']!r} is not allowed, ccw or cw")
        record["rotor_position"][i] = rotor["position"]
        record["rotor_direction"][i] = _DIRECTIONS[rotor["direction"]]


def _assumed_layout(record: np.void, description: dict[str, Any] | None) -> RotorLayout | None:
    """Return the layout of ``control_allocation``: ``positions`` (x, y per rotor, m, FLU) and ``moment_ratio`` (m).

    Raises:
        ModelError: the number of positions is not the number of rotors.
    """
    if description is None:
        return None
    _check_fields("control_allocation", description, ("positions", "moment_ratio"))
    count = int(record["rotor_count"])
    positions = np.asarray(description["positions"], float)
    if positions.shape != (count, 2):
        raise ModelError(f"control_allocation: positions of shape {positions.shape} are not allowed, ({count}, 2)")
    frd = np.column_stack([positions[:, 0], -positions[:, 1], np.zeros(count)])
    return RotorLayout(frd, record["rotor_direction"][:count] * _positive(description, "moment_ratio"))


def _fill_sensors(record: np.void, sensors: dict[str, Any]) -> None:
    _check_fields("sensors", sensors, (*_SENSORS, *(section for section, _ in _OPTIONAL_SENSORS)))
    for section, prefix in _SENSORS.items():
        _fill_sensor(record, section, prefix, sensors[section])
    for section, name in _OPTIONAL_SENSORS:
        given = sensors.get(section) or {}
        _fill_sensor(record, section, f"{name}_", given)
        record[f"{name}_fitted"] = bool(given)


def _fill_sensor(record: np.void, section: str, prefix: str, given: Mapping[str, Any]) -> None:
    names = [name for name in MODEL.names or () if name.startswith(prefix or ("gyro_", "accel_"))]
    _check_fields(f"sensors: {section}", given, [name.removeprefix(prefix) for name in names if "_fitted" not in name])
    for field, value in given.items():
        record[f"{prefix}{field}"] = float(value)
