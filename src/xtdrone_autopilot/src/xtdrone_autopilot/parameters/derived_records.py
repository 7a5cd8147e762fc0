"""Records that are computed from many parameters: the correction of the sensors' samples, and the rotors' geometry.

After PX4 v1.14's sensor_calibration and ActuatorEffectivenessRotors. Each vehicle has one inertial sensor and one
magnetometer, with the device ids of PX4's simulation; as in PX4, the calibration in slot n belongs to the sensor whose
id is in CAL_<sensor>n_ID, and that of other sensors does not act. The simulated sensors are internal, which turn with
the board: CAL_<sensor>n_ROT has no effect.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_autopilot.state import MAX_ROTORS
from xtdrone_common.rotation import from_euler, rotate

IMU_DEVICE, MAG_DEVICE = 1310988, 197388  # of PX4's simulation
DEVICES = {"ACC": IMU_DEVICE, "GYRO": IMU_DEVICE, "MAG": MAG_DEVICE}
SLOTS = {"ACC": 3, "GYRO": 3, "MAG": 2}  # sensor instances of a SITL build with a calibration

Get = Callable[[str], float]

CORRECTION = np.dtype(
    [
        ("active", "i4"),  # 0: nothing to correct
        ("no_imu", "i4"),  # 1: the sensor is switched off
        ("no_mag", "i4"),
        ("no_baro", "i4"),
        ("no_gps", "i4"),
        ("gyro_offset", "f8", 3),  # rad/s, of the sensor
        ("accel_offset", "f8", 3),  # m/s^2
        ("accel_scale", "f8", 3),
        ("mag_offset", "f8", 3),  # gauss
        ("mag_scale", "f8", (3, 3)),
        ("rotation", "f8", (3, 3)),  # sensor to body
    ],
    align=True,
)

ROTORS = np.dtype(
    [
        ("changes", "i8"),  # number of times that the geometry has been written
        ("count", "i8"),  # 0: the vehicle's own geometry
        ("positions", "f8", (MAX_ROTORS, 3)),  # m, body FRD
        ("axes", "f8", (MAX_ROTORS, 3)),  # direction of the thrust, body FRD
        ("moment_ratios", "f8", MAX_ROTORS),  # m
        ("thrusts", "f8", MAX_ROTORS),  # thrust at full command, any unit
    ],
    align=True,
)

# PX4's rotations by number: roll, pitch and yaw, deg
_TURNS = (
    *((0, 0, yaw) for yaw in range(0, 360, 45)), *((180, 0, yaw) for yaw in range(0, 180, 45)), (0, 180, 0),
    *((180, 0, yaw) for yaw in (225, 270, 315)), *((roll, 0, yaw) for roll in (90, 270) for yaw in (0, 45, 90, 135)),
    (0, 90, 0), (0, 270, 0), (0, 180, 90), (0, 180, 270), (90, 90, 0), (180, 90, 0), (270, 90, 0), (90, 180, 0),
    (270, 180, 0), (90, 270, 0), (180, 270, 0), (270, 270, 0), (90, 180, 90), (90, 0, 270), (90, 68, 293),
    (0, 315, 0), (90, 315, 0),
)  # fmt: skip

_BOARD = ("SENS_BOARD_ROT", "SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF", "SENS_BOARD_Z_OFF")
_FITTED = {"no_mag": "SYS_HAS_MAG", "no_baro": "SYS_HAS_BARO", "no_gps": "SYS_HAS_GPS"}
_SYMMETRIC = (("XSCALE", "XODIAG", "YODIAG"), ("XODIAG", "YSCALE", "ZODIAG"), ("YODIAG", "ZODIAG", "ZSCALE"))
_CALIBRATED = {  # what each sensor's calibration has, besides ID and PRIO
    "ACC": ("XOFF", "YOFF", "ZOFF", "XSCALE", "YSCALE", "ZSCALE"),
    "GYRO": ("XOFF", "YOFF", "ZOFF"),
    "MAG": ("XOFF", "YOFF", "ZOFF", "XSCALE", "YSCALE", "ZSCALE", "XODIAG", "YODIAG", "ZODIAG"),
}
ROTOR_FIELDS = ("PX", "PY", "PZ", "AX", "AY", "AZ", "KM", "CT")


def _turn(degrees: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return the matrix of roll, pitch and yaw, degrees."""
    roll, pitch, yaw = np.radians(degrees)
    q = from_euler(roll, pitch, yaw)
    return np.column_stack([rotate(q, *axis) for axis in np.eye(3)])


