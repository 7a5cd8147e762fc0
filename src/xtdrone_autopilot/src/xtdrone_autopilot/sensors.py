"""Sensor samples before their use, after PX4 v1.14's module sensors.

Correction by calibration and mounting (sensor_calibration), body rates and angular acceleration for the rate controller
(vehicle_angular_velocity), vibration metrics (vehicle_imu), and PX4's low-pass filters (lib/mathlib, lib/controllib).
"""

from __future__ import annotations

import math

from xtdrone_autopilot.kernel import kernel


@kernel
def _turn(vector, matrix):
    """Multiply ``matrix`` by ``vector`` in place."""
    x, y, z = vector[0], vector[1], vector[2]
    for i in range(3):
        vector[i] = matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z


@kernel
def correct_samples(s, k):
    """Correct this step's samples in the ``SENSORS`` record ``s`` by the ``CORRECTION`` record ``k``.

    Sensors that are switched off give no samples.
    """
    if not k.active:
        return
    if k.no_imu:
        s.imu_missing = 1
    if k.no_mag:
        s.mag_fresh = 0
    if k.no_baro:
        s.baro_fresh = 0
    if k.no_gps:
        s.gps_fresh = 0
    if not s.imu_missing:
        for i in range(3):
            s.gyro[i] -= k.gyro_offset[i]
            s.accel[i] = (s.accel[i] - k.accel_offset[i]) * k.accel_scale[i]
        _turn(s.gyro, k.rotation)
        _turn(s.accel, k.rotation)
    if s.mag_fresh:
        for i in range(3):
            s.mag[i] -= k.mag_offset[i]
        _turn(s.mag, k.mag_scale)
        _turn(s.mag, k.rotation)


@kernel
def first_order_gain(cutoff_hz, dt):
    """Return the gain of a first-order low-pass (AlphaFilter, BlockLowPass); 1 (no filtering) for 0 Hz."""
    step = 2.0 * math.pi * cutoff_hz * dt
    return step / (1.0 + step) if cutoff_hz > 0.0 else 1.0


@kernel
def second_order_gains(cutoff_hz, dt):
    """Return b0, a1, a2 of a second-order Butterworth low-pass (LowPassFilter2p), where b1 = 2 b0 and b2 = b0.

    No filtering, (1, 0, 0), for 0 Hz or at least half of the sample rate.
    """
    if cutoff_hz <= 0.0 or 2.0 * cutoff_hz * dt >= 1.0:
        return 1.0, 0.0, 0.0
    w = math.tan(math.pi * cutoff_hz * dt)
    c = 1.0 + math.sqrt(2.0) * w + w * w
    return w * w / c, 2.0 * (w * w - 1.0) / c, (1.0 - math.sqrt(2.0) * w + w * w) / c


@kernel
def update_angular_velocity(e, s, p, dt):
    """Update e.rates (IMU_GYRO_CUTOFF) and their derivative (IMU_DGYRO_CUTOFF) by this step's gyro sample."""
    b0, a1, a2 = second_order_gains(p.imu_gyro_cutoff, dt)
    filtered = b0 < 1.0
    gain = first_order_gain(p.imu_dgyro_cutoff, dt)
    memory = e.rates_memory
    for i in range(3):
        before = e.rates[i]
        raw = s.gyro[i] - e.gyro_bias[i]
        rate = b0 * raw + memory[0, i]
        memory[0, i] = 2.0 * b0 * raw - a1 * rate + memory[1, i] if filtered else 0.0
        memory[1, i] = b0 * raw - a2 * rate if filtered else 0.0
        e.rates[i] = rate
        e.angular_acceleration[i] += gain * ((rate - before) / dt - e.angular_acceleration[i])


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
