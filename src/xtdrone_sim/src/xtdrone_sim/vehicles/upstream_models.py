"""XTDrone's models whose sensors are not simulated here: the reason why a name is unknown, or what it flies without."""

from __future__ import annotations

_IMU = "separate IMU (imu_gazebo)"

FLOWN_WITHOUT = {
    "iris_stereo_camera": _IMU,
    "solo_stereo_camera": _IMU,
    "iris_2d_lidar": _IMU,
    "iris_3d_lidar": _IMU,
    "iris_3d_gpu_lidar": _IMU,
    "iris_downward_camera": _IMU,
    "iris_realsense_camera": _IMU,
    "iris_realsense_livox": _IMU,
    "iris_zhihang": _IMU,
    "typhoon_h480_realsense": _IMU,
}
"""What is missing on models that fly."""

_REASONS = {
    "rover": "a ground vehicle",
    "rover_with_lidar_stereo": "a ground vehicle with lidar and stereo cameras",
    "catvehicle": "a ground vehicle",
    "plane": "a fixed-wing aircraft",
    "plane_gimbal": "a fixed-wing aircraft",
    "standard_vtol": "a VTOL aircraft",
    "tiltrotor": "a VTOL aircraft",
    "tailsitter": "a VTOL aircraft",
}


def not_simulated(name: str) -> str:
    """Return what keeps XTDrone's model ``name`` from flying, as a clause; "" for any other name."""
    return f"{_REASONS[name]} is not simulated" if name in _REASONS else ""
