"""Settings of the safety filter."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_control.settings import Settings, setting


@dataclass(frozen=True)
class SafetySettings(Settings):
    """Distances, limits and sources of the safety filter.

    The defaults of ``lag`` and ``deceleration`` are those of a vehicle with PX4's default gains, whose horizontal
    velocity follows its setpoint with a time constant of 0.55 s, delayed by one tick of the filter and one of the
    simulator.
    """

    distance: float = setting(
        1.5, low=0.3, high=20.0, unit="m", text="minimum distance between the centres of two vehicles"
    )
    obstacle_distance: float = setting(
        1.0, low=0.2, high=20.0, unit="m", text="minimum distance from the vehicle's centre to a point of an obstacle"
    )
    deceleration: float = setting(
        1.5, low=0.2, high=10.0, unit="m/s^2", text="deceleration that every vehicle can achieve"
    )
    lag: float = setting(1.0, low=0.1, high=5.0, unit="s", text="delay before a vehicle begins to brake")
    max_speed: float = setting(5.0, low=0.2, high=20.0, unit="m/s", text="maximum speed of a corrected setpoint")
    kp: float = setting(
        0.95, low=0.05, high=5.0, unit="1/s", text="speed per position error of a position setpoint (MPC_XY_P)"
    )
    tracking: float = setting(
        0.5, low=0.0, high=5.0, unit="m",
        text="deviation from its trajectory on /VEHICLE/planner/trajectory up to which a vehicle follows it; 0: "
        "trajectories are ignored",
    )  # fmt: skip
    range: float = setting(20.0, low=1.0, high=200.0, unit="m", text="range of vehicles and obstacles that count")
    timeout: float = setting(
        0.5, low=0.05, high=10.0, unit="s", text="age beyond which a position or a cloud is reported as outdated"
    )
    cloud: str = setting(
        "",
        text="topic of a PointCloud2 with obstacles, below the vehicle's name, e.g. ``velodyne_points``; empty: none",
    )
    mount: tuple[float, float, float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), low=-10.0, high=10.0,
        text="pose of the cloud's frame in the body frame (FLU): x, y, z, roll, pitch, yaw, m and rad",
    )  # fmt: skip
