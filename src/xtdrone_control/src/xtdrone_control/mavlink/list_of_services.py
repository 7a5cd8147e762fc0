"""The MAVLink services of one vehicle, one module each."""

from __future__ import annotations

from xtdrone_control.mavlink.commands.command_service import CommandService
from xtdrone_control.mavlink.commands.external_sensors_service import VisionService
from xtdrone_control.mavlink.commands.follow_service import FollowService
from xtdrone_control.mavlink.commands.gimbal_service import GimbalService
from xtdrone_control.mavlink.commands.home_service import HomeService
from xtdrone_control.mavlink.commands.manual_service import ManualService
from xtdrone_control.mavlink.commands.setpoint_service import SetpointService
from xtdrone_control.mavlink.microservices.autopilot_version import VersionService
from xtdrone_control.mavlink.microservices.event import EventService
from xtdrone_control.mavlink.microservices.files_and_logs.ftp import FtpService
from xtdrone_control.mavlink.microservices.files_and_logs.log_download import LogService
from xtdrone_control.mavlink.microservices.files_and_logs.log_stream import LogStreamService
from xtdrone_control.mavlink.microservices.files_and_logs.metadata import MetadataService
from xtdrone_control.mavlink.microservices.heartbeat_ping_timesync import HeartbeatService
from xtdrone_control.mavlink.microservices.mission import MissionService
from xtdrone_control.mavlink.microservices.parameter import ParameterService
from xtdrone_control.mavlink.microservices.signing import SigningService
from xtdrone_control.mavlink.service_base import Service, Vehicle


def all_services(vehicle: Vehicle) -> list[Service]:
    """Return every service of ``vehicle``."""
    commands = CommandService(vehicle)
    return [
        HeartbeatService(vehicle),
        commands,
        SetpointService(vehicle),
        FollowService(vehicle),
        SigningService(vehicle),
        ManualService(vehicle),
        ParameterService(vehicle),
        MissionService(vehicle),
        HomeService(vehicle, commands),
        LogService(vehicle),
        LogStreamService(vehicle),
        FtpService(vehicle),
        MetadataService(vehicle),
        VersionService(vehicle),
        EventService(vehicle),
        VisionService(vehicle),
        GimbalService(vehicle),
    ]
