"""Settings of map merging, and the reason why a map is not merged."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_control.settings import Settings, setting


class NotMergedError(Exception):
    """Two maps are not merged; the text is the reason."""


@dataclass(frozen=True)
class LinkSettings(Settings):
    """Relative pose of two maps from relative estimates."""

    samples: int = setting(120, low=4, high=10_000, text="latest relative estimates of a pair that count")
    least_samples: int = setting(10, low=2, high=10_000, text="minimum number of them")
    pose_noise: float = setting(
        0.1, low=1e-3, high=10.0, unit="m", text="standard deviation added to that of each relative estimate"
    )
    heading_deviation: float = setting(
        0.2,
        low=1e-3,
        high=100.0,
        unit="rad",
        text="standard deviation of the difference of the maps' headings, by compass; from 3 on headings are free",
    )
    correlation: float = setting(
        5.0, low=0.0, high=600.0, unit="s", text="time for which errors of relative estimates last"
    )
    gate: float = setting(3.5, low=1.0, high=100.0, text="standard deviations from which on an estimate is an outlier")
    least_inliers: float = setting(0.6, low=0.0, high=1.0, text="minimum share of estimates that are no outliers")
    worst_position: float = setting(
        1.0, above=0.0, high=100.0, unit="m", text="largest standard deviation of a map's place, in any direction"
    )
    worst_heading: float = setting(
        0.25, above=0.0, high=3.2, unit="rad", text="largest standard deviation of a map's heading"
    )


@dataclass(frozen=True)
class FitSettings(Settings):
    """Registration of two maps."""

    refine: str = setting(
        "required",
        choices=("required", "tried", "off"),
        text="maps have to fit: required; relative estimates alone are enough where they do not: tried; always: off",
    )
    cell: float = setting(
        0.3, low=0.02, high=5.0, unit="m", text="side of the cells in which points are averaged for the registration"
    )
    reach: float = setting(0.6, low=0.05, high=20.0, unit="m", text="maximum distance of corresponding points")
    least_overlap: float = setting(
        0.15, low=0.0, high=1.0, text="minimum share of the smaller map's upright surfaces that meet those of the other"
    )
    least_points: int = setting(100, low=10, high=1_000_000, text="minimum number of points that do")
    least_agreement: float = setting(
        0.6, low=0.0, high=1.0, text="minimum share of them among the points that lie within 4 times the reach"
    )
    most_residual: float = setting(
        0.2, above=0.0, high=10.0, unit="m", text="maximum root mean square distance from the other map's surfaces"
    )
    weakest: float = setting(
        0.02, low=0.0, high=1.0, text="minimum ratio of the least to the largest information on the place"
    )
    most_tilt: float = setting(
        0.1, low=0.0, high=1.6, unit="rad", text="maximum tilt between two maps, whose z axes both are up"
    )
    contradiction: float = setting(
        4.0, low=1.0, high=100.0, text="standard deviations by which the fit may be off the relative estimates"
    )


@dataclass(frozen=True)
class MergingOptions(Settings):
    """What the node subscribes to and publishes."""

    cloud: str = setting("octomap_point_cloud_centers", text="topic of each vehicle's map, below its name")
    odometry: str = setting(
        "",
        text="odometry in whose frame the map is: lidar_odometry, slam, ...; empty: the autopilot's estimate",
    )
    frame_id: str = setting("map", text="frame of the merged map: that of the first vehicle's map")
    interval: float = setting(
        0.5, low=0.0, high=60.0, unit="s", text="minimum time between two relative estimates of a pair that count"
    )
    period: float = setting(5.0, low=0.2, high=600.0, unit="s", text="time between two merged maps")
    latency: float = setting(
        1.0, low=0.0, high=60.0, unit="s", text="simulated time that merging takes; less than the period"
    )
    voxel: float = setting(0.2, low=0.02, high=5.0, unit="m", text="side of the cells of the merged map, a point each")
