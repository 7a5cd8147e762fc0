"""Vehicles of a fleet: names, models, MAVLink ids, UDP ports and start poses.

A fleet is described as ``"iris:9"`` or ``"iris:3,typhoon_h480:2"``, or by a fleet file.
"""

from .fleet_as_text import fleet_text, parse_fleet, place_ids, read_fleet_file, split_name, vehicle_named, with_ports
from .spawned_by_launch import SPAWNED, spawned_fleet, unused_ports
from .start_places import spawn_grid, start_pose, start_poses, with_poses
from .vehicle import (
    COMMAND_TOPICS,
    GCS_REMOTE_PORT,
    INSTANCE_STEP,
    MAX_INSTANCE,
    MAX_VEHICLES,
    OFFBOARD_PORTS,
    PX4,
    XTDRONE,
    FleetError,
    StartPose,
    Vehicle,
    check_instance,
    check_ports,
    instance_port,
)

__all__ = [
    "COMMAND_TOPICS",
    "GCS_REMOTE_PORT",
    "INSTANCE_STEP",
    "MAX_INSTANCE",
    "MAX_VEHICLES",
    "OFFBOARD_PORTS",
    "PX4",
    "SPAWNED",
    "XTDRONE",
    "FleetError",
    "StartPose",
    "Vehicle",
    "check_instance",
    "check_ports",
    "fleet_text",
    "instance_port",
    "parse_fleet",
    "place_ids",
    "read_fleet_file",
    "spawn_grid",
    "spawned_fleet",
    "split_name",
    "start_pose",
    "start_poses",
    "unused_ports",
    "vehicle_named",
    "with_ports",
    "with_poses",
]
