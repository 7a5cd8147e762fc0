"""Vibration metrics of the inertial sensors, as in PX4's VIBRATION message and vehicle_imu_status."""

from __future__ import annotations

import math

from xtdrone_control.kernel import kernel

_KEEP = 0.99  # low-pass coefficient per sample, as in PX4's vehicle_imu


@kernel
def update_vibration(vibration, s, dt):
    """Update the low-passed metrics: coning, and the change per sample of body rates and of specific force.

    Coning is the norm of the cross product of two consecutive delta angles.

    Args:
        vibration: ``VIBRATION`` record.
        s: ``SENSORS`` record.
        dt: time between samples, s.
    """
    g, a, before_g, before_a = s.gyro, s.accel, vibration.last_gyro, vibration.last_accel
    coning = 0.0
    gyro = 0.0
    accel = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        coning += (g[j] * before_g[k] - g[k] * before_g[j]) ** 2
        gyro += (g[i] - before_g[i]) ** 2
        accel += (a[i] - before_a[i]) ** 2
    vibration.metrics[0] = _KEEP * vibration.metrics[0] + (1.0 - _KEEP) * math.sqrt(coning) * dt * dt
    vibration.metrics[1] = _KEEP * vibration.metrics[1] + (1.0 - _KEEP) * math.sqrt(gyro)
    vibration.metrics[2] = _KEEP * vibration.metrics[2] + (1.0 - _KEEP) * math.sqrt(accel)
    for i in range(3):
        before_g[i] = g[i]
        before_a[i] = a[i]
