"""How much the inertial sensors shake: PX4's metrics, as VIBRATION and vehicle_imu_status have them."""

from __future__ import annotations

import math

from xtdrone_control.kernel import kernel

_KEEP = 0.99  # of a metric from one sample to the next, as in PX4's vehicle_imu


@kernel
def update_vibration(e, s, dt):
    """Filter three lengths: of delta angle x the delta angle before, of the changes of rates and of specific force.

    Args:
        e: ESTIMATOR record; ``vibration*`` are written.
        s: SENSORS record.
        dt: s between samples.
    """
    g, a, before_g, before_a = s.gyro, s.accel, e.vibration_gyro, e.vibration_accel
    coning = 0.0
    gyro = 0.0
    accel = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        coning += (g[j] * before_g[k] - g[k] * before_g[j]) ** 2
        gyro += (g[i] - before_g[i]) ** 2
        accel += (a[i] - before_a[i]) ** 2
    e.vibration[0] = _KEEP * e.vibration[0] + (1.0 - _KEEP) * math.sqrt(coning) * dt * dt
    e.vibration[1] = _KEEP * e.vibration[1] + (1.0 - _KEEP) * math.sqrt(gyro)
    e.vibration[2] = _KEEP * e.vibration[2] + (1.0 - _KEEP) * math.sqrt(accel)
    for i in range(3):
        before_g[i] = g[i]
        before_a[i] = a[i]
