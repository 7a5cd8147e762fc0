"""Control allocation: normalised torques and collective thrust to motor commands, for any fixed-rotor multicopter.

The mixing matrix is the pseudo-inverse of the rotor effectiveness, scaled as PX4 v1.14's ActuatorEffectivenessRotors
and ControlAllocationPseudoInverse scale it; saturation is resolved in PX4's order without air mode
(ControlAllocationSequentialDesaturation): thrust gives way to roll and pitch, yaw gives way to all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import MAX_ROTORS

_LEAST_SHARE = 0.1  # minimum hover thrust of a rotor, relative to the mean, that leaves room for torques


@dataclass(frozen=True)
class RotorLayout:
    """Rotors as the control allocation knows them.

    Attributes:
        positions: (n, 3) m, body FRD, relative to the centre of mass.
        moment_ratios: (n,) torque about the thrust's axis per thrust, m (CA_ROTORn_KM). As in PX4, positive for a rotor
            that turns counter-clockwise seen from above and whose reaction turns the body clockwise.
        axes: (n, 3) directions of the thrust, body FRD; None: all upwards.
        thrusts: (n,) thrust at full command, any unit; None: all the same.
    """

    positions: NDArray[np.float64]
    moment_ratios: NDArray[np.float64]
    axes: NDArray[np.float64] | None = None
    thrusts: NDArray[np.float64] | None = None


def effectiveness(layout: RotorLayout) -> NDArray[np.float64]:
    """Return the effectiveness of each rotor, shape (4, n) or more: roll, pitch and yaw torque, and upward thrust.

    Rows of horizontal thrust, which the rotors shall not give, follow if any rotor is tilted. A rotor without a
    direction has no effect.

    Raises:
        ValueError: fewer than 4 or more than ``MAX_ROTORS`` rotors, or the rotors cannot control all four axes.
    """
    count = len(layout.positions)
    if not 4 <= count <= MAX_ROTORS:
        raise ValueError(f"rotors: {count} is not allowed, 4 to {MAX_ROTORS}")
    axes = np.tile((0.0, 0.0, -1.0), (count, 1)) if layout.axes is None else layout.axes
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    axes = np.divide(axes, lengths, out=np.zeros_like(axes), where=lengths > 0.0)
    (px, py, pz), (ax, ay, az) = layout.positions.T, axes.T
    km = layout.moment_ratios
    torques = [py * az - pz * ay - km * ax, pz * ax - px * az - km * ay, px * ay - py * ax - km * az]
    matrix = np.stack([*torques, -az, *(row for row in (ax, ay) if np.any(row))])
    if layout.thrusts is not None and np.any(layout.thrusts):
        matrix = matrix * (layout.thrusts / np.max(layout.thrusts))
    if np.linalg.matrix_rank(matrix[:4]) < 4:
        raise ValueError("rotors: the arrangement cannot control all four axes")
    return matrix


def mixing_matrix(layout: RotorLayout, failed: int = 0) -> NDArray[np.float64]:
    """Return the mixer, shape (n, 4): columns roll, pitch, yaw torque and collective thrust to motor commands.

    Args:
        layout: see ``effectiveness``.
        failed: bit i is set for a failed rotor i. The others replace it if they can hover and control all four axes;
            otherwise yaw is not controlled.

    Raises:
        ValueError: see ``effectiveness``.
    """
    matrix = effectiveness(layout)
    count = len(layout.positions)
    works = np.flatnonzero([not failed >> i & 1 for i in range(count)])
    mix = np.zeros((count, 4))
    axes = np.array([0, 1, 2, 3] if _hovers(matrix[:4, works]) else [0, 1, 3])
    used = matrix[[*axes, *range(4, len(matrix))]][:, works]
    mix[np.ix_(works, axes)] = np.linalg.pinv(used)[:, : len(axes)]
    mix[:, 3] = np.maximum(mix[:, 3], 0.0)  # no rotor can produce downward thrust
    _scale(mix[works], mix)
    mix[np.abs(mix) < 1e-3] = 0.0
    return mix


def _hovers(matrix: NDArray[np.float64]) -> bool:
    """Return whether the rotors can hover and control all four axes, each with thrust to spare.

    A hexacopter with alternating rotor directions cannot after one failure: the opposite rotor hovers at zero thrust.
    """
    if np.linalg.matrix_rank(matrix) < 4:
        return False
    shares = np.linalg.pinv(matrix)[:, 3]
    return bool(shares.min() > _LEAST_SHARE * shares.mean())


def _scale(used: NDArray[np.float64], mix: NDArray[np.float64]) -> None:
    """Scale the columns of ``mix`` in place as PX4 does, by the rows ``used`` of working rotors."""
    roll_pitch = max(_rms_scale(used[:, 0]), _rms_scale(used[:, 1]))
    for axes, scale in (([0, 1], roll_pitch), ([2], np.max(np.abs(used[:, 2]))), ([3], np.mean(used[:, 3]))):
        if scale > 0.0:
            mix[:, axes] /= scale


def _rms_scale(column: NDArray[np.float64]) -> float:
    """Return PX4's norm of a roll or pitch column: sqrt(sum of squares / (half of the rotors that contribute))."""
    used = np.count_nonzero(np.abs(column) > 1e-3)
    return float(np.sqrt(np.sum(column**2) / (used / 2.0))) if used else 0.0


