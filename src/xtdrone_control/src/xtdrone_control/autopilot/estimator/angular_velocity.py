"""Body rates and angular acceleration for the rate controller (PX4 sensors/vehicle_angular_velocity)."""

from __future__ import annotations

from xtdrone_control.autopilot.low_pass_filters import first_order_gain, second_order_gains
from xtdrone_control.kernel import kernel


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
