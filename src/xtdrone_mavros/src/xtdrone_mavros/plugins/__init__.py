"""One module for each MAVROS plugin. Add new ones to ``PLUGINS``; its order is the order of the subscriptions."""

from __future__ import annotations

from xtdrone_mavros.extras.cam_imu_sync import CamImuSyncPlugin
from xtdrone_mavros.extras.camera import CameraPlugin
from xtdrone_mavros.extras.debug_value import DebugValuePlugin
from xtdrone_mavros.extras.distance_sensor import DistanceSensorPlugin
from xtdrone_mavros.extras.esc_status import EscStatusPlugin
from xtdrone_mavros.extras.fake_gps import FakeGpsPlugin
from xtdrone_mavros.extras.gps_rtk import GpsRtkPlugin
from xtdrone_mavros.extras.landing_target import LandingTargetPlugin
from xtdrone_mavros.extras.log_transfer import LogTransferPlugin
from xtdrone_mavros.extras.mocap_pose_estimate import MocapPlugin
from xtdrone_mavros.extras.mount_control import MountControlPlugin
from xtdrone_mavros.extras.obstacle_distance import ObstacleDistancePlugin
from xtdrone_mavros.extras.odom import OdometryPlugin
from xtdrone_mavros.extras.px4flow import Px4FlowPlugin
from xtdrone_mavros.extras.relayed import PASSED_ON
from xtdrone_mavros.extras.trajectory import TrajectoryPlugin
from xtdrone_mavros.extras.vision_pose_estimate import VisionPosePlugin
from xtdrone_mavros.extras.vision_speed_estimate import VisionSpeedPlugin
from xtdrone_mavros.plugins.actuator_control import ActuatorControlPlugin
from xtdrone_mavros.plugins.altitude import AltitudePlugin
from xtdrone_mavros.plugins.command import CommandPlugin
from xtdrone_mavros.plugins.diagnostics import DiagnosticsPlugin
from xtdrone_mavros.plugins.ftp import FtpPlugin
from xtdrone_mavros.plugins.global_position import GlobalPositionPlugin
from xtdrone_mavros.plugins.home_position import HomePositionPlugin
from xtdrone_mavros.plugins.imu import ImuPlugin
from xtdrone_mavros.plugins.local_position import LocalPositionPlugin
from xtdrone_mavros.plugins.manual_control import ManualControlPlugin
from xtdrone_mavros.plugins.mavlink_bridge import MavlinkBridge
from xtdrone_mavros.plugins.param import ParamPlugin
from xtdrone_mavros.plugins.rc_io import RcIoPlugin
from xtdrone_mavros.plugins.setpoint_accel import SetpointAccelPlugin
from xtdrone_mavros.plugins.setpoint_attitude import SetpointAttitudePlugin
from xtdrone_mavros.plugins.setpoint_position import SetpointPositionPlugin
from xtdrone_mavros.plugins.setpoint_raw import SetpointRawPlugin
from xtdrone_mavros.plugins.setpoint_trajectory import SetpointTrajectoryPlugin
from xtdrone_mavros.plugins.setpoint_velocity import SetpointVelocityPlugin
from xtdrone_mavros.plugins.shared_origin import SharedOriginPlugin
from xtdrone_mavros.plugins.sys_status import SysStatusPlugin
from xtdrone_mavros.plugins.sys_time import SysTimePlugin
from xtdrone_mavros.plugins.vfr_hud import VfrHudPlugin
from xtdrone_mavros.plugins.waypoint import GeofencePlugin, RallypointPlugin, WaypointPlugin
from xtdrone_mavros.uas import Plugin

PLUGINS: tuple[type[Plugin], ...] = (
    SysStatusPlugin,
    SysTimePlugin,
    CommandPlugin,
    ParamPlugin,
    ImuPlugin,
    LocalPositionPlugin,
    GlobalPositionPlugin,
    HomePositionPlugin,
    AltitudePlugin,
    VfrHudPlugin,
    RcIoPlugin,
    SetpointRawPlugin,
    SetpointPositionPlugin,
    SetpointVelocityPlugin,
    SetpointAccelPlugin,
    SetpointAttitudePlugin,
    SetpointTrajectoryPlugin,
    TrajectoryPlugin,
    ManualControlPlugin,
    ActuatorControlPlugin,
    WaypointPlugin,
    GeofencePlugin,
    RallypointPlugin,
    VisionPosePlugin,
    MocapPlugin,
    OdometryPlugin,
    MountControlPlugin,
    CamImuSyncPlugin,
    CameraPlugin,
    DebugValuePlugin,
    DistanceSensorPlugin,
    EscStatusPlugin,
    FakeGpsPlugin,
    GpsRtkPlugin,
    LandingTargetPlugin,
    ObstacleDistancePlugin,
    Px4FlowPlugin,
    VisionSpeedPlugin,
    *PASSED_ON,
    FtpPlugin,
    LogTransferPlugin,
    MavlinkBridge,
    DiagnosticsPlugin,
    SharedOriginPlugin,
)