@kernel
def _gain_to_limits(u, direction, count, low, high):
    """Return the step along ``direction`` that balances the worst excess over ``high`` and under ``low``."""
    k_min, k_max = 0.0, 0.0
    for i in range(count):
        d = direction[i]
        if abs(d) < 1e-6:
            continue
        if u[i] < low:
            k = (low - u[i]) / d
        elif u[i] > high:
            k = (high - u[i]) / d
        else:
            continue
        k_min = min(k_min, k)
        k_max = max(k_max, k)
    return k_min + k_max


@kernel
def _desaturate(u, direction, count, low, high, only_decrease):
    """Move ``u`` along ``direction`` to reduce saturation, in a full and a half step, as in PX4."""
    k = _gain_to_limits(u, direction, count, low, high)
    if k == 0.0 or (only_decrease and k > 0.0):  # within the limits: most calls
        return
    for i in range(count):
        u[i] += k * direction[i]
    k = 0.5 * _gain_to_limits(u, direction, count, low, high)
    if only_decrease and k > 0.0:
        return
    for i in range(count):
        u[i] += k * direction[i]


@kernel
def _mix_yaw(u, c, mix, count):
    """Add yaw, reduced where it exceeds the upper limit by over 15 % as in PX4; then reduce the thrust."""
    for i in range(count):
        u[i] += mix[2, i] * c.sp_torque[2]
    _desaturate(u, mix[2], count, 0.0, 1.15, False)
    _desaturate(u, mix[3], count, 0.0, 1.0, True)


@kernel
def _note_unallocated(c, unmix, count):
    """Flag the torque axes whose setpoint was not reached, by the sign of the unallocated torque."""
    for axis in range(3):
        given = 0.0
        for i in range(count):
            given += unmix[axis, i] * c.actuators[i]
        missing = c.sp_torque[axis] - given
        c.saturation_pos[axis] = 1 if missing > 1e-6 else 0
        c.saturation_neg[axis] = 1 if missing < -1e-6 else 0


@kernel
def allocate(c, mix, unmix, count, airmode, method):
    """Update c.actuators (0..1) and the saturation flags from c.sp_torque and c.sp_thrust.

    Args:
        c: ``CONTROL`` record.
        mix: (4, MAX_ROTORS) transposed mixer, so that each axis is a contiguous row.
        unmix: (4, MAX_ROTORS) pseudo-inverse of the mixer: motor commands to torques and thrust.
        count: number of rotors.
        airmode: MC_AIRMODE: to reach the torques, thrust may 0 only fall, 1 rise for roll and pitch, 2 also for yaw.
        method: CA_METHOD: 0 clips the commands instead.
    """
    u = c.actuators
    for i in range(count):
        u[i] = mix[0, i] * c.sp_torque[0] + mix[1, i] * c.sp_torque[1] + mix[3, i] * c.sp_thrust
    if method == 0:
        for i in range(count):
            u[i] += mix[2, i] * c.sp_torque[2]
    elif airmode == 2:
        for i in range(count):
            u[i] += mix[2, i] * c.sp_torque[2]
        _desaturate(u, mix[3], count, 0.0, 1.0, False)
        _desaturate(u, mix[2], count, 0.0, 1.0, False)
    elif airmode == 1:
        _desaturate(u, mix[3], count, 0.0, 1.0, False)
        _mix_yaw(u, c, mix, count)
    else:
        _desaturate(u, mix[3], count, 0.0, 1.0, True)
        _desaturate(u, mix[0], count, 0.0, 1.0, False)
        _desaturate(u, mix[1], count, 0.0, 1.0, False)
        _mix_yaw(u, c, mix, count)
    for i in range(count):
        u[i] = min(max(u[i], 0.0), 1.0)
    _note_unallocated(c, unmix, count)


@kernel
def to_motor_commands(c, count, factor):
    """Convert thrusts in c.actuators to motor commands u: thrust = factor u^2 + (1 - factor) u (PX4 FunctionMotors)."""
    if factor <= 0.0 or factor > 1.0:
        return
    half = (1.0 - factor) / (2.0 * factor)
    for i in range(count):
        c.actuators[i] = math.sqrt(half * half + c.actuators[i] / factor) - half