def _slot_of(get: Get, sensor: str) -> int | None:
    """Return the first slot with the calibration of the vehicle's own sensor, or None."""
    found = (slot for slot in range(SLOTS[sensor]) if int(get(f"CAL_{sensor}{slot}_ID")) == DEVICES[sensor])
    return next(found, None)


def _write_correction(get: Get, record: Any) -> None:
    """Fill the ``CORRECTION`` record."""
    record["no_imu"] = 0
    record["accel_scale"], record["mag_scale"] = 1.0, np.eye(3)
    for field in ("gyro_offset", "accel_offset", "mag_offset"):
        record[field] = 0.0
    for field, name in _FITTED.items():
        record[field] = int(get(name)) == 0
    for sensor, field in (("ACC", "accel"), ("GYRO", "gyro"), ("MAG", "mag")):
        slot = _slot_of(get, sensor)
        if slot is None:
            continue
        prefix = f"CAL_{sensor}{slot}_"
        record[f"{field}_offset"] = [get(f"{prefix}{axis}OFF") for axis in "XYZ"]
        if sensor == "ACC":
            record["accel_scale"] = [get(f"{prefix}{axis}SCALE") for axis in "XYZ"]
        if sensor == "MAG":
            record["mag_scale"] = [[get(prefix + name) for name in row] for row in _SYMMETRIC]
        if int(get(f"{prefix}PRIO")) == 0:
            record["no_mag" if sensor == "MAG" else "no_imu"] = 1
    number = int(get("SENS_BOARD_ROT"))
    board = _TURNS[number] if 0 <= number < len(_TURNS) else _TURNS[0]
    x, y, z = (get(name) for name in _BOARD[1:])
    record["rotation"] = _turn((x, y, z)) @ _turn(board) if number or x or y or z else np.eye(3)
    record["active"] = _acts(record)


def _acts(record: Any) -> bool:
    still = np.array_equal(record["rotation"], np.eye(3)) and np.array_equal(record["mag_scale"], np.eye(3))
    plain = still and np.all(record["accel_scale"] == 1.0)
    off = any(record[field] for field in ("no_imu", "no_mag", "no_baro", "no_gps"))
    return bool(off or not plain or any(np.any(record[f"{name}_offset"]) for name in ("gyro", "accel", "mag")))


def _write_rotors(get: Get, record: Any) -> None:
    """Fill the ``ROTORS`` record."""
    record["changes"] += 1
    record["count"] = min(max(int(get("CA_ROTOR_COUNT")), 0), MAX_ROTORS)
    for rotor in range(MAX_ROTORS):
        px, py, pz, ax, ay, az, km, ct = (get(f"CA_ROTOR{rotor}_{field}") for field in ROTOR_FIELDS)
        record["positions"][rotor], record["axes"][rotor] = (px, py, pz), (ax, ay, az)
        record["moment_ratios"][rotor], record["thrusts"][rotor] = km, ct


def geometry_parameters(positions: NDArray[np.float64], moment_ratios: NDArray[np.float64]) -> dict[str, float]:
    """Return the parameters of a vehicle's rotors, as PX4's airframes set them.

    Args:
        positions: (n, 3) m, body FRD.
        moment_ratios: (n,) m, positive for counter-clockwise.
    """
    found: dict[str, float] = {"CA_ROTOR_COUNT": len(positions)}
    for rotor, (place, ratio) in enumerate(zip(positions, moment_ratios, strict=True)):
        values = (*map(float, place), float(ratio))
        found |= {
            f"CA_ROTOR{rotor}_{field}": value for field, value in zip(("PX", "PY", "PZ", "KM"), values, strict=True)
        }
    return found


DERIVED: tuple[tuple[str, np.dtype, Callable[[Get, Any], None], frozenset[str]], ...] = (
    (
        "correction",
        CORRECTION,
        _write_correction,
        frozenset(
            (
                *_BOARD,
                *_FITTED.values(),
                *(
                    f"CAL_{sensor}{slot}_{name}"
                    for sensor, names in _CALIBRATED.items()
                    for slot, name in itertools.product(range(SLOTS[sensor]), ("ID", "PRIO", *names))
                ),
            )
        ),
    ),
    (
        "rotors",
        ROTORS,
        _write_rotors,
        frozenset(
            ("CA_ROTOR_COUNT", *(f"CA_ROTOR{rotor}_{name}" for rotor in range(MAX_ROTORS) for name in ROTOR_FIELDS))
        ),
    ),
)
"""Field of ``PARAMS``, its type, the function that fills it, and the parameters that it reads."""
