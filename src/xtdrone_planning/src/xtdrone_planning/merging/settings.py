"""Settings of map merging, and the reason why a map is not merged."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_common.settings import Settings, setting
from xtdrone_planning.octree.octree_format import check_octree_file


class NotMergedError(Exception):
    """Two maps cannot be merged; the text gives the reason."""


@dataclass(frozen=True)
class LinkSettings(Settings):
    """Relative pose of two maps from relative estimates."""

    samples: int = setting(120, low=4, high=10_000, text="number of latest relative estimates of a pair that are used")
    least_samples: int = setting(10, low=2, high=10_000, text="minimum number of relative estimates")
    pose_noise: float = setting(
        0.1, low=1e-3, high=10.0, unit="m", text="standard deviation added to that of each relative estimate"
    )
    heading_deviation: float = setting(
        0.2, low=1e-3, high=100.0, unit="rad",
        text="standard deviation of the difference between the maps' headings by compass; 3 or more: no prior",
    )  # fmt: skip
    correlation: float = setting(
        5.0, low=0.0, high=600.0, unit="s", text="correlation time of the errors of relative estimates"
    )
    gate: float = setting(3.5, low=1.0, high=100.0, text="standard deviations beyond which an estimate is an outlier")
    least_inliers: float = setting(0.6, low=0.0, high=1.0, text="minimum fraction of inliers")
    worst_position: float = setting(
        1.0, above=0.0, high=100.0, unit="m", text="maximum standard deviation of a map's position, in any direction"
    )
    worst_heading: float = setting(
        0.25, above=0.0, high=3.2, unit="rad", text="maximum standard deviation of a map's heading"
    )


@dataclass(frozen=True)
class FitSettings(Settings):
    """Registration of two maps."""

    refine: str = setting(
        "required",
        choices=("required", "tried", "off"),
        text="registration: required; tried: relative estimates suffice where it fails; off: relative estimates only",
    )
    cell: float = setting(0.3, low=0.02, high=5.0, unit="m", text="cell size for downsampling before registration")
    reach: float = setting(0.6, low=0.05, high=20.0, unit="m", text="maximum distance of corresponding points")
    least_overlap: float = setting(
        0.15, low=0.0, high=1.0, text="minimum fraction of the smaller map's vertical surfaces that the other shares"
    )
    least_points: int = setting(100, low=10, high=1_000_000, text="minimum number of coinciding points")
    least_agreement: float = setting(
        0.6, low=0.0, high=1.0, text="minimum fraction of coinciding points among those within 4 times the reach"
    )
    most_residual: float = setting(
        0.2, above=0.0, high=10.0, unit="m", text="maximum RMS distance from the other map's surfaces"
    )
    weakest: float = setting(
        0.02, low=0.0, high=1.0, text="minimum ratio of the smallest to the largest information on the position"
    )
    most_tilt: float = setting(
        0.1, low=0.0, high=1.6, unit="rad", text="maximum tilt between two maps, whose z axes both point up"
    )
    contradiction: float = setting(
        4.0, low=1.0, high=100.0, text="maximum deviation of the fit from the relative estimates, standard deviations"
    )


@dataclass(frozen=True)
class MergingOptions(Settings):
    """Topics, frame and timing of the node."""

    cloud: str = setting("octomap_point_cloud_centers", text="topic of each vehicle's map, below its name")
    odometry: str = setting(
        "", text="odometry that defines the map's frame: lidar_odometry, slam, ...; empty: the autopilot's estimate"
    )
    frame_id: str = setting("map", text="frame of the merged map, which is that of the first vehicle's map")
    interval: float = setting(
        0.5, low=0.0, high=60.0, unit="s", text="minimum time between two relative estimates of a pair that are used"
    )
    period: float = setting(5.0, low=0.2, high=600.0, unit="s", text="time between two merged maps")
    latency: float = setting(
        1.0, low=0.0, high=60.0, unit="s", text="simulated time from the inputs to the merged map; less than the period"
    )
    voxel: float = setting(0.2, low=0.02, high=5.0, unit="m", text="cell size of the merged map; one point per cell")
    file: str = setting("", text="file of the merged map at the end, .bt or .ot: occupied voxels only; empty: none")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_octree_file(self.file)
