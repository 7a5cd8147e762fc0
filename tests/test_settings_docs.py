"""docs/settings.md holds the tables that the settings classes generate; as a program, update the page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from xtdrone_common.settings import Settings
from xtdrone_control.communication.commands import CommandSettings
from xtdrone_coordination.follower_nodes import HostedCommunication, NeighbourSettings, TurnSettings
from xtdrone_coordination.network import NetworkOptions
from xtdrone_coordination.search.search_settings import MissionSettings
from xtdrone_interaction.bridges.foxglove.foxglove_node import FoxgloveSettings
from xtdrone_interaction.bridges.ros2.ros2_node import Ros2Settings
from xtdrone_interaction.bridges.rosbridge.rosbridge_node import RosbridgeSettings
from xtdrone_interaction.missions.crossing.state_machine import CrossingSettings
from xtdrone_interaction.missions.formation.director import DirectorSettings
from xtdrone_interaction.missions.landing.director import LandingSettings
from xtdrone_interaction.rviz.markers_node import MarkerSettings
from xtdrone_interaction.web.station_settings import StationSettings
from xtdrone_perception.detection.detector import DetectorSettings
from xtdrone_perception.detection.yolo_node import DetectionOptions, GroundOptions
from xtdrone_perception.following.human_tracking_node import TrackingOptions
from xtdrone_perception.following.person_following import FollowSettings
from xtdrone_perception.gimbal_node import GimbalOptions
from xtdrone_perception.localisation.relative_filter import FilterSettings
from xtdrone_perception.localisation.relative_node import RelativeOptions
from xtdrone_perception.slam.laser.laser_odometry import ScanMatchSettings
from xtdrone_perception.slam.laser.laser_odometry_node import LaserOdometryOptions
from xtdrone_perception.slam.lidar_odometry import RegistrationOptions
from xtdrone_perception.slam.lidar_odometry_node import LidarHealthLimits, LidarOdometryOptions
from xtdrone_perception.slam.loops.loop_closure import LoopOptions
from xtdrone_perception.slam.loops.loop_closure_node import LoopNodeOptions
from xtdrone_perception.slam.odometry_health import HealthLimits
from xtdrone_perception.slam.transfer.foreign_pose import PlaceSettings
from xtdrone_perception.slam.transfer.transfer_node import ForeignOptions
from xtdrone_perception.slam.visual.corner_tracks import TrackSettings
from xtdrone_perception.slam.visual.pose_from_points import NoiseSettings
from xtdrone_perception.slam.visual.visual_odometry import KeyframeSettings
from xtdrone_perception.slam.visual.visual_odometry_node import VisualHealthLimits, VisualOdometryOptions
from xtdrone_perception.tags.apriltag_node import AprilTagOptions
from xtdrone_perception.tags.tag_detector import TagDetectorSettings
from xtdrone_perception.tracking.geolocation import Noise, Person
from xtdrone_perception.tracking.tracker import TrackerSettings
from xtdrone_planning.exploration.settings import ExplorationSettings
from xtdrone_planning.mapping.map_feed import SensorChoice
from xtdrone_planning.mapping.range_images import DepthMapping, LidarMapping
from xtdrone_planning.mapping.sensor_watch import WatchSettings
from xtdrone_planning.mapping.voxel_grid import MapSettings
from xtdrone_planning.merging.settings import FitSettings, LinkSettings, MergingOptions
from xtdrone_planning.navigation.navigation_node import NavigationSettings
from xtdrone_planning.navigation.settings import CostmapSettings, NavigatorSettings, WindowSettings
from xtdrone_planning.navigation.vehicle_drives import DriveSettings
from xtdrone_planning.octree.octomap_node import OctomapOptions
from xtdrone_planning.octree.octree_map import OctreeSettings
from xtdrone_planning.planner_settings import AgreementSettings, PlannerSettings, TrajectorySettings
from xtdrone_planning.replanning.ego_transfer_node import TransferSettings
from xtdrone_planning.replanning.planner_node import TimingSettings
from xtdrone_planning.safety.velocity_filter import SafetySettings
from xtdrone_sim.air.body_drag import BodyDragSettings
from xtdrone_sim.air.dryden import DrydenSettings
from xtdrone_sim.air.rotor_wakes import DownwashSettings, GroundSettings
from xtdrone_sim.air.wind import RegionSettings
from xtdrone_sim.cameras.camera_node import CameraSettings
from xtdrone_sim.lidars.lidar_node import LidarSettings
from xtdrone_sim.runtime.full_simulation import FullSettings
from xtdrone_sim.runtime.simulator_node import NodeSettings
from xtdrone_sim.tf.vehicle_tf_node import TfSettings
from xtdrone_sim.topics.world_map import FloorPlanSettings
from xtdrone_sim.uwb.uwb_node import UwbSettings
from xtdrone_sim.vehicles.mounts.body_sensors import BodySensor, ImuMount, UwbMount
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount
from xtdrone_sim.video.video_node import VideoSettings
from xtdrone_swarm.simplified.simplified_node import SimplifiedSettings
from xtdrone_worlds.worlds.generated.city import CitySettings
from xtdrone_worlds.worlds.generated.forest import ForestSettings
from xtdrone_worlds.worlds.generated.indoor import IndoorSettings
from xtdrone_worlds.worlds.generated.maze import MazeSettings
from xtdrone_worlds.worlds.robots.robot_model import BodySettings, PlatformSettings
from xtdrone_worlds.worlds.robots.robot_settings import (
    AckermannLimits,
    BoatLimits,
    DifferentialLimits,
    DriveLimits,
    HullSettings,
    WaveSettings,
)
from xtdrone_worlds.worlds.scenery.countryside_layout import CountrysideSettings

PAGE = Path(__file__).parents[1] / "docs" / "settings.md"
CLASSES: dict[str, type[Settings]] = {
    cls.__name__: cls
    for cls in (
        NodeSettings,
        FullSettings,
        SimplifiedSettings,
        CommandSettings,
        HostedCommunication,
        TurnSettings,
        CameraSettings,
        VideoSettings,
        LidarSettings,
        LidarMount,
        UwbSettings,
        BodySensor,
        UwbMount,
        ImuMount,
        DrydenSettings,
        RegionSettings,
        GroundSettings,
        DownwashSettings,
        BodyDragSettings,
        ForestSettings,
        MazeSettings,
        IndoorSettings,
        CitySettings,
        CountrysideSettings,
        TfSettings,
        LidarOdometryOptions,
        RegistrationOptions,
        HealthLimits,
        LidarHealthLimits,
        VisualOdometryOptions,
        TrackSettings,
        NoiseSettings,
        KeyframeSettings,
        VisualHealthLimits,
        LaserOdometryOptions,
        ScanMatchSettings,
        LoopOptions,
        LoopNodeOptions,
        DriveLimits,
        DifferentialLimits,
        AckermannLimits,
        BodySettings,
        PlatformSettings,
        HullSettings,
        BoatLimits,
        WaveSettings,
        GimbalOptions,
        DetectionOptions,
        GroundOptions,
        DetectorSettings,
        TrackerSettings,
        Person,
        Noise,
        TrackingOptions,
        FollowSettings,
        MissionSettings,
        SafetySettings,
        NetworkOptions,
        AprilTagOptions,
        TagDetectorSettings,
        RelativeOptions,
        FilterSettings,
        NeighbourSettings,
        LandingSettings,
        DirectorSettings,
        CrossingSettings,
        PlannerSettings,
        TrajectorySettings,
        AgreementSettings,
        ExplorationSettings,
        NavigationSettings,
        DriveSettings,
        CostmapSettings,
        WindowSettings,
        NavigatorSettings,
        FloorPlanSettings,
        SensorChoice,
        LidarMapping,
        DepthMapping,
        WatchSettings,
        MapSettings,
        TimingSettings,
        TransferSettings,
        OctomapOptions,
        OctreeSettings,
        MergingOptions,
        LinkSettings,
        FitSettings,
        PlaceSettings,
        ForeignOptions,
        MarkerSettings,
        StationSettings,
        FoxgloveSettings,
        RosbridgeSettings,
        Ros2Settings,
    )
}


def updated(page: str) -> str:
    """Return the page with a current table below each comment that names a class."""
    page = re.sub(r"\n\|[^\n]*(?=\n)", "", page)
    page = re.sub(r"<!-- (\w+) -->\n+", lambda found: f"<!-- {found[1]} -->\n\n{table(found[1])}\n\n", page)
    return page.rstrip() + "\n"


def table(name: str) -> str:
    """Return the table of the settings that a class adds to those of its bases."""
    cls = CLASSES[name]
    return cls.table(vars(cls)["__annotations__"])


def test_the_page_is_current() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert updated(page) == page


@pytest.mark.parametrize("name", CLASSES)
def test_each_class_is_on_the_page(name: str) -> None:
    assert f"<!-- {name} -->" in PAGE.read_text(encoding="utf-8")


if __name__ == "__main__":
    PAGE.write_text(updated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
