"""The MAVLink services of one vehicle, one module each."""

from __future__ import annotations

from xtdrone_control.mavlink.service import Service, Vehicle

from .command import CommandService
from .event import EventService
from .follow import FollowService
from .ftp import FtpService
from .gimbal import GimbalService
from .log import LogService
from .manual import ManualService
from .metadata import MetadataService
from .mission import MissionService
from .parameter import ParameterService
from .place import PlaceService
from .presence import PresenceService
from .setpoint import SetpointService
from .signing import SigningService
from .version import VersionService
from .vision import VisionService


def all_services(vehicle: Vehicle) -> list[Service]:
    """Return every service of ``vehicle``."""
    commands = CommandService(vehicle)
    return [
        PresenceService(vehicle),
        commands,
        SetpointService(vehicle),
        FollowService(vehicle),
        SigningService(vehicle),
        ManualService(vehicle),
        ParameterService(vehicle),
        MissionService(vehicle),
        PlaceService(vehicle, commands),
        LogService(vehicle),
        FtpService(vehicle),
        MetadataService(vehicle),
        VersionService(vehicle),
        EventService(vehicle),
        VisionService(vehicle),
        GimbalService(vehicle),
    ]
