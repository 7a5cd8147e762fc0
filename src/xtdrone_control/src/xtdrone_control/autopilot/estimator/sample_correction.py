"""Correction of the sensors' samples by calibration and mounting, after PX4 v1.14's sensor_calibration."""

from __future__ import annotations

from xtdrone_control.kernel import kernel


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
