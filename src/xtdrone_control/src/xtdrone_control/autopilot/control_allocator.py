"""Control allocation: normalised torques and collective thrust to motor commands, for any fixed-rotor multicopter.

The mixing matrix is the pseudo-inverse of the rotor effectiveness, scaled as PX4 v1.14's ActuatorEffectivenessRotors
and ControlAllocationPseudoInverse scale it; saturation is resolved in PX4's order without air mode
(ControlAllocationSequentialDesaturation): thrust gives way to roll and pitch, yaw gives way to all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .kernel import kernel
from .state import MAX_ROTORS


def mixing_matrix(positions: NDArray[np.float64], moment_ratios: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mixer, shape (n, 4): columns roll, pitch, yaw torque and collective thrust to motor commands.

    Args:
        positions: (n, 3) rotor places, body FRD, m, relative to the centre of mass.
        moment_ratios: (n,) torque about body z per thrust, m (CA_ROTORn_KM): positive for counter-clockwise rotors
            seen from above, whose reaction turns the body clockwise, PX4's sign.

    Raises:
        ValueError: fewer than 4 or more than ``MAX_ROTORS`` rotors, or rotors that cannot control all four axes.
    """
    count = len(positions)
    if not 4 <= count <= MAX_ROTORS:
        raise ValueError(f"rotors: {count} is not allowed, 4 to {MAX_ROTORS}")
    # thrust along -z: torque = r x (0, 0, -1) + km (0, 0, 1)
    effectiveness = np.stack([-positions[:, 1], positions[:, 0], moment_ratios, -np.ones(count)])
    if np.linalg.matrix_rank(effectiveness) < 4:
        raise ValueError("rotors: the arrangement leaves an axis without control")
    mix = np.linalg.pinv(effectiveness)
    mix[:, 3] = -mix[:, 3]  # collective thrust counts upwards here
    roll_pitch_scale = max(_rms_scale(mix[:, 0]), _rms_scale(mix[:, 1]))
    mix[:, :2] /= roll_pitch_scale
    mix[:, 2] /= np.max(np.abs(mix[:, 2]))
    mix[:, 3] /= np.mean(mix[:, 3])
    mix[np.abs(mix) < 1e-3] = 0.0
    return mix


def _rms_scale(column: NDArray[np.float64]) -> float:
    """Return PX4's norm of a roll or pitch column: sqrt(sum of squares over half of the rotors that take part)."""
    used = np.count_nonzero(np.abs(column) > 1e-3)
    return float(np.sqrt(np.sum(column**2) / (used / 2.0)))


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
    """Move ``u`` along ``direction`` until limits are met as well as can be (two passes, the second by halves)."""
    k = _gain_to_limits(u, direction, count, low, high)
    if only_decrease and k > 0.0:
        return
    for i in range(count):
        u[i] += k * direction[i]
    k = 0.5 * _gain_to_limits(u, direction, count, low, high)
    if only_decrease and k > 0.0:
        return
    for i in range(count):
        u[i] += k * direction[i]


@kernel
def allocate(c, mix, count):
    """Fill c.actuators (0..1) from c.sp_torque and c.sp_thrust, and the saturation flags of the torque axes.

    Args:
        c: ``CONTROL`` record.
        mix: (4, MAX_ROTORS) transposed mixer, so that each axis is a contiguous row.
        count: number of rotors.
    """
    u = c.actuators
    for i in range(count):
        u[i] = mix[0, i] * c.sp_torque[0] + mix[1, i] * c.sp_torque[1] + mix[3, i] * c.sp_thrust
    _desaturate(u, mix[3], count, 0.0, 1.0, True)
    _desaturate(u, mix[0], count, 0.0, 1.0, False)
    _desaturate(u, mix[1], count, 0.0, 1.0, False)
    for i in range(count):
        u[i] += mix[2, i] * c.sp_torque[2]
    # yaw may use a little more than the range before it is cut (15 % in PX4), then thrust gives way
    _desaturate(u, mix[2], count, 0.0, 1.15, False)
    _desaturate(u, mix[3], count, 0.0, 1.0, True)
    for axis in range(3):
        c.saturation_pos[axis] = 0
        c.saturation_neg[axis] = 0
    for i in range(count):
        if 0.0 < u[i] < 1.0:
            continue
        at_top = u[i] >= 1.0
        u[i] = 1.0 if at_top else 0.0
        for axis in range(3):
            m = mix[axis, i]
            if abs(m) < 1e-6:
                continue
            if (m > 0.0) == at_top:
                c.saturation_pos[axis] = 1
            else:
                c.saturation_neg[axis] = 1
