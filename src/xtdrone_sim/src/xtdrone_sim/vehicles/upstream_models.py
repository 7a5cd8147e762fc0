"""XTDrone's models whose sensors are not simulated here: the reason why a name is unknown, or what it flies without."""

from __future__ import annotations

_STEREO = "stereo camera (stereo_camera/left, stereo_camera/right)"
_IMU = "separate IMU (imu_gazebo)"

FLOWN_WITHOUT = {
    "iris_stereo_camera": f"{_STEREO} and {_IMU}",
    "solo_stereo_camera": f"{_STEREO} and {_IMU}",
    "iris_2d_lidar": _IMU,
    "iris_3d_lidar": f"{_STEREO} and {_IMU}",
    "iris_3d_gpu_lidar": f"{_STEREO} and {_IMU}",
}
"""What is missing on models that fly: those that XTDrone's launch generator chooses for every iris and solo, and those
with lidars."""

_REASONS = {
    "iris_downward_camera": "its downward camera (camera/image_raw)",
    "iris_realsense_camera": "its depth camera (realsense/depth_camera)",
    "iris_realsense_livox": "its depth camera (realsense/depth_camera) and Livox lidar (scan)",
    "iris_zhihang": "its depth camera (realsense/depth_camera), stereo and downward cameras",
    "typhoon_h480_stereo": f"its {_STEREO}",
    "typhoon_h480_realsense": "its depth camera (realsense/depth_camera)",
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
